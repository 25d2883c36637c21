"""What takes seconds to make, such as fitted models: made by one process of a run, and read by all others."""

import os
import pickle
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from diffeo_calib.common.files import lock_file

T = TypeVar("T")
VARIABLE = "DIFFEO_CALIB_TEST_BANK"
"""Environment variable with the folder of a run, which its worker processes inherit."""


def begin() -> tempfile.TemporaryDirectory[str] | None:
    """A folder for this process and those that it starts, which lasts as long as the result; None if there is one."""
    if VARIABLE in os.environ:
        return None
    folder = tempfile.TemporaryDirectory(prefix="diffeo_calib_bank_")
    os.environ[VARIABLE] = folder.name
    return folder


def shared(name: str, make: Callable[[], T]) -> T:
    """What ``make`` returns, for the first process that asks for this name; copies of it for all others."""
    path = Path(os.environ[VARIABLE], name.replace(" ", "_")) if VARIABLE in os.environ else None
    if path is None:
        return make()
    with open(f"{path}.lock", "wb") as lock:
        lock_file(lock, wait=True)
        if path.exists():
            return pickle.loads(path.read_bytes())
        found = make()
        path.write_bytes(pickle.dumps(found))
    return found
