"""What do commanded poses and places tell, without joint values? Hand-eye transforms, and error fields of machines.

    python benchmarks/robustness/commanded_machines.py --seeds 10 --out commanded_machines.json

`hand-eye`: a camera on the flange sees a board (0.1 mm and 0.3 mrad of noise); the arm is off by a smooth random field
over its poses of 0, 0.3 or 1 mm (and twice as many mrad). Peers that take the arm to be perfect: least squares over
camera and board (SciPy), weighted by the true noise, and, where OpenCV 4 is installed, its `calibrateHandEye`. Errors
are those of the camera in the flange, and of the camera's place at 200 other poses. No linear unbiased estimate is
better on average than `bound_mm`, not even one that knows the covariance of the field.
`corners`: the same arms and images of a board of 9 x 6 corners, 0.1 or 0.3 px of noise, the lens unknown. The peer is a
bundle adjustment over camera, board and pinhole (SciPy); OpenCV gets poses by the true lens.
`gantry`, `delta`, `small`: a machine of 1 m out of square and bent; a delta robot with wrong lengths and zeros; smooth
random errors within 0.2 m. Measured places have 0.05 mm of noise a coordinate; errors are those of 500 other places.

Fields of a record: `machine`, `rows`, `arm_mm`, `corner_px`, `seed`; `before_mm` of the machine as it is, `after_mm` of
the model at new places, `inside` share of these in 95 % regions; `camera_mm` of the hand-eye transform, `sigmas` the
largest of its errors in standard deviations, `inside_camera` share of its six numbers within 1.96; `peer_mm`,
`peer_after_mm` of least squares; `opencv_mm` and `opencv_after_mm` of Daniilidis' method (of
the five the best, or within 2 % of it, in every case of 34 draws), None without OpenCV 4; `bound_mm`.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import argparse
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import harness
import numpy as np
import torch
from harness import Record
from held_out import covered
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.kinematics.hand_eye import HandEye

COLUMNS = ("machine", "rows", "arm_mm", "corner_px", "seed", "before_mm", "after_mm", "inside", "camera_mm", "sigmas")
COLUMNS = (*COLUMNS, "inside_camera", "peer_mm", "peer_after_mm", "opencv_mm", "opencv_after_mm", "bound_mm")
SHIFT_NOISE_M, TURN_NOISE_RAD, PLACE_NOISE_M = 1e-4, 3e-4, 5e-5
NEW_POSES, NEW_PLACES = 200, 500
WAVES_PER_UNIT, TURN_PER_SHIFT = 2.0, 2.0
"""Of the arm's field: its rates, and rad of turn for m of shift."""
PIXELS, FOCAL_PX, CORNERS, SQUARE_M = (1280, 1024), 800.0, (9, 6), 0.025
LENS = np.array([FOCAL_PX, FOCAL_PX, (PIXELS[0] - 1) / 2.0, (PIXELS[1] - 1) / 2.0])
"""The camera of images, and its board."""
Poses = NDArray[np.float64]
"""(N, 4, 4), m; or places (N, 3), m."""
ErrorOf = Callable[[Poses], Poses]


def transform(turn: object, place: object = (0.0, 0.0, 0.0)) -> Poses:
    """(..., 4, 4) of rotation vectors, rad, and places, m."""
    turn, place = np.broadcast_arrays(np.asarray(turn, float), np.asarray(place, float))
    found = np.zeros((*turn.shape[:-1], 4, 4))
    found[..., :3, :3] = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(*turn.shape[:-1], 3, 3)
    found[..., :3, 3], found[..., 3, 3] = place, 1.0
    return found


CAMERA, BOARD = transform((0.06, -0.08, 0.7), (0.03, -0.06, 0.05)), transform((0.03, 0.02, 0.35), (0.6, 0.02, 0.01))
DOWN = Rotation.from_euler("x", 180.0, degrees=True)


def waves(rng: np.random.Generator, inputs: int, outputs: int, per_unit: float) -> ErrorOf:
    """A smooth random field of unit size in each output, as a sum of six waves."""
    rates, phases = per_unit * rng.normal(size=(6, inputs)), rng.uniform(0.0, 2.0 * np.pi, 6)
    sizes = rng.normal(size=(6, outputs)) / 3.0**0.5
    return lambda x: np.sin(x @ rates.T + phases) @ sizes


