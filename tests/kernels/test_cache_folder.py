"""Compiled sums are executed: they are kept where nobody but the user can write, or for this process only."""

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from diffeo_calib.common.errors import DiffeoCalibWarning
from diffeo_calib.kernels.reductions import cache_folder

pytestmark = pytest.mark.skipif(not hasattr(os, "getuid"), reason="home folders are private here")
as_root = pytest.mark.skipif(hasattr(os, "getuid") and os.getuid() != 0, reason="needs files of another user")
NAME, STRANGER = "fused", 54321


@pytest.fixture(autouse=True)
def _new(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    _forget()
    yield
    _forget()


def _forget() -> None:
    for function in (cache_folder._kept_folder, cache_folder._passing_folder):
        function.cache_clear()


def kept(folder: Path) -> Path:
    """The usual folder in a cache, made by an earlier process."""
    own = folder / "diffeo_calib" / NAME
    own.mkdir(parents=True)
    (own / "code").write_bytes(b"compiled")
    return own


def passing(place: Path | str) -> None:
    with pytest.warns(DiffeoCalibWarning, match="for this run only: '[^']*diffeo_calib' is no folder") as caught:
        found = cache_folder.cache_folder(NAME)
    assert len(caught) == 1
    assert str(place) in str(caught[0].message)
    assert not list(found.iterdir())
    assert stat.S_IMODE(found.stat().st_mode) == 0o700
    assert cache_folder.cache_folder(NAME) == found  # without a warning


def test_the_users_folder_is_used_and_closed_to_others(tmp_path: Path) -> None:
    own = kept(tmp_path / "cache")
    own.chmod(0o755)
    assert cache_folder.cache_folder(NAME) == own
    assert stat.S_IMODE(own.stat().st_mode) == 0o700


def _link(own: Path, mode: int) -> None:
    """A link in place of a folder."""
    elsewhere = own.with_name("elsewhere")
    own.rename(elsewhere)
    own.symlink_to(elsewhere)
    elsewhere.chmod(mode)


UNSAFE: dict[str, Callable[[Path], object]] = {
    "writable by the group": lambda own: own.chmod(0o775),
    "writable by all": lambda own: own.chmod(0o777),
    "writable by all, sticky": lambda own: own.chmod(0o1777),
    "a folder above it writable by the group": lambda own: own.parent.chmod(0o770),
    "the cache writable by all": lambda own: own.parents[1].chmod(0o777),
    "a link to a writable folder": lambda own: _link(own, 0o777),
}
FOREIGN: dict[str, Callable[[Path], object]] = {
    "a file": lambda own: os.chown(own / "code", STRANGER, -1),
    "the folder": lambda own: os.chown(own, STRANGER, -1),
    "a folder above it": lambda own: os.chown(own.parent, STRANGER, -1),
    "the cache": lambda own: os.chown(own.parents[1], STRANGER, -1),
}
SAFE: dict[str, Callable[[Path], object]] = {
    "a shared folder that keeps files of their owners": lambda own: own.parents[1].chmod(0o1777),
    "a link to the cache": lambda own: _link(own.parents[1], 0o755),
}


@pytest.mark.parametrize("case", [*UNSAFE, *(pytest.param(case, marks=as_root) for case in FOREIGN)])
def test_a_folder_that_others_can_write_to_or_own_is_not_used(case: str, tmp_path: Path) -> None:
    (UNSAFE | FOREIGN)[case](kept(tmp_path / "cache"))
    passing(tmp_path)


@pytest.mark.parametrize("case", SAFE)
def test_a_folder_that_nobody_else_can_replace_is_used(case: str, tmp_path: Path) -> None:
    own = kept(tmp_path / "cache")
    SAFE[case](own)
    assert cache_folder.cache_folder(NAME) == own.resolve()


@pytest.mark.parametrize("home", ["", "relative"])
def test_without_a_home(home: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", home)
    monkeypatch.setenv("XDG_CACHE_HOME", "relative too")
    passing("diffeo_calib")
    assert list(tmp_path.iterdir()) == []
