"""A kind of device from outside the package, that of scripts/examples/laser_line.py: fitted, judged, written, read."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import reading_bank
import torch
from kind_bank import rigid_rms
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.planning.sensors import sensor_of
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.measurements.csv.files import read_observations, write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.sensors.devices import Devices
from diffeo_calib.sensors.kinds import KINDS, kind_of, register

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts" / "examples"))
import laser_line
from laser_line import Beams, readings

pytestmark = pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows


@pytest.fixture(autouse=True)
def registered() -> None:
    """The class of this module, also where another test ran the example as a program in this process."""
    KINDS[Beams.kind] = Beams


@pytest.fixture(scope="module")
def arm() -> SimulatedArm:
    return SimulatedArm(seed=0, markers=2)


@pytest.fixture(scope="module")
def rows(arm: SimulatedArm) -> dc.Observations:
    q, points = arm.measure(20, seed=5)
    tracked = dc.Measurements(q, points[:, 1:], arm.nominal.joint_names)
    return dc.Observations.joined([tracked, readings(arm, arm.sample(60, seed=6))])


@pytest.fixture(scope="module")
def result(arm: SimulatedArm, rows: dc.Observations) -> Any:
    return dc.calibrate(arm.nominal, rows, hyperparameters=reading_bank.scales())  # pyright: ignore


def test_slopes_are_derivatives_and_devices_are_found(arm: SimulatedArm) -> None:
    q = arm.sample(60, seed=6)
    data, z = readings(arm, q), reading_bank.in_base(arm, q)
    found = Beams.at(data, z).refined(data, z)
    assert float(found.errors(data, z).abs().max()) < 1e-4
    assert_close(found.constants[:, 3:].abs(), laser_line.DIRECTIONS, rtol=0, atol=1e-4)
    seen = found.observation(found.numbers(data))
    slope = torch.func.jacrev(lambda p: seen.value(p).sum(0))(z)[0]
    assert_close(seen.slope(z)[:, 0], slope)
    for increment in range(4):
        step = torch.zeros(2, 4, dtype=torch.float64)
        step[:, increment] = 1e-6
        ahead, behind = (found.moved(s).observation(data.device).value(z) for s in (step, -step))
        assert_close((ahead - behind) / 2e-6, seen.by_constants(z)[..., increment], rtol=0, atol=1e-8)


def test_beside_positions_it_makes_the_model_better(arm: SimulatedArm, rows: dc.Observations, result: Any) -> None:
    q = arm.sample(100, seed=9)
    truth = arm.true_points(q)[:, [1, 0]]
    error = rigid_rms(result.model(q).detach(), truth)
    alone = dc.calibrate(arm.nominal, rows.parts[0], hyperparameters=reading_bank.scales()).model
    assert error < 0.7 * rigid_rms(alone(q).detach(), truth[:, :1])
    assert error < 2 * result.expected.workspace
    assert "beam 'A' in the measuring frame through" in result.placement.sentences()[0]
    assert set(result.placement.entry()["devices"]["constants"]) == {"A", "B"}


def test_alone_it_calibrates_the_robot(arm: SimulatedArm) -> None:
    data = readings(arm, arm.sample(100, seed=6))
    found: Any = dc.calibrate(arm.nominal, data, hyperparameters=reading_bank.scales())
    q = arm.sample(100, seed=9)
    assert rigid_rms(found.model(q).detach(), arm.true_points(q)[:, :1]) < 2 * found.expected.workspace
    assert float(found.reading_errors(data)[1].abs().median()) < 5e-5


def test_new_readings_are_judged_and_predicted(arm: SimulatedArm, result: Any, tmp_path: Path) -> None:
    new = readings(arm, arm.sample(30, seed=7))
    found: Any = dc.evaluate(result.model, new)
    assert 1e-5 < found.rms < 3e-4
    dc.save(result.model, tmp_path / "m.safetensors")
    model: Any = dc.load(tmp_path / "m.safetensors")
    assert_close(dc.evaluate(model, new).rms, found.rms)  # pyright: ignore
    assert model.predict(new.q)[0].shape == (30, 2, 3)


def test_poses_are_planned_for_it(arm: SimulatedArm, result: Any) -> None:
    """A fixed point has as many unknowns; slopes tell them apart."""
    sensors = sensor_of(result.model)
    beams: Any = sensors[1:]
    assert [type(one.devices) for one in beams] == [Beams, Beams]
    known = result.readings[0].devices.constants
    for own in (one.devices.constants[0] for one in beams):
        alike = torch.linalg.cross(known[:, 3:], own[3:].expand(2, 3)).norm(dim=1)
        assert float(alike.min()) < 1e-3
        point, direction = known[int(alike.argmin())].split(3)
        assert float(torch.linalg.cross(own[:3] - point, direction, dim=0).norm()) < 3e-3
    plan = dc.plan(result.model, arm.sample(40, seed=3), 3)
    assert float(plan.expected_rms[-1]) < float(plan.expected_rms[0])


def test_written_and_read_in_its_own_unit(arm: SimulatedArm, tmp_path: Path) -> None:
    q = arm.sample(8, seed=1)
    names, table = arm.nominal.joint_names, TableFormat("mm", "deg")
    angles = 0.1 * torch.arange(16.0, dtype=torch.float64).view(8, 2)
    turns = dc.Readings.of("tilt", q, angles, None, names, unit=("mrad", 1e3), std=1e-4, numbers=2)
    beams = readings(arm, q)
    for data, cell in ((turns, "1500."), (beams, f"{1e3 * float(beams.values[0]):.6f}"[:-2])):
        columns, written = write_measurements(tmp_path / "t.csv", data, table)
        assert cell in (tmp_path / "t.csv").read_text()
        same: Any = read_observations(tmp_path / "t.csv", columns, written)
        assert (same.kind, same.unit, same.device_names) == (data.kind, data.unit, data.device_names)
        assert_close(same.values, data.values, rtol=0, atol=1e-12)
        assert (same.std is None) == (data.std is None)
    assert "mm" in beams.unit
    assert "rad" in turns._repr_html_()
    assert list(turns.to_frame().columns)[6:8] == ["tilt 1", "tilt 2"]
    whole = dc.Observations.joined([turns, beams])
    assert whole.kinds[0] == "tilt"
    assert whole.without_device
    with pytest.raises(MeasurementError, match=r"'tilt'.*register"):
        dc.calibrate(arm.nominal, dc.Readings.of("tilt", arm.sample(60), 0.1, None, names))


def test_kinds_are_registered_once() -> None:
    assert kind_of(dc.Readings.of("line distance", torch.zeros(3, 2), 1.0, doubt=False)) is Beams
    assert register(Beams) is Beams
    for wrong in (Devices, dc.Readings, Beams(("A",), torch.zeros(1, 6), torch.zeros(4))):
        with pytest.raises(InputError, match="subclass of Devices"):
            register(wrong)  # pyright: ignore
    other = type("Other", (Beams,), {"kind": "height"})
    with pytest.raises(InputError, match="height"):
        register(other)
    assert KINDS["height"] is not other
