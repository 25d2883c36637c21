"""The stage of a calibration that chooses the scales and weighs the outliers.

1 defaults     from the residual of the geometric calibration
2 search       by marginal likelihood from several starts, then the weights of outliers, and the search again
3 support      amplitudes that the data do not support become zero; weights once more
  payload      the sag under a payload in terms of that under the links' unknown masses: compliances are the same, so
               that one factor scales the prior deviations of all of its coefficients
4 gear lines   periodic errors of the gears that chance does not explain; the search again if there are any
  axes         errors that depend on the position of one axis, the same
5 inflation    of all standard deviations, by rows that took no part in the choice of the scales

Of many rows, a random sample goes through all of this; then all rows get their weights.

Of models of other robots of the same type, the geometric mean of length scales and factors is taken, of standard
deviations the root mean square: a part of the model that one robot does not need counts there as zero.

The fitting problem of the exact model of a robot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.calibration.identification.identification import Identification
from diffeo_calib.calibration.scales import position_errors
from diffeo_calib.calibration.scales.leave_one_out import (
    FEWEST_HALVED,
    LeaveOneOut,
    cross_validated_inflation,
    inflation_by_parts,
    inflation_by_places,
    leave_one_out,
    variance_ratio,
    weighed,
)
from diffeo_calib.calibration.scales.position_errors import with_axis_errors
from diffeo_calib.calibration.scales.selection import Selection, defaults, select
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.errors import InputError, sentence, warn_user
from diffeo_calib.fitting.problem import Problem
from diffeo_calib.fitting.result import Progress, silent
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.noise import Noise
from diffeo_calib.maps.observation import LinearFunctionals, Observation
from diffeo_calib.process.scales import DEVIATIONS, FOUND, PAYLOAD_FACTORS, SCALES, GearLine, Hyperparameters
from diffeo_calib.robots.cartesian import is_cartesian
from diffeo_calib.robots.tree import Tree

FEWEST_POSES = 12  # different poses below which the data cannot determine the scales: defaults are used
NOISE_SHARE = 0.3
"""Of the registration's residual, which counts as noise where the geometry has more parameters than there are data."""
DOUBTED_WEIGHT = 0.25
"""Of a row beside the geometric calibration, below which the first search for scales leaves it out."""
FEWEST_JUDGED = 30  # rows below which leave-one-out errors are too few to judge the scales
VARIANCE_RATIO = 2.5  # factor between leave-one-out and predicted variances from which the scales are warned about
MOST_COORDINATES = 8000  # measured coordinates of the random rows that stand for all rows where there are more


@dataclass(frozen=True)
class ChosenScales:
    """The scales, and what follows from them.

    Args:
        selection: the scales, and how they were chosen.
        data: the measurements with the weights that outliers get with these scales.
        left_out: leave-one-out errors with these scales.
        row_scales: narrower ones by which single rows are judged; None for the same. What places of sockets that are
            left out say concerns errors elsewhere, not a row that the others of its socket predict.
        unresolved: (n,) variances of errors of a machine that are too short for its fields, see
            :func:`unresolved_errors`; None for none.
    """

    selection: Selection
    data: TangentData
    left_out: LeaveOneOut
    row_scales: Hyperparameters | None = None
    unresolved: Tensor | None = None

    @property
    def judged(self) -> LeaveOneOut:
        """Leave-one-out errors by which single rows are judged."""
        return self.left_out if self.row_scales is None else leave_one_out(self.data, self.row_scales)


def choose_scales(
    data: TangentData,
    measurements: Any,
    registration: Identification,
    identification: Identification,
    *,
    given: Hyperparameters | None = None,
    models: Sequence[CalibratedKinematics] = (),
    seed: int = 0,
    progress: Progress = silent,
) -> ChosenScales:
    """Scales and weights: given, by marginal likelihood, or defaults where the data cannot determine them.

    Args:
        data: the measurements around the geometric calibration. measurements: the same as they were measured.
        registration: base and markers. identification: the geometric calibration.
        given: scales that are used as they are. models: of robots of the same type, whose scales are used, inflated
            where leave-one-out errors contradict them.

    Warns:
        DiffeoCalibWarning: too few poses to select scales; leave-one-out errors contradict the scales.
    """
    rows, some = data.sample(len(data.x), MOST_COORDINATES, seed)
    if len(rows) < len(data.x):
        stages, how = (registration, identification), {"given": given, "models": models}
        chosen = choose_scales(some, measurements[rows], *stages, **how, seed=seed, progress=progress)
        scales = chosen.selection.scales
        data = weighed(data.with_position_errors(scales), scales, seed)
        return replace(chosen, data=data, left_out=leave_one_out(data, scales, seed))
    if given is not None:
        data = weighed(data.with_position_errors(given), given, seed)
        left_out = leave_one_out(data, given, seed)
        _warn_of_wrong_scales(data, left_out)
        return ChosenScales(Selection(given, "given"), data, left_out)
    poses = int(measurements.groups().max()) + 1  # repeats determine the noise only
    centre = defaults(data, noise_of_few(data, poses, registration, identification), identification.prior)
    if models:
        scales = scales_of_models(models, centre)
        data = data.with_position_errors(scales)
        scales = with_axis_errors(data, with_payload_factor(data, scales, seed), measurements.line_numbers)
        data = data.with_position_errors(scales)
        selection = Selection(scales, f"those of {len(models)} other model{'s' * (len(models) > 1)}")
        data = weighed(data, scales, seed)
        return _inflated(selection, None, data, measurements, seed=seed, progress=progress)
    if poses < FEWEST_POSES:
        count = f"{poses} poses" if poses == len(measurements) else f"{poses} different poses"
        fix = f"measure at least {FEWEST_POSES} poses, better 60; trust held-out errors only"
        warn_user(sentence(f"{count} are too few to select scales: defaults are used", fix=fix))
        selection = Selection(centre, f"defaults, since {count} are too few to select them")
    else:
        # fields explain gross errors where these weigh as much as beside the geometry, whose errors are larger
        least = DOUBTED_WEIGHT * (not measurements.without_device)  # spreads in sockets are the geometry's own
        selection = select(centre, data.trusted(least), seed=seed, progress=progress)
        data = weighed(data, selection.scales, seed)
        again = True
        while again and not selection.interrupted:  # from the start once more where gross errors show only now
            gross = data.tails.gross
            start = None if gross else selection.scales  # which let the fields explain gross errors
            selection = select(centre, data, start=start, seed=seed, progress=progress)
            selection, data = _supported(selection, data, seed)
            again = data.tails.gross and not gross
        selection = replace(selection, scales=with_payload_factor(data, selection.scales, seed))
        how = {"poses": poses, "lines": measurements.line_numbers, "seed": seed, "progress": progress}
        centre, selection, data = _with_position_errors(centre, selection, data, **how)
    return _inflated(selection, centre, data, measurements, seed=seed, progress=progress)


def _inflated(
    selection: Selection,
    centre: Hyperparameters | None,
    data: TangentData,
    measurements: Any,
    *,
    seed: int,
    progress: Progress,
) -> ChosenScales:
    """The scales found, widened where cross-validation or places contradict them."""
    left_out = leave_one_out(data, selection.scales, seed)
    _warn_of_wrong_scales(data, left_out)
    groups = measurements.groups().to(data.x.device)
    poses = int(groups.max()) + 1
    few = left_out.inflation(poses)
    factor, row_scales, resting = 1.0, None, measurements.places >= 0
    if not bool(resting.all()):
        inflation: float | None = few
        if centre is None or (poses >= FEWEST_POSES and not selection.interrupted):
            inflation = cross_validated_inflation(centre, selection.scales, data, groups, seed=seed, progress=progress)
            selection = replace(selection, interrupted=inflation is None)
        if is_cartesian(data.nominal.geometry.chain) and poses >= FEWEST_HALVED:
            inflation = max(inflation or few, inflation_by_parts(data, selection.scales, seed))
        least = float(data.tails.gross or measurements.without_device)  # no reading shows every direction
        factor = max(inflation or few, least)
        row_scales = selection.scales if factor < 1.0 else None  # narrow regions make no outliers
    if bool(resting.any()):
        row_scales = selection.scales.inflated(max(factor, few) ** 0.5)
        units = measurements.places, measurements.socket_numbers, groups.to(resting.device)
        factor = max(factor, inflation_by_places(data, selection.scales, *units))
    unresolved = None if centre is None else unresolved_errors(selection, centre, data, poses, seed=seed, factor=factor)
    scales, words = selection.scales.inflated(factor**0.5), "; noise of the commands counts as the machine's errors"
    selection = replace(selection, scales=scales, status=selection.status + words * (unresolved is not None))
    return ChosenScales(selection, data, leave_one_out(data, scales, seed), row_scales, unresolved)


FEWEST_REPEATS = 10  # rows that repeat poses from which the noise is known by them
SUPPORT = 2.0
"""Log marginal likelihood by which noise of each command must be better than noise of the device alone: the two numbers
that it has more along three axes (H. Akaike, "A new look at the statistical model identification", 1974)."""
NOTHING = 1e-6  # share of a noise that counts as none


