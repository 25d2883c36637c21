"""Reading a table that a test writes out as text."""

from pathlib import Path
from typing import Any

import pytest
from table_bank import JOINTS, POSITION, Reader

from diffeo_calib.measurements.csv.files import read_measurements
from diffeo_calib.measurements.table import Measurements


@pytest.fixture
def read(tmp_path: Path) -> Reader:
    """Write a text to table.csv and read it, by default as q1, q2, x, y, z in rad and m."""

    def read_text(text: str | bytes, joints: Any = JOINTS, position: Any = POSITION, **options: Any) -> Measurements:
        path = tmp_path / "table.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        arguments: dict[str, Any] = {"length": "m", "angle": "rad"} | options
        return read_measurements(path, joints, position, **arguments)

    return read_text