def flange_poses(rng: np.random.Generator, count: int) -> Poses:
    """A flange that looks at the board, from 0.35 to 0.6 m away, tilted and turned."""
    angles = np.concatenate([rng.uniform(-35.0, 35.0, (count, 2)), rng.uniform(-90.0, 90.0, (count, 1))], 1)
    turns = (DOWN * Rotation.from_euler("xyz", angles, degrees=True)).as_matrix()
    away = rng.uniform(0.35, 0.6, (count, 1)) * turns[:, :, 2]
    found = transform(np.zeros((count, 3)), (0.6, 0.0, 0.0) - away + rng.uniform(-0.08, 0.08, (count, 3)))
    found[:, :3, :3] = turns
    return found


def hand_eye(rows: int, arm_mm: float, seed: int, corner_px: float | None = None) -> Record:
    """One camera on the flange of one arm, and poses of a board, or images of it."""
    rng = np.random.default_rng(seed)
    field = waves(rng, 6, 6, WAVES_PER_UNIT)

    def true(poses: Poses) -> Poses:
        return moved(poses, 1e-3 * arm_mm * field(inputs_of(poses)))

    commanded, new = flange_poses(rng, rows), flange_poses(rng, NEW_POSES)
    exact, machine = np.linalg.inv(true(commanded) @ CAMERA) @ BOARD, dc.cartesian(commanded)
    q = dc.pose_inputs(machine, commanded)
    if corner_px is None:
        seen = transform(TURN_NOISE_RAD * rng.normal(size=(rows, 3))) @ exact
        seen[:, :3, 3] = exact[:, :3, 3] + SHIFT_NOISE_M * rng.normal(size=(rows, 3))
        data = dc.Measurements.from_poses(q, torch.from_numpy(seen), camera_on_tool=True, doubt=False)
        peer, board = squares(commanded, seen)
    else:
        corners = images(exact, corner_px, rng)
        data = dc.Measurements.from_images(q, corners, PIXELS, doubt=False)
        (peer, board), seen = bundle(commanded, corners), solved(corners)
    model = dc.calibrate(machine, data).model
    camera = HandEye.of(model).camera
    away = np.concatenate([(camera.pose[:3, 3].numpy() - CAMERA[:3, 3]), turn_between(camera.pose.numpy(), CAMERA)])
    sigmas = np.abs(away) / camera.deviations.numpy()
    there = np.linalg.inv(BOARD) @ true(new) @ CAMERA  # the camera, seen from the board
    mean, covariance = model.predict_poses(dc.pose_inputs(machine, new), noise=False)
    shifts = torch.from_numpy(there[:, None, :3, 3]) - mean[:, None, :3, 3]
    nominal = (np.linalg.inv(board) @ new @ peer)[:, :3, 3] - there[:, :3, 3]
    return {
        "machine": "hand-eye" if corner_px is None else "corners",
        **{"rows": rows, "arm_mm": arm_mm, "corner_px": corner_px, "seed": seed, "before_mm": None},
        "after_mm": 1e3 * rms(shifts[:, 0].numpy()),
        "inside": covered(shifts, covariance[:, None, :3, :3]),
        "camera_mm": 1e3 * float(np.linalg.norm(away[:3])),
        "sigmas": float(sigmas.max()),
        "inside_camera": float((sigmas < 1.96).mean()),
        "peer_mm": 1e3 * float(np.linalg.norm(peer[:3, 3] - CAMERA[:3, 3])),
        "peer_after_mm": 1e3 * rms(nominal),
        **dict(zip(("opencv_mm", "opencv_after_mm"), of_opencv(commanded, seen, new, there), strict=True)),
        "bound_mm": None if corner_px is not None else bound_mm(commanded, 1e-3 * arm_mm),
    }


def images(board: Poses, corner_px: float, rng: np.random.Generator) -> Poses:
    """(N, K, 5) corners in the plane of the board, m, and their pixels, NaN outside of the image."""
    x, y = np.meshgrid(*(SQUARE_M * (np.arange(count) - (count - 1) / 2.0) for count in CORNERS), indexing="ij")
    plane = np.stack([x, y, 0.0 * x], 2).reshape(-1, 3)
    found = np.concatenate([np.broadcast_to(plane, (len(board), *plane.shape)), pixels(board, plane, LENS)], 2)
    found[..., 3:] += corner_px * rng.normal(size=found[..., 3:].shape)
    found[((found[..., 3:] < 0.0) | (found[..., 3:] > np.array(PIXELS) - 1.0)).any(2)] = np.nan
    return found