def unresolved_errors(
    selection: Selection, centre: Hyperparameters, data: TangentData, poses: int, *, seed: int = 0, factor: float = 1.0
) -> Tensor | None:
    """Variances (n,) of a machine's errors that its fields do not resolve, times a factor, m^2 or rad^2; None for none.

    Without repeats, errors that change between neighbouring commands, as those of an arm near its wrist's singular
    poses, are the same as noise of the commands: a region of the machine without noise must hold them. Noise of the
    device is none of the machine's. The rows tell them apart as far as that has no axes of the machine. Errors that
    are too short are no larger than those of the fields: of a perfect machine there are none.
    """
    repeated, chain = len(data.x) - poses, data.nominal.geometry.chain
    if not is_cartesian(chain) or repeated >= FEWEST_REPEATS or poses < FEWEST_POSES or selection.interrupted:
        return None
    scales, without = selection.scales, replace(centre, joint_noise=NOTHING * centre.joint_noise)
    moved = (data.jacobian * scales.joint_noise.square() * data.jacobian).sum(2).mean()
    start = replace(scales, joint_noise=without.joint_noise, sensor_noise=(scales.sensor_noise.square() + moved).sqrt())
    other = select(without, data, start=start, seed=seed)
    some = data.sample(POSES, COORDINATES, seed)[1]
    if other.interrupted or some.process(scales).evidence - some.process(other.scales).evidence < SUPPORT:
        return None
    slides = 1.0 - torch.tensor(chain.periodic, dtype=data.x.dtype, device=data.x.device)
    fields = scales.transmission_amplitude.square() + scales.coupled_amplitude.square()
    return factor * torch.minimum(scales.joint_noise.square(), fields + slides * scales.task_amplitude.square())


def noise_of_few(data: TangentData, poses: int, registration: Identification, identification: Identification) -> float:
    """Noise of the geometric calibration; of the registration where geometry can fit the data exactly, m."""
    if poses * data.coordinates / len(data.x) > data.nominal.geometry.size:
        return identification.noise
    return max(identification.noise, NOISE_SHARE * registration.noise)


def _supported(selection: Selection, data: TangentData, seed: int) -> tuple[Selection, TangentData]:
    """Drop amplitudes that the data do not support, and with the weights that follow."""
    noise = data.noise_model.mean_covariance(selection.scales, data.jacobian)
    scales = selection.scales.supported(data.jacobian, noise)
    return replace(selection, scales=scales), weighed(data, scales, seed)


def _with_position_errors(
    centre: Hyperparameters,
    selection: Selection,
    data: TangentData,
    *,
    poses: int,
    lines: Tensor,
    seed: int,
    progress: Progress,
) -> tuple[Hyperparameters, Selection, TangentData]:
    """Add the gear lines, then the axes, that the data show; choose the other scales again for what is left."""
    for stage in ("gear lines",) * (poses >= position_errors.FEWEST_POSES) + ("axes",):
        if selection.interrupted:
            break
        progress(stage, 0, 1)
        if stage == "axes":
            start = with_axis_errors(data, selection.scales, lines)
        elif gears := position_errors.find_gear_lines(data, start := selection.scales, seed):
            start = replace(start, lines=gears)
        if start is not selection.scales:
            data = data.with_position_errors(start)
            centre = replace(centre, **{name: getattr(start, name) for name in FOUND})
            again = select(centre, data, start=start, seed=seed, progress=progress)
            selection, data = _supported(again, data, seed)
    return replace(centre, payload=selection.scales.payload), selection, data


def _warn_of_wrong_scales(data: TangentData, left_out: LeaveOneOut) -> None:
    """Warn if leave-one-out errors differ from what the scales predict."""
    ratio = variance_ratio(data, left_out)
    # Predictions that are too wide are cautious, and a usual effect of outliers, unless the deviations were given.
    overstated = data.noise_model.stated and ratio < 1 / VARIANCE_RATIO
    if len(data.x) >= FEWEST_JUDGED and (overstated or ratio > VARIANCE_RATIO):
        fix = "trust held-out errors, not the predicted deviations; measure more poses"
        if overstated:
            fix = "the given standard deviations are larger than the errors: check `std` and its unit"
        got, expected = f"{ratio:.2g} times that", "squared errors of the predicted variance"
        warn_user(sentence("leave-one-out errors contradict the selected scales", expected=expected, got=got, fix=fix))


POSES, COORDINATES = 300, 1500  # most poses and coordinates on which the factor is chosen


