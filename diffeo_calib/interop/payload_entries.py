"""The payloads of a model in its file: an entry of the robot, and tensors of their own.

Readers that know nothing of payloads must refuse such a file: the masses of the rows are part of its controls.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import GeometryMap, SessionMarkers
from diffeo_calib.maps.nominal import NominalMap
from diffeo_calib.robots.payload import NO_PAYLOAD, Payload

PAYLOADS = ("payloads", "task_controls", "unladen_theta")
"""Names of the tensors: mass of every control; then, for readers without the formulas of a payload, the places of the
controls' markers before the task-space flow, and theta of a robot for which the payload of the model is a part of its
own weight."""


def describe_payload(payload: Payload) -> dict[str, Any]:
    """The entry of a robot that carries one payload in all queries."""
    return {"link": payload.link, "mass": float(payload.masses), "unit": payload.unit}


def payload_tensors(fitted: FittedMap) -> dict[str, Tensor]:
    """The tensors of a map; none without payloads."""
    spec, theta = fitted.geodesic.spec, fitted.geodesic.momenta.theta
    nominal, by_row = spec.nominal, spec.nominal_of_controls
    if not isinstance(nominal, GeometryMap) or nominal.elasticity is None or nominal.payload is None:
        return {}
    rows = by_row.load if isinstance(by_row, GeometryMap | SessionMarkers) else NO_PAYLOAD
    if not rows.by_row:
        raise InputError.of("the model cannot be saved: the payloads of its rows are not known")
    sag = nominal.sag
    folded = torch.cat([theta[: sag.start], nominal.elasticity.folded(theta[sag]), theta[sag.stop :]])
    return dict(zip(PAYLOADS, (rows.masses, fitted.geodesic.task_controls, folded), strict=True))


def rebuild_payload(entry: Mapping[str, Any] | None) -> Payload | None:
    """The inverse of :func:`describe_payload`.

    Raises:
        InputError: numbers that are no masses.
    """
    if entry is None:
        return None
    mass, unit = (float(entry[name]) for name in ("mass", "unit"))
    if not 0 <= mass < float("inf") or not isinstance(entry["link"], str):
        raise InputError.of("the entry payload", expected="a link and a mass of 0 or more", got=dict(entry))
    return Payload(entry["link"], torch.tensor(mass, dtype=torch.float64, device=HOST), unit)


def rows_with_payloads(nominal: NominalMap, tensors: Mapping[str, Tensor]) -> GeometryMap | None:
    """k0 at the controls, each with its own payload; None without payloads.

    Raises:
        InputError: not one mass for each control.
    """
    if not isinstance(nominal, GeometryMap) or nominal.payload is None:
        return None
    masses = as_tensor(tensors[PAYLOADS[0]], PAYLOADS[0], (len(tensors["x"]),))
    return nominal.with_payload(nominal.payload.weighing(masses))
