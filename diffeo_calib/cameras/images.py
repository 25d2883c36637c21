"""Measurements from images of a board: its poses in the camera, with errors that the lens makes in all of them.

Image i shows corners j at pixels u_ij = h(T_i b_j(s), s) + e_ij: T_i is the pose of the board in the camera's frame,
and s the unknowns of all images: lens and board. With slopes J_i by a shift and turn of T_i and S_i by s, weights W_i,

    A_i = J_i^T W_i J_i,  B_i = J_i^T W_i S_i,  K = 1 + sum_i S_i^T W_i S_i - B_i^T A_i^-1 B_i,

the minimum over all T_i and s leaves every pose with an error of its own and one that all images share,

    T^_i = T_i + A_i^-1 B_i (s - s^) + N(0, A_i^-1),    s - s^ ~ N(0, K^-1).

To first order this is all that the pixels say: 6 numbers per image instead of two per corner. Of several cameras that
see the same board, s holds the lens of each and the one board: the print's scale is the same error in all images.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffeo_calib.cameras.board import (
    BOARD,
    LENS,
    BoardPrior,
    View,
    board_slopes,
    project,
    project_slopes,
    real_board,
    towards,
)
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.common.quantiles import chi2_above
from diffeo_calib.robots.se3 import nearest_rotations, rotation, skew, transforms

UNKNOWNS = (*LENS, *BOARD)
FEWEST_CORNERS = 6
OUTLIER_DEVIATIONS = 3.5  # errors of corners, in standard deviations of their image, from which they lose their weight
ROUNDS, STEPS = 6, 30
CONVERGED, DAMPED = 1e-10, 1e10
SMALLEST_NOISE_PX = 1e-3
PRIOR_IMAGE_CORNERS = 10.0  # corners of a usual image whose noise counts beside an image's own
CENTRE_SHARE, FOCAL_SHARE = 0.25, 1.0
"""Prior deviations of the principal point relative to the image's width, and of focal lengths."""
CHANGED_PROBABILITY = 1e-3
"""Of a difference as large between lenses and boards of two dates that are the same, below which they are others."""
BOARD_DIGITS = 7  # decimal places, m, of corners of a board that are the same
EDGE_SHARE = 1.02  # largest angle from the axis at which corners are seen, relative to that of the image's own corners
MOST_TOGETHER = 512  # images whose slopes are held at a time
DISTORTIONS = (0.5, 1.0, 0.02, 0.02, 1.0)  # prior standard deviations of k1, k2, p1, p2, k3


@dataclass(frozen=True, eq=False)
class Images:
    """N images of a board."""

    points: Tensor  # (N, K, 3) corners of the board as it was meant, m, in its frame; NaN where they were not seen
    pixels: Tensor  # (N, K, 2) where they were seen, pixels: column and row, 0 in the middle of the first pixel
    width: int  # pixels
    height: int

    @property
    def seen(self) -> Tensor:
        """(N, K) boolean."""
        return ~self.pixels.isnan().any(-1)

    @property
    def half_size(self) -> float:
        """Half of the board's larger side, m."""
        flat = self.points[self.seen]
        return 0.5 * float((flat.amax(0) - flat.amin(0)).max())


