"""The command line in this process, and one robot with its table and its fitted model for all files."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from command_bank import NOTE, Command, Outcome, Site, make_site, run_process
from commanded_bank import write_columns
from init_bank import ARM, NAMES, ROWS, Proposed
from shared_bank import shared
from torch import Tensor

import diffeo_calib as dc

NEWTON_STEPS = 20
"""About ten are usual, those of readings that are wrong never end."""

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return make_site(tmp_path_factory.mktemp("site"), rows=40)


@pytest.fixture(scope="session")
def fitted(site: Site) -> Outcome:
    """One real fit in a process of its own, with its model."""
    path = site.folder / "model.safetensors"

    def make() -> tuple[Outcome, bytes]:
        done = run_process(*site.fit(site.csv, path, "--note", NOTE))
        return done, path.read_bytes()

    done, content = shared("fitted site", make)
    path.write_bytes(content)
    return done


@pytest.fixture(scope="session")
def model(fitted: Outcome, site: Site) -> dc.CalibratedKinematics:
    assert fitted.code == 0
    loaded = dc.load(site.folder / "model.safetensors")
    assert isinstance(loaded, dc.CalibratedKinematics)
    return loaded


@pytest.fixture(scope="session")
def small_site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return make_site(tmp_path_factory.mktemp("small_site"), rows=30)


@pytest.fixture(scope="session")
def sound_path(small_site: Site, sound: bytes) -> Path:
    path = small_site.folder / "sound.safetensors"
    path.write_bytes(sound)
    return path


@pytest.fixture
def init(command: Command, tmp_path: Path) -> Callable[..., tuple[dict[str, Any], str]]:
    """The campaign that `init` writes for a table and a robot: its entries, and its text with the remarks.

    Of a table that it refuses no entries, and the message. With fewer steps for rows that belong to no robot.
    """
    command.monkeypatch.setattr("diffeo_calib.robots.placement.MAX_ITERATIONS", NEWTON_STEPS)

    def proposed(*words: object, name: str = "c.toml") -> tuple[dict[str, Any], str]:
        (tmp_path / name).unlink(missing_ok=True)
        done = command("init", *words, "-o", tmp_path / name)
        text = done.error if done.code else (tmp_path / name).read_text(encoding="utf-8")
        return {} if done.code else tomllib.loads(text), text

    return proposed


@pytest.fixture
def proposed(tmp_path: Path, init: Proposed) -> Proposed:
    """What `init` proposes for columns of some names and numbers, and a robot: its entries, and its text."""

    def propose(*columns: tuple[Sequence[str], Tensor], robot: str = "arm.urdf") -> tuple[dict[str, Any], str]:
        if not (tmp_path / robot).exists():
            ARM.write_urdf(tmp_path / robot)
        table = write_columns(tmp_path / "t.csv", **{"|".join(names): values for names, values in columns})
        return init(table, tmp_path / robot)

    return propose


@pytest.fixture
def frame(tmp_path: Path) -> Any:
    """A table of the arm as a data frame, m and rad, beside its URDF."""
    ARM.write_urdf(tmp_path / "arm.urdf")
    return dc.Measurements(*ARM.measure(ROWS, seed=0), NAMES).to_frame()
