"""Noise of measured rows: blocks R_i from the scales, a known part, and the weights of heavy tails.

A row reports R = B F numbers of B bodies, F of each, some of which may be absent. A body errs as a whole, and
independently of the others: a marker by sigma^2 I, a reading of a distance by sigma^2. A pose is one measurement of a
rigid body that is represented by three points (poses.py), so that these share their errors: a shift (sigma) and a turn
(rho). A small noise of the single points, the slack, sets how exactly the deformed model has to keep the body rigid; it
cannot be estimated, since the points of a pose are exactly rigid. Each kind of device has a sigma of its own.

A camera on the tool sees one point of a board most precisely: errors of the board's rotation and of the position of one
of its points are independent for one point only, usually the middle of the board: the position of any other point errs
by the rotation's error times its distance from there. Sensor noise is modelled as independent errors about this point.
It is estimated: that of the points b of the board's plane, z = 0 in its frame, whose position in the camera's frame is
predicted best,

    min over b   sum_i w_i |t_i + R_i b - (t^_i + R^_i b)|^2 + |b|^2 s^2 / PRIOR^2,

(R_i, t_i) measured and (R^_i, t^_i) predicted poses of the board in the camera, s^2 the mean square at b = 0.

A 95 % region of new measurements shall hold 95 % although their noise differs from configuration to configuration: a
camera errs most across its line of sight, and joint noise moves a marker by its lever arms. A new measurement has the
mean covariance M of the rows, but its errors are a mixture of Gaussians, with heavier tails than one. Of a marker whose
errors e have the covariance C_i,

    d^2 = e^T M^-1 e,    a sum of independent chi-squares times the eigenvalues of M^-1 C_i,

is gamma-distributed to a good approximation, with mean tr(M^-1 C_i) and variance 2 tr((M^-1 C_i)^2) (F. Satterthwaite,
"An approximate distribution of estimates of variance components", 1946), exactly if C_i is a multiple of M.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from math import nan

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.common.device import HOST
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.maps.noise import mean_block, without_hidden
from diffeo_calib.measurements.bodies import seen_board
from diffeo_calib.measurements.poses import block_diagonal, inverse_poses, own_blocks, poses_from_marks
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.process.scales import Hyperparameters
from diffeo_calib.regression.regions import CONFIDENCE, region_factor, smallest
from diffeo_calib.regression.tails import Tails

SMALLEST_NOISE_M = 1e-7
"""Independent noise that is always present: with less, exact data would make G + R singular in float64."""
FREEDOM_OF_POSES = 6
SLACK_SHARE = 0.1  # noise of the single points of a pose, relative to the residual of the geometric calibration
FINEST_SHARE = 0.3  # the same relative to the finest direction of known errors: it adds a tenth to their variance


@dataclass(frozen=True)
class NoiseModel:
    """How N rows were measured."""

    visible: Tensor  # (N, R) boolean: the numbers that were measured
    # (N, B) int64, number of each body's kind of device: 0 errs by ``sensor_noise``, k by the k-th of ``other_noise``.
    # B bodies, such as markers, poses or readings, have independent noise, and F = R / B numbers each
    kinds: Tensor
    known: Tensor  # (N, R, R) covariance that is known beforehand, m^2
    # (N, T, F, 6) displacements of the numbers of the first T bodies, poses, by a shift and a turn, zero where one is
    # hidden; each number by itself where a row reports something else. T may be 0
    modes: Tensor
    slack: float = 0.0  # standard deviation of the single points of a pose, m
    smallest_noise: float = SMALLEST_NOISE_M  # standard deviation that is added to every number, m

    @classmethod
    def alike(cls, rows: int, bodies: int, size: int = 3) -> NoiseModel:
        """N rows that report as many bodies of one kind with as many numbers each."""
        covariance = torch.zeros(rows, bodies * size, bodies * size, dtype=torch.float64, device=HOST)
        kinds = torch.zeros(rows, bodies, dtype=torch.int64, device=HOST)
        visible = torch.ones(rows, bodies * size, dtype=torch.bool, device=HOST)
        return cls(visible, kinds, covariance, covariance.new_zeros(rows, 0, size, FREEDOM_OF_POSES))

    @classmethod
    def of(cls, data: Measurements, residual: float) -> NoiseModel:
        """Noise of measured coordinates; ``residual`` is that of the geometric calibration per coordinate, m."""
        size, visible, covariance = data.bodies.points, data.visible.repeat_interleave(3, 1), data.covariance
        plain = cls.alike(len(data), data.markers // size, 3 * size)
        covariance, modes = plain.known if covariance is None else covariance, data.bodies.modes(data)
        finest = covariance.new_zeros(0)  # deviation of poses along any direction
        if 3 * size >= FREEDOM_OF_POSES:
            finest = torch.linalg.eigvalsh(own_blocks(covariance, plain.bodies))[..., -FREEDOM_OF_POSES]
            finest = finest[finest > SMALLEST_NOISE_M**2]
        # that size would drown what images of a board tell across the line of sight: a tenth of that along it
        slack = min(SLACK_SHARE * residual, FINEST_SHARE * (float(finest.median()) ** 0.5 if len(finest) else residual))
        return cls(visible, plain.kinds, covariance, plain.modes if modes is None else modes, slack)

    def rows(self, index: Tensor) -> NoiseModel:
        """Noise of some configurations."""
        arrays = self.visible[index], self.kinds[index], self.known[index], self.modes[index]
        return NoiseModel(*arrays, self.slack, self.smallest_noise)

    @property
    def bodies(self) -> int:
        """B."""
        return self.kinds.shape[1]

    @property
    def size(self) -> int:
        """F, numbers of each body: 3 coordinates of a marker, 9 of the three points of a pose."""
        return self.visible.shape[1] // self.bodies

    @property
    def stated(self) -> bool:
        """Whether something is known beforehand."""
        return bool(self.known.any())

    @property
    def without_known(self) -> NoiseModel:
        """Forget the noise that is known beforehand."""
        return replace(self, known=torch.zeros_like(self.known))

    @cached_property
    def kind_count(self) -> int:
        """Kinds of devices."""
        return int(self.kinds.max()) + 1

    @property
    def row_kinds(self) -> Tensor:
        """(N,) the kind of each row's first body that was seen."""
        return self.kinds.gather(1, self.seen.to(torch.int64).argmax(1)[:, None])[:, 0]

    @property
    def seen(self) -> Tensor:
        """(N, B) boolean: the bodies that were seen."""
        return self.visible.unflatten(1, (self.bodies, -1)).any(2)

    @property
    def freedom(self) -> Tensor:
        """(N, B) numbers that tell of each body, such as 3 coordinates of a point and 6 of a pose; 1 where hidden."""
        counts, poses = self.visible.unflatten(1, (self.bodies, -1)).sum(2), self.modes.shape[1]
        counts[:, :poses] = (self.modes != 0.0).any(2).sum(2)
        return (counts * self.seen).clamp(min=1)

    def of_freedom(self, value: Callable[[int], float], like: Tensor) -> Tensor:
        """A function of each body's degrees of freedom: like squares (N, B)."""
        values, freedom = torch.zeros_like(like), self.freedom
        for number in freedom.unique().tolist():
            values[freedom == number] = value(number)
        return values

    def covariance(self, scales: Hyperparameters, jacobian: Tensor) -> Tensor:
        """R_i without tails: Jacobian of k0 (N, R, n) -> (N, R, R) in m^2; absent numbers carry no information."""
        total = self._of_all(scales, jacobian) + self._of_bodies(scales)
        return total if bool(self.visible.all()) else without_hidden(total, self.visible)

    def mean_covariance(self, scales: Hyperparameters, jacobian: Tensor) -> Tensor:
        """The mean of R_i without tails, everything visible: (R, R) in m^2."""
        bodies = mean_block(self._of_bodies(scales), self.visible)  # not known of hidden poses
        return self._of_all(scales, jacobian).mean(0) + bodies

    def typical(self, scales: Hyperparameters, jacobian: Tensor, freedom: float) -> Tensor:
        """Mean covariance (R, R), whose 95 % region holds 95 %: inflated by heavy tails, and where the rows differ."""
        mean = self.mean_covariance(scales, jacobian)
        between_rows = differing_factor(self.covariance(scales, jacobian), mean, self.visible)
        return mean * between_rows * region_factor(freedom, int(self.freedom.max()))

    def _of_all(self, scales: Hyperparameters, jacobian: Tensor) -> Tensor:
        """R_i of joints and single numbers, as if everything were visible."""
        levels = scales.sensor_noise.reshape(1)
        levels = levels if scales.other_noise is None else torch.cat([levels, scales.other_noise.reshape(-1)])
        single = levels.square()[self.kinds.clamp(max=len(levels) - 1)]
        posed = (torch.arange(self.bodies, device=self.kinds.device) < self.modes.shape[1]) & (self.kinds == 0)
        single = torch.where(posed, self.slack**2, single) + self.smallest_noise**2
        single = single.repeat_interleave(self.size, 1)
        return jacobian * scales.joint_noise.square() @ jacobian.mT + torch.diag_embed(single)

    def _of_bodies(self, scales: Hyperparameters) -> Tensor:
        """Covariance (N, R, R) of the shifts and turns of poses, and what is known beforehand."""
        poses = self.modes.shape[1]
        if not poses:
            return self.known
        size = torch.cat([scales.sensor_noise.expand(3), scales.rotation_noise.expand(3)])
        blocks = (self.modes * size.square()) @ self.modes.mT
        blocks = blocks if self.kind_count == 1 else blocks * (self.kinds == 0)[:, :poses, None, None]
        return self.known + torch.nn.functional.pad(block_diagonal(blocks), (0, self.size * (self.bodies - poses)) * 2)

    def weighted(self, covariance: Tensor, tails: Tails) -> Tensor:
        """R_i with every body's noise divided by its weight, 1 where hidden; correlations are kept."""
        per_number = tails.weights.rsqrt().repeat_interleave(self.size, 1)
        return per_number[:, :, None] * covariance * per_number[:, None, :]

    def squares(self, covariance: Tensor, errors: Tensor) -> Tensor:
        """Squared distances (N, B), in units of the noise, of errors with second moments (N, R, R).

        NaN for hidden bodies.
        """
        blocks, present = [own_blocks(matrix, self.bodies) for matrix in (covariance, errors)], self.seen
        absent = ~self.visible.unflatten(1, (self.bodies, -1))
        if self.modes.shape[1] == self.bodies:
            to_body = torch.linalg.pinv(self.modes)  # (N, T, 6, 9)
            blocks = [to_body @ matrix @ to_body.mT for matrix in blocks]
            absent = (self.modes == 0.0).all(2) | ~present[..., None]
        both = absent[..., None] | absent[..., None, :]
        eye = torch.eye(absent.shape[2], dtype=covariance.dtype, device=covariance.device)
        ratios = torch.linalg.solve(torch.where(both, eye, blocks[0]), blocks[1].masked_fill(both, 0.0))
        return ratios.diagonal(dim1=-2, dim2=-1).sum(-1).masked_fill(~present, nan)


