"""Fixtures that files share, and one thread for these small problems.

Waiting for a second thread costs more than it brings on a busy machine; it is set before torch and numpy are imported,
and for the processes that tests start. Calibrations cost seconds, so files share them.
"""

import os
import re

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else every process that a test starts compiles the package


import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import product_bank
import pytest
from command_bank import Command, leave_undrawn
from kind_bank import KINDS
from product_bank import Case, calibrated, ur10_measurements, ur10_scales, usual_scales, with_usual_scales
from shared_bank import begin, shared

import diffeo_calib as dc

BANK = begin()  # of this run


@pytest.fixture(scope="session")
def arm() -> Case:
    """The simulated arm, calibrated with 60 poses of one marker."""
    return shared("arm", lambda: calibrated(60))


@pytest.fixture(scope="session")
def pair() -> Case:
    """The simulated arm with two markers on its tool, 40 poses."""
    return shared("pair", lambda: calibrated(40, markers=2))


@pytest.fixture(scope="session")
def posed() -> Case:
    """The simulated arm, calibrated with 30 poses of a frame on its tool."""
    return shared("posed", lambda: product_bank.calibrated_poses(30))


@pytest.fixture(scope="session")
def slider() -> Case:
    """A robot with a prismatic joint, 50 poses."""
    robot = product_bank.sliding_robot()
    train, test = product_bank.erring(robot, 50), product_bank.erring(robot, 300, seed=1)
    scales = usual_scales(robot).inflated(2.0)
    return shared("slider", lambda: Case(robot, train, test, dc.calibrate(robot, train, hyperparameters=scales)))


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    return Command(capsys, monkeypatch)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without pictures, for tests that look at their text and numbers."""
    leave_undrawn(monkeypatch)


@pytest.fixture
def given_scales(monkeypatch: pytest.MonkeyPatch) -> None:
    """`fit` in this process with the usual scales, for tests that do not look at their choice."""
    monkeypatch.setattr("diffeo_calib.cli.commands.fit.calibrate", with_usual_scales)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium, where this machine has it."""
    playwright = pytest.importorskip("playwright.sync_api")
    names = "chromium", "chromium-browser", "google-chrome", "google-chrome-stable"
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip("no Chromium on this machine: apt install chromium")
    with playwright.sync_playwright() as running:
        root = hasattr(os, "geteuid") and os.geteuid() == 0  # Chromium's sandbox refuses root
        started = running.chromium.launch(executable_path=path, args=["--no-sandbox"] if root else [])
        yield started
        started.close()


BY_KIND = (
    *("test_matrix.py", "test_kinds_judged.py", "test_init.py", "test_live_campaign.py", "test_expected_errors.py"),
    *("test_registered_kinds.py", "test_laws_of_kinds.py", "test_golden.py"),
)
"""Files whose tests end in a kind of measurement. Those of one kind run in one process, which calibrates it once."""
LONGEST = (
    *BY_KIND,
    *("test_keops.py", "test_torch_program.py", "test_report.py", "test_registered.py", "test_recalibrate.py"),
    *("test_documentation.py", "test_outliers.py", "test_sockets.py", "test_rigid.py"),
    *("test_plan.py", "test_commands.py"),
    *("test_distributed.py", "test_evaluators.py", "test_readings.py", "test_tree_calibrations.py"),
    *("test_registration.py", "test_calibrate.py", "test_hardware.py", "test_unusual_data.py"),
    *("test_second_device.py", "test_fit.py"),
    *("test_examples.py", "test_calibrated.py", "test_correct_command.py", "test_set_ups.py"),
)
"""File names, those of a quarter of a minute and more; all others follow in the usual order."""


KIND = re.compile(rf"({'|'.join(BY_KIND)})::.*[-\[]({'|'.join(map(re.escape, KINDS))})\]$")


def scope(test: str) -> str:
    """What runs in one process: the tests of a file, or those of a kind."""
    found = KIND.search(test)
    return found[2] if found else test.partition("::")[0]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """``--dist loadfile``, but for the files of :data:`BY_KIND`."""
    from xdist.scheduler import LoadFileScheduling

    class ByKind(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return scope(nodeid)

    return ByKind(config, log) if config.getoption("dist") == "loadfile" else None


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """A process for each processor, at most 4, for the whole suite; for files and folders named, this one."""
    whole = [Path(argument).resolve() for argument in config.args] == [Path(__file__).parent]
    return min(4, os.cpu_count() or 1) if whole else 0


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first: no process is left alone with one of them in the end."""
    rank = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))
    allow_open_directions(items)


def allow_open_directions(items: list[pytest.Item]) -> None:
    """On the UR10 the tool's x axis is vertical in all poses, so that the place of the marker along it stays open."""
    vertical = r"ignore:the (place|turn) of the (marker|measured frame) on '\w+' (along|about) \(1.00, "
    for item in items:
        if "ur10_folder" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.filterwarnings(vertical))


@pytest.fixture(scope="session")
def ur10_folder() -> Path:
    """632 poses of a UR10, measured with a laser tracker."""
    folder = os.environ.get("DIFFEO_CALIB_DATA")
    if not folder or not (Path(folder) / "ipa_ur10").is_dir():
        pytest.skip("needs real measurements: set DIFFEO_CALIB_DATA to the folder that holds ipa_ur10/")
    return Path(folder) / "ipa_ur10"


@pytest.fixture(scope="session")
def ur10_150(ur10_folder: Path) -> Case:
    """That UR10, calibrated with 150 of 442 rows, the usual ones held out."""
    robot, data = ur10_measurements(ur10_folder)
    train, test = data.split(0.7, seed=0)
    some = train.rows(np.random.default_rng(0).permutation(len(train))[:150])
    some = dc.Measurements(some.q, some.points)
    return shared("ur10 150", lambda: Case(robot, some, test, dc.calibrate(robot, some, hyperparameters=ur10_scales())))
