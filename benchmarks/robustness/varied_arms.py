"""Simulated arms of several kinds, for constants that must not be tuned to one robot.

The seed draws the errors of an arm: geometry, transmission, gravity sag, gear lines, backlash and noise, added to a
nominal chain. Rows are random configurations, repeated configurations, or rows along motions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi

import numpy as np
import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.joint import turned_axes
from diffeo_calib.robots.se3 import rotation

TWIST_DEVIATION = 5e-4
"""Standard deviation of geometric errors, m and rad."""
TRANSMISSION_RAD = 2e-4
LARGEST_SAG_RAD = 1e-3
ROWS_PER_MOTION, MOTION_STEP = 10, 0.02
"""MOTION_STEP is in units of the joint ranges."""
REPEATS = 3
OUTLIER_M = 5e-3


@dataclass(frozen=True)
class Kind:
    """Errors of an arm and of its measurements.

    Args:
        geometry, transmission, gravity: factors on the default errors.
        gear_line: amplitude of a gear line in every joint, rad. backlash: of every joint, rad.
        noise: standard deviation of a coordinate, m. freedom: degrees of freedom of its Student's t; infinite for
            Gaussian noise.
        outliers: fraction of outlying rows. joint_range: fraction of the joint ranges that rows cover.
        rows: "random", "repeated" configurations, or along "motions".
    """

    geometry: float = 1.0
    transmission: float = 1.0
    gravity: float = 1.0
    gear_line: float = 0.0
    backlash: float = 0.0
    noise: float = 2e-5
    freedom: float = float("inf")
    outliers: float = 0.0
    joint_range: float = 1.0
    rows: str = "random"


KINDS = {
    "usual": Kind(),
    "stiff": Kind(geometry=0.5, transmission=0.3, gravity=0.2, noise=3e-5),
    "soft": Kind(gravity=5.0),
    "gears": Kind(gear_line=5e-5, noise=1.5e-5),
    "backlash": Kind(backlash=1.5e-4),
    "t3": Kind(freedom=3.0, noise=3e-5),
    "outliers": Kind(outliers=0.02),
    "noisy": Kind(noise=1.5e-4, transmission=0.5),
    "small": Kind(joint_range=0.3),
    "motions": Kind(rows="motions"),
    "repeated": Kind(rows="repeated", noise=4e-5),
}


class VariedArm:
    """One arm of a kind.

    Args:
        nominal: nominal chain. kind: see :class:`Kind`. seed: draws the errors, and where device and marker are.
    """

    def __init__(self, nominal: dc.Tree, kind: Kind, seed: int) -> None:
        rng = np.random.default_rng([seed, 0])
        self.nominal, self.kind, n = nominal, kind, nominal.n
        self.base = torch.eye(4, dtype=torch.float64)
        axis, shift = rng.standard_normal(3), rng.standard_normal(3)
        self.base[:3, :3] = rotation(torch.from_numpy(axis / np.linalg.norm(axis) * rng.uniform(0.5, pi)))
        self.base[:3, 3] = torch.from_numpy(3.0 * shift / np.linalg.norm(shift))
        self.tool = torch.from_numpy(rng.uniform((-0.1, -0.1, 0.05), (0.1, 0.1, 0.2), (1, 3)))
        self.twists = torch.from_numpy(TWIST_DEVIATION * kind.geometry * rng.standard_normal(6 * nominal.moving))
        self.harmonics = torch.from_numpy(np.column_stack([np.ones(n), np.full(n, 2), rng.integers(3, 7, n)]))
        size = TRANSMISSION_RAD * kind.transmission
        self.waves = torch.from_numpy(size * rng.uniform(0.5, 1.5, (n, 3)))
        self.phases = torch.from_numpy(rng.uniform(0, 2 * pi, (n, 4)))
        self.ratios = torch.from_numpy(rng.choice([100.0, 120.0, 160.0], n))
        self.masses = torch.from_numpy(rng.uniform(0.5, 1.5, n) * np.linspace(1.0, 0.3, n))
        self.sag = torch.from_numpy(LARGEST_SAG_RAD * kind.gravity * rng.uniform(0.1, 1.0, n))

    def later(self, seed: int, drift: float) -> VariedArm:
        """The same arm on another date: device and marker elsewhere, its errors changed by the fraction ``drift``."""
        other, rng = VariedArm(self.nominal, self.kind, seed), np.random.default_rng([seed, 1])
        other.twists, other.waves, other.phases, other.sag = self.twists, self.waves, self.phases, self.sag
        other.ratios, other.masses, other.harmonics = self.ratios, self.masses, self.harmonics
        if drift:
            own = drift * TWIST_DEVIATION * self.kind.geometry
            other.twists = self.twists + torch.from_numpy(own * rng.standard_normal(len(self.twists)))
            other.waves = self.waves * torch.from_numpy(1 + 2 * drift * rng.standard_normal(self.waves.shape))
            other.sag = self.sag * torch.from_numpy(1 + drift * rng.standard_normal(self.sag.shape))
        return other

    def true_points(self, q: Tensor) -> Tensor:
        """True markers (N, 1, 3), m, without backlash."""
        smooth = (self.waves * torch.sin(self.harmonics * q[..., None] + self.phases[:, :3])).sum(-1)
        lines = self.kind.gear_line * torch.sin(self.ratios * q + self.phases[:, 3])
        return self._geometry().points(q + smooth + lines + self.sag * self._torques(q))

    def measured(self, q: Tensor, seed: int) -> Tensor:
        """Measured markers (N, 1, 3), m."""
        rng, kind = np.random.default_rng([seed, 2]), self.kind
        signs = torch.from_numpy(rng.choice([-0.5, 0.5], tuple(q.shape)))
        points = self.true_points(q + kind.backlash * signs)
        drawn = kind.noise * rng.standard_normal((len(q), 1, 3))
        if kind.freedom < float("inf"):
            drawn /= np.sqrt(rng.chisquare(kind.freedom, (len(q), 1, 1)) / kind.freedom)
        wrong = rng.random((len(q), 1, 1)) < kind.outliers
        return points + torch.from_numpy(drawn + wrong * OUTLIER_M * rng.standard_normal((len(q), 1, 3)))

    def rows(self, count: int, seed: int, style: str | None = None) -> Tensor:
        """Joint values (count, n), rad; in the style of the kind unless given."""
        rng, style = np.random.default_rng([seed, 3]), style or self.kind.rows
        low, high = (side.numpy() for side in self.nominal.limits.clamp(-pi, pi).unbind(1))
        middle, half = 0.5 * (low + high), 0.5 * self.kind.joint_range * (high - low)
        if style == "motions":
            starts = rng.uniform(-0.8, 0.8, (-(-count // ROWS_PER_MOTION), 1, len(low)))
            steps = 2 * MOTION_STEP * rng.standard_normal(starts.shape) * np.arange(ROWS_PER_MOTION)[:, None]
            share = (starts + steps).reshape(-1, len(low))[:count].clip(-1, 1)
        else:
            each = REPEATS if style == "repeated" else 1
            share = np.repeat(rng.uniform(-1, 1, (-(-count // each), len(low))), each, 0)[:count]
        return torch.from_numpy(middle + half * share)

    def _geometry(self) -> Geometry:
        placed = replace(Geometry.nominal(self.nominal, 1), base=self.base, tool=self.tool)
        theta = torch.zeros(placed.size, dtype=torch.float64)
        theta[placed.slices["joints"]] = self.twists
        return placed.absorb(theta)

    def _torques(self, q: Tensor) -> Tensor:
        """Torques of gravity about the joints (N, n), in units of the largest."""
        frames = self.nominal.joint_frames(q)
        axes, origins = turned_axes(frames, self.nominal.axes), frames[..., :3, 3]
        tip = self.nominal(q)[..., :3, 3].reshape(len(q), 1, 3)
        loads = torch.cat([origins[:, 1:], tip], 1)
        pull = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64) * self.masses[:, None]
        arms = loads[:, None] - origins[:, :, None]
        return (axes[:, :, None] * torch.linalg.cross(arms, pull.expand_as(arms))).sum(-1).triu().sum(-1)
