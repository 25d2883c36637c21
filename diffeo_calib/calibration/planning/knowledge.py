"""What is known about the markers at many configurations before the next measurement, and the best one to make.

    K(x, x') = F(x, x') + sum_k sign_k f_k(x) f_k(x')^T

F is the covariance of the fields. The features f hold the parameters with their priors, what earlier data tell, and
what may have moved since. What is not known about the devices, c ~ N(0, I), is one more group of numbers. A measurement
A z(x) + D c + noise adds r features with sign -1, the rows of L^-1 (A K(x, .) + D K(c, .)) with L L^T its covariance.

Measurements are chosen greedily: each is the one that lowers the mean variance over the targets most. With V the main
directions of the targets' covariance and C_i = V^T K(targets, measurement i), this lowers their variance by

    gain_i = tr[(K_ii + R_i)^-1 C_i^T C_i],

where K is the covariance after those chosen before (Cohn, Ghahramani, Jordan, "Active learning with statistical
models", 1996; sequential A-optimal design for predictions). Taking one costs one row of K and an update of rank r.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.planning.sensors import Options, Scene
from diffeo_calib.common.errors import InputError, NumericalError
from diffeo_calib.common.threads import large_work
from diffeo_calib.maps.linearisation import Linearisation
from diffeo_calib.regression.choose import BYTES_PER_FLOAT, BYTES_PER_GIB, free_memory
from diffeo_calib.regression.conditional import NOISE_ADVICE, Features, diagonal_blocks


class Knowledge:
    """Covariances of the markers at M configurations, and how measurements there change them.

    Args:
        at: first-order response of the markers there; only its fields are used.
        features: everything else, see the module, for one group of configurations after the other.
        options: the measurements that can be made there.
        shifts: (k, c0) the features of the first shifts; the other ones are new.
        room: how many measurements will be made; memory is set aside for them.

    Attributes:
        blocks: (M, m, m) covariance of each configuration, m^2.

    Raises:
        InputError: the features need more memory than is free.
    """

    def __init__(
        self, at: Linearisation, features: Iterable[Features], options: Options, shifts: Tensor, room: int
    ) -> None:
        self.options, self._fields, self._known = options, at.fields, 0
        self._values = self._signs = options.slopes.new_empty(0)
        M, self.m, _ = at.sensitivity.shape
        self._shifts = slice(M * self.m, M * self.m + options.shared.shape[2])
        eye = torch.eye(self.m, dtype=at.sensitivity.dtype, device=at.sensitivity.device).expand(M, self.m, self.m)
        self.blocks = self._fields.projected(eye).own_blocks()
        filled = 0
        for values, signs in features:
            if not filled:
                self._make_room(signs, shifts, room)
            count = values.shape[1] // self.m
            self._values[: len(signs), filled * self.m : (filled + count) * self.m] = values
            each = values.view(len(signs), count, self.m).movedim(0, 1)  # (count, k, m)
            self.blocks[filled : filled + count] += (each.mT * signs) @ each
            filled += count
        values, signs = self._values[: self._known], self._signs[: self._known, None]
        self._with_shifts = values.T @ (signs * values[:, self._shifts])  # (M m + c, c) covariance with the shifts

    def _make_room(self, signs: Tensor, known: Tensor, room: int) -> None:
        """Memory for the features with these signs, those of the shifts, and those of ``room`` measurements."""
        shifts = self._shifts.stop - self._shifts.start - known.shape[1]
        self._known, numbers = len(signs) + shifts, self._shifts.stop
        total = self._known + room * self.options.slopes.shape[1]
        needed, free = BYTES_PER_FLOAT * total * numbers, free_memory()
        if free is not None and needed > free:
            what = f"{total} features of {len(self.blocks)} configurations need more memory than is free"
            expected, got = (f"{count / BYTES_PER_GIB:.1f} GiB" for count in (needed, free))
            raise InputError.of(what, expected=expected, got=got, fix="pass fewer candidates")
        self._values = signs.new_empty(total, numbers)
        self._values[: self._known, self._shifts] = 0.0
        own, first = self._values[len(signs) : self._known], self._shifts.start + known.shape[1]
        own.zero_()
        own[:, first:] = torch.eye(shifts, dtype=own.dtype, device=own.device)
        self._values[: len(known), self._shifts.start : first] = known
        self._signs = signs.new_full((total,), -1.0)
        self._signs[: len(signs)], self._signs[len(signs) : self._known] = signs, 1.0

    def coordinates(self, rows: Tensor) -> Tensor:
        """Numbers of the coordinates of some configurations: (B,) -> (B m,)."""
        return (rows[:, None] * self.m + torch.arange(self.m, device=rows.device)).flatten()

    def between(self, rows: Tensor, directions: Tensor | None = None) -> Tensor:
        """K between some configurations and everything, or between linear functions of these and everything.

        Args:
            rows: (B,) row numbers. directions: (k, B m) linear functions.

        Returns:
            (B m, M m + c), or (k, M m + c), in m^2 and m.
        """
        values, signs = self._values[: self._known], self._signs[: self._known]
        own = values[:, self.coordinates(rows)].T * signs  # (B m, features)
        fields = self._fields.rows(rows).gram(self._fields)
        with large_work(fields.numel()):
            if directions is not None:
                own, fields = directions @ own, directions @ fields
            found = own @ values
            found[:, : fields.shape[1]] += fields
            return found

    def covariances(self) -> Tensor:
        """Covariance of every measurement that can be made, its noise included: (O, r, r), m^2."""
        rows, A, D, R = self.options[:4]
        with_shifts = self._with_shifts[: self._shifts.start].view(len(self.blocks), self.m, -1)  # (M, m, c)
        cross = A @ with_shifts[rows] @ D.mT
        return A @ self.blocks[rows] @ A.mT + cross + cross.mT + D @ self._with_shifts[self._shifts] @ D.mT + R

    def without_motions(self, rows: Tensor, reference: Tensor, slopes: Tensor) -> Tensor:
        """Covariances (B, m, m) of some configurations without the rigid motion that fits the errors at others best.

        Args:
            rows: (B,) row numbers. reference: (T,) those of the others. slopes: (M, m, 6) by the rigid motion.
        """
        fit = torch.linalg.pinv(slopes[reference].flatten(0, 1))  # (6, T m)
        between = self.between(reference, fit)
        own = between[:, self.coordinates(reference)] @ fit.mT
        cross = between[:, self.coordinates(rows)].T.reshape(len(rows), self.m, 6) @ slopes[rows].mT
        return self.blocks[rows] - cross - cross.mT + slopes[rows] @ own @ slopes[rows].mT

    def with_options(self, values: Tensor) -> Tensor:
        """Covariances (k, M m + c) with everything as those with all measurements: (O, r, k)."""
        at, shifts = values[:, : self._shifts.start].T.reshape(len(self.blocks), self.m, -1), values[:, self._shifts].T
        return self.options.slopes @ at[self.options.rows] + self.options.shared @ shifts

    def measure(self, number: int) -> Tensor:
        """Make one of the measurements: the features (r, M m + c) that it adds.

        Raises:
            NumericalError: K + R is not positive definite.
        """
        rows, A, D, R = (part[number : number + 1] for part in self.options[:4])
        cross = A[0] @ self.between(rows) + D[0] @ self._with_shifts.T
        inner = cross[:, self.coordinates(rows)] @ A[0].T + cross[:, self._shifts] @ D[0].T + R[0]
        factor, info = torch.linalg.cholesky_ex(0.5 * (inner + inner.T))
        if int(info):
            raise NumericalError.of("the covariance of the planned measurements is singular", fix=NOISE_ADVICE)
        with large_work(cross.numel()):
            added = torch.linalg.solve_triangular(factor, cross, upper=False)
        self._values[self._known : self._known + len(added)] = added
        self._known += len(added)
        each = added[:, : self._shifts.start].view(len(added), -1, self.m).movedim(0, 1)  # (M, r, m)
        self.blocks = self.blocks - each.mT @ each
        self._with_shifts = self._with_shifts - added.T @ added[:, self._shifts]
        return added


MAIN_DIRECTIONS = 150
"""Directions of the targets whose variance is followed; the rest of it is far below the noise."""


class Choice(NamedTuple):
    """Chosen measurements in the order in which they were taken, and what they leave unknown.

    Args:
        order: (count,) numbers of the options. variance: (count + 1,) mean variance of the targets' coordinates after
            0, 1, ... of them, m^2.
    """

    order: Tensor
    variance: Tensor


def choose(knowledge: Knowledge, targets: Tensor, open_: Tensor, count: int, scene: Scene) -> Choice:
    """Choose ``count`` of the options, at most one at every configuration.

    Args:
        knowledge: before the first measurement; it takes those that are chosen.
        targets: (T,) row numbers of the configurations where the robot shall be known.
        open_: (O,) boolean: the options that can be chosen, at ``count`` configurations or more.
        scene: the configurations; it says of which errors the variance is reported.
    """
    m, rows, of_option = knowledge.m, knowledge.coordinates(targets), knowledge.options.rows
    motions = scene.motions(targets)
    P = torch.eye(len(rows), dtype=knowledge.blocks.dtype, device=rows.device)
    if motions is not None:
        B = motions[targets].flatten(0, 1)
        P = P - B @ torch.linalg.pinv(B)
    own = P @ knowledge.between(targets)[:, rows] @ P
    _, V = torch.linalg.eigh(0.5 * (own + own.T))
    main = V[:, -MAIN_DIRECTIONS:].T  # (k, T m)
    C = knowledge.with_options(knowledge.between(targets, main))  # (O, r, k)
    variance = [scene.along(diagonal_blocks(own, len(targets))).diagonal(dim1=1, dim2=2).mean()]
    open_, order = open_.clone(), []
    for _ in range(count):
        gains = torch.linalg.solve(knowledge.covariances(), C @ C.mT).diagonal(dim1=1, dim2=2).sum(1)
        best = int(torch.where(open_, gains, -torch.inf).argmax())
        order.append(best)
        open_ &= of_option != of_option[best]
        added = knowledge.measure(best)  # (r, M m + c)
        C -= knowledge.with_options(added) @ (added[:, rows] @ main.T)
        seen = scene.averaged @ (added[:, rows] @ P).view(len(added), len(targets), m, 1)  # (r, T, ., 1)
        variance.append(variance[-1] - seen.square().sum(0).mean())
    return Choice(torch.tensor(order, dtype=torch.int64, device=C.device), torch.stack(variance).clamp(min=0))