@dataclass(frozen=True, eq=False)
class Camera:
    """Lens and board that images show, with their joint uncertainty."""

    width: int  # of the images, pixels
    height: int
    half_size: float  # of the board, m
    unknowns: Tensor  # (14,) lens and board, see UNKNOWNS
    root: Tensor  # (14, c) with root root^T their covariance
    noise: float = 0.0  # standard deviation of a corner's coordinate, pixels
    view: View | None = None  # what its images showed; None before images

    @property
    def lens(self) -> Tensor:
        """(9,) fx, fy, cx, cy, k1, k2, p1, p2, k3."""
        return self.unknowns[: len(LENS)]

    @property
    def board(self) -> Tensor:
        """(5,) scale, stretch, and bends."""
        return self.unknowns[len(LENS) :]

    @property
    def deviations(self) -> Tensor:
        """(14,) standard deviations of the unknowns."""
        return self.root.square().sum(1).sqrt()

    @property
    def longer(self) -> Tensor:
        """(c,) errors of unit variance, of which ``root`` has the effects, that double the focal length; 0 if exact."""
        return self.root[:2].any() * torch.linalg.pinv(self.root)[:, :2] @ self.unknowns[:2]

    def pixels(self, poses: Tensor, points: Tensor) -> Tensor:
        """Where corners (N, K, 3) of a board at poses (N, 4, 4) are seen: (N, K, 2)."""
        real = real_board(points, self.board, self.half_size)
        return project(real @ poses[:, :3, :3].mT + poses[:, None, :3, 3], self.lens)

    @property
    def corners(self) -> Tensor:
        """(K, 3) corners of the board as it was meant, m, of a camera with images."""
        if self.view is None:
            raise AssertionError("a camera with images")
        return self.view.points

    def entry(self) -> dict[str, object]:
        """For programs: pixels, and ratios of the board."""
        values = zip(UNKNOWNS, self.unknowns.tolist(), self.deviations.tolist(), strict=True)
        entry: dict[str, object] = {"width": self.width, "height": self.height, "noise_px": self.noise}
        return entry | {name: {"value": value, "std": std} for name, value, std in values}

    def sentences(self) -> Iterator[str]:
        """The lens with standard deviations."""
        value, std = self.unknowns.tolist(), self.deviations.tolist()
        texts = [f"{name} {value[k]:.2f} +- {std[k]:.2f}" for k, name in enumerate(LENS[:4])]
        yield f"camera: {', '.join(texts)} px, corners to {self.noise:.3f} px"
        texts = [f"{name} {value[k]:.5f} +- {std[k]:.5f}" for k, name in enumerate(LENS[4:], 4)]
        yield f"lens distortion: {', '.join(texts)}"

    def board_sentence(self) -> str:
        """The board with standard deviations."""
        value, std = self.unknowns.tolist(), self.deviations.tolist()
        k, size = len(LENS), 1e3 * self.half_size
        bends = ", ".join(f"{size * value[k + 2 + i]:.2f} +- {size * std[k + 2 + i]:.2f}" for i in range(3))
        return (
            f"board: scale {1e6 * value[k]:+.0f} +- {1e6 * std[k]:.0f} ppm, x against y {2e6 * value[k + 1]:+.0f} +- "
            f"{2e6 * std[k + 1]:.0f} ppm, bent {bends} mm; lengths in the images are the board's"
        )

    def alike(self, other: Camera) -> bool:
        """Whether lens and board of an earlier camera may be the same, by the uncertainty of both."""
        mine, theirs = ((c.width, c.height, round(c.half_size, BOARD_DIGITS)) for c in (self, other))
        deviations = (self.deviations.square() + other.deviations.square()).sqrt()
        away = ((self.unknowns - other.unknowns) / deviations).nan_to_num(0.0)
        roots = (torch.cat([self.root, other.root], 1) / deviations[:, None]).nan_to_num(0.0)
        square = away @ torch.linalg.pinv(roots @ roots.mT, hermitian=True) @ away
        return mine == theirs and float(square) < chi2_above(CHANGED_PROBABILITY, len(away))

    def held(self) -> Camera:
        """Hold the lens at its values."""
        root = self.root.clone()
        root[: len(LENS)] = 0.0
        return replace(self, root=root)


@dataclass(frozen=True, eq=False)
class Sights:
    """Measurements from N images of one camera."""

    camera: Camera  # lens and board
    poses: Tensor  # (N, 4, 4) of the board in the camera's frame, m
    covariance: Tensor  # (N, 6, 6) of the own errors of shift (m) and turn (rad), in the camera's axes
    shared: Tensor  # (N, 6, c) effects of the c errors, of unit variance, that all images share


def sighted(images: Images, camera: Camera | None = None, board: BoardPrior | None = None) -> Sights:
    """Poses of a board, and lens and board, from images of one camera; see :func:`sighted_by_several`."""
    return sighted_by_several([images], [camera], board)[0]


def sighted_by_several(
    images: Sequence[Images], cameras: Sequence[Camera | None], board: BoardPrior | None = None
) -> list[Sights]:
    """Poses of one board, lenses, and the board, from images of several cameras: the c errors are the same in all.

    Args:
        images: of each camera. cameras: what is known of the lens and board of each before; None if nothing is, and of
            the board nothing if its size there is 0. The board is that of the first camera that knows one.
        board: prior of a board of which nothing is known.

    Raises:
        MeasurementError: an image with too few corners, or corners on a line; corners that are no image of the board.
    """
    for group in images:
        _check(group)
    starts = _known(images, cameras, board or BoardPrior())
    v = torch.zeros_like(starts[0].root[0])
    states = [State(*parts, first_poses(*parts), v) for parts in zip(images, starts, strict=True)]
    weights = [_weights(state, state.errors().norm(dim=-1).nanmedian() / 1.2) for state in states]
    for _ in range(ROUNDS):
        states = _minimum(states, weights)
        before, weights = weights, [_weights(state) for state in states]
        changes = ((new / old - 1).abs().nan_to_num(0.0).max() for new, old in zip(weights, before, strict=True))
        if max(map(float, changes)) < 1e-3:
            break
    return _result(_minimum(states, weights), weights)


