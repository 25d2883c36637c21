"""A simulated elastic six-axis arm whose errors are all known, which no real robot offers.

The causes of a real arm's errors are added to an invented nominal robot (``simulated_arm.urdf``):

    y_k(q) = Geometry_true( q + e(q) + g(q) )_k + noise,
    e_l(q) = sum_h a_lh sin(h q_l + phi_lh)          transmission error: harmonics 1, 2 and one higher; gear lines
    g_l(q) = c_l tau_l(q)                            gravity sag: compliance c_l times the torque about axis l

All draws come from one seed; switching one error source off leaves the rest unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from math import pi
from os import PathLike
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import check_seed
from diffeo_calib.common.device import methods_outside_inference_mode
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.files import write_whole
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.joint import turned_axes
from diffeo_calib.robots.se3 import rotation
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import load_urdf
from diffeo_calib.runtime.chain import joint_motions

URDF_FILE = Path(__file__).with_name("simulated_arm.urdf")
GRAVITY = (0.0, 0.0, -9.81)  # acceleration in the robot's base, which stands upright [m/s^2]
TWIST_DEVIATION = 5e-4  # standard deviation of geometric errors: 0.5 mm and 0.5 mrad
TRANSMISSION_RANGE = (1e-4, 3e-4)  # amplitudes of each harmonic of a joint's transmission error [rad]
HARMONICS, HIGHER_HARMONICS = 3, (3, 7)  # the third harmonic is drawn from this half-open range (waves per turn)
COMPLIANCE = (3.0e-6, 4.0e-6, 6.0e-6, 2.5e-5, 3.0e-5, 4.0e-5)
"""Joint compliances [rad/(N m)]: stiffness 2.5e5 N m/rad at the shoulder, 2.5e4 at the wrist, usual for such gears."""
PAYLOAD_CENTRE = (0.01, -0.02, 0.08)  # centre of mass of the payload in the flange's frame [m]


@dataclass(frozen=True, eq=False)
class Components:
    """The true contributions to the error at some configurations."""

    transmission: Tensor  # (N, 6) true minus measured joint angles [rad]
    gravity: Tensor  # (N, 6) gravity sag of the joints [rad]
    geometry: Tensor  # (N, P, 3) displacement of the markers by the geometric errors alone [m]


@methods_outside_inference_mode
class SimulatedArm:
    """A six-axis arm of about 1.1 m reach with known errors, watched by a laser tracker.

    Args:
        seed: seed of the errors and of the places of tracker and markers. markers: number of markers on the tool.
        geometry: factor on the geometric errors; 0 switches them off. transmission: factor on the transmission errors.
        gravity: factor on the joint compliances. noise: standard deviation of one measured coordinate [m].
        payload: mass at the flange [kg], where the methods are given no other.
        lines: joint number, waves per turn and amplitude [rad] of further transmission errors, such as those of
            reduction gears at multiples of their ratio; their phases are drawn.

    Attributes:
        nominal: the chain as its maker publishes it.
        truth: the true geometry: base in the tracker's frame, joint errors, markers.

    Raises InputError: a negative factor, noise or payload, no marker, or a line of a joint that is not there.
    """

    def __init__(
        self,
        seed: int = 0,
        *,
        markers: int = 1,
        geometry: float = 1.0,
        transmission: float = 1.0,
        gravity: float = 1.0,
        noise: float = 2e-5,
        payload: float = 6.0,
        lines: Sequence[tuple[int, float, float]] = (),
    ) -> None:
        sizes = {"geometry": geometry, "transmission": transmission, "gravity": gravity}
        for name, value in {**sizes, "noise": noise, "payload": payload, "markers": markers - 1}.items():
            if not value >= 0:
                raise InputError.of(f"`{name}` of the simulated arm is too small", fix="pass 0 or more")
        check_seed(seed)
        self.noise, self.payload = noise, payload
        self.nominal = load_urdf(URDF_FILE, "base_link", "flange")
        self._placed, self.truth = _draw_geometry(self.nominal, np.random.default_rng([seed, 0]), markers, geometry)
        self._waves = _draw_waves(seed, self.nominal.n, transmission, lines)
        self._compliance = gravity * torch.tensor(COMPLIANCE, dtype=torch.float64, device="cpu")
        self._masses, self._centres = _loads(self.nominal)

    def true_points(self, q: Tensor, payload: Tensor | float | None = None) -> Tensor:
        """True markers in the tracker's frame, without noise: q (N, 6) [rad] -> (N, P, 3) [m].

        Args:
            q: joint values. payload: masses at the flange (N,) [kg], or one for all; the arm's own by default.
        """
        q = self.nominal.joint_values(q)
        return self.truth.points(q + self._transmission(q) + self._gravity_sag(q, payload))

    def components(self, q: Tensor) -> Components:
        """The contribution of each error source at q (N, 6) [rad]."""
        q = self.nominal.joint_values(q)
        geometry = self.truth.points(q) - self._placed.points(q)
        return Components(self._transmission(q), self._gravity_sag(q), geometry)

    def gravity_torques(self, q: Tensor, payload: Tensor | float | None = None) -> Tensor:
        """Torques of gravity about the joint axes, links and payload: q (N, 6) [rad] -> (N, 6) [N m]."""
        q = self.nominal.joint_values(q)
        frames = self.nominal.joint_frames(q)
        axes, origins = turned_axes(frames, self.nominal.axes), frames[..., :3, 3]  # (N, n, 3)
        links = frames @ joint_motions(self.nominal.motion_terms.to(q.device), q, torch)  # a link moves with its joint
        centres = (links[..., :3, :3] @ self._centres.to(q.device)[..., None])[..., 0] + links[..., :3, 3]
        payload_centre = torch.tensor([*PAYLOAD_CENTRE, 1.0], dtype=torch.float64, device=q.device)
        held = links[:, -1] @ (self.nominal.tip_offsets[0].to(q.device) @ payload_centre)
        centres = torch.cat([centres, held[:, None, :3]], dim=1)
        carried = torch.as_tensor(self.payload if payload is None else payload, dtype=torch.float64, device=q.device)
        masses = torch.cat([self._masses.to(q.device).expand(len(q), -1), carried.expand(len(q))[:, None]], dim=1)
        weights = masses[..., None] * torch.tensor(GRAVITY, dtype=torch.float64, device=q.device)  # (N, n + 1, 3) [N]
        arms = centres[:, None] - origins[:, :, None]  # (N, joint, load, 3)
        moments = (axes[:, :, None] * torch.linalg.cross(arms, weights[:, None].expand_as(arms))).sum(-1)
        return moments.triu().sum(-1)  # joint l carries links l, l + 1, ..., and the payload

    def sample(self, count: int, seed: int = 0) -> Tensor:
        """Random joint values (count, 6) [rad], uniform between the limits."""
        lower, upper = self.nominal.limits.unbind(1)
        draw = torch.from_numpy(np.random.default_rng([seed, 3]).random((count, self.nominal.n)))
        return lower + (upper - lower) * draw

    def measure(self, count: int, seed: int = 0, payload: Tensor | float | None = None) -> tuple[Tensor, Tensor]:
        """Random configurations and the tracker's measurements: q (count, 6) [rad], points (count, P, 3) [m].

        Args:
            count: of configurations. seed: of the draw. payload: masses at the flange, see :meth:`true_points`.
        """
        q = self.sample(count, seed)
        points = self.true_points(q, payload)
        draw = np.random.default_rng([seed, 4]).standard_normal(tuple(points.shape))
        return q, points + self.noise * torch.from_numpy(draw)

    def worn(self, joint: int, factor: float) -> SimulatedArm:
        """Return the arm after the transmission error of one joint has grown by a factor.

        Args:
            joint: its number. factor: of the amplitudes of all its harmonics.
        """
        other, (joints, frequencies, amplitudes, phases) = copy(self), self._waves
        grown = torch.arange(len(joints), device=joints.device) // HARMONICS == range(self.nominal.n)[joint]
        other._waves = joints, frequencies, torch.where(grown, factor * amplitudes, amplitudes), phases
        return other

    def write_urdf(self, path: str | PathLike[str]) -> None:
        """Write the nominal robot as a URDF file (links ``base_link`` to ``flange``)."""
        write_whole(path, URDF_FILE.read_bytes())

    def _transmission(self, q: Tensor) -> Tensor:
        joints, frequencies, amplitudes, phases = (part.to(q.device) for part in self._waves)
        return torch.zeros_like(q).index_add(-1, joints, amplitudes * torch.sin(frequencies * q[..., joints] + phases))

    def _gravity_sag(self, q: Tensor, payload: Tensor | float | None = None) -> Tensor:
        return self._compliance.to(q.device) * self.gravity_torques(q, payload)


def _draw_geometry(chain: Tree, rng: np.random.Generator, markers: int, factor: float) -> tuple[Geometry, Geometry]:
    """Places of tracker and markers, and joint errors: the true geometry without and with joint errors."""
    axis, shift = rng.standard_normal(3), rng.standard_normal(3)
    base = torch.eye(4, dtype=torch.float64, device="cpu")
    base[:3, :3] = rotation(torch.from_numpy(axis / np.linalg.norm(axis) * rng.uniform(0.5, pi)))
    base[:3, 3] = torch.from_numpy(shift / np.linalg.norm(shift) * rng.uniform(2.0, 4.0))
    tool = torch.from_numpy(rng.uniform((-0.1, -0.1, 0.05), (0.1, 0.1, 0.2), (markers, 3)))
    placed = replace(Geometry.nominal(chain, markers), base=base, tool=tool)
    theta = torch.zeros(placed.size, dtype=torch.float64, device="cpu")
    theta[placed.slices["joints"]] = torch.from_numpy(factor * TWIST_DEVIATION * rng.standard_normal(6 * chain.moving))
    return placed, placed.absorb(theta)


def _draw_waves(
    seed: int, n: int, factor: float, lines: Sequence[tuple[int, float, float]]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Joints, waves per turn, amplitudes and phases [rad] of transmission errors, (K,) each: harmonics, then lines."""
    for joint, frequency, amplitude in lines:
        if not (joint in range(n) and frequency > 0 and amplitude >= 0):
            expected = f"joint numbers from 0 to {n - 1}, positive frequencies, amplitudes of 0 or more"
            raise InputError.of("`lines` of the simulated arm", expected=expected, got=(joint, frequency, amplitude))
    rng, of_lines = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 5])
    harmonics = np.column_stack([np.ones(n), np.full(n, 2), rng.integers(*HIGHER_HARMONICS, n)])
    amplitudes = factor * rng.uniform(*TRANSMISSION_RANGE, (n, HARMONICS))
    phases = np.append(rng.uniform(0, 2 * pi, (n, HARMONICS)), of_lines.uniform(0, 2 * pi, len(lines)))
    joints = [*np.repeat(np.arange(n), HARMONICS).tolist(), *(joint for joint, _, _ in lines)]
    numbers = np.concatenate(
        [np.stack([harmonics, amplitudes]).reshape(2, -1), np.array(lines).reshape(-1, 3).T[1:]], 1
    )
    frequencies, sizes, shifts = (torch.from_numpy(part.copy()) for part in (*numbers, phases))
    return torch.tensor(joints, dtype=torch.int64, device="cpu"), frequencies, sizes, shifts


def _loads(chain: Tree) -> tuple[Tensor, Tensor]:
    """Mass (n,) [kg] and centre of mass (n, 3) [m] of each joint's link, without payload."""
    root = ElementTree.parse(URDF_FILE).getroot()
    masses, centres = [], []
    for name in chain.joint_names:
        link = next(root.iterfind(f"joint[@name='{name}']/child")).attrib["link"]
        inertial = next(root.iterfind(f"link[@name='{link}']/inertial"))
        masses.append(float(next(inertial.iterfind("mass")).attrib["value"]))
        centres.append([float(word) for word in next(inertial.iterfind("origin")).attrib["xyz"].split()])
    mass, centre = (torch.tensor(values, dtype=torch.float64, device="cpu") for values in (masses, centres))
    return mass, centre
