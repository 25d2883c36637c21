"""Where compiled kernel sums are kept."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder(name: str) -> Path:
    """A folder of this name in the user's cache, made if there is none."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = base / "diffeo_calib" / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder
