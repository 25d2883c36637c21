"""The errors that a model expects over the joint ranges of its rows, what they consist of, and what those of rows mean.

Without a measuring device rigid motions that remain in the fields say nothing about the robot, and are taken out of all
covariances (regression/conditional.py). A device that measured other rows holds the frame.

Scales are chosen, and the model is fitted, with base and markers near their registration and with joint errors of the
size that the rows show. Where the rows cannot show them (a tool that never turns, joints that stand still) this is no
knowledge. The covariances of the model then start from what is known of any robot and tool; its mean stays.

Joints sag under the weight of the robot. In a small part of the workspace the sag hardly varies, and the rows tell it
from geometric errors as little as they tell how large it is elsewhere. It then counts as that of any robot.

Rows that leave the place of base or markers open show the errors of few joints, and the size that they have in common
is known as poorly: that of all joints is then no smaller than that of any robot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from math import hypot
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics.open_directions import (
    sampled_configurations,
    undetermined_places,
    without_shared,
)
from diffeo_calib.calibration.identification.identification import Identification, Prior
from diffeo_calib.common.errors import InputError, printable
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.regression.conditional import diagonal_blocks, roots
from diffeo_calib.robots.placement import PLACES, rigid_fit
from diffeo_calib.sensors.errors import ERRORS, Evaluation
from diffeo_calib.sensors.kinds import device_coordinates


def stands_free(model: CalibratedKinematics) -> bool:
    """Whether no device measured positions in the fit of a model: its frame is the robot's base."""
    return model.map.unregistered.stands_free


OPEN_RATIO = 10.0
"""A direction of base and markers is open if it moves points anywhere by this factor more than in the rows, or than
their noise."""
MARKER_SHARE = 0.3  # shift of a marker relative to that of the base from which the marker is named
MOST_ROWS = 300  # rows of a fit that show what their configurations determine and what is expected there


@dataclass(frozen=True)
class ExpectedError:
    """Errors of positions that a model expects, without the noise of a measurement.

    All are root mean square distances, m, of the ball if the model has one, else of all markers, or of the origins of
    measured poses; without a measuring device after the best rigid motion.

    Args:
        workspace: over the joint ranges of the rows, apart from the places of base and markers that the rows leave
            open: after the best motion along these.
        whole: the same with these places. measured: at the rows of the fit.
        open_places: names of these places.
        size: standard deviation of the robot's size, relative. size_share: its part of ``workspace``, from 0 to 1.
        doubt: distance, m, by which points move with what is in doubt; it is in ``workspace`` and ``whole``.
    """

    workspace: float
    whole: float
    measured: float
    open_places: tuple[str, ...]
    size: float
    size_share: float
    doubt: float = 0.0

    @classmethod
    def of(cls, model: CalibratedKinematics) -> ExpectedError:
        """Expected error of a model."""
        fitted, q, opened = model.map, model.map.everywhere, OpenPlaces.of(model.map)
        shown, bare, some = _shown(model), fitted.unregistered, _some_rows(fitted.x)

        def rms(covariance: Tensor) -> float:
            points = shown @ covariance @ shown.mT  # (M, 3 P, 3 P)
            return float((3 * points.diagonal(dim1=1, dim2=2).mean()).clamp(min=0).sqrt())

        points, at = bare.geodesic.linearised_value(q)
        away = points[:, -3:] - points[:, -3:].mean(0)
        last = torch.eye(bare.m, dtype=points.dtype, device=points.device)[-3:].expand(len(points), -1, -1)
        along = (away / away.square().sum()).flatten()  # of a growth of the robot about the middle of its points
        size = float((along @ bare.conditional.covariance_between(at.projected(last)) @ along).clamp(min=0).sqrt())
        whole = expected = rms(fitted.posterior(q, noise=False)[1])
        if opened.motions.shape[1]:
            left = opened.without(opened.without(fitted.joint_covariance(q)).mT)
            expected = min(whole, rms(diagonal_blocks(left, len(q))))
        share = min(size * float(away.square().sum(1).mean().sqrt()) / max(expected, 1e-12), 1.0)
        doubt = 0.0 if model.summary is None else model.summary.length_in_doubt or 0.0
        measured = rms(fitted.posterior(fitted.x[some], noise=False)[1])
        return cls(hypot(expected, doubt), hypot(whole, doubt), measured, opened.names_on(model), size, share, doubt)

    @property
    def sentence(self) -> str:
        """How large it is, and what it leaves out."""
        text = f"{1e3 * self.workspace:.3f} mm RMS"
        if self.doubt:
            settled = max(self.workspace**2 - self.doubt**2, 0.0) ** 0.5
            text = f"{text}, with what is in doubt ({1e3 * settled:.3f} mm without it)"
        if self.open_places:
            what = f"{' and '.join(self.open_places)}, which the rows leave open"
            text = f"{text} apart from {what} ({1e3 * self.whole:.3f} mm with it)"
        return f"{text}; {1e3 * self.measured:.3f} mm at the poses of the fit"

    def entry(self) -> dict[str, object]:
        """For programs."""
        return {
            "expected_error_m": self.workspace,
            "with_open_places_m": self.whole,
            "at_rows_of_fit_m": self.measured,
            "open_places": list(self.open_places),
            "length_in_doubt_m": self.doubt,
            "size_deviation": self.size,
        }


def expected_errors(
    model: CalibratedKinematics, stages: Mapping[str, Callable[[Tensor], Tensor]], expected: ExpectedError | None = None
) -> dict[str, float]:
    """Root mean square distances, m, of the positions of every stage from the true ones, by stage.

    sqrt(d^2 + s^2) with d the distance between the places of a stage and those of the model, and s the one that the
    model expects of its own, see :class:`ExpectedError`: both apart from what the rows leave open, and without a
    measuring device after the best rigid motion.

    Args:
        model: a calibrated model. stages: name -> kinematics, (N, n) -> (N, P, 3) in m.
        expected: what it expects of its own errors, if that has been found already.
    """
    fitted, opened = model.map.unregistered, OpenPlaces.of(model.map)
    workspace = (expected or ExpectedError.of(model)).workspace
    q, shown = fitted.everywhere, _shown(model)
    places = model(q).detach().flatten(1)

    def from_truth(points: Tensor) -> float:
        apart = opened.without((points.flatten(1) - places).reshape(-1, 1)).view(places.shape) + places
        apart, targets = ((shown @ each[:, :, None]).view(-1, 3) for each in (apart, places))
        if fitted.stands_free:
            T = rigid_fit(apart, targets)
            apart = apart @ T[:3, :3].mT + T[:3, 3]
        bodies = len(shown) // 3
        return float(((apart - targets).square().sum() / (len(q) * bodies) + workspace**2).sqrt())

    return {name: from_truth(kinematics(q).detach()) for name, kinematics in stages.items()}


def _shown(model: CalibratedKinematics) -> Tensor:
    """(r, m) what expected errors are of: the ball if the model has one, else all markers, or origins of poses."""
    every = model.bodies.averaging(model.map.new_noise)
    by_device = device_coordinates(model.map.m, ball=model.ball, free=stands_free(model))
    return every[-3:] if by_device < model.map.m else every


