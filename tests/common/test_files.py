"""Files that are written whole or not at all."""

import errno
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from diffeo_calib.common.errors import InputError
from diffeo_calib.common.files import WholeFile, check_writable, write_together, write_whole


def test_replaces_whole_files_and_keeps_permissions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"old")
    path.chmod(0o640)
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]
    done, fsync, replace = list[str](), os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda file: (done.append("fsync"), fsync(file)))
    monkeypatch.setattr(os, "replace", lambda *paths: (done.append("replace"), replace(*paths)))
    write_whole(tmp_path / "a", b"content")
    assert done == ["fsync", "replace"]


@pytest.mark.parametrize(("number", "written"), [(errno.EINVAL, True), (errno.ENOTSUP, True), (errno.EIO, False)])
def test_without_fsync_or_locks(number: int, written: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refused)
    monkeypatch.setattr("fcntl.flock", refused)
    path = tmp_path / "a"
    path.write_bytes(b"old")
    if written:
        write_whole(path, b"new")
    else:
        with pytest.raises(InputError, match="Input/output error"):
            write_whole(path, b"new")
    assert path.read_bytes() == (b"new" if written else b"old")
    assert names(tmp_path) == ["a"]


WRITER = """
import sys
from diffeo_calib.common.files import WholeFile
with WholeFile(sys.argv[1]) as file:
    file.write(b"half")
    print("begun", flush=True)
    sys.stdin.read()
"""


def begun(path: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-B", "-c", WRITER, str(path)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    return process


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_what_a_killed_writer_leaves_is_removed_by_the_next_one(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"old")
    others = ["a.csv.backup01.partly", "b.csv.abcdefgh.part", "a.csv.part", "a.csv.ABCDEFGH.part"]
    for name in others:
        (tmp_path / name).write_bytes(b"mine")
    with begun(path) as process:
        process.kill()
    assert len(names(tmp_path)) == len(others) + 2
    assert path.read_bytes() == b"old"
    write_whole(path, b"new")
    assert names(tmp_path) == sorted(["a.csv", *others])
    assert path.read_bytes() == b"new"


def test_a_living_writer_is_left_alone(tmp_path: Path) -> None:
    """Two processes write the same file: the last one to finish wins."""
    path = tmp_path / "a.csv"
    with begun(path) as process:
        write_whole(path, b"new")
        assert len(names(tmp_path)) == 2
        assert path.read_bytes() == b"new"
        process.communicate("")
    assert process.returncode == 0
    assert names(tmp_path) == ["a.csv"]
    assert path.read_bytes() == b"half"


def interrupted(file: WholeFile) -> None:
    file.write(b"half")
    raise KeyboardInterrupt


@pytest.mark.parametrize("old", [[], ["a.csv"]])
def test_ctrl_c_leaves_what_there_was(old: list[str], tmp_path: Path) -> None:
    for name in old:
        (tmp_path / name).write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), WholeFile(tmp_path / "a.csv") as file:
        interrupted(file)
    assert names(tmp_path) == old
    assert all((tmp_path / name).read_bytes() == b"old" for name in old)


def test_a_missing_folder_and_a_pipe(tmp_path: Path) -> None:
    paths = [tmp_path / "a.c", tmp_path / "a.h"]
    write_together(dict.fromkeys(paths, b"old"))
    with pytest.raises(InputError, match=r"none.*No such file or directory\); make its folder first"):
        write_together({paths[0]: b"new", tmp_path / "none" / "a.h": b"new"})
    assert [path.read_bytes() for path in paths] == [b"old", b"old"]
    assert names(tmp_path) == ["a.c", "a.h"]
    read, write = os.pipe()
    write_whole(f"/dev/fd/{write}", b"content")
    os.close(write)
    with os.fdopen(read, "rb") as file:
        assert file.read() == b"content"


@pytest.mark.parametrize("place", ["folder", "missing/a", "loop", "file/a", "c" * 300, "dangling"])
def test_places_that_cannot_be_written(place: str, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(b"old")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "dangling").symlink_to("missing/b")
    before = names(tmp_path)
    for action in (check_writable, lambda path: write_whole(path, b"new")):
        with pytest.raises(InputError, match=r"cannot be written \(.+\); "):
            action(tmp_path / place)
    assert names(tmp_path) == before
