"""Where compiled kernel sums are kept: in a folder that only the user can write to, since they are executed."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import stat
import tempfile
import warnings
from functools import cache
from pathlib import Path

from diffeo_calib.common.errors import DiffeoCalibWarning, sentence


def cache_folder(name: str) -> Path:
    """A folder of this name in the user's cache, made if there is none: the code in it is executed.

    Where it cannot be made, or others may write to it or have written there, one of this process, with one warning.
    """
    base = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):
        base = os.path.expanduser("~/.cache") if os.environ.get("HOME") != "" else ""
    return (_kept_folder(base, name) if os.path.isabs(base) else None) or _passing_folder(base)


@cache
def _kept_folder(base: str, name: str) -> Path | None:
    """The folder, without links, if nobody else can write to it, has written there or can put another in its place."""
    folder = Path(base, "diffeo_calib", name)
    try:
        for part in (folder.parents[1], folder.parent, folder):
            part.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder = folder.resolve()
        if hasattr(os, "getuid"):  # not on Windows, where the home folders are private
            me, ours = os.getuid(), folder.stat()
            for status in (*map(os.stat, folder.parents), ours):
                sticky = status.st_mode & stat.S_ISVTX and status is not ours  # only its owner renames what lies there
                if status.st_uid not in {0, me} or (status.st_mode & 0o022 and not sticky):
                    return None
            for entry in folder.rglob("*"):
                with contextlib.suppress(FileNotFoundError):  # another process has finished with it
                    if entry.lstat().st_uid != me:
                        return None
            folder.chmod(0o700)  # whatever the mode of the files that KeOps will make
    except OSError:
        return None
    return folder


@cache
def _passing_folder(base: str) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="diffeo_calib-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    place = Path(base, "diffeo_calib")
    what = f"compiled kernel sums are kept for this run only: '{place}' is no folder that you alone can write to"
    text = sentence(what, fix="remove it, or name a folder of yours in the variable XDG_CACHE_HOME")
    warnings.warn(text, DiffeoCalibWarning, stacklevel=2)  # not warn_user: models do not record it
    return folder
