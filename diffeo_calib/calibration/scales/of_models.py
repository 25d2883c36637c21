"""Scales of other robots of the same type, for a robot with too few rows to determine its own.

Of length scales and factors the geometric mean over the models is taken, of standard deviations the root mean square:
a part of the model that one robot does not need counts there as zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.process.scales import DEVIATIONS, SCALES, GearLine, Hyperparameters
from diffeo_calib.robots.tree import Tree


def check_models(models: object, robot: Tree) -> None:
    """Raise InputError unless these are models, with scales, of robots with the same kinds of joints."""
    if not isinstance(models, Sequence):
        raise InputError.of("`scales_of`", expected="a list of models", got=type(models).__name__)
    for number, model in enumerate(models):
        what = f"`scales_of`, model {number + 1}"
        if not isinstance(model, CalibratedKinematics):
            expected = "a calibrated robot, such as `result.model`"
            raise InputError.of(what, expected=expected, got=type(model).__name__)
        own, other = (tuple(each.periodic) for each in (robot, model.robot))
        if own != other or robot.moving != model.robot.moving:
            got = f"{model.robot.n} joints, {sum(other)} of them revolute, {model.robot.moving} moving"
            expected = f"{robot.n} joints, {sum(own)} of them revolute, {robot.moving} moving, as of '{robot.name}'"
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
    return replace(like.with_vector(mean), lines=lines)


def _lines(model: CalibratedKinematics) -> list[GearLine]:
    """Gear lines of a model with their prior amplitudes."""
    waves = model.nominal.waves
    amplitudes = model.map.unregistered.deformation.spec.prior_variance.sqrt()[-waves.size :: 2] if waves.size else ()
    return [GearLine(*each) for each in zip(waves.joints, waves.frequencies, map(float, amplitudes), strict=True)]