def pixels(board: Poses, plane: Poses, lens: Poses) -> Poses:
    """(N, K, 2) of corners (K, 3), m, on boards (N, 4, 4) in the camera, by focal lengths and centre (4,), px."""
    there = plane @ board[:, :3, :3].swapaxes(1, 2) + board[:, None, :3, 3]
    return there[..., :2] / there[..., 2:] * lens[:2] + lens[2:]


def bundle(flange: Poses, corners: Poses) -> tuple[Poses, Poses]:
    """Camera in the flange and board in the base by bundle adjustment from the truth, a pinhole unknown too."""
    shown, plane = ~np.isnan(corners[..., 3:]), np.nanmax(corners[..., :3], 0)

    def missed(x: Poses) -> Poses:
        camera, board = CAMERA @ transform(x[:3], x[3:6]), BOARD @ transform(x[6:9], x[9:12])
        return (pixels(np.linalg.inv(flange @ camera) @ board, plane, LENS + FOCAL_PX * x[12:]) - corners[..., 3:])[
            shown
        ]

    x = least_squares(missed, np.zeros(16), x_scale="jac").x
    return CAMERA @ transform(x[:3], x[3:6]), BOARD @ transform(x[6:9], x[9:12])


def solved(corners: Poses) -> Poses | None:
    """Poses of the board by OpenCV and the true lens; None without OpenCV 4."""
    cv2, found = opencv(), []
    if cv2 is None:
        return None
    lens = np.array([[LENS[0], 0.0, LENS[2]], [0.0, LENS[1], LENS[3]], [0.0, 0.0, 1.0]])
    for image in corners:
        own = image[~np.isnan(image).any(1)]
        _, turn, place = cv2.solvePnP(own[:, :3].copy(), own[:, 3:].copy(), lens, None)
        found.append(transform(turn[:, 0], place[:, 0]))
    return np.stack(found)


def inputs_of(poses: Poses) -> Poses:
    """(N, 6) of the arm's field, m and rad."""
    return np.concatenate([poses[:, :3, 3], (DOWN.inv() * turns_of(poses)).as_rotvec()], 1)


def moved(poses: Poses, error: Poses) -> Poses:
    """Poses with the errors (N, 6) of an arm."""
    found = transform(TURN_PER_SHIFT * error[:, 3:])
    found[:, :3, :3] = found[:, :3, :3] @ poses[:, :3, :3]
    found[:, :3, 3] = poses[:, :3, 3] + error[:, :3]
    return found


def turns_of(poses: Poses) -> Rotation:
    """Rotations of poses."""
    return Rotation.from_matrix(poses[..., :3, :3])


def turn_between(first: Poses, second: Poses) -> Poses:
    """(..., 3) rotation vectors, rad."""
    return (turns_of(first) * turns_of(second).inv()).as_rotvec()


def squares(commanded: Poses, seen: Poses) -> tuple[Poses, Poses]:
    """Camera in the flange and board in the base by least squares from the truth, which is the peer's best case."""

    x = least_squares(lambda x: left(x, commanded, seen).ravel(), np.zeros(12), x_scale="jac").x
    return CAMERA @ transform(x[:3], x[3:6]), BOARD @ transform(x[6:9], x[9:])


def left(x: Poses, flange: Poses, seen: Poses) -> Poses:
    """(N, 6) errors of board poses in standard deviations, with turn and shift x (12,) of camera and board."""
    camera, board = CAMERA @ transform(x[:3], x[3:6]), BOARD @ transform(x[6:9], x[9:])
    expected = np.linalg.inv(flange @ camera) @ board
    shift = (expected - seen)[:, :3, 3] / SHIFT_NOISE_M
    return np.concatenate([shift, turn_between(expected, seen) / TURN_NOISE_RAD], 1)