def _known(images: Sequence[Images], cameras: Sequence[Camera | None], board: BoardPrior) -> list[Camera]:
    """Knowledge of all lenses and the one board, with the same columns of errors in all roots.

    The board's errors are counted once: they are those of the first camera that knows it, the other ones add lenses.
    """
    size = max(i.half_size for i in images)
    guesses = [first_guess(i, board, size) if c is None else c for i, c in zip(images, cameras, strict=True)]
    first = next((k for k, c in enumerate(cameras) if c is not None and c.half_size), 0)
    whole = guesses[first]
    if not whole.half_size:  # its lens is known alone
        c = torch.diag(whole.unknowns.new_tensor(board.deviations(size)))
        whole = replace(whole, half_size=size, root=torch.block_diag(whole.root[: len(LENS)], c))
    nothing = torch.zeros_like(whole.root[: len(LENS)])
    roots = [torch.linalg.qr(c.root[: len(LENS)].mT).R.mT for c in guesses]  # (9, c) of the lens alone
    lenses = [nothing[:, :0] if k == first else root for k, root in enumerate(roots)]
    unknowns = []
    for k, (c, others) in enumerate(zip(guesses, torch.block_diag(*lenses).split(len(LENS)), strict=True)):
        lens = torch.cat([whole.root[: len(LENS)] if k == first else nothing, others], 1)
        root = torch.cat([lens, torch.nn.functional.pad(whole.root[len(LENS) :], (0, others.shape[1]))])
        unknowns.append(replace(c, half_size=whole.half_size, unknowns=torch.cat([c.lens, whole.board]), root=root))
    return unknowns


def first_guess(images: Images, board: BoardPrior, half_size: float | None = None) -> Camera:
    """A lens without distortion from homographies, with its principal point in the middle of the image.

    With H = (h1 h2 h3) of an image in pixels from there, h1^T w h2 = 0 and h1^T w h1 = h2^T w h2 for
    w = diag(1/f^2, 1/f^2, 1). Half of the board's size, m, is what the images show of it, by default.
    Source: Z. Zhang, "A flexible new technique for camera calibration", 2000.
    """
    H = homographies(images)
    a, b = H[..., 0], H[..., 1]
    left = torch.cat([(a * b)[:, :2].sum(1), (a * a - b * b)[:, :2].sum(1)])
    right = -torch.cat([(a * b)[:, 2], (a * a - b * b)[:, 2]])
    inverse_square = float((left * right).sum() / (left * left).sum().clamp(min=1e-300))
    usual = float(max(images.width, images.height))
    focal = inverse_square**-0.5 if inverse_square > 0 else usual
    focal = min(max(focal, 0.3 * usual), 10 * usual)
    middle = [(images.width - 1) / 2, (images.height - 1) / 2]
    unknowns = H.new_tensor([focal, focal, *middle, *[0.0] * 10])
    lens = [FOCAL_SHARE * focal] * 2 + [CENTRE_SHARE * images.width] * 2 + list(DISTORTIONS)
    size = half_size or images.half_size
    root = torch.diag(H.new_tensor([*lens, *board.deviations(size)]))
    return Camera(images.width, images.height, size, unknowns, root)


def projection(pixels: Tensor, points: Tensor) -> Tensor:
    """P (3, k + 1) with P (z, 1) ~ (u, v, 1) of images (N, 2) of points z (N, k), by direct linear transformation.

    Source: R. Hartley, A. Zisserman, "Multiple view geometry in computer vision", 2003, section 7.1.
    """
    at = torch.cat([points, torch.ones_like(points[:, :1])], 1)
    rows = torch.cat([torch.cat([at * (k == 0), at * (k == 1), -pixels[:, k : k + 1] * at], 1) for k in range(2)])
    return torch.linalg.svd(rows, full_matrices=len(rows) < rows.shape[1]).Vh[-1].view(3, -1)


