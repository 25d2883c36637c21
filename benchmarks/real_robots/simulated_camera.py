"""The simulated arm with a camera on its flange that looks at a board on the floor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.cameras.board import BoardPrior
from diffeo_calib.cameras.images import Camera
from diffeo_calib.common.device import HOST, seeded
from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.robots.simulated_arm import SimulatedArm

BOARD = (0.55, 0.1, 0.05)
"""Place of the board in the arm's base, m."""
CAMERA = (0.06, 0.01, 0.04, 0.1, -0.2, 0.3)
"""Place of the camera in the flange, m, and its rotation vector, rad."""
CAMERA_BESIDE = (-0.09, 0.03, 0.02, -0.15, 0.3, 1.7)
"""The same of a second camera on the flange."""
FIXED_CAMERA = (1.0, 0.3, 0.7), (0.5, 0.0, 0.35)
"""Place of a fixed camera in the arm's base, and where it looks, m."""
SECOND_CAMERA = (0.5, -0.75, 0.6), (0.5, 0.0, 0.35)
"""The same of another camera that sees the same board."""
BOARD_ON_FLANGE = 0.0, 0.02, 0.05
"""Place of a board on the flange, m, that looks away from it."""
NEAR, FAR, VIEW = 0.25, 0.6, 0.85
"""Distances of the board that the camera sees, m, and cosine of half its angle of view."""
WIDTH, HEIGHT, SQUARE, CORNERS = 1280, 960, 0.03, (7, 5)
"""Of the images, pixels; side of a square of the board, m, and its inner corners along x and y."""
LENS = 1200.0, 1195.0, 650.0, 470.0, -0.15, 0.08, 1e-3, -5e-4, 0.0
"""True lens of the camera, see diffeo_calib.cameras.board."""
SECOND_LENS = 1000.0, 1003.0, 630.0, 490.0, -0.1, 0.04, -5e-4, 8e-4, 0.0
"""That of the second camera."""
PRINT = 1e-4, 1e-4, 1e-3, 0.0, -5e-4
"""True errors of the printed board, see diffeo_calib.cameras.board."""
BOARD_PRIOR = BoardPrior(scale=2e-4)
"""Of a print that was measured with a caliper."""
FEWEST_SEEN = 12
"""Corners of an image that is used."""
LEVER = 0.1
MARKS = torch.tensor(
    [[1.0, 0.0, 0.0], [-0.5, 0.75**0.5, 0.0], [-0.5, -(0.75**0.5), 0.0]], dtype=torch.float64, device=HOST
)
"""Three marks around a frame, at LEVER m from its origin, carry its pose: the simulated arm knows points alone."""


def marks_of(poses: Tensor) -> Tensor:
    """Marks (..., 3, 3) of poses (..., 4, 4), one per row, m."""
    return poses[..., None, :3, 3] + LEVER * MARKS @ poses[..., :3, :3].mT


def poses_of(marks: Tensor) -> Tensor:
    """Poses (..., 4, 4) that marks (..., 3, 3) carry, m."""
    x = torch.nn.functional.normalize(marks[..., 0, :] - marks.mean(-2), dim=-1)
    y = torch.nn.functional.normalize(marks[..., 1, :] - marks[..., 2, :], dim=-1)
    return transforms(torch.stack([x, y, torch.linalg.cross(x, y)], -1), marks.mean(-2))


