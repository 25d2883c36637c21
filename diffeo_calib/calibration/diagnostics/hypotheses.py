"""What may be wrong: unknowns with effects on the rows, of what changes, differs from row to row, and of lengths.

Errors of links and a wrong scale of the device look alike: the fit takes up either without a trace in its residuals.
What tells them apart is how improbable links are that are wrong by so much: a length of the robot, its links or the
device is a hypothesis beside the errors of a robot with usual errors of its links.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from math import hypot, inf
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.scales.leave_one_out import LeaveOneOut
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import sentence, warn_user, with_deviation
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.kinematics.nominal import rigid_motions
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.conditional import Process
from diffeo_calib.regression.linear_rows import Evidence
from diffeo_calib.regression.tails import FACTORS
from diffeo_calib.robots.tree import Tree
from diffeo_calib.sensors.devices import MILLIMETRE, Hypothesis
from diffeo_calib.sensors.set_ups import frame_slopes


class SampledRows(NamedTuple):
    """N rows that stand for all, beside a model."""

    index: Tensor  # (N,) their numbers among all
    process: Process  # what is known by them, of M numbers
    basis: Tensor | None  # (N, m, r) of what poses tell, see :class:`TangentData`; None where rows tell coordinates

    @classmethod
    def of(cls, data: TangentData, scales: Hyperparameters) -> tuple[SampledRows, TangentData]:
        """Sample the rows of a calibration with these scales: what is known by them, and their measurements."""
        index, some = data.sample(len(data.x), gates.JUDGED_COORDINATES, seed=0)
        return cls(index, some.process(scales), some.basis), some

    def in_coordinates(self, values: Tensor) -> Tensor:
        """Motions (N, r, U) of what the rows tell as those of all coordinates: (N, m, U)."""
        return values if self.basis is None else self.basis @ values

    def columns(self, effects: Tensor, codes: Tensor | None = None) -> Tensor:
        """Effects (N, R, U) on what rows tell, in each row times its code (N,), as those on the numbers (M, U)."""
        return self.process.numbers.of_table(effects if codes is None else effects * codes[:, None, None])

    def distances(self, effects: Tensor, u: Tensor) -> Tensor:
        """(N, B) motions, m, of the points, or numbers, of each row by unknowns (U,) with effects (N, R, U)."""
        motion = self.in_coordinates(effects) @ u
        return motion.unflatten(1, (-1, 3 if motion.shape[1] % 3 == 0 else motion.shape[1])).norm(dim=2)

    def left(self, E: Tensor) -> float:
        """Part of the RMS left-out error that remains beside unknowns of any size with effects (M, U)."""
        return left_out_rms(self.process.opened(E)) / left_out_rms(self.process)


def left_out_rms(process: Process) -> float:
    """RMS of the errors of rows, m, as all other rows predict them."""
    return float((process.rows_left_out()[0].square().sum() / len(process.numbers.owner.unique())).sqrt())


def worth_it(before: Tensor, after: Tensor) -> bool:
    """Whether left-out errors (N, m), m, prove unknowns that were opened: most of them, and not a few large ones."""
    first, second = before.square().nansum(1), after.square().nansum(1)
    gain = first - second
    sure = float(gain.mean()) > gates.SURE * float(gain.std()) / len(gain) ** 0.5
    return sure and float(second.mean()) < gates.WORTH**2 * float(first.mean())


def warn_of_taken_scales(taken: LeaveOneOut, chosen: LeaveOneOut) -> None:
    """Warn if left-out errors prove that the scales of other robots are not those of these rows."""
    if worth_it(taken.errors, chosen.errors):
        left = float((chosen.errors.square().nansum() / taken.errors.square().nansum()).sqrt())
        got = f"leave-one-out errors that fall to {100 * left:.0f} % with scales of their own"
        warn_user(sentence("`scales_of` does not suit these rows", got=got, fix="leave it out (--scales-of)"))


# --- what may change, from a row on or slowly -------------------------------------------------------------------------

BASE, MARKERS = "the measuring device or the robot's base", "a marker or the tool"
SCALE = "the scale of the device or the size of the robot"
NEW_SET_UP = "name the set-ups in a column (`session`), or use the rows before or after it"
TWO_ROBOTS = "calibrate the rows before it, and recalibrate that model with the rows after it"


def changes_of(data: TangentData, devices: Iterable[Hypothesis] = (), index: Tensor | None = None) -> list[Hypothesis]:
    """What may change of robot, tool, measuring frame, and devices, with effects on what rows tell.

    Args:
        devices: with effects on more rows, of which these have the numbers ``index`` (N,).
    """
    points, geometry = data.points.unflatten(1, (-1, 3)), data.nominal.geometry
    base, R = frame_slopes(points, points.mean((0, 1))), geometry.marker_turns(data.x)
    eye = torch.eye(R.shape[1], dtype=R.dtype, device=R.device)
    markers = torch.einsum("npab,pk->npakb", R, eye).flatten(3).flatten(1, 2)  # (N, 3 P, 3 P), in the tips' frames
    if data.basis is not None:  # nothing bends a frame
        markers = markers @ torch.block_diag(*rigid_motions(geometry.tool.flatten()).to(markers.device))
    places = data.places.unflatten(1, (-1, 3))
    away = (places - places.mean((0, 1))).flatten(1)[..., None]
    base, markers, away = (data.slopes @ each for each in (base, markers, away))
    base = base * (data.noise_model.row_kinds == 0)[:, None, None]  # sockets do not show where another device stands
    joints = data.jacobian
    if data.adrift:  # without a device no row shows an offset of the first joint
        base, joints = 0.0 * base, torch.cat([0.0 * joints[..., :1], joints[..., 1:]], 2)
    cases = changes_of_set_up(base, markers, joints, geometry.chain)
    cases.append(Hypothesis(SCALE, away, ("ppm", 1e-6), NEW_SET_UP))
    cases += [case._replace(effects=case.effects[index]) for case in devices]
    return [case._replace(effects=data.motions_in_numbers(case.effects)) for case in cases if bool(case.effects.any())]


def changes_of_set_up(frame: Tensor, markers: Tensor, joints: Tensor, chain: Tree) -> list[Hypothesis]:
    """What may change of a measuring frame, of what is on the tool, and of joints, with effects (N, R, 6), ..."""
    causes = [Hypothesis(BASE, each, fix=NEW_SET_UP) for each in (frame, frame[..., :3])]
    causes.append(Hypothesis(MARKERS, markers, fix=NEW_SET_UP))
    for name, turns, effects in zip(chain.joint_names, chain.periodic, joints.split(1, 2), strict=True):
        causes.append(Hypothesis(name, effects, ("mrad" if turns else "mm", 1e-3), TWO_ROBOTS))
    return causes


# --- lengths ----------------------------------------------------------------------------------------------------------

PERCENT = "%", 1e-2
OF_ROBOT = "check the scale and the unit of the device, known distances, and the robot's variant"
OF_AXIS = "check the scale of the device along this axis and the columns of the positions"
OF_LINK = "check the robot's variant and this link in its description"
OF_SLIDE = "check its unit and its sign"
OF_MIMIC = "check the multiplier of this joint in the robot's description"


def lengths_of(data: TangentData) -> Iterator[Hypothesis]:
    """The whole robot, the axes of its measuring device, slides, and what joints are to those that they follow."""
    geometry = data.nominal.geometry
    away = data.places.unflatten(1, (-1, 3)) - geometry.base[:3, 3].to(data.x.device)

    def effects(motion: Tensor) -> Tensor:
        return data.slopes @ motion.flatten(1)[..., None]

    chain, q, ratio = geometry.chain, data.x - data.x.mean(0), {"unit": PERCENT, "usual": gates.USUAL_RATIO}
    scale = {"unit": PERCENT} if any(chain.periodic) else ratio  # a machine of slides alone is as wrong as its spindles
    yield Hypothesis("the size of the robot", effects(away), fix=OF_ROBOT, **scale)
    if not data.adrift:  # a device has axes
        eye = torch.eye(3, dtype=away.dtype, device=away.device)
        for axis, unit in zip("xyz", eye, strict=True):
            yield Hypothesis(
                f"the scale of the measuring frame along {axis}", effects(away * unit), fix=OF_AXIS, **scale
            )
    for joint, (name, turns) in enumerate(zip(chain.joint_names, chain.periodic, strict=True)):
        if not turns and any(chain.periodic):  # a machine of slides alone is judged by the axes of its places
            along = data.jacobian[..., joint, None] * q[:, joint, None, None]
            yield Hypothesis(f"the scale of {name}", along, fix=OF_SLIDE, **ratio)
    for joint, name in enumerate(chain.moving_names):
        if name not in chain.joint_names:
            place = 6 + 6 * joint + 3 * bool(chain.revolute[joint])
            moved = data.sensitivities[..., place : place + 3] @ chain.axes[joint].to(q)
            along = (moved * (q @ chain.coupling[joint].to(q))[:, None])[..., None]
            yield Hypothesis(f"the multiplier of {name}", along, fix=OF_MIMIC, **ratio)


def links_of(data: TangentData) -> Iterator[Hypothesis]:
    """Single links."""
    chain = data.nominal.geometry.chain
    for joint, name in enumerate(chain.moving_names):
        offset = chain.offsets[joint].to(data.x.device)
        length = float(offset[:3, 3].norm())
        if chain.before[joint] >= 0 and length > gates.LINK_M:  # the first joint's is where the base stands
            along, start = offset[:3, :3].mT @ offset[:3, 3] / length, 6 + 6 * joint
            effects = data.sensitivities[..., start : start + 3] @ along[:, None]
            yield Hypothesis(f"the link before {name} ({1e3 * length:.4g} mm)", effects, fix=OF_LINK)


LEAST_OWN = 1e-6  # part of what rows say of a length that must be left beside links of any size


class Length(NamedTuple):
    """A length against what it is said to be."""

    cause: Hypothesis
    value: float  # how much it differs, in m or relative
    deviation: float
    motion: float  # RMS motion of a point by a unit of it, m
    unnoticed: float  # largest value that a usual robot shows by chance, and that passes without a warning
    taken_up: bool  # whether it is surely the robot's, and so part of the fit

    @property
    def gain(self) -> float:
        """What it explains, in log evidence."""
        return 0.5 * (self.value / self.deviation) ** 2

    def __str__(self) -> str:
        unit, size = self.cause.unit or MILLIMETRE
        number = with_deviation(self.value / size, self.deviation / size)
        return (
            f"{self.cause.name} against its description: {number} {unit}, which moves points by "
            f"{1e3 * abs(self.value) * self.motion:.2g} mm; up to {self.cause.amount(self.unnoticed)} "
            f"({1e3 * self.unnoticed * self.motion:.2g} mm) may be wrong without a warning"
        )


def lengths(data: TangentData, scales: Hyperparameters, devices: Iterable[Hypothesis] = ()) -> list[Length]:
    """Lengths against what they are said to be, that of the whole robot first, beside errors of usual size.

    Links that explain the rows far better than anything that a device may have wrong are the robot's, and are opened
    for all others; if then nothing else is wrong.

    Args:
        data: the measurements. scales: those of the model. devices: what devices are said to hold, such as a focal
            length.
    """
    usual = {name: getattr(scales, name).clamp(max=most) for name, most in gates.USUAL_SCALES.items()}
    turning = torch.tensor(data.space.periodic, dtype=torch.bool, device=data.x.device)
    most = torch.where(turning, inf, gates.USUAL_SLIDE).to(scales.transmission_amplitude)
    usual["transmission_amplitude"] = scales.transmission_amplitude.minimum(most)
    capped = replace(scales, **usual)
    rows, some = SampledRows.of(data, scales if torch.equal(capped.vector, scales.vector) else capped)
    links, others = [*links_of(some)], (cause._replace(effects=cause.effects[rows.index]) for cause in devices)
    causes = [*lengths_of(some), *others, *links]
    E, process = torch.cat([cause.effects for cause in causes], 2), rows.process
    columns = rows.columns(some.motions_in_numbers(E))
    g, H, total = columns.T @ process.mu, columns.T @ process.factor.solve(columns), process.numbers.target @ process.mu
    motions = (3 * (E - E.mean(0))[some.visible].square().mean(0)).sqrt().tolist()
    least, judged, alone = LEAST_OWN * H.diagonal(), dict[int, Length](), dict[int, Length]()
    left, first = H.diagonal().nonzero()[:, 0].tolist(), len(causes) - len(links)
    allowed, apart = chi2_above(gates.LENGTH_CHANCE / max(len(left), 1), 1) ** 0.5, gates.CHANGES_TOLD_APART
    while left:
        each = Evidence(g[left, None], H.diagonal()[left, None, None], float(total), len(columns))
        deviations = (each.excess / each.H[:, 0, 0]).sqrt().tolist()
        for k, size, chance in zip(left, each.size[:, 0].tolist(), deviations, strict=True):
            sd, taken_up = hypot(chance, causes[k].usual), causes[k].usual > 0.0 and abs(size) <= gates.TAKEN_UP
            judged[k] = Length(causes[k], size, sd, motions[k], allowed * sd, taken_up)
        gains = {k: judged[k].gain for k in left}
        best = max((k for k in left if k >= first), key=lambda k: gains[k], default=left[0])
        doubts = max((gains[k] for k in left if k < first), default=0.0)
        if gains[best] < max(0.5 * allowed**2, doubts + apart) or best < first:
            break
        alone, apart = alone or dict(judged), 0.0  # where one link is wrong, others probably are
        judged[best], step = judged[best]._replace(taken_up=True), H[best] / H[best, best]
        total, g, H = total - g[best].square() / H[best, best], g - step * g[best], H - torch.outer(step, H[best])
        left = (H.diagonal() > least).nonzero()[:, 0].tolist()
    unclear = any(abs(length.value) > length.unnoticed and not length.taken_up for length in judged.values())
    return [*(alone if alone and unclear else judged).values()]


def warn_of_lengths(judged: list[Length]) -> float | None:
    """Warn of the least probable length, if it is too improbable; by how much any such length moves points, m."""
    if not (wrong := [length for length in judged if abs(length.value) > length.unnoticed]):
        return None
    worst = max(wrong, key=lambda length: length.gain)
    moved = max((abs(length.value) * length.motion for length in wrong if not length.taken_up), default=None)
    what = f"{worst.cause.name} seems to differ by {worst.cause.amount(worst.value, '+')} from what it is said to be"
    expected = f"at most about {worst.cause.amount(3 * worst.deviation)}: links and devices are seldom that wrong"
    got = None if moved is None else f"absolute positions that may be wrong by {1e3 * moved:.2g} mm RMS"
    fix = worst.cause.fix + "; the expected error does not hold before that is settled" * (moved is not None)
    warn_user(sentence(what, expected=expected, got=got, fix=fix))
    return moved


# --- what differs from row to row -------------------------------------------------------------------------------------

# RMS motions of the points by unknowns of which the size is sought.
VARIATION_M = torch.logspace(-6, -2, 41, dtype=torch.float64, device="cpu")


def variation(data: TangentData, scales: Hyperparameters, hypotheses: Sequence[Hypothesis]) -> tuple[float, str] | None:
    """The likeliest number that differs from row to row, if it is clear: an unknown u_i ~ N(0, s^2) of every row i.

    It is clear beside the tails of the noise, but seems small beside those that it makes: s counts all but gross rows.

    Returns:
        s, m, rad or relative, and a sentence about it.
    """
    if not hypotheses:
        return None
    rows, some = SampledRows.of(data, scales)

    def sized(rows: SampledRows, hypothesis: Hypothesis) -> tuple[float, float, Hypothesis]:
        columns = rows.columns(some.motions_in_numbers(hypothesis.effects[rows.index]))
        E = torch.nn.functional.one_hot(rows.process.numbers.owner).to(columns) * columns
        E = E[:, E.any(0)]
        sizes = VARIATION_M.to(E) / float(E[E.any(1)].square().sum(1).mean().sqrt())
        odds = Evidence.of(E, rows.process).log_odds(sizes.square())
        return float(odds.max()), float(sizes[odds.argmax()]), hypothesis

    trials = (sized(rows, hypothesis) for hypothesis in hypotheses)
    odds, _, best = max(trials, key=lambda trial: trial[0])
    if odds < gates.ROW_ODDS:
        return None
    tails = some.tails
    tails = replace(tails, weights=tails.weights.where(tails.weights < 1.0 / FACTORS[0], 1.0))
    _, size, _ = sized(rows._replace(process=some.with_tails(tails).process(scales)), best)
    moved = 1e3 * size * float((3 * best.effects[best.effects != 0].square().mean()).sqrt())
    got = f"about {best.amount(size)}, which moves the tool by {moved:.2g} mm"
    what, expected = f"{best.name} seems to differ", "the same for all rows"
    return size, sentence(what, expected=expected, got=got, fix=best.fix)
