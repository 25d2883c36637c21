"""Lengths: the robot and its links against their description, the device's scale, and what a device is said to hold.

Errors of links and a wrong scale of the device look alike: the fit takes up either without a trace in its residuals.
What tells them apart is how improbable links are that are wrong by so much: a length is a hypothesis beside the errors
of a robot with usual errors of its links.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.diagnostics.hypotheses import Evidence
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import sentence, warn_user, with_deviation
from diffeo_calib.common.quantiles import chi2_above, chi2_probability
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.sensors.devices import Hypothesis

PERCENT, MILLIMETRE = ("%", 1e-2), ("mm", 1e-3)
OF_ROBOT = "check the scale and the unit of the device, known distances, and the robot's variant"
OF_AXIS = "check the scale of the device along this axis and the columns of the positions"
OF_LINK = "check the robot's variant and this link in its description"


class Length(NamedTuple):
    """A length against what it is said to be.

    Args:
        cause: what. value, deviation: how much it differs, in m or relative. motion: RMS motion of a coordinate by a
            unit of it, m. chance: probability that a usual robot shows as much. unnoticed: largest value that passes
            without a warning.
    """

    cause: Hypothesis
    value: float
    deviation: float
    motion: float
    chance: float
    unnoticed: float = 0.0

    @property
    def displacement(self) -> float:
        """RMS motion of a point by it, m."""
        return abs(self.value) * self.motion * 3**0.5

    def __str__(self) -> str:
        unit, size = self.cause.unit or MILLIMETRE
        found = with_deviation(self.value / size, self.deviation / size)
        return (
            f"{self.cause.name} against its description: {found} {unit}, which moves points by "
            f"{1e3 * self.displacement:.2g} mm; up to {self.unnoticed / size:.2g} {unit} "
            f"({1e3 * self.unnoticed * self.motion * 3**0.5:.2g} mm) may be wrong without a warning"
        )


def lengths(data: TangentData, scales: Hyperparameters, devices: Iterable[Hypothesis] = ()) -> list[Length]:
    """Lengths against what they are said to be: that of the whole robot first.

    Args:
        data: the measurements. scales: those of the model. devices: what devices are said to hold, such as a focal
            length.
    """
    rows, some = data.sample(len(data.x), gates.JUDGED_COORDINATES, seed=0)
    process, found = some.process(usual(scales)), list[Length]()
    for one in (*_lengths_of(some), *(each._replace(effects=each.effects[rows]) for each in devices)):
        evidence = Evidence.of(process.numbers.of_table(some.motions_in_numbers(one.effects)), process)
        h = float(evidence.H)
        if h <= 0.0:
            continue
        value, deviation = float(evidence.size), (evidence.excess / h) ** 0.5
        motion = float((one.effects - one.effects.mean(0))[some.visible].square().mean().sqrt())
        found.append(Length(one, value, deviation, motion, chi2_probability((value / deviation) ** 2, 1)))
    allowed = chi2_above(gates.LENGTH_CHANCE / max(len(found), 1), 1) ** 0.5
    return [one._replace(unnoticed=allowed * one.deviation) for one in found]


def warn_of_lengths(found: list[Length]) -> float | None:
    """Warn of the least probable length, if it is too improbable; by how much any such length moves points, m."""
    wrong = [one for one in found if one.chance * len(found) < gates.LENGTH_CHANCE]
    if not wrong:
        return None
    worst, moved = max(wrong, key=lambda one: abs(one.value) / one.deviation), max(one.displacement for one in wrong)
    unit, size = worst.cause.unit or MILLIMETRE
    text = sentence(
        f"{worst.cause.name} seems to differ by {worst.value / size:+.2g} {unit} from what it is said to be",
        expected=f"at most about {3 * worst.deviation / size:.2g} {unit}: links and devices are seldom that wrong",
        got=f"absolute positions that may be wrong by {1e3 * moved:.2g} mm RMS",
        fix=f"{worst.cause.fix}; the expected error does not hold before that is settled",
    )
    warn_user(text)
    return moved


def usual(scales: Hyperparameters) -> Hyperparameters:
    """The same scales, none larger than usual."""
    return replace(
        scales,
        translation_errors=scales.translation_errors.clamp(max=gates.USUAL_TRANSLATION_M),
        rotation_errors=scales.rotation_errors.clamp(max=gates.USUAL_ROTATION_RAD),
        coupled_amplitude=scales.coupled_amplitude.clamp(max=gates.USUAL_COUPLED_RAD),
        task_amplitude=scales.task_amplitude.clamp(max=gates.USUAL_TASK_M),
    )


def _lengths_of(data: TangentData) -> Iterator[Hypothesis]:
    """The whole robot, the axes of its measuring device, and single links."""
    geometry = data.nominal.geometry
    away = data.places.unflatten(1, (-1, 3)) - geometry.base[:3, 3].to(data.x.device)

    def seen(motion: Tensor) -> Tensor:
        motion = motion.flatten(1)[..., None]
        return motion if data.slopes is None else data.slopes @ motion

    yield Hypothesis("the size of the robot", seen(away), PERCENT, OF_ROBOT)
    if not data.adrift:  # a device has axes
        eye = torch.eye(3, dtype=away.dtype, device=away.device)
        for axis, own in zip("xyz", eye, strict=True):
            yield Hypothesis(f"the scale of the measuring frame along {axis}", seen(away * own), PERCENT, OF_AXIS)
    chain = geometry.chain
    for joint, name in enumerate(chain.moving_names):
        offset = chain.offsets[joint].to(data.x.device)
        length = float(offset[:3, 3].norm())
        if chain.before[joint] >= 0 and length > gates.LINK_M:  # the first joint's is where the base stands
            along, start = offset[:3, :3].mT @ offset[:3, 3] / length, 6 + 6 * joint
            own = data.sensitivities[..., start : start + 3] @ along[:, None]
            yield Hypothesis(f"the link before {name} ({1e3 * length:.4g} mm)", own, MILLIMETRE, OF_LINK)
