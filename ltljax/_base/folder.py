"""A folder of results, in which ltljax replaces and removes only what it can prove to have written (host).

What enters: the folder, and the names and contents of results. What leaves: files, each whole or absent, or an
`OutputError` that names the file in the way.

Beside the results lies ``.ltljax/manifest.json``, which names every file that was written with the SHA-256 of its
content. Each file is entered in the manifest before it is moved into place, so that an interrupted program can prove
what it left behind. A file of the same name with another content belongs to somebody else. While a program writes, it
holds a lock on the folder; the operating system releases it when the program ends, however it ends.
"""

import contextlib
import errno
import hashlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

_OWN = ".ltljax"
_MANIFEST = f"{_OWN}/manifest.json"
_LOCK = f"{_OWN}/lock"
_COPIES = "inputs"
_VERSION = 1
# A folder that goes away while it is to be locked is made again so many times.
_TRIES = 100


class OutputError(ValueError):
    """Results that cannot be written where they were asked for."""


class Folder:
    """A folder, and what of it is ltljax's own.

    Args:
        path: the folder, which may be absent.

    Raises:
        OutputError: it is no folder, or its manifest was not written by ltljax or is damaged.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if self.path.exists() and not self.path.is_dir():
            raise OutputError(f"{self.path} is not a folder. Name another one.")
        self._lock = None
        self._read()

    def _read(self) -> None:
        self._files: dict[str, list[str]] = {}
        self._drafts: list[str] = []
        path = self.path / _MANIFEST
        if not os.path.lexists(path):
            return
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
            self._files = {str(name): [str(digest) for digest in digests] for name, digests in found["files"].items()}
            self._drafts = [str(name) for name in found["drafts"]]
            is_ours = found["ltljax"] == _VERSION
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise OutputError(f"{path} is damaged, or not written by ltljax. Name another folder.") from error
        leads_out = any(Path(name).is_absolute() or ".." in Path(name).parts for name in self._files)
        if not is_ours or leads_out or any(not _is_draft(name) for name in self._drafts):
            raise OutputError(f"{path} was not written by this version of ltljax. Name another folder.")

    def recorded(self) -> list[str]:
        """The names of the files that ltljax has written here, whatever has become of them."""
        return list(self._files)

    def owns(self, name: str) -> bool:
        """Whether ltljax has written a file, and nobody has changed it since."""
        path = self.path / name
        if name not in self._files or path.is_symlink() or not path.is_file():
            return False
        return _digest_of(path) in self._files[name]

    def check(self, names: Iterable[str], inputs: Iterable[Path] = ()) -> None:
        """Raise where one of these files is there and is not ltljax's own, or is one of the inputs.

        Args:
            names: relative to the folder.
            inputs: files that are read and must stay.

        Raises:
            OutputError: it names the file and what to do.
        """
        read = [file for file in inputs if file.exists()]
        for name in names:
            path = self.path / name
            for parent in reversed(path.relative_to(self.path).parents[:-1]):
                if os.path.lexists(self.path / parent) and not (self.path / parent).is_dir():
                    raise OutputError(f"{self.path / parent} is in the way of {path}. Name another folder.")
            if not os.path.lexists(path):
                continue
            if path.exists() and any(path.samefile(file) for file in read):
                raise OutputError(f"The results would replace {path}, which is read. Name another folder.")
            if not self.owns(name):
                raise OutputError(
                    f"The results would replace {path}, which ltljax did not write, or which has been changed since. "
                    "Move it, or name another folder."
                )

    @contextlib.contextmanager
    def locked(self, waits: bool = False) -> Iterator["Folder"]:
        """Lock the folder for the duration of the ``with`` block; it is created if absent.

        Args:
            waits: whether to wait for another program that holds it.

        Raises:
            OutputError: another program, or another thread of this one, is writing there.
        """
        with self._held_lock(waits) as file:
            self._lock = file
            try:
                self._read()
                for draft in self._drafts:
                    shutil.rmtree(self.path / _OWN / draft, ignore_errors=True)
                for path in (self.path / _OWN).iterdir():  # what a killed program left unfinished
                    if _UNFINISHED.fullmatch(path.name) and path.is_file():
                        path.unlink()
                self._note(self._files, [])
                yield self
            finally:
                self._lock = None

    def _held_lock(self, waits: bool) -> IO[Any]:
        """The file of the lock, open and locked."""
        for _ in range(_TRIES):
            try:
                (self.path / _OWN).mkdir(parents=True, exist_ok=True)
                # Opened for appending, so that somebody else's file of this name is not truncated.
                file = open(self.path / _LOCK, "ab")  # noqa: SIM115 (returned)
            except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
                raise OutputError(f"{error.filename} is in the way. Name another folder.") from error
            except FileNotFoundError:  # removed by the program that held it, with its folder
                continue
            except PermissionError as error:
                raise OutputError(f"{self.path} cannot be written to. Name another folder.") from error
            try:
                if not _lock(file, waits):
                    raise OutputError(
                        f"Another run is writing to {self.path}. Wait for its end, or name another folder."
                    )
                # The program that held it may have removed it, and another one have made a new one.
                if (self.path / _LOCK).exists() and os.path.samestat(
                    os.fstat(file.fileno()), os.stat(self.path / _LOCK)
                ):
                    return file
            except BaseException:
                file.close()
                raise
            file.close()
        raise OutputError(f"{self.path} cannot be made. Name another folder.")

    @contextlib.contextmanager
    def draft(self) -> Iterator[Path]:
        """A new folder to write into; if nothing fails, its contents are then moved into this one.

        Results that are there stay as they are until all new ones are complete, so that a full disk spoils none.

        Raises:
            OutputError: a file that is not ltljax's own is in the way.
        """
        name = f"draft-{secrets.token_hex(8)}"
        self._note(self._files, [*self._drafts, name])
        draft = self.path / _OWN / name
        draft.mkdir()
        try:
            yield draft
            self._put(draft)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
            self._note(self._files, [other for other in self._drafts if other != name])

    def _put(self, draft: Path) -> None:
        names = sorted(path.relative_to(draft).as_posix() for path in draft.rglob("*") if path.is_file())
        self.check(names)
        digests = {name: _digest_of(draft / name) for name in names}
        # Until a file is in its place, both the old content and the new one are ltljax's.
        both = {name: [*self._digest_there(name), digest] for name, digest in digests.items()}
        self._note(self._files | both, self._drafts)
        for name in names:
            (self.path / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(draft / name, self.path / name)
        self._note(self._files | {name: [digest] for name, digest in digests.items()}, self._drafts)

    def write(self, name: str, content: bytes) -> None:
        """Write one file, whole or not at all, and through to the disk.

        Raises:
            OutputError: a file that is not ltljax's own is in the way.
        """
        self.check([name])
        unfinished = self.path / _OWN / f"draft-{secrets.token_hex(8)}"
        both = [*self._digest_there(name), hashlib.sha256(content).hexdigest()]
        self._note(self._files | {name: both}, self._drafts)
        (self.path / name).parent.mkdir(parents=True, exist_ok=True)
        try:
            _write_through(unfinished, content)
            os.replace(unfinished, self.path / name)
        finally:
            unfinished.unlink(missing_ok=True)

    def _digest_there(self, name: str) -> list[str]:
        """The digest of a file that is there, which is known to be ltljax's own."""
        path = self.path / name
        return [_digest_of(path)] if path.exists() else []

    def remove(self, names: Iterable[str]) -> None:
        """Remove those of some files that are ltljax's own, and folders that this leaves empty."""
        names = list(names)
        for name in names:
            if self.owns(name):
                (self.path / name).unlink()
                for parent in (self.path / name).relative_to(self.path).parents[:-1]:
                    with contextlib.suppress(OSError):  # what is not empty stays
                        (self.path / parent).rmdir()
        self._note({name: kept for name, kept in self._files.items() if name not in names}, self._drafts)

    def remove_itself(self) -> None:
        """Remove everything ltljax wrote here, and the folder itself if it is then empty."""
        self.remove(list(self._files))
        (self.path / _MANIFEST).unlink()
        with contextlib.suppress(OSError):  # Windows removes no file that is open
            if (self.path / _LOCK).stat().st_size == 0:
                (self.path / _LOCK).unlink()
            (self.path / _OWN).rmdir()
            self.path.rmdir()

    def _note(self, files: Mapping[str, list[str]], drafts: list[str]) -> None:
        """Write the manifest."""
        if self._lock is None:
            raise RuntimeError("Lock the folder before writing to it.")
        text = json.dumps(dict(ltljax=_VERSION, files=dict(files), drafts=drafts), indent=1) + "\n"
        unfinished = self.path / _OWN / f"manifest-{secrets.token_hex(8)}"
        try:
            _write_through(unfinished, text.encode())
            os.replace(unfinished, self.path / _MANIFEST)
        finally:
            unfinished.unlink(missing_ok=True)
        self._files, self._drafts = dict(files), drafts

    def keep_inputs(self, draft: Path, files: Mapping[str, Path]) -> dict[str, str]:
        """Copy files that a run is made from into a draft; returns their names relative to the folder.

        Args:
            draft: as of `draft`.
            files: by the dotted key that names each, as ``{"mesh.file": Path("spot.obj")}``. Each goes into a folder of
                its own, so that equal names stay apart.
        """
        kept = copies(files)
        for key, file in files.items():
            target, name = draft / kept[key], self.path / kept[key]
            if name.exists() and name.samefile(file):  # what is read is the copy itself
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
        return kept


def copies(files: Mapping[str, Path]) -> dict[str, str]:
    """Where the copies of inputs lie: each in a folder named by the tables that name it."""
    return {key: "/".join([_COPIES, "-".join(key.split(".")[:-1]), file.name]) for key, file in files.items()}


def _is_draft(name: str) -> bool:
    return name.startswith("draft-") and name.removeprefix("draft-").isalnum()


def _digest_of(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write_through(path: Path, content: bytes) -> None:
    with open(path, "xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


# The names of single files that are being written.
_UNFINISHED = re.compile("(draft|manifest)-[0-9a-f]{16}")
# What the operating system answers where another program holds a lock.
_HELD = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)


def _lock(file: IO[Any], waits: bool) -> bool:
    """Take a lock that ends with this process or with the file's closing; whether it could be had.

    Raises:
        OutputError: the file system has no locks.
    """
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_LOCK if waits else msvcrt.LK_NBLCK, 1)  # type: ignore (Windows only)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | (0 if waits else fcntl.LOCK_NB))
    except OSError as error:
        if error.errno not in _HELD:
            raise OutputError(
                f"{file.name} cannot be locked ({error.strerror}). Name a folder on another disk."
            ) from error
        return False
    return True
