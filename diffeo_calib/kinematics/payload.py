"""Calibrated maps under another payload. The flows stay; only the nominal map at the queries changes."""

from __future__ import annotations

from copy import copy
from math import inf

import torch
from torch import Tensor

from diffeo_calib.common.checks import number_of
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, as_written, sentence, warn_user
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.re_registration.registered_map import RegisteredMap
from diffeo_calib.kinematics.session_markers import SessionMarkers
from diffeo_calib.maps.nominal import NominalMap
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.robots.payload import Payload

ABSURD, BEYOND = 1000.0, 1.1
"""Masses, relative to the largest of the fit, that are refused and that are warned about."""


def payload_of(nominal: NominalMap | None) -> Payload | None:
    """The payload of a robot's nominal map; None for one without, and for other maps."""
    nominal = nominal.nominal if isinstance(nominal, SessionMarkers) else nominal
    return nominal.payload if isinstance(nominal, GeometryMap) else None


def carried(nominal: NominalMap) -> float | None:
    """The mass that a robot carries in all queries."""
    payload = payload_of(nominal)
    return None if payload is None else float(payload.masses)


def check_payloads(own: float | None, data: Measurements) -> None:
    """Raise MeasurementError if only one of a model and its measurements has payloads."""
    if own is not None and data.payload is None:
        fix = "name their column (`payload`), or pass data.with_payload(mass)"
        raise MeasurementError.of("the model was calibrated with payloads, the measurements have none", fix=fix)
    if own is None and data.payload is not None:
        fix = "calibrate with payloads too, or leave them out"
        raise MeasurementError.of("the measurements have payloads, the model was calibrated without", fix=fix)


def with_mass_of(fitted: FittedMap, nominal: GeometryMap, data: Measurements) -> FittedMap:
    """A map of a robot that carries the payload of measurements, the median where they differ.

    Args:
        fitted: the map. nominal: that of its fit. data: the rows.
    """
    if not isinstance(data, Measurements):
        return fitted  # the registration refuses it
    check_payloads(carried(nominal), data)
    if data.payload is None:
        return fitted
    return with_mass(fitted, float(data.payload.median()))


def with_mass(fitted: FittedMap, mass: float) -> FittedMap:
    """The same map of a robot that carries another mass.

    Raises:
        InputError: a mass that is negative or no number, or a map without payload.
    """
    number = number_of(mass)
    if number is None or not 0 <= number < inf:
        raise InputError.of("`mass` of the payload", expected="a number of 0 or more", got=as_written(mass))
    return with_masses(fitted, torch.tensor(number, dtype=torch.float64, device=HOST))


def check_masses(nominal: NominalMap, masses: Tensor) -> None:
    """Refuse masses that cannot be meant, and warn of masses beyond those of the fit.

    Raises:
        InputError: a mass far above those of the fit.

    Warns:
        DiffeoCalibWarning: a mass above those of the fit.
    """
    payload = payload_of(nominal)
    if payload is None or masses.numel() == 0:
        return
    largest = float(masses.max())
    got, measured = f"{largest:g}", f"0 to {payload.unit:g} in the measurements of the fit"
    if largest > ABSURD * payload.unit:
        raise InputError.of("`mass` of the payload", expected=measured, got=got, fix="check its unit")
    if largest > BEYOND * payload.unit:
        what = f"a payload of {got} is beyond the {measured}: errors are larger than the predicted deviations say"
        warn_user(sentence(what, fix="measure rows with such a payload too"))


def with_masses(fitted: FittedMap, masses: Tensor) -> FittedMap:
    """The same map under checked masses, one () or one for each of the rows (N,) at which it is then evaluated."""
    if isinstance(fitted, RegisteredMap):
        return RegisteredMap(with_masses(fitted.fitted, masses), fitted.registration)
    nominal = fitted.deformation.spec.nominal
    payload = payload_of(nominal)
    if payload is None or not isinstance(nominal, GeometryMap):
        fix = "calibrate with measurements that name their payload, Measurements.with_payload"
        raise InputError.of("this model was calibrated without payloads: it does not know the sag under one", fix=fix)
    other = copy(fitted)  # with what it has computed for its covariances, which are those of the rows
    other.deformation = fitted.geodesic.with_nominal(nominal.with_payload(payload.weighing(masses)))
    return other
