"""A small model and its file, shared by the tests of model files."""

from pathlib import Path

import pytest
from model_file_bank import Editor
from product_bank import simulated

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibWarning


@pytest.fixture(scope="session")
def small() -> dc.CalibratedKinematics:
    """A model of nine poses, whose file is short enough to test damage all over it."""
    arm, train, _ = simulated(9)
    with pytest.warns(DiffeoCalibWarning, match="9 poses are too few"):
        return dc.calibrate(arm.nominal, train).model


@pytest.fixture(scope="session")
def sound(small: dc.CalibratedKinematics, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    dc.save(small, path)
    return path.read_bytes()


@pytest.fixture
def editor(sound: bytes, tmp_path: Path) -> Editor:
    return Editor(sound, tmp_path)