def differing_factor(covariance: Tensor, mean: Tensor, measured: Tensor) -> float:
    """Factor, one or more, on the mean covariance with which 95 % regions of markers hold 95 % of all rows' errors.

    Args:
        covariance: (N, 3 P, 3 P) of every row, m^2. mean: (3 P, 3 P) over the rows, m^2.
        measured: (N, 3 P) boolean: the coordinates that were measured.
    """
    markers = len(mean) // 3
    visible = measured.unflatten(1, (markers, 3)).all(2)
    relative = torch.linalg.solve(own_blocks(mean[None], markers), own_blocks(covariance, markers))[visible]
    first = relative.diagonal(dim1=-2, dim2=-1).sum(-1)
    second = (relative * relative.mT).sum((-2, -1))
    gaussian = chi2_above(1.0 - CONFIDENCE, 3)

    def holds(bound: float) -> bool:
        inside = torch.special.gammainc(first.square() / (2.0 * second), bound * first / (2.0 * second)).mean()
        return float(inside) >= CONFIDENCE

    most = gaussian * max(float(first.max()), 1.0)  # more than any single row needs
    return smallest(holds, gaussian, most) / gaussian


LOG = logging.getLogger(__name__)
PRIOR_M = 0.3  # prior standard deviation of the point around the board's origin, m: the size of usual boards
SAME_BOARD_M = 1e-6  # boards of several sessions, brought into one frame, are farther apart than this