def homographies(images: Images) -> Tensor:
    """(N, 3, 3) from the board's plane, m, to pixels from the middle of the image."""
    matrices, middle = [], images.pixels.new_tensor([(images.width - 1) / 2, (images.height - 1) / 2])
    for points, pixels, visible in zip(images.points, images.pixels, images.seen, strict=True):
        flat, centred = points[visible][:, :2], pixels[visible] - middle
        size, scale = flat.abs().max(), centred.abs().max()
        H = projection(centred / scale, flat / size)
        H = torch.diag(H.new_tensor([float(scale), float(scale), 1.0])) @ H
        H = H @ torch.diag(H.new_tensor([1 / float(size), 1 / float(size), 1.0]))
        matrices.append(H / H[:, :2].norm(dim=0).mean())
    return torch.stack(matrices)


def first_poses(images: Images, camera: Camera) -> Tensor:
    """Poses (N, 4, 4) of the board from the homographies of corners without distortion."""
    lens = camera.lens
    tangents = undistorted(images.pixels, lens)
    middle = images.pixels.new_tensor([(images.width - 1) / 2, (images.height - 1) / 2])
    H = homographies(replace(images, pixels=tangents * lens[:2].mean() + middle))
    H = torch.diag(torch.stack([1 / lens[:2].mean(), 1 / lens[:2].mean(), torch.ones_like(lens[0])])) @ H
    H = H * torch.where(H[:, 2, 2] < 0, -1.0, 1.0)[:, None, None]  # in front of the camera
    length = H[..., :2].norm(dim=1).mean(1)[:, None, None]
    first, second, place = (H / length).unbind(-1)
    R = nearest_rotations(torch.stack([first, second, torch.linalg.cross(first, second)], -1))
    return transforms(R, place)


def undistorted(pixels: Tensor, lens: Tensor) -> Tensor:
    """Tangents of angles (..., 2) whose images are these pixels, by Newton's method."""
    start = (pixels - lens[2:4]) / lens[:2]
    estimate = start
    for _ in range(20):
        at = torch.cat([estimate, torch.ones_like(estimate[..., :1])], -1)
        slope = project_slopes(at, lens)[0][..., :2]
        step = torch.linalg.solve(slope.nan_to_num(1.0) + 1e-12 * _eye(2, slope), pixels - project(at, lens))
        estimate = estimate + step.clamp(-0.2, 0.2)
    return torch.where((estimate - start).norm(dim=-1, keepdim=True) < 1.0, estimate, start)


@dataclass(frozen=True, eq=False)
class State:
    """Poses (N, 4, 4) of the board, and v (c,), with lens and board = known.unknowns + known.root v."""

    images: Images
    known: Camera
    poses: Tensor
    v: Tensor

    @property
    def camera(self) -> Camera:
        """With this lens and board."""
        return replace(self.known, unknowns=self.known.unknowns + self.known.root @ self.v)

    def errors(self) -> Tensor:
        """Seen minus predicted pixels (N, K, 2), NaN where not seen."""
        return self.images.pixels - self.camera.pixels(self.poses, self.images.points)

    def slopes(self) -> tuple[Tensor, Tensor]:
        """Derivatives of pixels by poses (N, K, 2, 6) and by v (N, K, 2, c)."""
        camera, points = self.camera, self.images.points
        turned = real_board(points, camera.board, camera.half_size) @ self.poses[:, :3, :3].mT
        by_point, by_lens = project_slopes(turned + self.poses[:, None, :3, 3], camera.lens)
        by_pose = by_point @ torch.cat([_eye(3, turned).expand(*turned.shape[:2], 3, 3), -skew(turned)], -1)
        by_board = by_point @ self.poses[:, None, :3, :3] @ board_slopes(points, camera.half_size)
        return by_pose, torch.cat([by_lens, by_board], -1) @ self.known.root

    def moved(self, steps: Tensor, v: Tensor) -> State:
        """After shifts and turns (N, 6), and with other unknowns."""
        R = rotation(steps[:, 3:]) @ self.poses[:, :3, :3]
        return replace(self, poses=transforms(R, self.poses[:, :3, 3] + steps[:, :3]), v=v)

    def cost(self, weights: Tensor) -> float:
        """Weighted squares of all errors."""
        return float((self.errors() * weights[..., None]).nan_to_num(0.0).square().sum())