@dataclass(frozen=True)
class CameraArm:
    """An arm, configurations in which its camera sees the board, true poses of the board in the camera, lens, print."""

    arm: SimulatedArm
    q: Tensor
    boards: Tensor
    camera: Camera

    def measured(self, position_std: float, rotation_std: float, *, on_tool: bool = True) -> dc.Measurements:
        """Measured poses with drawn errors [m, rad]; not ``on_tool``: inverted by hand, as of any device."""
        N, dtype = len(self.q), torch.float64
        shifts, turns = (torch.randn(N, 3, dtype=dtype, device=HOST, generator=seeded(k)) for k in (5, 6))
        seen = rotation(rotation_std * turns) @ self.boards[:, :3, :3]
        boards = transforms(seen, self.boards[:, :3, 3] + position_std * shifts)
        poses = boards if on_tool else torch.linalg.inv(boards)
        return dc.Measurements.from_poses(self.q, poses, self.arm.nominal.joint_names, camera_on_tool=on_tool)

    def images(self, noise_px: float, *, on_tool: bool = True, seed: int = 7) -> dc.Measurements:
        """Corners with drawn errors in the images that show enough of them; not ``on_tool``: seen by a fixed camera."""
        q, corners = self.shown(noise_px, seed)
        known = {"board": BOARD_PRIOR, "camera_on_tool": on_tool}
        return dc.Measurements.from_images(q, corners, (WIDTH, HEIGHT), self.arm.nominal.joint_names, **known)

    def shown(self, noise_px: float, seed: int = 7) -> tuple[Tensor, Tensor]:
        """Configurations, and corners with drawn errors, of the images that show enough of them."""
        corners = seen_corners(self.boards, noise_px, seed, self.camera)
        shown = (~corners[..., 3].isnan()).sum(1) >= FEWEST_SEEN
        return self.q[shown], corners[shown]

    def error(self, kinematics: dc.CalibratedKinematics, q: Tensor) -> float:
        """Root mean square distance to the truth of the three points of the camera's pose, m."""
        return float((kinematics(q) - self.arm.true_points(q)).square().sum(-1).mean().sqrt())


def flat_board() -> Tensor:
    """Inner corners (K, 3) of the board as it was meant, m, its middle at the origin."""
    x, y = (SQUARE * (torch.arange(count, dtype=torch.float64, device=HOST) - (count - 1) / 2) for count in CORNERS)
    x, y = torch.meshgrid(x, y, indexing="ij")
    return torch.stack([x.flatten(), y.flatten(), torch.zeros_like(x).flatten()], 1)


def true_camera(print_seed: int | None = None, lens: Sequence[float] = LENS) -> Camera:
    """Lens and board as they are; with a seed the errors of the print are drawn from their prior."""
    half_size = SQUARE * (max(CORNERS) - 1) / 2
    unknowns = torch.tensor([*lens, *PRINT], dtype=torch.float64, device=HOST)
    if print_seed is not None:
        draw = torch.randn(len(PRINT), dtype=torch.float64, device=HOST, generator=seeded(print_seed))
        unknowns[len(LENS) :] = draw * draw.new_tensor(BOARD_PRIOR.deviations(half_size))
    return Camera(WIDTH, HEIGHT, half_size, unknowns, unknowns.new_zeros(len(unknowns), 0))


def seen_corners(boards: Tensor, noise_px: float, seed: int = 7, camera: Camera | None = None) -> Tensor:
    """Corners (N, K, 5) of boards at poses (N, 4, 4) in the camera's frame, m and pixels, NaN outside of the image."""
    points = flat_board().expand(len(boards), -1, 3)
    pixels = (camera or true_camera()).pixels(boards, points)
    pixels = pixels + noise_px * torch.randn(pixels.shape, dtype=pixels.dtype, device=HOST, generator=seeded(seed))
    found = torch.cat([points, pixels], 2)
    outside = (pixels < 0).any(2) | (pixels[..., 0] > WIDTH - 1) | (pixels[..., 1] > HEIGHT - 1)
    return found.masked_fill(outside[..., None], torch.nan)


