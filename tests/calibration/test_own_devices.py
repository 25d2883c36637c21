"""Kinds of devices from outside the package, those of scripts/examples: what the matrix of verbs does not look at."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import inclinometer
import laser_line
import pytest
import reading_bank
import torch
from inclinometer import Inclinometers
from kind_bank import kind_named, rigid_rms
from laser_line import Beams, readings
from product_bank import simulated_poses
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, MeasurementError
from diffeo_calib.measurements.csv.files import read_observations, write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.sensors.devices import Devices
from diffeo_calib.sensors.kinds import KINDS, kind_of, register

pytestmark = pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows


@pytest.fixture(autouse=True)
def registered() -> None:
    """The classes of these modules, also where another test ran an example as a program in this process."""
    KINDS.update({Beams.kind: Beams, Inclinometers.kind: Inclinometers})


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
    assert float(reading_bank.reading_errors(found, data).abs().median()) < 5e-5


def test_an_inclinometer_finds_how_it_is_mounted_and_makes_the_model_better() -> None:
    """Against the truth of the simulation, and a model of the poses alone."""
    kind = kind_named("inclinations")
    (own,) = kind.result.readings
    axes, up = own.devices.constants[0, :6].view(2, 3), own.devices.constants[0, 6:]
    frames = inclinometer.frames(simulated_poses(1)[0], kind.q(1))
    model, _ = kind.model.predict_poses(kind.q(1))
    mount = model[0, :3, :3].mT @ frames[0, :3, :3]  # the model's frame is that of the poses of the table
    assert_close(axes @ mount, inclinometer.AXES, rtol=0, atol=2e-3)
    assert_close(up, torch.nn.functional.normalize(inclinometer.UP, dim=0), rtol=0, atol=2e-3)
    assert float(own.known.max()) < 2e-3  # pyright: ignore
    alone = dc.calibrate(kind.robot, kind.data.parts[0], hyperparameters=kind.scales).model
    q = kind.q(100)
    assert kind.error_mm(kind.model(q), q) < kind.error_mm(alone(q), q)


def test_numbers_of_a_frame_have_their_own_noise_and_freedom() -> None:
    """Rows of the inclinometer: none of the shift, turn and slack of poses, two numbers."""
    data = kind_named("inclinations").result.placed.tangent_data()
    rows, noise = data.visible.sum(1) == 2, data.noise_model
    scales = replace(kind_named("inclinations").scales, other_noise=torch.tensor([3e-5], dtype=torch.float64))
    jacobian = data.jacobian[rows][:, :2]
    of_joints = jacobian * scales.joint_noise.square() @ jacobian.mT
    expected = of_joints + (3e-5**2 + noise.smallest_noise**2) * torch.eye(2, dtype=torch.float64)
    found = noise.covariance(scales, data.jacobian)
    assert_close(found[rows][:, :2, :2], expected)
    assert noise.freedom[rows].unique().tolist() == [2]  # pyright: ignore
    assert noise.freedom[~rows].unique().tolist() == [6]  # pyright: ignore
    errors = torch.diag_embed(1e-10 * data.visible.to(data.y))
    alone = torch.linalg.inv(expected).diagonal(dim1=1, dim2=2).sum(1) * 1e-10
    assert_close(noise.squares(found, errors)[rows, 0], alone)


def test_a_frame_is_seen_beside_poses_only() -> None:
    arm = simulated_poses(1)[0]
    seen, (q, points) = inclinometer.readings(arm, arm.sample(60)), arm.measure(20)
    marked = dc.Measurements(q, points[:, :1], arm.nominal.joint_names)
    for rows in (seen, dc.Observations.joined([marked, seen])):
        with pytest.raises(MeasurementError, match=r"inclination.*beside measured poses"):
            dc.calibrate(arm.nominal, rows)  # pyright: ignore
    with pytest.raises(InputError, match="poses"):
        dc.evaluate(kind_named("positions").model, seen)


def test_written_and_read_in_its_own_unit(arm: SimulatedArm, tmp_path: Path) -> None:
    q = arm.sample(8, seed=1)
    names, table = arm.nominal.joint_names, TableFormat("mm", "deg")
    angles = 0.1 * torch.arange(16.0, dtype=torch.float64).view(8, 2)
    turns = dc.Readings.of("tilt", q, angles, None, names, unit=("mrad", 1e3), std=1e-4, numbers=2)
    beams = readings(arm, q)
    for data, cell in ((turns, "1500."), (beams, f"{1e3 * float(beams.values[0]):.6f}"[:-2])):
        written = write_measurements(tmp_path / "t.csv", data, table)
        assert cell in (tmp_path / "t.csv").read_text()
        same: Any = read_observations(tmp_path / "t.csv", written)
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
