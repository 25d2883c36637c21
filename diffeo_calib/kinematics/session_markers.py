"""Nominal kinematics of rows that were measured in several sessions, each with its own places of the markers."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.nominal import NominalMap


class SessionMarkers(NominalMap):
    """k0 at N given rows; the parameters theta are those of all sessions.

    Args:
        nominal: k0 of the newest session; with payloads, under those of the rows.
        session: (N,) number of each row's session, the oldest is 0.
        tools: (sessions, P, 3) markers at theta = 0 in the tip's frame, m.

    Raises:
        InputError: a session without markers.
    """

    def __init__(self, nominal: GeometryMap, session: Tensor, tools: Tensor) -> None:
        if tools.shape[1:] != nominal.geometry.tool.shape or int(session.min()) < 0 or int(session.max()) >= len(tools):
            expected = f"numbers below {len(tools)}, markers like {tuple(nominal.geometry.tool.shape)}"
            got = f"up to {int(session.max())}, {tuple(tools.shape[1:])}"
            raise InputError.of("sessions of the rows", expected=expected, got=got)
        self.nominal, self.session, self.tools = nominal, session, tools
        self.parameters, self.turns, self.places = nominal.parameters, nominal.turns, nominal.places
        self.maps = [nominal.with_geometry(nominal.geometry.with_tool(tool)) for tool in tools]

    def __call__(self, x: Tensor, theta: Tensor) -> Tensor:
        """Marker positions in m: (N, 3 P)."""
        return self._by_session(lambda nominal, rows: nominal(x[rows], theta))

    def jacobian(self, x: Tensor, theta: Tensor) -> Tensor:
        """Dk0 in m/rad or m/m: (N, 3 P, n)."""
        return self._by_session(lambda nominal, rows: nominal.jacobian(x[rows], theta))

    def sensitivities(self, x: Tensor, theta: Tensor) -> Tensor:
        """d k0 / d theta in m/m or m/rad: (N, 3 P, K)."""
        return self._by_session(lambda nominal, rows: nominal.sensitivities(x[rows], theta))

    def moved(self, nominal: GeometryMap) -> SessionMarkers:
        """The same sessions with the base of another nominal map, and the payloads of their rows."""
        return SessionMarkers(nominal.with_payload(self.nominal.payload), self.session, self.tools)

    def _by_session(self, of: Callable[[GeometryMap, Tensor], Tensor]) -> Tensor:
        rows = [(self.session.cpu() == number).nonzero()[:, 0] for number in range(len(self.maps))]
        parts = [of(nominal.rows(own), own) for nominal, own in zip(self.maps, rows, strict=True) if len(own)]
        together = torch.cat(parts)
        return together[torch.cat(rows).argsort().to(together.device)]