class _Normal(NamedTuple):
    """A^-1 (N, 6, 6), A^-1 B (N, 6, c), K - 1 (c, c), and gradients by poses (N, 6) and by v after elimination (c,)."""

    inverse: Tensor
    effect: Tensor
    known: Tensor
    push: Tensor
    along: Tensor

    @classmethod
    def of(cls, state: State, weights: Tensor, damping: float = 0.0) -> _Normal:
        """The normal equations of one camera's images."""
        by_pose, by_v = ((slopes * weights[..., None, None]).nan_to_num(0.0).flatten(1, 2) for slopes in state.slopes())
        errors = (state.errors() * weights[..., None]).nan_to_num(0.0).flatten(1)[..., None]
        A, B = by_pose.mT @ by_pose, by_pose.mT @ by_v
        A = A + damping * torch.diag_embed(A.diagonal(dim1=1, dim2=2))
        inverse = inverses(A)
        push, effect = by_pose.mT @ errors, inverse @ B
        information = (by_v.mT @ by_v - B.mT @ effect).sum(0)
        along = (by_v.mT @ errors - effect.mT @ push).sum(0)[:, 0]
        return cls(inverse, effect, information, push[..., 0], along)


def inverses(A: Tensor) -> Tensor:
    """Inverses of matrices (N, 6, 6) whose rows have different units."""
    size = A.diagonal(dim1=1, dim2=2).rsqrt()
    return size[..., None] * torch.linalg.inv(size[..., None] * A * size[:, None]) * size[:, None]


def _together(parts: Sequence[_Normal]) -> Tensor:
    """K (c, c) of all cameras."""
    return _eye(len(parts[0].along), parts[0].known) + sum(part.known for part in parts)


def _cost(states: Sequence[State], weights: Sequence[Tensor]) -> float:
    """Weighted squares of all errors, and of v."""
    total = sum(state.cost(each) for state, each in zip(states, weights, strict=True))
    return total + float(states[0].v.square().sum())


def _minimum(states: Sequence[State], weights: Sequence[Tensor]) -> list[State]:
    """Levenberg and Marquardt's method with the poses eliminated."""
    damping, cost, states = 1e-6, _cost(states, weights), list(states)
    for _ in range(STEPS):
        parts = [_Normal.of(state, part, damping) for state, part in zip(states, weights, strict=True)]
        K, v = _together(parts), states[0].v
        dv = torch.linalg.solve(K + damping * torch.diag(K.diagonal()), sum(part.along for part in parts) - v)
        steps = [(part.inverse @ part.push[..., None])[..., 0] - part.effect @ dv for part in parts]
        trial = [state.moved(step, v + dv) for state, step in zip(states, steps, strict=True)]
        reached = _cost(trial, weights)
        if reached <= cost:
            done = cost - reached < CONVERGED * cost
            states, cost, damping = trial, reached, max(damping / 10, 1e-12)
            if done:
                break
        elif damping > DAMPED:
            break
        else:
            damping = max(10 * damping, 1e-6)
    return states


def _weights(state: State, noise: Tensor | None = None) -> Tensor:
    """Square roots of the corners' weights (N, K), 1 / pixel, zero where not seen: outliers of an image count less."""
    seen, size = state.images.seen, state.errors().norm(dim=-1).nan_to_num(0.0)
    if noise is None:
        usual = (size.where(seen, size.new_tensor(torch.nan)).nanmedian(1).values / 1.1774).clamp(min=SMALLEST_NOISE_PX)
        inlier = seen & (size < OUTLIER_DEVIATIONS * usual[:, None])
        squares, numbers = (size**2 * inlier).sum(1), 2.0 * inlier.sum(1)
        spare = (numbers - 6).clamp(min=1.0)
        level = (squares / spare).median()  # a usual image: few blurred ones do not count for all
        noise = ((squares + 2 * PRIOR_IMAGE_CORNERS * level) / (spare + 2 * PRIOR_IMAGE_CORNERS)).sqrt()[:, None]
    noise = noise.clamp(min=SMALLEST_NOISE_PX)
    return torch.where(seen, (OUTLIER_DEVIATIONS * noise / size.clamp(min=1e-300)).clamp(max=1.0) / noise, 0.0)


