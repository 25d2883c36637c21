"""A calibration under another default device and type: every tensor states its own, so that the results are the same.

Any operation that mixes the "meta" device, whose tensors hold no values, with real ones fails.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
import torch
from product_bank import simulated, simulated_poses
from tangent_bank import Setting, normal
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.choose_scales import choose_scales
from diffeo_calib.calibration.diagnostics.likely_mistakes import likely_mistake
from diffeo_calib.calibration.diagnostics.moved_devices import change_row, changes_of, findings
from diffeo_calib.calibration.diagnostics.plausibility import check_identification, check_joints, check_limits
from diffeo_calib.calibration.identification.identification import Prior, identify
from diffeo_calib.calibration.identification.registration import (
    find_joint_offsets,
    register,
    register_robustly,
    with_joint_offsets,
)
from diffeo_calib.calibration.scales.leave_one_out import estimate_tails, leave_one_out
from diffeo_calib.calibration.scales.noise_model import NoiseModel
from diffeo_calib.calibration.scales.selection import SearchLimits, defaults, log_posterior, select
from diffeo_calib.process.tails import Tails, reweight

pytestmark = pytest.mark.slow  # several calibrations

POINTS, POSES = "points", "poses"


@contextmanager
def elsewhere() -> Iterator[None]:
    """Tensors are made on the meta device and in half precision, unless they state theirs."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float16)
    try:
        with torch.device("meta"):
            yield
    finally:
        torch.set_default_dtype(before)


class Measured(Setting):
    """A small simulated arm, and its measurements after the geometric calibration."""

    def __init__(self, kind: str) -> None:
        arm, self.data, _ = simulated(16, markers=2) if kind == POINTS else simulated_poses(16)
        self.robot = arm.nominal
        super().__init__(arm.nominal, self.data)


@pytest.fixture(scope="module", params=[POINTS, POSES])
def measured(request: pytest.FixtureRequest) -> Measured:
    return Measured(request.param)


def tensors(found: Any) -> dict[str, Any]:
    """Everything in a result, by name."""
    if isinstance(found, Tensor | float | int | str | bool | type(None)):
        return {"": found}
    parts = dict(enumerate(found)) if isinstance(found, list | tuple) else vars(found)
    return {f"{name}.{inner}": value for name, part in parts.items() for inner, value in tensors(part).items()}


def same(work: Callable[[], Any]) -> None:
    """The work has the same results, bit by bit, whatever the default device is."""
    expected = tensors(work())
    with elsewhere():
        found = tensors(work())
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if isinstance(value, Tensor):
            assert_close(found[name], value, rtol=0, atol=0, msg=name)
        else:
            assert found[name] == value, name


def test_the_meta_device_would_be_noticed() -> None:
    with elsewhere(), pytest.raises((RuntimeError, NotImplementedError)):
        normal(3, seed=0).add(torch.zeros(3))


def test_registration(measured: Measured) -> None:
    robot, data = measured.robot, measured.data
    same(lambda: register(robot, data.q, data.points).geometry.tool)
    same(lambda: (register_robustly(robot, data).covariance, register_robustly(robot, data).status))


def test_robust_registration_with_outliers_and_offsets(measured: Measured) -> None:
    robot, q, points = measured.robot, measured.data.q.clone(), measured.data.points.clone()
    points[3] += 0.5
    q[:, 2] += 0.2
    wrong = dc.Measurements(q, points)

    def work() -> list[Tensor]:
        with pytest.warns(dc.DiffeoCalibWarning, match="joint offsets are far"):
            found = register_robustly(robot, wrong)
        return [found.geometry.base, found.geometry.joint_errors]

    same(work)


def test_joint_offsets(measured: Measured) -> None:
    data, geometry = measured.data, measured.nominal.geometry
    same(lambda: find_joint_offsets(geometry, data.q, data.points))
    offsets = 0.1 * normal(6, seed=1)
    same(lambda: with_joint_offsets(geometry, offsets).joint_errors)


