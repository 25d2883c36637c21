"""What only some models have in their files: payloads, a registration, sessions; entries of the header, and tensors.

Readers that know nothing of them must refuse such a file: controls of other payloads or sessions have other markers,
and the markers of the fit are not those of a registered model.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, check_number
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import GeometryMap, SessionMarkers
from diffeo_calib.kinematics.re_registration.registered_map import Registration
from diffeo_calib.maps.nominal import NominalMap
from diffeo_calib.robots.payload import NO_PAYLOAD, Payload
from diffeo_calib.robots.se3 import rigid

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


PREFIX = "registration_"
ARRAYS = ("transform", "markers", "covariance", "centre", "q", "gain", "noise")
REGISTRATION = tuple(PREFIX + name for name in ARRAYS)
"""Names of the tensors."""
SHIFT = "shift"
NUMBERS = ("lever", "rms_before", "rms_after", "left_out_rms", "excess", "same_place")
OPTIONAL = ("lever", "rms_before", "same_place")
ENTRIES = {*NUMBERS, "same", "free", "outliers", "undetermined", SHIFT}


def describe_registration(found: Registration) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Its entry in the header, and its tensors."""
    entry = {name: getattr(found, name) for name in (*NUMBERS, "same", "free")}
    shift = None if found.shift is None else found.shift.tolist()
    entry |= {"outliers": list(found.outliers), "undetermined": list(found.undetermined), SHIFT: shift}
    return entry, {PREFIX + name: getattr(found, name) for name in ARRAYS}


def rebuild_registration(entry: Any, tensors: dict[str, Tensor], n: int) -> Registration:
    """The inverse of :func:`describe_registration`; ``n`` is the number of joints.

    Raises:
        InputError: entries that are missing or do not fit together.
    """
    if not isinstance(entry, dict) or set(entry) != ENTRIES:
        got = sorted(entry) if isinstance(entry, dict) else entry
        raise InputError.of("the entry registration", expected=sorted(ENTRIES), got=got)
    for name in NUMBERS:
        if not (entry[name] is None and name in OPTIONAL):
            check_number(entry[name], f"the entry {name} of the registration", above=-1e-300, below=inf)
    if not isinstance(entry["same"], bool) or entry["free"] not in ("both", "base", "marker"):
        expected = "a boolean `same`, and `free` of both, base or marker"
        raise InputError.of("the entry registration", expected=expected, got=(entry["same"], entry["free"]))
    arrays = {name: tensors[PREFIX + name] for name in ARRAYS}
    markers, rows = len(arrays["markers"]), len(arrays["q"])
    k, m = 6 + 3 * markers, 3 * markers
    shapes = {"markers": (markers, 3), "covariance": (k, k), "centre": (3,), "q": (rows, n), "gain": (k, m * rows)}
    for name, shape in (shapes | {"noise": (m, m)}).items():
        as_tensor(arrays[name], PREFIX + name, shape)
    rigid(arrays["transform"], PREFIX + "transform")
    shift = None if entry[SHIFT] is None else as_tensor(entry[SHIFT], SHIFT, (markers, 3))
    words = {"outliers": tuple(map(int, entry["outliers"])), "undetermined": tuple(map(str, entry["undetermined"]))}
    return Registration(**arrays, **words, shift=shift, **{name: entry[name] for name in (*NUMBERS, "same", "free")})


SHARED = "shared_noise"
SESSIONS = (SHARED, "session", "session_tools")
"""Names of the tensors: effects of shifts that rows share, number of each control's session, markers of each. The last
two are missing where one calibration had several sessions, whose markers are those of the model."""


def describe_sessions(fitted: FittedMap) -> dict[str, Tensor]:
    """The tensors of a map; none if all its rows are of one session."""
    by_row = fitted.geodesic.spec.at_controls
    if not isinstance(by_row, SessionMarkers):
        return {SHARED: fitted.noise.shared} if fitted.noise.shared.shape[2] else {}
    values = fitted.noise.shared, by_row.session.to(torch.float64), by_row.tools
    return dict(zip(SESSIONS, values, strict=True))


def rebuild_sessions(nominal: NominalMap, tensors: dict[str, Tensor]) -> SessionMarkers | None:
    """The inverse of :func:`describe_sessions`: k0 at the controls.

    Raises:
        InputError: tensors that do not fit together.
    """
    if SHARED not in tensors:
        return None
    if not isinstance(nominal, GeometryMap):
        raise InputError.of("sessions of rows", expected="a robot", got="a plain function")
    noise, rows = tensors["noise"], len(tensors["x"])
    as_tensor(tensors[SHARED], SHARED, (len(noise), noise.shape[1], "c"))
    if SESSIONS[1] not in tensors:
        return None
    numbers = as_tensor(tensors["session"], "session", (rows,))
    tools = as_tensor(tensors["session_tools"], "session_tools", ("S", nominal.geometry.markers, 3))
    whole = numbers.round().to(torch.int64)
    if bool((whole != numbers).any()):
        raise InputError.of("the tensor session", expected="whole numbers", got=numbers[:5].tolist())
    return SessionMarkers(nominal, whole, tools)
