"""Files of cameras: YAML of OpenCV and of ROS (camera_info), and what is known of lens and board beside them."""

from __future__ import annotations

from math import inf
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.cameras.images import UNKNOWNS, Camera
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError
from diffeo_calib.common.files import read_regular

MATRICES = {"camera_matrix": 9, "distortion_coefficients": 5}
LARGEST_FILE = 1_000_000
"""Bytes of a file that no camera has."""
LARGEST = 1e6
"""Above all numbers of cameras: focal lengths are some thousand pixels."""
BOARD, ROOT = "board", "root"
"""Matrices that only files of this package hold: (5,) of the board, and (14, c) of the uncertainty."""


def camera_text(camera: Camera, *, ros: bool = False) -> str:
    """A camera as YAML, of OpenCV's `FileStorage` or of ROS's `camera_info_manager`."""
    fx, fy, cx, cy, *distortion = camera.lens.tolist()
    head = [] if ros else ["%YAML:1.0", "---"]
    head += [f"image_width: {camera.width}", f"image_height: {camera.height}"]
    matrix = "camera_matrix", 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    lens = "distortion_coefficients", 1, distortion
    if ros:
        head += ["camera_name: camera", "distortion_model: plumb_bob"]
        eye, whole = [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0], [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        own = [matrix, lens, ("rectification_matrix", 3, eye), ("projection_matrix", 3, whole)]
    else:
        head += [f"avg_reprojection_error: {camera.noise!r}", f"board_half_size: {camera.half_size!r}"]
        root = ROOT, len(UNKNOWNS), camera.root.flatten().tolist()
        own = [matrix, lens, (BOARD, 1, camera.board.tolist()), root]
    return "\n".join(
        [*head, *(line for name, rows, data in own for line in matrix_lines(name, rows, data, ros=ros)), ""]
    )


def read_camera(path: str | PathLike[str]) -> Camera:
    """The camera of a file of this package, of OpenCV or of ROS.

    The lens of foreign files is taken as exact, and their board, of which they know nothing, has the size 0.

    Raises:
        InputError: no such file, one that is no camera, or another distortion model than five coefficients.
    """
    file = Path(path)
    try:
        text = read_regular(file, "camera file", LARGEST_FILE).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError.of(f"file '{file}'", expected="a camera's YAML file", got=str(error)) from None
    values = {name: _numbers(file, text, name, count) for name, count in MATRICES.items()}
    fx, _, cx, _, fy, cy = values["camera_matrix"][:6].tolist()
    width, height = (int(_number(file, text, f"image_{name}")) for name in ("width", "height"))
    lens = torch.cat([values["camera_matrix"].new_tensor([fx, fy, cx, cy]), values["distortion_coefficients"]])
    if not (fx > 0 and fy > 0 and min(width, height) > 0):
        raise InputError.of(
            f"file '{file}'", expected="positive focal lengths and image size", got=f"{fx}, {fy}, {width}, {height}"
        )
    if f"\n{ROOT}:" not in text:
        return Camera(width, height, 0.0, torch.cat([lens, lens.new_zeros(5)]), lens.new_zeros(len(UNKNOWNS), 0))
    root = _numbers(file, text, ROOT, None).view(len(UNKNOWNS), -1)
    half, noise = (_number(file, text, name) for name in ("board_half_size", "avg_reprojection_error"))
    return Camera(width, height, half, torch.cat([lens, _numbers(file, text, BOARD, 5)]), root, noise)


def matrix_lines(name: str, rows: int, data: list[float], *, ros: bool = False) -> list[str]:
    """A matrix in YAML, of OpenCV or of ROS, from its numbers row by row."""
    cols, numbers = len(data) // rows, ", ".join(repr(float(value)) for value in data)
    kind = [] if ros else ["   dt: d"]
    return [
        f"{name}:" + " !!opencv-matrix" * (not ros),
        f"   rows: {rows}",
        f"   cols: {cols}",
        *kind,
        f"   data: [{numbers}]",
    ]


def _numbers(file: Path, text: str, name: str, count: int | None) -> Tensor:
    """The numbers of a matrix; of the root those of whole rows."""
    data = f"\n{text}".partition(f"\n{name}:")[2].partition("data:")[2].lstrip()
    inside, end, _ = data.partition("]")
    try:
        values = [float(word) for word in inside.removeprefix("[").replace(",", " ").split()] if end else []
    except ValueError:
        values = []
    if name == "distortion_coefficients" and len(values) == 4:
        values.append(0.0)
    right = len(values) == count if count else values and len(values) % len(UNKNOWNS) == 0
    if not right or not all(abs(value) < LARGEST for value in values):
        expected = f"a matrix `{name}` of {count or f'{len(UNKNOWNS)} rows of'} numbers below {LARGEST:.0e}"
        raise InputError.of(f"file '{file}'", expected=expected, got=f"{len(values)} numbers", fix="check the file")
    return torch.tensor(values, dtype=torch.float64, device=HOST)


def _number(file: Path, text: str, name: str) -> float:
    word = f"\n{text}".partition(f"\n{name}:")[2].partition("\n")[0].strip()
    try:
        value = float(word)
    except ValueError:
        value = inf
    if not 0.0 <= value < LARGEST:
        expected = f"a line `{name}: NUMBER`, positive and below {LARGEST:.0e}"
        raise InputError.of(f"file '{file}'", expected=expected, got=repr(word), fix="check the file")
    return value