def with_payload_factor(data: TangentData, scales: Hyperparameters, seed: int = 0) -> Hyperparameters:
    """Set the likeliest payload factor; scales without payload stay."""
    sag = data.nominal.elasticity
    if sag is None or not bool(sag.loaded.any()):  # no coefficient depends on it
        return scales
    some = data.sample(POSES, COORDINATES, seed)[1]
    tried = [replace(scales, payload=factor) for factor in PAYLOAD_FACTORS]
    return max(tried, key=lambda candidate: some.process(candidate).evidence)


RESIDUAL_TOLERANCE = 1e-5  # of coupling and end residual: the remaining error is far below the noise


def robot_problem(data: TangentData, scales: Hyperparameters) -> Problem:
    """Measurements of a robot, with the kernels, priors and noise that the scales determine.

    Rows that carry payloads have a nominal map of their own; elsewhere the robot carries the median of them.
    """
    how: Any = {"joint_kernel": scales.joint_kernel(data.space), "task_kernel": scales.task_kernel()}
    how |= {"markers": data.nominal.geometry.markers, "prior_variance": data.prior_variance(scales)}
    how |= {"new_noise": data.noise_of_any_row(scales)}

    def problem(y: Tensor, noise: Noise, nominal: GeometryMap, observe: Observation | None) -> Problem:
        plain = Problem(nominal.typical, data.x, y, noise=noise, observe=observe, **how)
        return plain.with_nominal_of_rows(nominal)

    whole = problem(data.y, Noise(data.weighted_noise(scales), data.shared), data.nominal, data.observe)
    if data.basis is None:
        return whole
    basis, noise = LinearFunctionals(data.basis.mT), Noise(data.noise_of_numbers(scales), data.in_numbers(data.shared))
    return problem(basis.value(data.y), noise, data.nominal.changed(rigid=True), basis).standing_for(whole)


MOST_REACH = 1.5  # of robots of the same type, relative to each other: tools differ


def check_models(models: object, robot: Tree) -> None:
    """Raise InputError unless these are models, with scales, of robots with the same kinds of joints."""
    if not isinstance(models, Sequence):
        raise InputError.of("`scales_of`", expected="a list of models", got=type(models).__name__)
    for number, model in enumerate(models):
        what = f"`scales_of`, model {number + 1}"
        if not isinstance(model, CalibratedKinematics):
            expected = "a calibrated robot, such as `result.model`"
            raise InputError.of(what, expected=expected, got=type(model).__name__)
        turning, other = (tuple(each.periodic) for each in (robot, model.robot))
        if turning != other or robot.moving != model.robot.moving:
            got = f"{model.robot.n} joints, {sum(other)} of them revolute, {model.robot.moving} moving"
            expected = f"{robot.n} joints, {sum(turning)} of them revolute, {robot.moving} moving, as of '{robot.name}'"
            raise InputError.of(what, expected=expected, got=got, fix="pass models of the same type of robot")
        ratio = model.robot.reach / robot.reach if robot.reach < inf else 1.0
        if not 1 / MOST_REACH < ratio < MOST_REACH:
            got, expected = f"a reach of {model.robot.reach:.3g} m", f"one of about {robot.reach:.3g} m"
            raise InputError.of(what, expected=expected, got=got, fix="pass models of the same type of robot")
        if model.scales is None:
            fix = "calibrate it again with this version"
            raise InputError.of(f"{what} has no scales: an earlier version wrote it", fix=fix)


def scales_of_models(models: Sequence[CalibratedKinematics], like: Hyperparameters) -> Hyperparameters:
    """The mean scales of models, shaped ``like`` the defaults of the measurements, with the gear lines of all models.

    Args:
        models: see :func:`check_models`.
        like: the defaults, of which the noise of further devices is kept.
    """
    vectors = torch.stack([model.scales for model in models if model.scales is not None]).to(like.sensor_noise)
    deviations = torch.cat(
        [torch.full_like(getattr(like, name).reshape(-1), name in DEVIATIONS, dtype=torch.bool) for name in SCALES]
    )
    mean = torch.where(deviations, vectors.square().mean(0).sqrt(), vectors.log().mean(0).exp())
    share = len(models) ** -0.5
    lines = tuple(replace(line, amplitude=share * line.amplitude) for model in models for line in _lines(model))
    mean = torch.cat([mean.log(), like.logarithms()[len(mean) :]])  # scales that only some have are kept
    return replace(like.from_logarithms(mean), lines=lines)


def _lines(model: CalibratedKinematics) -> list[GearLine]:
    """Gear lines of a model with their prior amplitudes."""
    deviations = model.map.unregistered.deformation.spec.prior_variance.sqrt()[model.nominal.parts["waves"]]
    waves = model.nominal.own.waves
    return [GearLine(*wave, amplitude) for wave, amplitude in zip(waves, deviations[::2].tolist(), strict=True)]
