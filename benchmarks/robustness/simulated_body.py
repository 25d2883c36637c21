"""A simulated elastic upper body with two arms, whose errors are all known: the other arm bends the common torso.

    y_k(q) = Geometry_true(q + e(q); theta_s(q))_k + noise,

with transmission errors e_l(q_l) as in the simulated arm, and a sag theta_s of every joint's frame: compliance times
the moment of all links' weights beyond the joint, at their centres of mass. A joint yields about its own axis and less
about the two axes across it. All draws come from one seed.
"""

from __future__ import annotations

from math import pi
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from diffeo_calib.common.checks import check_seed
from diffeo_calib.common.device import methods_outside_inference_mode
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.robots.tree import Tree
from diffeo_calib.robots.urdf import load_urdf
from diffeo_calib.runtime.chain import joint_motions, perpendicular

URDF_FILE = Path(__file__).with_name("simulated_upper_body.urdf")
GRAVITY = (0.0, 0.0, -9.81)
"""Acceleration in the base, which stands upright [m/s^2]."""
HANDS = ("left_hand", "right_hand")
TORSO_COMPLIANCE, ARM_COMPLIANCE = 4e-5, 8e-5
"""About a joint's own axis [rad/(N m)]: some millimetres of sag at the hands, as light humanoids have."""
LATERAL_SHARE = 0.3
"""Compliance across the axis, relative to that about it."""
TWIST_DEVIATION = 5e-4
"""Standard deviation of geometric errors: 0.5 mm and 0.5 mrad."""
TURN_NOISE = 1e-3
"""Of a measured hand, about each axis [rad]: that of cameras which see 0.1 mm at 0.1 m from its middle."""
TRANSMISSION_RAD = (1e-4, 3e-4)
"""Range of the amplitudes of the first and second harmonic of a joint's transmission error."""


