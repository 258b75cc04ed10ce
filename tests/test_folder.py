"""ltljax replaces and removes only its own files in a folder of results."""

import json
import subprocess
import sys
import threading

import pytest

from ltljax._base import owned_folder as folder_module
from ltljax._base.owned_folder import Folder, OutputError, copies


def written(path, **contents):
    with Folder(path).locked() as folder, folder.draft() as draft:
        for name, content in contents.items():
            (draft / name).write_text(content)
    return Folder(path)


def owned(folder):
    return [name for name in folder.recorded() if folder.owns(name)]


def tree(path):
    return {entry.relative_to(path).as_posix(): entry.read_bytes() for entry in path.rglob("*") if entry.is_file()}


def test_a_file_is_owned_until_it_changes(tmp_path):
    folder = written(tmp_path, a="1", b="2")
    assert sorted(owned(folder)) == ["a", "b"]
    written(tmp_path, a="3")
    assert (tmp_path / "a").read_text() == "3"
    (tmp_path / "a").write_text("mine")
    folder = Folder(tmp_path)
    assert owned(folder) == ["b"]
    with pytest.raises(OutputError, match=r"a, which ltljax did not write, or which has been changed"):
        written(tmp_path, a="4", b="5")
    assert (tmp_path / "a").read_text() == "mine"
    assert (tmp_path / "b").read_text() == "2"
    with folder.locked():
        folder.remove(["a", "b"])
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [".ltljax", "a"]


def test_an_empty_folder_is_removed_with_its_files(tmp_path):
    folder = written(tmp_path / "out", a="1")
    with folder.locked():
        folder.remove_itself()
    assert not (tmp_path / "out").exists()


def test_results_do_not_change_if_new_results_are_incomplete(tmp_path):
    folder = written(tmp_path, a="1", b="2")
    before = tree(tmp_path)

    def write_to_a_full_disk():
        with folder.locked(), folder.draft() as draft:
            (draft / "a").write_text("new")
            raise OSError("The disk is full.")

    with pytest.raises(OSError, match="full"):
        write_to_a_full_disk()
    assert tree(tmp_path) == before


@pytest.mark.parametrize("kind", ["file", "link", "folder"])
def test_files_links_and_folders_of_the_user_are_not_replaced(tmp_path, kind):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_text("mine")
    out = tmp_path / "out"
    out.mkdir()
    {
        "file": lambda: (out / "a").write_text("mine"),
        "link": lambda: (out / "a").symlink_to(elsewhere),
        "folder": lambda: (out / "a" / "b").mkdir(parents=True),
    }[kind]()
    with pytest.raises(OutputError, match="which ltljax did not write"):
        written(out, a="1")
    folder = Folder(out)
    with folder.locked():
        folder.remove(["a"])
    assert (out / "a").exists()
    assert elsewhere.read_text() == "mine"


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"files": {}}', '{"ltljax": 2, "files": {}, "drafts": []}', "[" * 9999]
)
def test_an_invalid_manifest_is_rejected_and_not_changed(tmp_path, content):
    (tmp_path / ".ltljax").mkdir()
    (tmp_path / ".ltljax" / "manifest.json").write_text(content)
    with pytest.raises(OutputError, match=r"manifest\.json"):
        Folder(tmp_path)
    assert (tmp_path / ".ltljax" / "manifest.json").read_text() == content


def test_a_draft_outside_the_folder_is_rejected(tmp_path):
    (tmp_path / "mine").mkdir()
    manifest = dict(ltljax=1, files={}, drafts=["../mine"])
    (tmp_path / ".ltljax").mkdir()
    (tmp_path / ".ltljax" / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(OutputError):
        Folder(tmp_path)
    assert (tmp_path / "mine").exists()


def test_one_program_writes_at_a_time_and_a_killed_program_releases_its_lock(tmp_path):
    code = (
        "import sys; from ltljax._base.owned_folder import Folder\n"
        "with Folder(sys.argv[1]).locked() as folder, folder.draft() as draft:\n"
        "    (draft / 'half').write_text('x'); print('locked', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "locked\n"
        with pytest.raises(OutputError, match="Another run is writing"):
            written(tmp_path, a="1")
        process.kill()
    written(tmp_path, a="1")
    assert sorted(tree(tmp_path)) == [".ltljax/lock", ".ltljax/manifest.json", "a"]


def test_waiting_threads_write_one_after_another(tmp_path):
    def write(name):
        folder = Folder(tmp_path)
        for count in range(10):
            with folder.locked(waits=True):
                folder.write(name, f"{count}".encode())

    threads = [threading.Thread(target=write, args=(f"{name}",)) for name in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(owned(Folder(tmp_path))) == [f"{name}" for name in range(8)]
    assert {(tmp_path / name).read_text() for name in owned(Folder(tmp_path))} == {"9"}


def test_inputs_are_not_replaced_and_their_copies_are_separate(tmp_path):
    mesh = tmp_path / "mesh.obj"
    mesh.write_text("v")
    folder = Folder(tmp_path)
    with pytest.raises(OutputError, match="which is read"):
        folder.check(["mesh.obj"], [mesh])
    files = {"mesh.file": mesh, "initial.u.file": mesh}
    assert copies(files) == {"mesh.file": "inputs/mesh/mesh.obj", "initial.u.file": "inputs/initial-u/mesh.obj"}
    with folder.locked(), folder.draft() as draft:
        folder.keep_inputs(draft, files)
    assert (tmp_path / "inputs/initial-u/mesh.obj").read_text() == "v"
    assert mesh.read_text() == "v"


def test_a_file_stays_owned_if_the_disk_is_full_twice(tmp_path, monkeypatch):
    folder = written(tmp_path, a="1")
    write_through = folder_module._write_through

    def full(path, content):
        if "manifest" not in path.name:
            raise OSError(28, "No space left on device")
        write_through(path, content)

    with folder.locked():
        monkeypatch.setattr(folder_module, "_write_through", full)
        for _ in range(2):
            with pytest.raises(OSError, match="No space"):
                folder.write("a", b"2")
        monkeypatch.setattr(folder_module, "_write_through", write_through)
        assert folder.owns("a")
        folder.write("a", b"3")
    assert (tmp_path / "a").read_text() == "3"


@pytest.mark.parametrize("name", ["../mine", "/etc/passwd"])
def test_a_manifest_with_files_outside_the_folder_is_rejected(tmp_path, name):
    (tmp_path / ".ltljax").mkdir()
    (tmp_path / ".ltljax" / "manifest.json").write_text(json.dumps(dict(ltljax=1, files={name: ["0"]}, drafts=[])))
    with pytest.raises(OutputError, match="was not written by this version"):
        Folder(tmp_path)


def test_the_error_names_a_file_in_the_way_of_the_lock(tmp_path):
    (tmp_path / ".ltljax").write_text("mine")
    with pytest.raises(OutputError, match=r"\.ltljax"):
        written(tmp_path, a="1")


def test_unfinished_files_of_a_killed_program_are_removed(tmp_path):
    written(tmp_path, a="1")
    for name in ("draft-0123456789abcdef", "manifest-0123456789abcdef", "mine"):
        (tmp_path / ".ltljax" / name).write_text("x")
    written(tmp_path, a="2")
    assert sorted(path.name for path in (tmp_path / ".ltljax").iterdir()) == ["lock", "manifest.json", "mine"]
