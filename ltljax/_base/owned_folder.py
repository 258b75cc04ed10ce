"""A folder of results, in which ltljax replaces and removes only the files that it wrote (host).

The file ``.ltljax/manifest.json`` in the folder lists every file that was written, with the SHA-256 digest of its
content. A file whose content does not match its digest belongs to the user. A file is added to the manifest before it
is moved into place, so that the files of an interrupted program are recognised too. Files are written completely or not
at all. While a program writes, it holds a lock on the folder, which the operating system releases when the program
ends.
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
# Number of attempts to lock a folder that another program removes at the same time.
_TRIES = 100


class OutputError(ValueError):
    """Raised if results cannot be written to the requested folder."""


class Folder:
    """A folder and the list of the files in it that ltljax wrote.

    Args:
        path: path of the folder, which need not exist.

    Raises:
        OutputError: the path is not a folder, or its manifest is damaged or was not written by ltljax.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if self.path.exists() and not self.path.is_dir():
            raise OutputError(f"{self.path} is not a folder. Choose another path.")
        self._lock = None
        self._read()

    def _read(self) -> None:
        self._files: dict[str, list[str]] = {}
        self._drafts: list[str] = []
        path = self.path / _MANIFEST
        if not os.path.lexists(path):
            return
        try:
            manifest = json.loads(path.read_text(encoding="utf-8"))
            files = manifest["files"].items()
            self._files = {str(name): [str(digest) for digest in digests] for name, digests in files}
            self._drafts = [str(name) for name in manifest["drafts"]]
            is_ours = manifest["ltljax"] == _VERSION
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise OutputError(f"{path} is damaged, or not written by ltljax. Choose another folder.") from error
        leaves_folder = any(Path(name).is_absolute() or ".." in Path(name).parts for name in self._files)
        if not is_ours or leaves_folder or any(not _is_draft(name) for name in self._drafts):
            raise OutputError(f"{path} was not written by this version of ltljax. Choose another folder.")

    def recorded(self) -> list[str]:
        """The names of all files in the manifest, including files that were changed or removed since."""
        return list(self._files)

    def owns(self, name: str) -> bool:
        """Whether ltljax wrote the file and it has not been changed since."""
        path = self.path / name
        if name not in self._files or path.is_symlink() or not path.is_file():
            return False
        return _digest_of(path) in self._files[name]

    def check(self, names: Iterable[str], inputs: Iterable[Path] = ()) -> None:
        """Raise if one of these files exists and was not written by ltljax, or is one of the inputs.

        Args:
            names: names of files relative to the folder.
            inputs: input files, which must not be replaced.

        Raises:
            OutputError: a file is in the way; the message names it.
        """
        existing_inputs = [file for file in inputs if file.exists()]
        for name in names:
            path = self.path / name
            for parent in reversed(path.relative_to(self.path).parents[:-1]):
                if os.path.lexists(self.path / parent) and not (self.path / parent).is_dir():
                    raise OutputError(f"{self.path / parent} is in the way of {path}. Choose another folder.")
            if not os.path.lexists(path):
                continue
            if path.exists() and any(path.samefile(file) for file in existing_inputs):
                raise OutputError(
                    f"The results would replace {path}, which is read by this run. Choose another folder."
                )
            if not self.owns(name):
                raise OutputError(
                    f"The results would replace {path}, which ltljax did not write, or which has been changed since. "
                    "Move it, or choose another folder."
                )

    @contextlib.contextmanager
    def locked(self, waits: bool = False) -> Iterator["Folder"]:
        """Lock the folder for the duration of the ``with`` block; it is created if it does not exist.

        Args:
            waits: whether to wait for a program that holds the lock.

        Raises:
            OutputError: another program or thread is writing to the folder.
        """
        with self._open_lock(waits) as file:
            self._lock = file
            try:
                self._read()
                for draft in self._drafts:
                    shutil.rmtree(self.path / _OWN / draft, ignore_errors=True)
                for path in (self.path / _OWN).iterdir():  # unfinished files of a killed program
                    if _UNFINISHED.fullmatch(path.name) and path.is_file():
                        path.unlink()
                self._note(self._files, [])
                yield self
            finally:
                self._lock = None

    def _open_lock(self, waits: bool) -> IO[Any]:
        """The lock file, open and locked."""
        for _ in range(_TRIES):
            try:
                (self.path / _OWN).mkdir(parents=True, exist_ok=True)
                # Opening for appending does not truncate a file of this name that the user made.
                file = open(self.path / _LOCK, "ab")  # noqa: SIM115 (returned)
            except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
                raise OutputError(f"{error.filename} is in the way. Choose another folder.") from error
            except FileNotFoundError:  # the program that held the lock has just removed the folder
                continue
            except PermissionError as error:
                raise OutputError(f"{self.path} cannot be written to. Choose another folder.") from error
            try:
                if not _lock(file, waits):
                    raise OutputError(
                        f"Another run is writing to {self.path}. Wait until it ends, or choose another folder."
                    )
                # The program that held the lock may have removed this file, and another program created a new one.
                if (self.path / _LOCK).exists() and os.path.samestat(
                    os.fstat(file.fileno()), os.stat(self.path / _LOCK)
                ):
                    return file
            except BaseException:
                file.close()
                raise
            file.close()
        raise OutputError(f"{self.path} cannot be created. Choose another folder.")

    @contextlib.contextmanager
    def draft(self) -> Iterator[Path]:
        """A new folder whose contents are moved into this folder when the ``with`` block ends without an exception.

        Existing results are not changed until all new results are complete, so that a full disk damages none of them.

        Raises:
            OutputError: a file that ltljax did not write is in the way.
        """
        name = f"draft-{secrets.token_hex(8)}"
        self._note(self._files, [*self._drafts, name])
        draft = self.path / _OWN / name
        draft.mkdir()
        try:
            yield draft
            self._move_into_place(draft)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
            self._note(self._files, [other for other in self._drafts if other != name])

    def _move_into_place(self, draft: Path) -> None:
        names = sorted(path.relative_to(draft).as_posix() for path in draft.rglob("*") if path.is_file())
        self.check(names)
        digests = {name: _digest_of(draft / name) for name in names}
        # Until a file is in place, both its old and its new content belong to ltljax.
        both = {name: [*self._current_digests(name), digest] for name, digest in digests.items()}
        self._note(self._files | both, self._drafts)
        for name in names:
            (self.path / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(draft / name, self.path / name)
        self._note(self._files | {name: [digest] for name, digest in digests.items()}, self._drafts)

    def write(self, name: str, content: bytes) -> None:
        """Write a file, completely or not at all, and wait until it is on the disk.

        Raises:
            OutputError: a file that ltljax did not write is in the way.
        """
        self.check([name])
        unfinished = self.path / _OWN / f"draft-{secrets.token_hex(8)}"
        both = [*self._current_digests(name), hashlib.sha256(content).hexdigest()]
        self._note(self._files | {name: both}, self._drafts)
        (self.path / name).parent.mkdir(parents=True, exist_ok=True)
        try:
            _write_through(unfinished, content)
            os.replace(unfinished, self.path / name)
        finally:
            unfinished.unlink(missing_ok=True)

    def _current_digests(self, name: str) -> list[str]:
        """The digest of an existing file of ltljax, or an empty list if there is no file."""
        path = self.path / name
        return [_digest_of(path)] if path.exists() else []

    def remove(self, names: Iterable[str]) -> None:
        """Remove the named files that ltljax wrote, and the folders that become empty."""
        names = list(names)
        for name in names:
            if self.owns(name):
                (self.path / name).unlink()
                for parent in (self.path / name).relative_to(self.path).parents[:-1]:
                    with contextlib.suppress(OSError):  # folders with other files stay
                        (self.path / parent).rmdir()
        self._note({name: digests for name, digests in self._files.items() if name not in names}, self._drafts)

    def remove_itself(self) -> None:
        """Remove everything that ltljax wrote, and the folder itself if it becomes empty."""
        self.remove(list(self._files))
        (self.path / _MANIFEST).unlink()
        with contextlib.suppress(OSError):  # Windows does not remove open files
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
        """Copy the input files of a run into a draft; returns their names relative to the folder.

        Args:
            draft: a folder from `draft`.
            files: input files by their keys in the scenario, such as ``{"mesh.file": Path("spot.obj")}``. Each copy is
                in a folder of its own, so that files may have equal names.
        """
        names = copies(files)
        for key, file in files.items():
            target, previous = draft / names[key], self.path / names[key]
            if previous.exists() and previous.samefile(file):  # the input is the copy itself
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
        return names


def copies(files: Mapping[str, Path]) -> dict[str, str]:
    """The names of the copies of input files, each in a folder named after the table of its key."""
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


# Names of files that are being written.
_UNFINISHED = re.compile("(draft|manifest)-[0-9a-f]{16}")
# Error codes of the operating system if another program holds a lock.
_HELD = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)


def _lock(file: IO[Any], waits: bool) -> bool:
    """Lock a file until it is closed or the process ends; returns whether the lock was free.

    Raises:
        OutputError: the file system does not support locks.
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
                f"{file.name} cannot be locked ({error.strerror}). Choose a folder on another disk."
            ) from error
        return False
    return True
