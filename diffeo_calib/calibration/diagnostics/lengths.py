"""Lengths: the robot and its links against their description, the device's scale, and what a device is said to hold.

Errors of links and a wrong scale of the device look alike: the fit takes up either without a trace in its residuals.
What tells them apart is how improbable links are that are wrong by so much. With K the covariance of the errors of a
robot with usual errors of its links, a direction B of unknown size has the most probable size and deviation

    s = B^T K^-1 r / h,    sd = 1 / sqrt(h),    h = B^T K^-1 B.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.moved_devices import Cause
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import sentence, warn_user, with_deviation
from diffeo_calib.common.quantiles import chi2_above, chi2_probability
from diffeo_calib.process.scales import Hyperparameters


@dataclass(frozen=True)
class LengthLimits:
    """Usual deviations of lengths, and when a larger one is reported.

    Args:
        translation_m, rotation_rad: of the errors of links. coupled_rad, task_m: amplitudes of the fields; what these
            explain beyond is not the robot's.
        link_m: length of a link from which it is judged by itself.
        chance: probability that a usual robot shows any length that is as wrong, from which nothing is reported.
        coordinates: measured coordinates of the random rows that stand for all where there are more.
    """

    translation_m: float = 5e-4
    rotation_rad: float = 5e-4
    coupled_rad: float = 3e-4
    task_m: float = 1e-4
    link_m: float = 0.05
    chance: float = 1e-3
    coordinates: int = 2000


LIMITS = LengthLimits()
PERCENT, MILLIMETRE = ("%", 1e-2), ("mm", 1e-3)
SIZE, OF_ROBOT = (
    "the size of the robot",
    "check the scale and the unit of the device, known distances, and the robot's variant",
)
OF_AXIS = "check the scale of the device along this axis and the columns of the positions"
OF_LINK = "check the robot's variant and this link in its description"


class Length(NamedTuple):
    """The size of a direction.

    Args:
        cause: what. value, deviation: s and sd, in m or relative. displacement: RMS motion of a coordinate by s, m.
        chance: probability that a usual robot shows as much.
        unnoticed: largest size that passes without a warning, and the RMS motion of a coordinate by it, m.
    """

    cause: Cause
    value: float
    deviation: float
    displacement: float
    chance: float
    unnoticed: tuple[float, float] = (0.0, 0.0)

    def __str__(self) -> str:
        unit, size = self.cause.unit or MILLIMETRE
        found = with_deviation(self.value / size, self.deviation / size)
        text = f"{self.cause.name} against its description: {found} {unit}"
        least, motion = self.unnoticed
        return (
            f"{text}, which moves points by {1e3 * self.displacement * 3**0.5:.2g} mm; "
            f"up to {least / size:.2g} {unit} ({1e3 * motion * 3**0.5:.2g} mm) may be wrong without a warning"
        )


def lengths(
    data: TangentData,
    scales: Hyperparameters,
    devices: Callable[[], Iterable[Cause]] = tuple,
    *,
    seed: int = 0,
    limits: LengthLimits = LIMITS,
) -> list[Length]:
    """Lengths against what they are said to be: that of the whole robot first.

    Args:
        data: the measurements. scales: those of the model. devices: what devices are said to hold, such as a focal
            length. seed: draws the rows where there are too many. limits: what is usual.
    """
    rows, some = data.sample(len(data.x), limits.coordinates, seed)
    process, numbers = some.process(usual(scales, limits)), some.numbers
    total, found = float(process.mu @ numbers.target), []
    causes = (one._replace(effects=one.effects[rows]) for one in (*_directions(data, limits), *devices()))
    for cause in causes:
        moved = cause.effects - cause.effects.mean(0)
        B = numbers.of_table(cause.told_by(some).effects)[:, 0]
        h, g = float(B @ process.factor.solve(B[:, None])[:, 0]), float(B @ process.mu)
        if h <= 0.0:
            continue
        excess = max(1.0, (total - g**2 / h) / max(len(numbers.target), 1))  # of errors that are not usual
        value, deviation = g / h, (excess / h) ** 0.5
        motion = float(moved[some.visible].square().mean().sqrt())
        chance = chi2_probability((value / deviation) ** 2, 1)
        found.append(Length(cause, value, deviation, abs(value) * motion, chance, (deviation, deviation * motion)))
    allowed = chi2_above(limits.chance / max(len(found), 1), 1) ** 0.5
    return [one._replace(unnoticed=(allowed * one.unnoticed[0], allowed * one.unnoticed[1])) for one in found]


def doubtful(found: list[Length], limits: LengthLimits = LIMITS) -> Length | None:
    """The length that is least probable, if that is too improbable, with the motion by any that is."""
    wrong = [one for one in found if one.chance * len(found) < limits.chance]
    if not wrong:
        return None
    worst = max(wrong, key=lambda one: abs(one.value) / one.deviation)
    return worst._replace(displacement=max(one.displacement for one in wrong))


def warn_of_length(worst: Length) -> None:
    """Warn of a length that is not what it is said to be."""
    unit, size = worst.cause.unit or MILLIMETRE
    text = sentence(
        f"{worst.cause.name} seems to differ by {worst.value / size:+.2g} {unit} from what it is said to be",
        expected=f"at most about {3 * worst.deviation / size:.2g} {unit}: links and devices are seldom that wrong",
        got=f"absolute positions that may be wrong by {1e3 * worst.displacement * 3**0.5:.2g} mm RMS",
        fix=f"{worst.cause.fix}; the expected error does not hold before that is settled",
    )
    warn_user(text)


def usual(scales: Hyperparameters, limits: LengthLimits) -> Hyperparameters:
    """The same scales, none larger than usual."""
    return replace(
        scales,
        translation_errors=scales.translation_errors.clamp(max=limits.translation_m),
        rotation_errors=scales.rotation_errors.clamp(max=limits.rotation_rad),
        coupled_amplitude=scales.coupled_amplitude.clamp(max=limits.coupled_rad),
        task_amplitude=scales.task_amplitude.clamp(max=limits.task_m),
    )


def _directions(data: TangentData, limits: LengthLimits) -> list[Cause]:
    """The whole robot, the axes of its measuring device, and single links."""
    geometry = data.nominal.geometry
    away = data.places.unflatten(1, (-1, 3)) - geometry.base[:3, 3].to(data.x.device)

    def seen(motion: Tensor) -> Tensor:
        motion = motion.flatten(1)[..., None]
        return motion if data.slopes is None else data.slopes @ motion

    found = [Cause(SIZE, seen(away), PERCENT, OF_ROBOT)]
    if not data.held:  # a device has axes
        eye = torch.eye(3, dtype=away.dtype, device=away.device)
        for axis, own in zip("xyz", eye, strict=True):
            found.append(Cause(f"the scale of the measuring frame along {axis}", seen(away * own), PERCENT, OF_AXIS))
    chain = geometry.chain
    for joint, name in enumerate(chain.moving_names):
        offset = chain.offsets[joint].to(data.x.device)
        length = float(offset[:3, 3].norm())
        if chain.before[joint] >= 0 and length > limits.link_m:  # the first joint's is where the base stands
            along = offset[:3, :3].mT @ offset[:3, 3] / length
            start = 6 + 6 * joint
            own = data.sensitivities[..., start : start + 3] @ along[:, None]
            found.append(Cause(f"the link before {name} ({1e3 * length:.4g} mm)", own, MILLIMETRE, OF_LINK))
    return found
