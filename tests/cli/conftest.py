"""The command line in this process, and one robot with its table and its fitted model for all files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from command_bank import Outcome, Site, make_site, run_process
from server_bank import Server

import diffeo_calib as dc


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """40 rows of one marker."""
    return make_site(tmp_path_factory.mktemp("site"), rows=40)


@pytest.fixture(scope="session")
def fitted(site: Site) -> Outcome:
    """One real fit in a process of its own, with its model and its figure."""
    return run_process(*site.fit(site.csv, site.folder / "model.safetensors", "--figure", site.folder / "errors.png"))


@pytest.fixture(scope="session")
def model(fitted: Outcome, site: Site) -> dc.CalibratedKinematics:
    assert fitted.code == 0
    loaded = dc.load(site.folder / "model.safetensors")
    assert isinstance(loaded, dc.CalibratedKinematics)
    return loaded


@pytest.fixture(scope="session")
def small_site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    """30 rows, for tests of wrong input."""
    return make_site(tmp_path_factory.mktemp("small_site"), rows=30)


@pytest.fixture(scope="session")
def sound(small_site: Site) -> bytes:
    """A model file of the small site."""
    path = small_site.folder / "sound.safetensors"
    with pytest.warns(dc.DiffeoCalibWarning, match="10 poses are too few"):
        dc.save(dc.calibrate(small_site.arm.nominal, small_site.data.rows(slice(10))).model, path)
    return path.read_bytes()


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Commands in processes of their own."""
    with Server(tmp_path_factory.mktemp("printed")) as running:
        yield running


@pytest.fixture(scope="session")
def sound_path(small_site: Site, sound: bytes) -> Path:
    """The model file of the small site."""
    assert sound
    return small_site.folder / "sound.safetensors"
