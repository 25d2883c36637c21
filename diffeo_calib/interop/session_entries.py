"""The sessions of a recalibrated model in its file: tensors of their own.

Readers that know nothing of sessions must refuse such a file: the controls of earlier sessions have other markers.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import GeometryMap, SessionMarkers
from diffeo_calib.maps.nominal import NominalMap

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
