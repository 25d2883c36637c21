"""What is wrong? A hypothesis opens unknowns u, and the rows say how much these explain.

With errors r of covariance K, and effects E of the unknowns,

    g = E^T K^-1 r,    H = E^T K^-1 E,    u = H^-1 g,    cov(u) = H^-1.

They explain the gain g^T u of r^T K^-1 r: by chance chi-squared, one degree of freedom per unknown. With a prior
N(0, s^2) of the unknowns the log evidence grows by

    1/2 g^T (H + s^-2)^-1 g - 1/2 log |1 + s^2 H|.

Errors of links and a wrong scale of the device look alike: the fit takes up either without a trace in its residuals.
What tells them apart is how improbable links are that are wrong by so much: a length of the robot, its links or the
device is a hypothesis beside the errors of a robot with usual errors of its links.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from math import inf
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import sentence, warn_user, with_deviation
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.process.process import Process
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.cholesky import Factor
from diffeo_calib.sensors.devices import MILLIMETRE, Hypothesis

RELATIVE_RIDGE = 1e-9
"""Relative size of the diagonal that keeps H invertible where rows do not determine all unknowns."""


class Evidence(NamedTuple):
    """What rows say of U unknowns: g (..., U) and H (..., U, U), see above; r^T K^-1 r of a count of errors."""

    g: Tensor
    H: Tensor
    total: float = 0.0
    count: int = 1

    @classmethod
    def of(cls, E: Tensor, process: Process) -> Evidence:
        """By the rows of a process, with effects (M, U) on their numbers."""
        target = process.numbers.target
        return cls(E.T @ process.mu, E.T @ process.factor.solve(E), float(target @ process.mu), len(target))

    @classmethod
    def by(cls, E: Tensor, r: Tensor, factor: Tensor) -> Evidence:
        """By errors (M,), with effects (M, U) on them and the Cholesky factor (M, M) of K."""
        white = torch.linalg.solve_triangular(factor, torch.cat([r[:, None], E], 1), upper=False)
        r, E = white[:, 0], white[:, 1:]
        return cls(E.T @ r, E.T @ E, float(r @ r), len(r))

    @property
    def size(self) -> Tensor:
        """(..., U) the most probable unknowns."""
        level = RELATIVE_RIDGE * self.H.diagonal(dim1=-2, dim2=-1).amax()
        H = self.H + level * torch.eye(self.H.shape[-1], dtype=level.dtype, device=level.device)
        return (torch.linalg.pinv(H, hermitian=True) @ self.g[..., None])[..., 0]

    @property
    def gain(self) -> Tensor:
        """(...) what they explain."""
        return (self.g * self.size).sum(-1)

    @property
    def excess(self) -> float:
        """Mean square, at least one, of what they leave unexplained: of errors that K understates."""
        return max(1.0, (self.total - float(self.gain)) / self.count)

    def log_odds(self, variances: Tensor) -> Tensor:
        """(S, ...) by how much the log evidence grows with a prior of each variance (S,)."""
        h, V = torch.linalg.eigh(self.H)
        scaled = variances[:, None] * h.clamp(min=0.0)  # (S, U)
        gains = torch.einsum("su,...u->s...", variances[:, None] / (1.0 + scaled), (self.g @ V).square())
        return 0.5 * (gains - scaled.log1p().sum(1).view(-1, *[1] * (gains.ndim - 1)))


def opened(process: Process, E: Tensor, size: float | None = None) -> Process:
    """The same rows beside unknowns of this RMS size, of any by default, with effects (M, U) on their numbers."""
    E = E / E.norm(dim=0).clamp(min=torch.finfo(E.dtype).tiny) if size is None else size * E
    W = torch.linalg.solve_triangular(process.factor.L, E, upper=False)
    factor, variance = Factor(process.factor.L, torch.cat([process.factor.W, W], 1)), E.new_ones(E.shape[1])
    return replace(process, variance=torch.cat([process.variance, variance]), factor=factor)


def worth_it(before: Tensor, after: Tensor) -> bool:
    """Whether left-out errors (N, m), m, prove unknowns that were opened: most of them, and not a few large ones."""
    first, second = before.square().nansum(1), after.square().nansum(1)
    gain = first - second
    sure = float(gain.mean()) > gates.SURE * float(gain.std()) / len(gain) ** 0.5
    return sure and float(second.mean()) < gates.WORTH**2 * float(first.mean())


def warn_of_taken_scales(taken: LeaveOneOut, own: LeaveOneOut) -> None:
    """Warn if left-out errors prove that the scales of other robots are not those of these rows."""
    if worth_it(taken.errors, own.errors):
        left = float((own.errors.square().nansum() / taken.errors.square().nansum()).sqrt())
        got = f"leave-one-out errors that fall to {100 * left:.0f} % with scales of their own"
        warn_user(sentence("`scales_of` does not suit these rows", got=got, fix="leave it out (--scales-of)"))


def left_out_rms(process: Process) -> float:
    """RMS of the errors of rows, m, as all other rows predict them."""
    errors, _ = process.left_out(process.numbers.owner)
    return float((errors.square().sum() / len(process.numbers.q)).sqrt())


# --- lengths against what they are said to be -------------------------------------------------------------------------

PERCENT = "%", 1e-2
OF_ROBOT = "check the scale and the unit of the device, known distances, and the robot's variant"
OF_AXIS = "check the scale of the device along this axis and the columns of the positions"
OF_LINK = "check the robot's variant and this link in its description"
OF_SLIDE = "check its unit and its sign"
OF_MIMIC = "check the multiplier of this joint in the robot's description"


class Length(NamedTuple):
    """A length against what it is said to be.

    Args:
        cause: what. value, deviation: how much it differs, in m or relative. motion: RMS motion of a point by a unit of
            it, m. unnoticed: largest value that a usual robot shows by chance, and that passes without a warning.
    """

    cause: Hypothesis
    value: float
    deviation: float
    motion: float
    unnoticed: float

    def __str__(self) -> str:
        unit, size = self.cause.unit or MILLIMETRE
        found = with_deviation(self.value / size, self.deviation / size)
        return (
            f"{self.cause.name} against its description: {found} {unit}, which moves points by "
            f"{1e3 * abs(self.value) * self.motion:.2g} mm; up to {self.cause.amount(self.unnoticed)} "
            f"({1e3 * self.unnoticed * self.motion:.2g} mm) may be wrong without a warning"
        )


def lengths(data: TangentData, scales: Hyperparameters, devices: Iterable[Hypothesis] = ()) -> list[Length]:
    """Lengths against what they are said to be, that of the whole robot first, beside errors of usual size.

    Args:
        data: the measurements. scales: those of the model. devices: what devices are said to hold, such as a focal
            length.
    """
    rows, some = data.sample(len(data.x), gates.JUDGED_COORDINATES, seed=0)
    usual = {name: getattr(scales, name).clamp(max=most) for name, most in gates.USUAL_SCALES.items()}
    turning = torch.tensor(data.space.periodic, dtype=torch.bool, device=data.x.device)
    most = torch.where(turning, inf, gates.USUAL_SLIDE).to(scales.transmission_amplitude)
    usual["transmission_amplitude"] = scales.transmission_amplitude.minimum(most)
    process, found = some.process(replace(scales, **usual)), list[Length]()
    for one in (*_lengths_of(some), *(each._replace(effects=each.effects[rows]) for each in devices)):
        evidence = Evidence.of(process.numbers.of_table(some.motions_in_numbers(one.effects)), process)
        if (h := float(evidence.H)) > 0.0:
            motion = float((3 * (one.effects - one.effects.mean(0))[some.visible].square().mean()).sqrt())
            deviation = (evidence.excess / h + one.usual**2) ** 0.5
            found.append(Length(one, float(evidence.size), deviation, motion, 0.0))
    allowed = chi2_above(gates.LENGTH_CHANCE / max(len(found), 1), 1) ** 0.5
    return [one._replace(unnoticed=allowed * one.deviation) for one in found]


def warn_of_lengths(found: list[Length]) -> float | None:
    """Warn of the least probable length, if it is too improbable; by how much any such length moves points, m."""
    wrong = [one for one in found if abs(one.value) > one.unnoticed]
    if not wrong:
        return None
    worst = max(wrong, key=lambda one: abs(one.value) / one.deviation)
    doubted = [one for one in wrong if not one.cause.usual or abs(one.value) > gates.TAKEN_UP]
    moved = max((abs(one.value) * one.motion for one in doubted), default=None)
    text = sentence(
        f"{worst.cause.name} seems to differ by {worst.cause.amount(worst.value, '+')} from what it is said to be",
        expected=f"at most about {worst.cause.amount(3 * worst.deviation)}: links and devices are seldom that wrong",
        got=None if moved is None else f"absolute positions that may be wrong by {1e3 * moved:.2g} mm RMS",
        fix=worst.cause.fix + "; the expected error does not hold before that is settled" * (moved is not None),
    )
    warn_user(text)
    return moved


def _lengths_of(data: TangentData) -> Iterator[Hypothesis]:
    """The whole robot, the axes of its measuring device, and single links."""
    geometry = data.nominal.geometry
    away = data.places.unflatten(1, (-1, 3)) - geometry.base[:3, 3].to(data.x.device)

    def seen(motion: Tensor) -> Tensor:
        return data.slopes @ motion.flatten(1)[..., None]

    yield Hypothesis("the size of the robot", seen(away), PERCENT, OF_ROBOT)
    if not data.adrift:  # a device has axes
        eye = torch.eye(3, dtype=away.dtype, device=away.device)
        for axis, own in zip("xyz", eye, strict=True):
            yield Hypothesis(f"the scale of the measuring frame along {axis}", seen(away * own), PERCENT, OF_AXIS)
    chain = geometry.chain
    q = data.x - data.x.mean(0)
    ratio = {"unit": PERCENT, "usual": gates.USUAL_RATIO}
    for joint, (name, turns) in enumerate(zip(chain.joint_names, chain.periodic, strict=True)):
        if not turns and any(chain.periodic):  # a machine of slides alone is judged by the axes of its places
            along = data.jacobian[..., joint, None] * q[:, joint, None, None]
            yield Hypothesis(f"the scale of {name}", along, fix=OF_SLIDE, **ratio)
    for joint, name in enumerate(chain.moving_names):
        if name not in chain.joint_names:
            place = 6 + 6 * joint + 3 * bool(chain.revolute[joint])
            moved = data.sensitivities[..., place : place + 3] @ chain.axes[joint].to(q)
            value = q @ chain.coupling[joint].to(q)
            along = (moved * value[:, None])[..., None]
            yield Hypothesis(f"the multiplier of {name}", along, fix=OF_MIMIC, **ratio)
        offset = chain.offsets[joint].to(data.x.device)
        length = float(offset[:3, 3].norm())
        if chain.before[joint] >= 0 and length > gates.LINK_M:  # the first joint's is where the base stands
            along, start = offset[:3, :3].mT @ offset[:3, 3] / length, 6 + 6 * joint
            own = data.sensitivities[..., start : start + 3] @ along[:, None]
            yield Hypothesis(f"the link before {name} ({1e3 * length:.4g} mm)", own, fix=OF_LINK)