def camera_arm(
    rows: int, seed: int = 1, print_seed: int | None = None, *, second: bool = False, worse: float = 1.0
) -> CameraArm:
    """An arm whose camera sees the board in random configurations; the print as of :func:`true_camera`.

    ``worse``: factor on the arm's errors of joints and links.
    """
    arm = SimulatedArm(seed=seed, markers=3, transmission=worse, geometry=worse)
    given = torch.tensor(CAMERA_BESIDE if second else CAMERA, dtype=torch.float64, device=HOST)
    camera = transforms(rotation(given[None, 3:]), given[None, :3])
    base = torch.eye(4, dtype=torch.float64, device=HOST)
    base[:3, 3] = -torch.tensor(BOARD, dtype=torch.float64, device=HOST)
    arm.truth = replace(arm.truth, base=base, tool=marks_of(camera)[0])
    seen_boards = _seen(arm, rows, seed, lambda points: torch.linalg.inv(poses_of(points)))
    return CameraArm(arm, *seen_boards, true_camera(print_seed, SECOND_LENS if second else LENS))


def fixed_camera_arm(rows: int, seed: int = 1, print_seed: int | None = None, *, second: bool = False) -> CameraArm:
    """An arm with the board on its flange, in random configurations in which a fixed camera sees it; print as there."""
    arm, where = SimulatedArm(seed=seed, markers=3), SECOND_CAMERA if second else FIXED_CAMERA
    place, aim = (torch.tensor(xyz, dtype=torch.float64, device=HOST) for xyz in where)
    z = (aim - place) / (aim - place).norm()
    x = torch.linalg.cross(z, z.new_tensor([0.0, 0.0, 1.0]))
    x = x / x.norm()
    R = torch.stack([x, torch.linalg.cross(z, x), z])  # from the base to the camera
    base = torch.eye(4, dtype=torch.float64, device=HOST)
    base[:3, :3], base[:3, 3] = R, -R @ place
    on_flange = torch.eye(4, dtype=torch.float64, device=HOST)
    on_flange[:3, 3] = torch.tensor(BOARD_ON_FLANGE, dtype=torch.float64, device=HOST)
    arm.truth = replace(arm.truth, base=base, tool=marks_of(on_flange))
    seen_boards = _seen(arm, rows, seed, poses_of)
    return CameraArm(arm, *seen_boards, true_camera(print_seed, SECOND_LENS if second else LENS))


def images_of_both(
    arms: Sequence[CameraArm], rows: Sequence[int], noise_px: float, seed: int = 7, *, on_tool: bool = False
) -> dc.Measurements:
    """The first images of two cameras, "left" and "right", of the same arm and board, in turn: on the tool, or not."""
    names = arms[0].arm.nominal.joint_names
    q, corners = zip(*(arm.shown(noise_px, seed + k) for k, arm in enumerate(arms)), strict=True)
    order = torch.cat([torch.arange(count, device=HOST) for count in rows]).argsort(stable=True)
    q, corners = (torch.cat([own[:n] for own, n in zip(each, rows, strict=True)])[order] for each in (q, corners))
    cameras = [name for name, count in zip(("left", "right"), rows, strict=True) for _ in range(count)]
    known = {"board": BOARD_PRIOR, "camera_on_tool": on_tool, "seen_by": [cameras[k] for k in order.tolist()]}
    return dc.Measurements.from_images(q, corners, (WIDTH, HEIGHT), names, **known)


def _seen(arm: SimulatedArm, rows: int, seed: int, boards_of: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """Random configurations in which the camera sees the printed side of the board, and poses of the board."""
    found: list[tuple[Tensor, Tensor]] = []
    for draw in range(200):
        q = arm.sample(20_000, seed=1000 * seed + draw)
        boards = boards_of(arm.true_points(q))
        away = boards[:, :3, 3].norm(dim=1)
        ahead = boards[:, 2, 3] > VIEW * away
        above = torch.linalg.inv(boards)[:, 2, 3] > 0.15
        seen = ahead & above & (away > NEAR) & (away < FAR)
        found.append((q[seen], boards[seen]))
        if sum(len(part) for part, _ in found) >= rows:
            break
    q, boards = (torch.cat(parts)[:rows] for parts in zip(*found, strict=True))
    return q, boards