def bound_mm(flange: Poses, arm_m: float) -> float:
    """RMS error of the camera's place by the best linear unbiased estimate, which knows the covariance of the field.

    Six waves of random rates have the covariance exp(-rate^2 d^2 / 2) in each output (Gauss and Markov's theorem).
    """
    nothing, seen, h = np.zeros(12), np.linalg.inv(flange @ CAMERA) @ BOARD, 1e-6
    by_unknown = np.stack([left(h * one, flange, seen).ravel() / h for one in np.eye(12)], 1)
    errors = [moved(flange, np.tile(h * one, (len(flange), 1))) for one in np.eye(6)]
    by_error = np.stack([left(nothing, own, seen) / h for own in errors], 2)  # (N, 6, 6)
    x = inputs_of(flange)
    K = arm_m**2 * np.exp(-0.5 * WAVES_PER_UNIT**2 * ((x[:, None] - x) ** 2).sum(2))
    covariance = np.einsum("iab,ij,jcb->iajc", by_error, K, by_error).reshape(len(by_unknown), -1)
    covariance += np.eye(len(covariance))
    found = np.linalg.inv(by_unknown.T @ np.linalg.solve(covariance, by_unknown))
    return 1e3 * float(np.sqrt(found.diagonal()[3:6].sum()))


def opencv() -> Any:
    """OpenCV 4, which is optional; version 5 has no methods for hand-eye."""
    try:
        found = import_module("cv2")
    except ImportError:
        return None
    return found if hasattr(found, "calibrateHandEye") else None


def of_opencv(
    commanded: Poses, seen: Poses | None, new: Poses, there: Poses
) -> tuple[float, float] | tuple[None, None]:
    """Errors, mm, of OpenCV 4: of the camera in the flange, and of its place at new poses; or nothing.

    The board is where it is on average.
    """
    cv2 = opencv()
    if cv2 is None or seen is None:
        return None, None
    split = [list(each) for own in (commanded, seen) for each in (own[:, :3, :3], own[:, :3, 3])]
    camera = np.eye(4)
    camera[:3, :3], place = cv2.calibrateHandEye(*split, method=cv2.CALIB_HAND_EYE_DANIILIDIS)
    camera[:3, 3] = place[:, 0]
    boards = commanded @ camera @ seen
    board = transform(turns_of(boards).mean().as_rotvec(), boards[:, :3, 3].mean(0))
    away = (np.linalg.inv(board) @ new @ camera)[:, :3, 3] - there[:, :3, 3]
    return 1e3 * float(np.linalg.norm(camera[:3, 3] - CAMERA[:3, 3])), 1e3 * rms(away)


def rms(errors: Poses) -> float:
    """Of vectors (N, 3)."""
    return float(np.sqrt((errors**2).sum(1).mean()))


def gantry(rng: np.random.Generator) -> tuple[ErrorOf, ErrorOf]:
    """Errors (N, 3) of places (N, 3), m, and places of draws in the unit cube."""
    size, bent, skew = np.array([1.0, 0.8, 0.4]), waves(rng, 3, 3, 6.0), 6e-4 * rng.normal(size=(3, 3))
    return lambda x: (x - size / 2) @ skew.T + 3e-4 * bent(x), lambda draws: size * draws


def small(rng: np.random.Generator) -> tuple[ErrorOf, ErrorOf]:
    """The same of smooth random errors within 0.2 m."""
    field = waves(rng, 3, 3, 18.0)
    return lambda x: 6e-4 * field(x), lambda draws: 0.2 * draws - 0.1


def delta(rng: np.random.Generator) -> tuple[ErrorOf, ErrorOf]:
    """The same of a delta robot: where it goes with the joint values of its nominal lengths."""
    wrong = {"upper": 5e-4 * rng.normal(size=3), "lower": 5e-4 * rng.normal(size=3)}
    wrong |= {"base": 5e-4 * rng.normal(size=3), "zero": 1e-3 * rng.normal(size=3)}
    right = {name: np.zeros(3) for name in wrong}

    def error(x: Poses) -> Poses:
        joints, place = delta_joints(x, right), x.copy()
        for _ in range(20):  # Newton's steps
            steps = [delta_joints(place + h, wrong) - delta_joints(place - h, wrong) for h in 1e-6 * np.eye(3)]
            slopes = np.stack(steps, 2) / 2e-6
            place = place - np.linalg.solve(slopes, (delta_joints(place, wrong) - joints)[..., None])[..., 0]
        return place - x

    def places(draws: Poses) -> Poses:
        radius, turn = 0.35 * np.sqrt(draws[:, 0]), 2.0 * np.pi * draws[:, 1]
        return np.stack([radius * np.cos(turn), radius * np.sin(turn), -0.55 - 0.25 * draws[:, 2]], 1)

    return error, places


