"""Errors that depend on a joint's own position: lines of its gear, and an axis that is not straight or wobbles.

Gear lines are periodic errors of reduction gears at multiples of their ratio, found by a scan over frequencies.

A line of joint l adds C cos(w q_l) + S sin(w q_l) to its value. With X = [J_l cos w q_l, J_l sin w q_l] for all rows,
r the target and K = G + R of the model without it, generalised least squares lower the whitened sum of squares by

    T(w, l) = s^T A^-1 s,    s = X^T K^-1 r,    A = X^T K^-1 X,

which is chi-squared with two degrees of freedom where there is no line. The largest of many T must exceed what chance
reaches in one of a thousand scans. T is a process in w whose level t is crossed upwards at the rate
sd(q) sqrt(t / 2 pi) e^(-t / 2) per unit of w (Davies 1987, "Hypothesis testing when a nuisance parameter is present
only under the alternative", Biometrika 74): steps between frequencies that are as good as the same do not count.

s and A for all frequencies are Fourier transforms of sums over rows and over pairs of rows, binned by q_i, q_i - q_j
and q_i + q_j: the whole scan costs less than one factorisation of K.

Guides that are not straight and bearings that wobble are errors of an axis: errors of all six directions before a
joint are part of the model if they raise the evidence of the rows, beside scales without them, by more than a gate.
Their sizes and their length scale are the likeliest on a grid, where the search for all scales then starts.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from math import log, pi
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import sentence, warn_user
from diffeo_calib.process.scales import GearLine, Hyperparameters, axis_deviations, joint_weights
from diffeo_calib.regression.conditional import Process
from diffeo_calib.regression.linear_rows import Evidence
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.runtime.build import axis_waves
from diffeo_calib.runtime.chain import Waves, wave_angles

MEDIAN_OF_CHANCE = 2.0 * log(2.0)  # median of chi-squared with two degrees of freedom
SMALLEST_CORNER = 1e-6  # smallest eigenvalue of A relative to the largest at which cosine and sine can be told apart


LOWEST, HIGHEST, STEP = 8.0, 420.0, 0.04  # frequencies of the scan, rad per rad
BINS = 1 << 18  # of the Fourier transforms, a power of two
FEWEST_POSES = 60  # different poses below which there is no scan
PER_SCALE = 6
"""Measured coordinates for each scale below which there is none: scales that were overfitted make the noise too small
and lines of chance (17 joints, 150 poses of one marker)."""
MOST_COORDINATES = 3000  # measured coordinates in the scan
FALSE_ALARMS = 0.001
"""Share of robots without lines on which chance alone makes one. Real residuals are not quite white: at one in twenty a
UR10 showed a line in one series that was not there in another."""
CLEARANCE = 6.0  # fall of the sum of squares by which a line must surpass other frequencies that explain the same
MOST_LINES = 20


def find_gear_lines(data: TangentData, scales: Hyperparameters, seed: int = 0) -> tuple[GearLine, ...]:
    """The lines that chance does not explain, the clearest first, without those that the scales have already.

    Args:
        data: the measurements with the weights of their tails.
        scales: of all other parts of the model; their own lines count as found.
        seed: draws the rows of the scan if there are too many.
    """
    if data.coordinates < PER_SCALE * len(scales.logarithms()):
        return ()
    data = data.sample(len(data.x), MOST_COORDINATES, seed)[1]
    turning = [joint for joint, periodic in enumerate(data.space.periodic) if periodic]
    scan = _Scan(data.process(scales))
    lines: list[GearLine] = []
    falls = {joint: scan.falls(joint) for joint in turning}
    while falls and len(lines) < MOST_LINES:
        joint = max(falls, key=lambda candidate: float(falls[candidate].max()))
        if float(falls[joint].max()) < scan.threshold(list(falls)):
            break
        frequency = scan.refined(joint, float(scan.frequencies[falls[joint].argmax()]))
        line = scan.line(joint, frequency)
        rest = None if line is None else scan.without(joint, frequency)
        after = {} if rest is None else {other: rest.falls(other) for other in falls}
        if line is None or rest is None or _ambiguous(falls, after, joint, frequency, scan):
            del falls[joint]
        else:
            lines.append(line)
            falls, scan = after, rest
    return tuple(lines)


def _ambiguous(falls: dict[int, Tensor], after: dict[int, Tensor], joint: int, frequency: float, scan: _Scan) -> bool:
    """Whether other frequencies explain nearly as much, and nothing any more once this one is in the model.

    Args:
        falls, after: T of every joint without and with the line. joint, frequency: of the line.
    """
    least, q = float(falls[joint].max()) - CLEARANCE, scan.q[:, joint]
    width = 4.0 * pi / max(float(q.max() - q.min()), 1e-9)  # of side lobes, which predict the same in the joint's range
    for other, before in falls.items():
        rivals = (before > least) & (after[other] < 0.5 * before)
        if other == joint:
            rivals &= (scan.frequencies - frequency).abs() > width
        if bool(rivals.any()):
            return True
    return False


class _Scan:
    """What the scan needs of K^-1; lines that were found are unknowns of the process."""

    def __init__(self, process: Process) -> None:
        self.process, numbers, at = process, process.numbers, process.numbers.at
        self.q, J = at.xi - at.xi.mean(0), at.joint_to_start
        self.pairs = joint_weights(J, numbers.square(process.inverse))  # (n, N, N) J_l^T K^-1 J_l
        self.rows = torch.einsum("irn,ir->ni", J, numbers.in_table(process.mu))  # (n, N) J_l^T K^-1 r
        first, last = (round(w / STEP) for w in (LOWEST, HIGHEST))
        self._steps = slice(first, last + 1)
        self.frequencies = STEP * torch.arange(first, last + 1, dtype=self.q.dtype, device=self.q.device)

    def falls(self, joint: int) -> Tensor:
        """T of a joint at all frequencies (F,), relative to what chance gives on average if the scales are too low."""
        falls = _fall(*self._binned(joint))
        return falls / max(1.0, float(falls.median()) / MEDIAN_OF_CHANCE)

    def _binned(self, joint: int) -> tuple[Tensor, Tensor, Tensor]:
        """s, A_cc + A_ss and A_cc - A_ss + 2 i A_cs at all frequencies (F,)."""
        q, P = self.q[:, joint], self.pairs[joint]
        both, unlike = self._transform(q[:, None] - q, P).real, self._transform(q[:, None] + q, P)
        return self._transform(q, self.rows[joint]), both, unlike

    def _transform(self, places: Tensor, values: Tensor) -> Tensor:
        """sum values e^(i w places) at all frequencies: complex (F,). Values are shared by the two nearest bins."""
        bins, step = BINS, STEP
        spacing = 2.0 * pi / (bins * step)
        at = (places / spacing).flatten()
        low = at.floor()
        share, index = at - low, low.to(torch.int64).remainder(bins)
        grid = torch.zeros(bins, dtype=values.dtype, device=values.device)
        grid.index_add_(0, index, values.flatten() * (1.0 - share))
        grid.index_add_(0, (index + 1).remainder(bins), values.flatten() * share)
        sums = torch.fft.rfft(grid)[self._steps].conj()
        return sums / torch.sinc(self.frequencies * spacing / (2.0 * pi)).square()

    def _waves(self, joint: int, frequencies: Tensor) -> Tensor:
        """Cosines and sines of a joint (N, F, 2)."""
        angles = frequencies * self.q[:, joint, None]
        return torch.stack([angles.cos(), angles.sin()], 2)

    def _evidence(self, joint: int, frequencies: Tensor) -> Evidence:
        """s (F, 2) and A (F, 2, 2) without bins, at a few frequencies."""
        waves = self._waves(joint, frequencies)
        turned = (self.pairs[joint] @ waves.flatten(1)).view_as(waves)
        s = torch.einsum("n,nfa->fa", self.rows[joint], waves)
        return Evidence(s, torch.einsum("nfa,nfb->fab", waves, turned))

    def refined(self, joint: int, frequency: float) -> float:
        """The frequency of the largest T within two steps."""
        for reach in (2.0, 0.2):
            near = frequency + STEP * torch.linspace(-reach, reach, 41, dtype=self.q.dtype, device=self.q.device)
            frequency = float(near[self._evidence(joint, near).gain.argmax()])
        return frequency

    def line(self, joint: int, frequency: float) -> GearLine | None:
        """The line with the amplitude b of the largest marginal likelihood; None if that is zero."""
        evidence = self._evidence(joint, self.q.new_tensor([frequency]))
        evidence = Evidence(evidence.g[0], evidence.H[0])
        a = torch.linalg.eigvalsh(evidence.H)
        if float(a[0]) < SMALLEST_CORNER * float(a[1]):
            return None
        b2 = evidence.size.square().sum() * torch.logspace(-3, 1, 401, dtype=a.dtype, device=a.device)
        odds = evidence.log_odds(b2)
        return GearLine(joint, frequency, float(b2[odds.argmax()]) ** 0.5) if float(odds.max()) > 0 else None

    def without(self, joint: int, frequency: float) -> _Scan:
        """The scan beside a line of any amplitude."""
        waves = self._waves(joint, self.q.new_tensor([frequency]))[:, 0]
        numbers = self.process.numbers
        effects = numbers.at.joint_to_start[:, :, joint, None] * waves[:, None]
        return _Scan(self.process.opened(numbers.of_table(effects)))

    def threshold(self, joints: list[int]) -> float:
        """The T that the largest of these joints exceeds by chance with the probability :data:`FALSE_ALARMS`."""
        q, weights = self.q.T[joints], self.pairs.diagonal(dim1=1, dim2=2)[joints]  # by what the rows tell of them
        weights = weights / weights.sum(1, keepdim=True)
        variances = (weights * (q - (weights * q).sum(1, keepdim=True)).square()).sum(1)
        spans = [(HIGHEST - LOWEST) * variance**0.5 for variance in variances.tolist()]
        level = 10.0
        for _ in range(50):  # a contraction
            level = 2.0 * log(sum(1.0 + span * (level / (2.0 * pi)) ** 0.5 for span in spans) / FALSE_ALARMS)
        return level


def _fall(s: Tensor, both: Tensor, unlike: Tensor) -> Tensor:
    """s^T A^-1 s from complex sums: s = s_c + i s_s, A_cc + A_ss, A_cc - A_ss + 2 i A_cs; (F,)."""
    determinant = 0.25 * (both.square() - unlike.abs().square())
    # A^-1 = [[A_ss, -A_cs], [-A_cs, A_cc]] / det
    numerator = 0.5 * (both * s.abs().square() - (unlike.conj() * s * s).real)
    sound = determinant > SMALLEST_CORNER * both.square()
    return torch.where(sound, numerator / determinant.clamp(min=torch.finfo(both.dtype).tiny), 0.0)


# --- axes ------------------------------------------------------------------------------------------------------------

FUNCTIONS, MARGIN = 10, 0.125
"""Functions of an axis, and the part of its measured range by which theirs is longer on both sides: they vary there,
and regions widen."""
MIDDLE = 0.3, 0.2
GRID = (0.1, 0.3, 1.0, 3.0), (0.1, 0.2, 0.4, 0.8)
"""Turns per shift, rad/m, of which either shrinks further in the search, but would hardly grow from zero, and length
scales, as a part of the range. First the middle is tried alone."""
SHIFTS_M = torch.logspace(-6, -2, 25, dtype=torch.float64, device="cpu")
PLAUSIBLE = 3.0  # log odds in the middle of the grid below which the rest is not tried
STILL, TOLD_APART = 1e-3, 6.0
"""Range of a joint, rad or m, below which its axis is not sought. Log odds by which a base that drifts explains the
rows better than an axis."""
FEWEST_ROWS, ODDS, AXIS_COORDINATES = 40, 6.0, 2000
"""Rows below which such errors prove nothing, as 10 and 15 of clean tables that had log odds above 6. Log odds from
which they are part of the model: at most 3.8 in 57 clean tables of many kinds (30 to 223 rows), and 5.0 in eleven of a
UR10 and a Franka; two of a Panda had 8.9 and 6.6, and errors 1.4 % smaller with them. Measured coordinates that say
so."""


class Axis(NamedTuple):
    """A moving joint, its range and the count of functions, with the likeliest sizes and length scale."""

    own: tuple[int, float, float, int]
    effects: Tensor  # (M, 6 K) of the coefficients on the numbers of rows
    odds: float
    errors: Tensor  # (2,) shift, m, and turn, rad
    lengthscale: Tensor  # () as a part of the range


def with_axis_errors(data: TangentData, scales: Hyperparameters, lines: Tensor) -> Hyperparameters:
    """The scales with the axes whose errors the rows prove, one after the other; the same object without any.

    Rows that are measured along an axis, in the order of ``lines`` (N,), take errors of the axis for those of a base
    that drifts, with the same functions: they are of the base where that explains them clearly better.
    """
    chain, proven = data.nominal.geometry.chain, list[Axis]()
    if is_cartesian(chain) or len(data.x) < FEWEST_ROWS:  # commanded poses have no axes
        return scales
    index, some = data.sample(len(data.x), AXIS_COORDINATES, seed=0)
    values = torch.cat([chain.moving_values(data.x), lines.argsort().argsort().to(data.x)[:, None]], 1)
    ranges = torch.stack([values.amin(0), values.amax(0)])
    process, rest = some.process(scales), {*(ranges[1] - ranges[0] > STILL).nonzero()[:, 0].tolist()}
    while rest:
        tried = [_axis(joint, some, process, values[index], ranges[:, joint]) for joint in rest]
        best = max(tried, key=lambda axis: axis.odds - TOLD_APART * (axis.own[0] == chain.moving))
        if best.odds < ODDS:
            break
        drift = max((axis.odds for axis in tried if axis.own[0] == chain.moving), default=0.0)
        if best.own[0] < chain.moving and drift > max(ODDS, best.odds - TOLD_APART):
            what = f"errors by the position of {chain.moving_names[best.own[0]]} may be a drift of the device as well"
            fix = "measure some of its positions again at another time"
            warn_user(sentence(what, expected="rows in random order", fix=fix))
        proven.append(best)
        rest = {axis.own[0] for axis in tried if axis.odds > PLAUSIBLE} - {best.own[0]}
        process = process.opened(best.effects * axis_deviations(best.errors, best.lengthscale, FUNCTIONS), 1.0)
    proven = [axis for axis in proven if axis.own[0] < chain.moving]
    if not proven:
        return scales
    errors, lengths = torch.stack([axis.errors for axis in proven]), torch.stack([axis.lengthscale for axis in proven])
    return replace(scales, axes=tuple(axis.own for axis in proven), axis_errors=errors, axis_lengthscale=lengths)


def _axis(joint: int, data: TangentData, process: Process, values: Tensor, ends: Tensor) -> Axis:
    """The likeliest errors of the axis of a moving joint, or of the base by the last of the values (N, L + 1)."""
    low, high = ends.tolist()
    margin, column = MARGIN * (high - low), 6 * ((joint + 1) % values.shape[1])
    axis = joint, low - margin, high + margin, FUNCTIONS
    waves = Waves(*(torch.from_numpy(part).to(values.device) for part in axis_waves([axis], values.shape[1])))
    functions = wave_angles(waves, values, torch).cos()  # (N, K)
    effects = (data.sensitivities[:, :, None, column : column + 6] * functions[:, None, :, None]).flatten(2)
    E = process.numbers.of_table(data.motions_in_numbers(effects))
    evidence, tried = Evidence.of(E, process), list[Axis]()
    for ratio, lengthscale in (MIDDLE, *product(*GRID)):
        errors, length = E.new_tensor([1.0, ratio]), E.new_tensor(lengthscale)
        shape = axis_deviations(errors, length, FUNCTIONS)
        odds = Evidence(shape * evidence.g, shape[:, None] * evidence.H * shape).log_odds(SHIFTS_M.to(E).square())
        tried.append(Axis(axis, E, float(odds.max()), errors * SHIFTS_M[int(odds.argmax())].to(E), length))
        if tried[0].odds < PLAUSIBLE:
            break
    return max(tried, key=lambda candidate: candidate.odds)