@pytest.mark.parametrize("noise", [None, 1e-4])
def test_identification(noise: float | None, measured: Measured) -> None:
    data, geometry = measured.data, measured.nominal.geometry

    def work() -> list[Any]:
        found = identify(geometry, data.q, data.points, noise)
        return [found.theta, found.covariance, found.noise, found.tails, found.prior, found.geometry.joint_errors]

    same(work)
    same(lambda: Prior().deviations(geometry))


def test_diagnostics(measured: Measured) -> None:
    robot, data = measured.robot, measured.data
    wrong = dc.Measurements(data.q[:, [1, 0, 2, 3, 4, 5]], data.points)

    def work() -> str:
        check_joints(robot, data)
        check_limits(robot, data)
        check_identification(data, measured.identification)
        return likely_mistake(robot, wrong, 0.3)

    same(work)


def test_student_t() -> None:
    squares = normal(20, 2, seed=3).square()
    same(lambda: reweight(squares, 3))
    same(lambda: Tails.none(3, 2))


def test_tangent_data(measured: Measured) -> None:
    """With fresh objects: nothing is computed beforehand."""
    scales, sensor = measured.scales, measured.tangent_data.noise_model
    errors = normal(*measured.tangent_data.y.shape, seed=4)
    moments = errors[:, :, None] * errors[:, None]

    def work() -> list[Any]:
        data = replace(measured.tangent_data)
        rows, some = data.sample(10, 900, 5)
        process, values = data.process(scales), data.pairs.values(scales)
        inner = data.pairs.inner(values, process.inverse)
        found = [process.mu, process.evidence, process.estimate, process.covariance, process.inverse, inner]
        return [rows, some.target, *found, sensor.squares(data.noise(scales), moments)]

    same(work)
    same(lambda: NoiseModel.of(measured.data, 1e-4).covariance(scales, measured.tangent_data.jacobian))


def test_scales(measured: Measured) -> None:
    data, identification = measured.tangent_data, measured.identification
    same(lambda: defaults(replace(data), identification.noise, identification.prior).logarithms())
    scales = measured.scales

    def work() -> list[Any]:
        derived = [scales.inflated(1.5), scales.supported(data.jacobian, data.noise(scales))]
        return [scales.amplitudes(), scales.prior_variance(data.nominal), *(vars(s) for s in derived)]

    same(lambda: [part if isinstance(part, Tensor) else list(part.values()) for part in work()])


def test_selection(measured: Measured) -> None:
    data, scales = measured.tangent_data, measured.scales
    limits = SearchLimits(iterations=2, fewest_first=2, most_first=2)
    same(lambda: log_posterior(scales.logarithms(), scales, data))
    same(lambda: select(scales, data, limits=limits))


def test_tails_and_leave_one_out(measured: Measured) -> None:
    data, scales = measured.tangent_data, measured.scales
    same(lambda: estimate_tails(data, scales, block_coordinates=60))
    same(lambda: leave_one_out(data, scales, block_coordinates=60))


def test_change_points(measured: Measured) -> None:
    data, scales = measured.tangent_data, measured.scales
    effects, order = normal(16, data.y.shape[1], 4, seed=6), torch.arange(16)
    same(lambda: [change_row(effects, data.process(scales), order)])
    same(lambda: [one.size for one in findings(changes_of(data), data.process(scales), order)])


def test_the_choice_of_scales(measured: Measured) -> None:
    """Given ones: the weights and the errors that follow."""
    found = measured.identification
    given = measured.scales

    def work() -> list[Any]:
        chosen = choose_scales(replace(measured.tangent_data), measured.data, found, found, given=given)
        return [chosen.left_out, chosen.data.tails]

    same(work)


def test_a_calibration() -> None:
    arm, train, test = simulated(16)

    def work() -> list[Any]:
        result = dc.calibrate(arm.nominal, train)
        return [
            result.model(test.q),
            *result.model.predict(test.q[:5]),
            result.status,
            list(result.model.report.items()),
        ]

    same(work)