@methods_outside_inference_mode
class SimulatedUpperBody:
    """A torso of three joints and a passive fourth, two arms of seven joints, a marker on each hand, seen by cameras.

    Args:
        seed: of the errors and of the places of camera and markers.
        sag: factor on all compliances.
        noise: standard deviation of one measured coordinate [m].

    Attributes:
        nominal: the robot as its maker publishes it, with both hands as tips.
        truth: the true geometry without sag.
    """

    def __init__(self, seed: int = 0, *, sag: float = 1.0, noise: float = 1e-4) -> None:
        check_seed(seed)
        self.noise = noise
        self.nominal = load_urdf(URDF_FILE, "pelvis", HANDS)
        rng = np.random.default_rng([seed, 10])
        self.truth = _draw_geometry(self.nominal, rng)
        self._waves = rng.uniform(*TRANSMISSION_RAD, (2, self.nominal.n)), rng.uniform(0, 2 * pi, (2, self.nominal.n))
        self._masses, self._centres = _links(self.nominal)
        torso = [name in ("waist", "lean", "bend", "upright") for name in self.nominal.moving_names]
        drawn = sag * np.where(torso, TORSO_COMPLIANCE, ARM_COMPLIANCE) * rng.uniform(0.6, 1.4, self.nominal.moving)
        self._compliance = torch.from_numpy(drawn)

    def robot(self, tips: tuple[str, ...] = HANDS, load: tuple[str, ...] = ()) -> Tree:
        """The nominal robot with some of the hands as tips and others as loads."""
        return load_urdf(URDF_FILE, "pelvis", tips, load)

    def columns(self, robot: Tree) -> list[int]:
        """Columns of q that are the joints of a part of the robot."""
        return [self.nominal.joint_names.index(name) for name in robot.joint_names]

    def true_points(self, q: Tensor) -> Tensor:
        """True markers without noise: q (N, 17) [rad] -> (N, 2, 3) [m], left hand first."""
        return self.truth.points(*self._bent(q))

    def true_poses(self, q: Tensor) -> Tensor:
        """True poses of a frame at each marker, with the hand's axes: q (N, 17) [rad] -> (N, 2, 4, 4) [m]."""
        hands = self.truth.marker_poses(*self._bent(q))
        eye = torch.eye(3, dtype=hands.dtype, device=hands.device)
        return hands @ transforms(eye.expand(len(HANDS), 3, 3), self.truth.tool.to(hands))

    def _bent(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Joint values with their transmission errors, and theta with the sag, as the true geometry takes them."""
        q = self.nominal.joint_values(q)
        amplitudes, phases = (torch.from_numpy(part).to(q.device) for part in self._waves)
        harmonics = torch.tensor([[1.0], [2.0]], dtype=q.dtype, device=q.device)
        errors = (amplitudes * torch.sin(harmonics * q[:, None] + phases)).sum(1)
        theta = torch.zeros(len(q), self.truth.size, dtype=q.dtype, device=q.device)
        theta[:, self.truth.slices["joints"]] = self.sag(q).flatten(1)
        return q + errors, theta

    def sag(self, q: Tensor) -> Tensor:
        """True twists of the joints' frames by gravity: (N, 17) -> (N, 18, 6) [m, rad]."""
        robot, count = self.nominal, self.nominal.moving
        places = robot.places(q)[:, :count]
        links = places @ joint_motions(robot.motion_terms, robot.moving_values(q), torch)
        centres = (links[..., :3, :3] @ self._centres[..., None]).squeeze(-1) + links[..., :3, 3]
        weights = self._masses[:, None] * torch.tensor(GRAVITY, dtype=q.dtype, device=q.device)  # (L, 3) [N]
        arms = centres[:, None] - places[:, :, None, :3, 3]  # (N, joint, link, 3)
        carried = robot.ancestors[:count].T | torch.eye(count, dtype=torch.bool, device=q.device)  # joint, link
        moments = torch.linalg.cross(arms, weights.expand_as(arms)).mul(carried[..., None]).sum(2)  # (N, L, 3)
        own = (places[..., :3, :3].mT @ moments[..., None]).squeeze(-1)  # in the joints' frames
        turns = torch.zeros_like(own)
        for joint, axis in enumerate(robot.axes):
            sides = torch.from_numpy(perpendicular(axis.numpy()))
            for e, share in ((axis, 1.0), *((side, LATERAL_SHARE) for side in sides)):
                turns[:, joint] += share * self._compliance[joint] * (own[:, joint] @ e)[:, None] * e
        return torch.cat([torch.zeros_like(turns), turns], dim=-1)

    def sample(self, count: int, seed: int = 0) -> Tensor:
        """Random joint values (count, 17) [rad], uniform between the limits."""
        lower, upper = self.nominal.limits.unbind(1)
        draw = torch.from_numpy(np.random.default_rng([seed, 11]).random((count, self.nominal.n)))
        return lower + (upper - lower) * draw

    def measure(self, count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
        """Random configurations and measured markers: q (count, 17) [rad], points (count, 2, 3) [m]."""
        q = self.sample(count, seed)
        points = self.true_points(q)
        draw = np.random.default_rng([seed, 12]).standard_normal(tuple(points.shape))
        return q, points + self.noise * torch.from_numpy(draw)

    def measure_poses(self, count: int, seed: int = 0, *, turn_noise: float = TURN_NOISE) -> tuple[Tensor, Tensor]:
        """The same configurations, and measured poses (count, 2, 4, 4) of a frame at each marker [m].

        Args:
            count: of rows. seed: of configurations and noise.
            turn_noise: standard deviation of the turn about each axis [rad].
        """
        q, points = self.measure(count, seed)
        poses = self.true_poses(q)
        draw = np.random.default_rng([seed, 13]).standard_normal(tuple(points.shape))
        turned = rotation(turn_noise * torch.from_numpy(draw)) @ poses[..., :3, :3]
        return q, transforms(turned, points)


def _draw_geometry(robot: Tree, rng: np.random.Generator) -> Geometry:
    """Places of camera and markers, and joint errors."""
    axis, shift = rng.standard_normal(3), rng.standard_normal(3)
    base = torch.eye(4, dtype=torch.float64, device="cpu")
    base[:3, :3] = rotation(torch.from_numpy(axis / np.linalg.norm(axis) * rng.uniform(0.5, pi)))
    base[:3, 3] = torch.from_numpy(shift / np.linalg.norm(shift) * rng.uniform(2.0, 3.0))
    tool = torch.from_numpy(rng.uniform(-0.05, 0.05, (len(robot.tips), 3)))
    nominal = Geometry.nominal(robot)
    placed = Geometry(robot, base, nominal.joint_errors, tool, robot.tips)
    theta = torch.zeros(placed.size, dtype=torch.float64, device="cpu")
    theta[placed.slices["joints"]] = torch.from_numpy(TWIST_DEVIATION * rng.standard_normal(6 * robot.moving))
    return placed.absorb(theta)


def _links(robot: Tree) -> tuple[Tensor, Tensor]:
    """Mass (L,) [kg] and centre of mass (L, 3) [m] of the link after every moving joint."""
    root = ElementTree.parse(URDF_FILE).getroot()
    children = {joint.attrib["name"]: joint.find("child") for joint in root.iter("joint")}
    masses, centres = [], []
    for name in robot.moving_names:
        child = children[name]
        link = root.find(f"link[@name='{'' if child is None else child.attrib['link']}']/inertial")
        mass, origin = (None, None) if link is None else (link.find("mass"), link.find("origin"))
        masses.append(0.0 if mass is None else float(mass.attrib["value"]))
        centres.append([0.0] * 3 if origin is None else [float(word) for word in origin.attrib["xyz"].split()])
    mass, centre = (torch.tensor(values, dtype=torch.float64, device="cpu") for values in (masses, centres))
    return mass, centre