def delta_joints(place: Poses, error: dict[str, Poses]) -> Poses:
    """Joint values (N, 3), rad, of a platform's places (N, 3), m: arms of 0.3 and 0.7 m at radii of 0.2 and 0.05 m."""
    found = []
    for k in range(3):
        c, s = np.cos(2.0 * np.pi * k / 3.0), np.sin(2.0 * np.pi * k / 3.0)
        x, y = place[:, 0] * c + place[:, 1] * s + 0.05 - 0.2 - error["base"][k], place[:, 1] * c - place[:, 0] * s
        upper, lower = 0.3 + error["upper"][k], 0.7 + error["lower"][k]
        C, S = -2.0 * upper * x, 2.0 * upper * place[:, 2]
        h = lower**2 - x**2 - y**2 - place[:, 2] ** 2 - upper**2
        middle, half = np.arctan2(S, C), np.arccos(np.clip(h / np.hypot(C, S), -1.0, 1.0))
        outward = np.cos(middle - half) > np.cos(middle + half)
        found.append(np.where(outward, middle - half, middle + half) + error["zero"][k])
    return np.stack(found, 1)


MACHINES = {"gantry": gantry, "delta": delta, "small": small}


def field(machine: str, rows: int, seed: int) -> Record:
    """One machine with commanded places."""
    rng = np.random.default_rng(seed)
    error, places = MACHINES[machine](rng)
    commanded, new = (places(rng.uniform(size=(count, 3))) for count in (rows, NEW_PLACES))
    device = transform((0.1, 0.2, -0.3), (1.0, 2.0, 0.3))
    seen = (
        (commanded + error(commanded)) @ device[:3, :3].T + device[:3, 3] + PLACE_NOISE_M * rng.normal(size=(rows, 3))
    )
    robot = dc.cartesian(commanded)
    data = dc.Measurements(dc.pose_inputs(robot, commanded), torch.from_numpy(seen), doubt=False)
    model = dc.calibrate(robot, data).model
    true: Tensor = torch.from_numpy((new + error(new)) @ device[:3, :3].T + device[:3, 3])
    mean, covariance = model.predict(dc.pose_inputs(robot, new), noise=False)
    away, before = true[:, None] - mean, error(new)
    return {
        **{"machine": machine, "rows": rows, "arm_mm": None, "corner_px": None, "seed": seed},
        "before_mm": 1e3 * rms(before - before.mean(0)),
        "after_mm": 1e3 * rms(away[:, 0].numpy()),
        "inside": covered(away, covariance),
        **dict.fromkeys(COLUMNS[8:]),
    }


def measure(arguments: argparse.Namespace) -> Iterator[Record]:
    """Yield one record for every machine, number of rows and seed."""
    seeds = 1 if arguments.quick else arguments.seeds
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
        for rows in (20,) if arguments.quick else (10, 20, 40, 80):
            for arm_mm in (0.3,) if arguments.quick else (0.0, 0.3, 1.0):
                for corner_px in (None, 0.3) if arguments.quick else (None, 0.1, 0.3):
                    yield from (hand_eye(rows, arm_mm, seed, corner_px) for seed in range(seeds))
        for machine in MACHINES:
            for rows in (40,) if arguments.quick else (100, 400):
                yield from (field(machine, rows, seed) for seed in range(seeds))


def main() -> None:
    """Parse the arguments and measure."""
    parser = harness.parser(__doc__)
    parser.add_argument("--seeds", type=harness.count, default=10, metavar="N", help="machines of each kind")
    arguments = parser.parse_args()
    harness.guarded(lambda: _report(arguments))


def _report(arguments: argparse.Namespace) -> None:
    harness.report(measure(arguments), arguments.out, COLUMNS)


if __name__ == "__main__":
    main()