def _result(states: Sequence[State], weights: Sequence[Tensor]) -> list[Sights]:
    parts = [_Normal.of(state, weight) for state, weight in zip(states, weights, strict=True)]
    root = torch.linalg.inv(torch.linalg.cholesky(_together(parts))).mT  # root root^T = K^-1
    every = torch.cat([state.images.points[state.images.seen] for state in states])
    points, sightings = every.round(decimals=BOARD_DIGITS).unique(dim=0), []
    for state, weight, part in zip(states, weights, parts, strict=True):
        noise = float((state.images.seen.sum() / weight.square().sum()).sqrt())
        view = View.of(state.images.seen, state.poses, points)
        camera = replace(state.camera, root=state.known.root @ root, noise=noise, view=view)
        sightings.append(Sights(camera, state.poses, part.inverse, part.effect @ root))
    return sightings


def _check(images: Images) -> None:
    counts = images.seen.sum(1)
    short = (counts < FEWEST_CORNERS).nonzero()[:, 0].tolist()
    if short:
        got, fix = f"{int(counts[short[0]])} in image {short[0]}", "leave this image out"
        raise MeasurementError.of("corners of a board", expected=f"{FEWEST_CORNERS} or more", got=got, fix=fix)
    for number, (points, visible) in enumerate(zip(images.points, images.seen, strict=True)):
        flat = points[visible] - points[visible].mean(0)
        _, width, depth = torch.linalg.svdvals(flat).tolist()
        if width < 1e-6 or depth > 1e-6:
            got = "corners on a line" if width < 1e-6 else "corners that are not in a plane"
            fix = "leave this image out" if width < 1e-6 else "pass points of one printed plane"
            raise MeasurementError.of(f"the board in image {number}", expected="corners of a plane", got=got, fix=fix)


def _eye(size: int, like: Tensor) -> Tensor:
    return torch.eye(size, dtype=like.dtype, device=like.device)


def sees(camera: Camera, poses: Tensor) -> Tensor:
    """(N,) boolean: whether it sees boards at poses (N, 4, 4) in its frame, m, as well as in the worst of its images.

    They are as near and as little inclined, and show as many corners. A camera without images sees all.
    """
    if camera.view is None:
        return torch.ones(len(poses), dtype=torch.bool, device=poses.device)
    view, (away, cosine) = camera.view, towards(poses, camera.view.points)
    visible = (away >= view.near) & (away <= view.far)
    visible &= (-1.0 if view.facing < 0 else 1.0) * cosine >= abs(view.facing)
    visible[visible.clone()] = shown(camera, poses[visible]).sum(1) >= view.fewest
    return visible


def shown(camera: Camera, poses: Tensor) -> Tensor:
    """(N, K) boolean: which corners of boards at poses (N, 4, 4) are inside the image of a camera with images.

    Far outside of the image, where nothing showed the distortion, it may fold rays back into it.
    """
    points, size = camera.corners, camera.unknowns.new_tensor([camera.width - 1, camera.height - 1])
    edge = undistorted(size * size.new_tensor([[0, 0], [0, 1], [1, 0], [1, 1]]), camera.lens).norm(dim=1).max()
    there = points @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
    ahead = there[..., :2].norm(dim=-1) <= EDGE_SHARE * edge * there[..., 2]
    pixels = camera.pixels(poses, points.expand(len(poses), -1, -1))
    return ahead & (pixels >= 0).all(-1) & (pixels <= size).all(-1)


def expected(camera: Camera, poses: Tensor) -> tuple[Tensor, Tensor]:
    """Errors expected of boards at poses (N, 4, 4), m, in images by a camera that has taken images before.

    Covariance (N, 6, 6) of shift (m) and turn (rad) in the camera's axes, and effects (N, 6, 14) of lens and board.
    """
    points, parts = camera.corners, list[tuple[Tensor, Tensor]]()
    eye = torch.eye(len(UNKNOWNS), dtype=poses.dtype, device=poses.device)
    whole = replace(camera, root=eye)
    for some in poses.split(MOST_TOGETHER):
        images = Images(points.expand(len(some), -1, -1), points[:0], camera.width, camera.height)
        unit = shown(camera, some)[..., None, None] / camera.noise
        by_pose, by_unknowns = ((by * unit).flatten(1, 2) for by in State(images, whole, some, 0.0 * eye[0]).slopes())
        covariance = inverses(by_pose.mT @ by_pose)
        parts.append((covariance, covariance @ by_pose.mT @ by_unknowns))
    covariances, effects = (torch.cat(each) for each in zip(*parts, strict=True))
    return covariances, effects
