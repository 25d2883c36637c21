"""Sockets after a calibration: where they are, how well that is known, and what places that are left out say.

Without a measuring device rigid motions that remain in the fields say nothing about the robot, and are taken out of all
covariances (regression/rigid_motions.py). A device that measured other rows holds the frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffeo_calib.calibration.choose_scales import ChosenScales
from diffeo_calib.calibration.socket_places import SocketPlaces
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.re_registration.registered_map import frame_slopes
from diffeo_calib.kinematics.socket_errors import socket_errors
from diffeo_calib.maps.noise import Noise
from diffeo_calib.measurements.sockets import Sockets
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.regression.choose import condition_for_covariances

WORKSPACE_ROWS = 100
"""Random configurations in the joint ranges of the rows, over which rigid motions are left out."""
FLATTERY = (
    "the spread within sockets flatters: errors that all rows of a socket share, and the robot's size, do not show in "
    "it, so that absolute errors are 2 to 6 times as large; choose nothing by it"
)


@dataclass(frozen=True)
class PlaceErrors:
    """A place as predicted by the model without its rows, scales kept.

    Args:
        place: its name. rows: their number.
        spread: root mean square distance of the ball from the middle of its socket, m: consistency, no accuracy.
        distance_errors: found minus known distances of its sockets, m.
    """

    place: str
    rows: int
    spread: float
    distance_errors: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class FoundSockets:
    """The sockets after a calibration, in the measuring frame: that of the device, or the robot's base without one.

    Args:
        names: S names. positions: (S, 3) m.
        covariance: (3 S, 3 S) of the positions, m^2; without a device without rigid motions of all of them.
        left_out: every place, predicted by all other rows.
        workspace_deviation: root mean square distance, m, that the model expects between its positions of the ball and
            the true ones over the joint ranges of the rows; without a device after the best rigid motion.
        by_device: whether a device measured other rows.
    """

    names: tuple[str, ...]
    positions: Tensor
    covariance: Tensor
    left_out: tuple[PlaceErrors, ...]
    workspace_deviation: float
    by_device: bool = False

    @property
    def deviations(self) -> Tensor:
        """(S, 3) standard deviations of the coordinates, m."""
        return self.covariance.diagonal().clamp(min=0).sqrt().view(-1, 3)

    @property
    def left_out_spread(self) -> float:
        """Root mean square distance from the middle of its socket over the rows of all places, each left out, m."""
        rows = sum(one.rows for one in self.left_out)
        return (sum(one.rows * one.spread**2 for one in self.left_out) / rows) ** 0.5

    def entry(self) -> dict[str, object]:
        """Positions by name, spread of places left out, and expected absolute error, for programs; all in m."""
        positions = dict(zip(self.names, self.positions.tolist(), strict=True))
        spread = self.left_out_spread
        return {"positions_m": positions, "left_out_spread_m": spread, "expected_error_m": self.workspace_deviation}

    def sentences(self) -> list[str]:
        """Places of the sockets, how well they are predicted, and what that does not show."""
        frame = "the measuring frame" if self.by_device else "the robot's base"
        among, fitted = ("", "") if self.by_device else ("among the sockets ", ", after a rigid fit")
        lines = [
            f"socket '{name}': {', '.join(f'{1e3 * v:.3f}' for v in place)} mm in {frame}, deviations "
            f"{among}{', '.join(f'{1e3 * v:.3f}' for v in deviation)} mm"
            for name, place, deviation in zip(
                self.names, self.positions.tolist(), self.deviations.tolist(), strict=True
            )
        ]
        for one in self.left_out:
            errors = ", ".join(f"{1e3 * error:+.3f}" for error in one.distance_errors)
            known = f", distance {errors} mm" * bool(errors)
            lines.append(f"place '{one.place}' left out: spread {1e3 * one.spread:.4f} mm{known} ({one.rows} rows)")
        lines.append(
            f"spread within sockets, each place left out: {1e3 * self.left_out_spread:.4f} mm; expected absolute error "
            f"over the joint ranges of the rows{fitted}: {1e3 * self.workspace_deviation:.3f} mm"
        )
        return lines if self.by_device else [*lines, FLATTERY]


def found_sockets(fitted: FittedMap, placed: Measurements, places: SocketPlaces, chosen: ChosenScales) -> FoundSockets:
    """The sockets with what the fit says about them.

    Args:
        fitted: the map, without rigid motions if there was no device. placed: its rows, as
            :meth:`SocketPlaces.placed` gives them.
        places: where the sockets were before. chosen: scales, and the rows with their weights.
    """
    noise, own = fitted.noise, places.root.shape[1]
    errors = (placed.points - fitted(placed.q).detach().unflatten(1, (-1, 3))).nan_to_num(0.0).flatten(1)
    shifts = torch.einsum("nmc,nm->c", noise.shared, noise.solve(errors))[-own:]
    positions, root = places.positions - (places.root @ shifts).view(-1, 3), places.root
    if fitted.workspace is not None:
        B = frame_slopes(positions[None], positions.mean(0))[0]  # (3 S, 6)
        root = root - B @ (torch.linalg.pinv(B) @ root)
    # (1 + Z^T (G + R_i)^-1 Z)^-1: 1 - Z^T (G + R)^-1 Z would lose all digits, so wide is their prior
    others, sockets = noise.shared[..., :-own], noise.shared[..., -own:]
    alone = condition_for_covariances(fitted.geodesic.linearise(fitted.data), Noise(noise.covariance, others))
    known = torch.einsum("nmc,nmk->ck", sockets, alone.solve(sockets))
    known = known + torch.eye(len(known), dtype=known.dtype, device=known.device)
    covariance = root @ torch.linalg.solve(known, root.mT)
    left_out, spread = _left_out(placed, chosen), workspace_deviation(fitted)
    return FoundSockets(places.sockets.names, positions, covariance, left_out, spread, not placed.without_device)


def workspace_deviation(fitted: FittedMap) -> float:
    """Root mean square distance, m, between modelled and true positions that the model expects over its workspace.

    Of the last marker, the ball.
    """
    covariance = fitted.posterior(workspace_of(fitted), noise=False)[1]
    return float(covariance.diagonal(dim1=1, dim2=2)[:, -3:].sum(1).mean().sqrt())


def without_rigid_motions(fitted: FittedMap) -> FittedMap:
    """The same map whose covariances leave out rigid motions over the joint ranges of its rows."""
    parts = fitted.noise, fitted.data, fitted.new_noise, workspace_of(fitted)
    return FittedMap(fitted.deformation, *parts, slopes=fitted.slopes)


def workspace_of(fitted: FittedMap) -> Tensor:
    """Random configurations (M, n) in the joint ranges of the rows; those that the map keeps if there are any."""
    if fitted.workspace is not None:
        return fitted.workspace
    low, high = fitted.x.amin(0), fitted.x.amax(0)
    shape = WORKSPACE_ROWS, len(low)
    draws = torch.rand(shape, dtype=torch.float64, generator=seeded(0), device=HOST).to(low)
    return low + (high - low) * draws


def _left_out(placed: Measurements, chosen: ChosenScales) -> tuple[PlaceErrors, ...]:
    """Every place as predicted by all other rows: with A its block of (G + R)^-1, its errors are A^-1 mu.

    What the others tell about shifts that they share with it, those of a distance, is no prediction of the model.
    """
    if placed.socket is None or placed.sockets is None:
        raise InputError.of("the rows have no sockets", fix="pass Measurements.from_sockets(...)")
    data, sockets, found = chosen.data, placed.sockets, []
    dense = data.factorised(chosen.selection.scales)
    inverse, mu = torch.cholesky_inverse(dense.factor), dense.mu(data.target)
    ball = torch.arange(mu.numel(), device=mu.device).view(mu.shape)[:, -3:]
    shared = mu.new_zeros(*mu.shape, 0) if data.shared is None else data.shared
    for number, name in enumerate(sockets.place_names):
        rows = (placed.places == number).nonzero()[:, 0]
        index = ball[rows].flatten()
        errors = torch.linalg.solve(inverse[index][:, index], mu[rows, -3:].flatten())
        others = mu - (inverse[:, index] @ errors).view(mu.shape)  # (G + R)^-1 y without the place
        errors = errors.view(-1, 3) + torch.einsum("nac,mbc,mb->na", shared[rows, -3:], shared, others)
        predicted = placed.points[rows, -1] - errors
        found.append(PlaceErrors(name, len(rows), *_spread(predicted, placed.socket[rows], sockets)))
    return tuple(found)


def _spread(predicted: Tensor, socket: Tensor, sockets: Sockets) -> tuple[float, tuple[float, ...]]:
    """Spread of predicted positions (N, 3) within sockets, and errors of the known distances, m."""
    errors = socket_errors(predicted, socket, sockets)
    return float(errors.away.square().sum(-1).mean().sqrt()), tuple(one.error for one in errors.distances)