def _some_rows(x: Tensor) -> Tensor:
    """Numbers of at most :data:`MOST_ROWS` evenly spaced rows."""
    return torch.arange(0, len(x), -(-len(x) // MOST_ROWS), device=x.device)


@dataclass(frozen=True, eq=False)
class OpenPlaces:
    """Places of base and markers that rows leave open, although points elsewhere depend on them.

    With S and S_0 the derivatives of the points anywhere and in the rows by these places, of deviations D, the
    directions w of unit variance that |S D w|^2 = c^2 (|S_0 D w|^2 + noise^2) for a large c.
    """

    motions: Tensor  # (M m, k) of the points at the configurations of the workspace
    directions: Tensor  # (6 + 3 P, k) of base and markers, m and rad

    @classmethod
    def of(cls, fitted: FittedMap) -> OpenPlaces:
        """Open directions of a fitted map, by the rows of its registration if it has one."""
        root, anywhere, rows = _places(fitted)
        A, B = ((S @ root) / S.shape[0] ** 0.5 for S in (anywhere, rows))
        noise = fitted.new_noise.diagonal().mean()
        factor = torch.linalg.cholesky(B.mT @ B + noise * torch.eye(B.shape[1], dtype=B.dtype, device=B.device))
        white = torch.linalg.solve_triangular(factor, A.mT, upper=False)
        ratios, vectors = torch.linalg.eigh(white @ white.mT)
        open_ = vectors[:, ratios > OPEN_RATIO**2].flip(1)
        directions = root @ torch.linalg.solve_triangular(factor.mT, open_, upper=True)
        return cls(anywhere @ directions, directions)

    def without(self, errors: Tensor) -> Tensor:
        """Errors (M m, E) at the workspace after the best motions along what is open."""
        basis, _ = torch.linalg.qr(self.motions)
        return errors - basis @ (basis.mT @ errors)

    def names_on(self, model: CalibratedKinematics) -> tuple[str, ...]:
        """The places in words, each once: a marker that moves together with the base is what a turn would show."""
        names = []
        for direction in self.directions.mT:
            base, markers = direction[:3], direction[6:].view(-1, 3)
            shifts = markers.norm(dim=1)
            if not len(markers) or float(shifts.max()) < MARKER_SHARE * float(base.norm()):
                names.append("the place of the measuring frame")
            else:
                number = int(shifts.argmax())
                what, on = model.bodies.name(number, len(model.geometry.on)), printable(model.geometry.on[number])
                names.append(f"the place of the {what} on '{on}' along {'xyz'[int(markers[number].abs().argmax())]}")
        return tuple(dict.fromkeys(names))


def _places(model_map: FittedMap) -> tuple[Tensor, Tensor, Tensor]:
    """Square root of the covariance of base and markers, and derivatives anywhere and in the rows, see the class."""
    registration, fitted = model_map.registration, model_map.unregistered
    q = fitted.everywhere
    if registration is not None and not registration.same:  # it found other markers
        conditional: Any = model_map.conditional
        rows = registration.q.to(q)
        return (conditional.root, *(conditional.slopes(model_map.linearised_value(at)[1]) for at in (q, rows)))
    nominal = fitted.geodesic.spec.nominal
    columns = torch.tensor(nominal.places, dtype=torch.int64, device=fitted.x.device)
    opened, theta = fitted.open_directions[columns], q.new_zeros(nominal.parameters)
    anywhere = nominal.sensitivities(q, theta)[..., columns].flatten(0, 1)
    if fitted.stands_free:
        moved = anywhere[:, :6]
        anywhere = anywhere - moved @ (torch.linalg.pinv(moved) @ anywhere)
    root, _ = roots(fitted.with_motions.posterior(fitted.parameters_as_points(columns))[0] + opened @ opened.mT)
    if registration is not None:  # its rows may show what those of the fit left open
        return root, anywhere, nominal.sensitivities(registration.q.to(q), theta)[..., columns].flatten(0, 1)
    some = _some_rows(fitted.x)
    rows = fitted.functionals[some] @ nominal.sensitivities(fitted.x[some], theta)[..., columns]
    rows, shared = (
        (each * fitted.noise.visible[some, :, None]).flatten(0, 1) for each in (rows, fitted.noise.shared[some])
    )
    return root, anywhere, without_shared(rows, shared)


STILL_RANGE = 0.05  # range of a joint, rad or m, below which the rows do not show its errors
SAG_DEVIATION = 5e-4  # prior scale of the sag of any robot's joints, rad or m: 100 N m on a gear of 2e5 N m/rad
SHOWN_SHARE = 0.5  # share of the variance of its features in any poses, from which the rows show the sag of a joint
SMALLEST_SPREAD = 0.1  # spread of features, relative to the largest, below which a combination of them does not count
SMALLEST_EFFECT = 1e-12
BASE_PER_DEVIATION = 3.0  # the base moves along with an undetermined marker and must not hold it


def with_open_directions(fitted: FittedMap, q: Tensor, registration: Identification, *, rigid: bool) -> FittedMap:
    """A map whose covariances hold in directions that the rows leave open; the map itself if there are none.

    No prior variance of theta is smaller than before.

    Args:
        fitted: the fitted model of a robot. q: (N, n) joint values of its rows.
        registration: base and markers by themselves, with deviations. rigid: whether markers are points of poses.
    """
    nominal, before = fitted.geodesic.spec.nominal, fitted.geodesic.spec.prior_variance
    if not isinstance(nominal, GeometryMap):
        return fitted
    parts, chain, prior = nominal.geometry.slices, nominal.geometry.chain, Prior()
    deviations, least = registration.deviations.to(before), torch.zeros_like(before)
    most = before.new_tensor([PLACES.open_base_m] * 3 + [PLACES.open_base_rad] * 3)
    least[parts["base"]] = torch.minimum(BASE_PER_DEVIATION * deviations[parts["base"]], most)
    least[parts["tool"]] = deviations[parts["tool"]]
    still = (q.amax(0) - q.amin(0)) < STILL_RANGE
    unseen = ~((chain.coupling.to(before) != 0) & ~still).any(1)  # (n_all,)
    if undetermined_places(chain, q, registration, rigid=rigid):
        unseen = torch.ones_like(unseen)
    twist = before.new_tensor([prior.translation] * 3 + [prior.rotation] * 3)
    least[parts["joints"]] = (unseen[:, None] * twist).flatten()
    least[nominal.sag] = _unseen_sag(nominal, q)
    variance = torch.maximum(before, least.square())
    deformation = fitted.geodesic.with_spec(prior_variance=variance)
    return fitted if torch.equal(variance, before) else replace(fitted, deformation=deformation)


def _unseen_sag(nominal: GeometryMap, q: Tensor) -> Tensor:
    """Deviations of the coefficients of sag: those of any robot for joints whose sag the rows do not show, else zero.

    Where the features of a joint's sag vary little in the rows, sag is nearly constant there, and geometric errors take
    its place. How large it is elsewhere the rows do not say. Joints whose sag varies as in any poses keep their scale.
    """
    sag = nominal.elasticity
    if sag is None:
        return q.new_zeros(0)
    anywhere = sag.features(sampled_configurations(nominal.geometry.chain)).to(q)
    rows, after = sag.features(q), q.new_zeros(sag.size)
    unladen, joints = sag.own.to(q.device) & ~sag.loaded.to(q.device), sag.joints.to(q.device)
    for joint in range(nominal.geometry.chain.moving):
        mine = unladen & (joints == joint)
        if bool(mine.any()) and _share(rows[:, mine], anywhere[:, mine]) < SHOWN_SHARE:
            effect = float(anywhere[:, mine].square().sum(1).mean())
            after[mine] = SAG_DEVIATION / max(effect, SMALLEST_EFFECT) ** 0.5
    return after


def _share(rows: Tensor, anywhere: Tensor) -> float:
    """Share of the variance of features anywhere (S, k) that they have in the rows (N, k), at most 1 per direction."""
    _, s, Vt = torch.linalg.svd((anywhere - anywhere.mean(0)) / len(anywhere) ** 0.5, full_matrices=False)
    kept = s > max(SMALLEST_SPREAD * float(s[0]), SMALLEST_EFFECT)
    if not bool(kept.any()):  # the same wherever the robot goes
        return 1.0
    white = (rows - rows.mean(0)) @ (Vt[kept].mT / s[kept]) / len(rows) ** 0.5
    return float(torch.linalg.svdvals(white).square().clamp(max=1.0).sum()) / int(kept.sum())


class Accuracy(NamedTuple):
    """What is compared with a limit."""

    value: float  # RMS error, in ``unit``: m or that of readings
    unit: str
    of: str  # what it is of, in words


def accuracy(
    model: CalibratedKinematics,
    errors: Iterable[Evaluation],
    unit: str,
    expected: ExpectedError | None = None,
    *,
    which: str = "",
) -> Accuracy:
    """The error by which a model is accepted, in a unit.

    In m that of measured positions. Where no position was measured it is the one that the model expects over the joint
    ranges of its rows. A spread within sockets and errors of readings are no accuracy, but the model is not more
    accurate than these. In another unit that of its readings.

    Args:
        errors: of the rows that decide, kind by kind. unit: m, px, ... expected: by the model, if it is known already.
        which: these rows are, in words.

    Raises:
        InputError: no row measured in this unit.
    """
    judged = list(errors)
    counted = [entry for entry in judged if entry.unit == unit and entry.count]
    of = ["" if entry.what == ERRORS else f"({entry.label}) " for entry in counted]
    measured = [Accuracy(entry.rms, unit, f"{of[k]}on {entry.count} rows{which}") for k, entry in enumerate(counted)]
    if unit != "m" and measured:
        return measured[0]
    if unit != "m":
        fix = "give the limit in mm: without positions the error that the model expects is compared with it"
        got = ", ".join(entry.kind for entry in judged)
        raise InputError.of(f"a limit in {unit}", expected="rows in this unit", got=got, fix=fix)
    if not any(entry.what == ERRORS for entry in counted):
        how = "expected over the joint ranges of the fit, without measured positions"
        measured.append(Accuracy((expected or ExpectedError.of(model)).whole, unit, how))
    return max(measured, key=lambda entry: entry.value)
