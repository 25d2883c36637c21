"""The paper's planar test bed: a rigid RR arm as nominal model, an elastic one as reality.

"Book's massless elastic chain": two links in a vertical plane, each a massless cantilever loaded at its end. It
represents a robot whose lengths, base and stiffness differ from its model. There is no noise, and the truth is known
everywhere. Source: R. Orozco, A. Ratajczak, "Calibration by diffeomorphisms of robot manipulator kinematics: a novel
approach", 2025, section 5; nominal model: equation (22). The paper does not print its elastic constants; the constants
below give the error that it reports (0.1 to 0.15 length units).
"""

from __future__ import annotations

from math import pi

import torch
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, wrapped

NOMINAL_LENGTHS = (1.0, 0.5)  # l1, l2 of (22) [length units]
REAL_LENGTHS = (1.08, 0.46)  # L1, L2: unloaded lengths of the real links [length units]
BASE_OFFSET = (0.04, -0.03)  # position of the real arm's base [length units]
LOADS = (1.0, 1.0)  # W1 at the elbow, W2 at the tip: weights along -y [force units]
BENDING_STIFFNESS = (25.0, 6.0)  # e I1, E I2 [force x length^2]
AXIAL_STIFFNESS = 200.0  # e A of both links [force]


def nominal(x: Tensor) -> Tensor:
    """Nominal kinematics (22): joint angles (N, 2) [rad] -> tip (N, 2) [length units]."""
    x1, x2 = _angles(x)
    l1, l2 = NOMINAL_LENGTHS
    return torch.stack([l1 * x1.cos() + l2 * (x1 + x2).cos(), l1 * x1.sin() + l2 * (x1 + x2).sin()], dim=-1)


def real(x: Tensor, scale: float = 1.0) -> Tensor:
    """Real kinematics: joint angles (N, 2) [rad] -> tip of the loaded elastic arm (N, 2) [length units].

    The loads act in the directions of the undeformed arm: closed form, smooth, 2 pi periodic. ``scale`` is a factor on
    all differences from the nominal arm (errors of lengths, base offset, loads): 0 is the nominal arm, 1 the paper's.
    """
    return real_links(x, scale, samples=1)[..., 1, -1, :]


def real_links(x: Tensor, scale: float = 1.0, *, samples: int = 20) -> Tensor:
    """The bent links of the real arm, to draw them; ``samples``: S points on each link after its first one.

    Returns (N, 2, S + 1, 2) points along both links [length units]; the last one is the tip.
    """
    x1, x2 = _angles(x)
    L1, L2 = (l0 + scale * (L - l0) for l0, L in zip(NOMINAL_LENGTHS, REAL_LENGTHS, strict=True))
    W1, W2 = (scale * W for W in LOADS)
    EI1, EI2 = BENDING_STIFFNESS
    s = torch.linspace(0.0, 1.0, samples + 1, dtype=x1.dtype, device=x1.device)
    t1, t2 = x1, x1 + x2
    # Weight in each link's own frame, R(t)^T (0, -W) = -W (sin t, cos t); the distal load also bends link 1.
    F1x, F1y = -(W1 + W2) * t1.sin(), -(W1 + W2) * t1.cos()
    F2x, F2y = -W2 * t2.sin(), -W2 * t2.cos()
    M1 = -W2 * L2 * t2.cos()
    u1, v1 = _cantilever(s, L1, EI1, (F1x, F1y, M1))
    u2, v2 = _cantilever(s, L2, EI2, (F2x, F2y, torch.zeros_like(F2y)))
    bend = F1y * L1**2 / (2 * EI1) + M1 * L1 / EI1  # slope at the end of link 1
    u2, v2 = _turn((bend + x2)[..., None], u2, v2)
    u = torch.stack([u1, u1[..., -1:] + u2], -2)  # (N, 2, S + 1), turned with the first joint's frame
    v = torch.stack([v1, v1[..., -1:] + v2], -2)
    u, v = _turn(x1[..., None, None], u, v)
    return torch.stack([scale * BASE_OFFSET[0] + u, scale * BASE_OFFSET[1] + v], dim=-1)


def grid(k: int = 16) -> Tensor:
    """The k x k grid (k^2, 2) of [-pi, pi)^2 [rad], without pi, which is -pi again."""
    side = -pi + 2 * pi / k * torch.arange(k, dtype=torch.float64, device="cpu")
    return torch.cartesian_prod(side, side)


def _angles(x: Tensor) -> tuple[Tensor, Tensor]:
    checked = x if isinstance(x, Tensor) and wrapped(x) else as_tensor(x, "x", ("N", 2), empty=True)
    return checked[..., 0], checked[..., 1]


def _turn(angle: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    return angle.cos() * x - angle.sin() * y, angle.sin() * x + angle.cos() * y


def _cantilever(s: Tensor, L: float, EI: float, load: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Points along a beam with force (Fx, Fy) and moment M at its end: parts s (S,) of its length -> (N, S) each."""
    along, (Fx, Fy, M) = L * s, (part[..., None] for part in load)
    return along + Fx * along / AXIAL_STIFFNESS, (Fy * (3 * L - along) / 6 + M / 2) * along**2 / EI