def with_best_seen_point(data: Measurements, fit: Identification) -> Measurements:
    """The measurements with the point in the place of the board's origin; unchanged unless a camera is on the tool.

    Known deviations are those of the origin, and boards of several sessions have no point in common: the origin stays.
    """
    view = seen_board(data)
    if view is None or data.covariance is not None:
        return data
    origins, S = view.origins, view.axes
    if float((origins - origins[0]).abs().max()) > SAME_BOARD_M:
        return data
    predicted = poses_from_marks(fit.geometry.points(data.q), view.lever)
    turned = S.mT - predicted[:, :3, :3].mT  # R_i - R^_i
    towards = inverse_poses(predicted)
    away = view.board - towards[:, :3, :3] @ origins[0] - towards[:, :3, 3]
    weights = fit.tails.weights.amin(1)
    size = float((weights * away.square().mean(1)).sum() / weights.sum())
    eye = torch.eye(3, dtype=away.dtype, device=away.device)
    normal = torch.einsum("n,nki,nkj->ij", weights, turned, turned) + size / PRIOR_M**2 * eye
    push, point = -torch.einsum("n,nki,nk->i", weights, turned, away), torch.zeros_like(origins[0])
    point[:2] = torch.linalg.solve(normal[:2, :2], push[:2])
    LOG.info("the board is seen best at %s mm from its origin", [round(v, 1) for v in (1e3 * point).tolist()])
    return with_attributes(data, board=view.board + (S.mT @ point))
