"""Files of cameras: lenses as OpenCV, ROS and Kalibr write them, and what is known of lens and board beside them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor

from diffeo_calib.cameras.images import UNKNOWNS, Camera
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, few, warn_user
from diffeo_calib.common.files import as_path, read_regular

MATRIX = ("camera_matrix", "k", "intrinsics", "intrinsic_matrix", "mtx")
COEFFS = ("coeffs", "coefs", "coeff", "coef", "coefficients", "parameters")
DISTORTION = (
    "distortion_coefficients",
    *("distortion", "dist", "d"),
    *(f"{first}{last}" for first in ("", "d", "dist", "distortion") for last in COEFFS),
)
CENTRE = {"cx": ("cx", "ppx", "u0"), "cy": ("cy", "ppy", "v0")}
SIZE = ("resolution", "image_size")
"""Names of a matrix of 9 numbers or fx, fy, cx, cy, of the distortion, the principal point, and width and height."""
FORMS = (
    "`camera_matrix` with `distortion_coefficients` (OpenCV, ROS), `k` with `d` (topic echo of camera_info), "
    "`intrinsics` with `distortion_coeffs` (Kalibr), or fx, fy, cx and cy"
)
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Of lenses as files hold them; those after k3 must be zero."""
MODELS = {"plumbbob", "radtan", "radialtangential", "brown", "brownconrady", "rationalpolynomial", "opencv", "pinhole"}
"""Names of the distortion that is read, without what joins their words."""
NOT = {"0", "false", "no", "none", "off"}  # values of names of lenses that are none of them
READ = "a pinhole with plumb_bob or radtan, 0 after k1, k2, p1, p2, k3"
MODEL_NAMES = re.compile("model|type|lens|distortion|projection|fisheye|^xi$")
BENT = re.compile(
    r"\b(fish ?eye|equi|equi(dist|solid)\w*|stereographic|kannala\w*|omni(dir\w*)?|unified|eucm|double ?sphere"
    r"|f?theta)\b"
)
BENT_WHOLE = {"mei", "ds", "ucm", "fov", "xi", "kb", "kb4"}
"""Words of lenses that are not read even without distortion, anywhere or as a whole name or value."""
OTHER = re.compile("inverse|modified|division|prism")  # words of another distortion
WORD = re.compile(r"""(?<![\w.])["']?([A-Za-z_][\w.]*)(?:["'][ \t]*:|[ \t]*:(?=[\s\[{"']|$))""")
LARGEST_FILE = 1_000_000
LARGEST = 1e6  # above all numbers of cameras: focal lengths are some thousand pixels
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
        entries = [matrix, lens, ("rectification_matrix", 3, eye), ("projection_matrix", 3, whole)]
    else:
        head += [f"avg_reprojection_error: {camera.noise!r}", f"board_half_size: {camera.half_size!r}"]
        root = ROOT, len(UNKNOWNS), camera.root.flatten().tolist()
        entries = [matrix, lens, (BOARD, 1, camera.board.tolist()), root]
    return "\n".join([*head, *(line for matrix in entries for line in matrix_lines(*matrix, ros=ros)), ""])


def read_camera(path: str | PathLike[str]) -> Camera:
    """The camera of a file of this package, or of one in any of FORMS as YAML, JSON or XML.

    The lens of foreign files is taken as exact, and their board, of which they know nothing, has the size 0.

    Raises:
        InputError: no such file, one that is no camera or several, or another lens than a pinhole with k1, k2, p1, p2
            and k3.
    """
    file = as_path(path)
    try:
        text = read_regular(file, "camera file", LARGEST_FILE).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError.of(f"file '{file}'", expected="a camera's YAML file", got=str(error)) from None
    lines = _Lines(file, text)
    distortion = lines.distortion()
    lens = lines.pinhole() + distortion
    width, height = lines.size()
    if not (min(lens[:2]) > 0 and min(width, height) > 0):
        expected = "positive fx, fy, image_width and image_height"
        raise InputError.of(f"file '{file}'", expected=expected, got=f"{lens[0]}, {lens[1]}, {width}, {height}")
    v: Tensor = torch.tensor(lens, dtype=torch.float64, device=HOST)
    if not lines.has(ROOT):
        return Camera(width, height, 0.0, torch.cat([v, v.new_zeros(5)]), v.new_zeros(len(UNKNOWNS), 0))
    root = lines.numbers((ROOT,), range(len(UNKNOWNS), len(UNKNOWNS) * LARGEST_FILE, len(UNKNOWNS)))
    half, noise = (lines.numbers((name,), (1,))[0] for name in ("board_half_size", "avg_reprojection_error"))
    unknowns = torch.cat([v, v.new_tensor(lines.numbers((BOARD,), (5,)))])
    return Camera(width, height, half, unknowns, v.new_tensor(root).view(len(UNKNOWNS), -1), noise)


class _Lines:
    """Names in YAML, JSON or XML, each with the words up to the next one; those of `data` are of the matrix before."""

    def __init__(self, file: Path, text: str) -> None:
        self.what, self.words, self.written = f"file '{file}'", dict[str, list[list[str]]](), dict[str, str]()
        if text.lstrip().startswith("<"):
            text = re.sub(r"<(\w+)\b[^<>]*>", r"\n\1: ", re.sub("<[/!?][^<>]*>", "\n", text))
        text = re.sub("#.*", "", text)
        if text.count("[") != text.count("]"):
            raise InputError.of(self.what, expected=FORMS, got="a list without an end", fix="check the file")
        parts, matrix = WORD.split(text), ""
        for name, value in zip(parts[1::2], parts[2::2], strict=True):
            short = name.rpartition(".")[2].lower().replace("_", "")
            if short in ("rows", "cols", "dt", "typeid"):
                continue
            matrix = short if short != "data" else matrix
            words = [word for word in re.split(r"[\s,\[\]{}\"'|]+", value) if word.strip("-.") and word[0] != "!"]
            if words or ("[" in value and "{" not in value) or short == "data":
                self.written[matrix] = name if name != "data" else self.written.get(matrix, "")
                self.words.setdefault(matrix, []).append(words)

    def has(self, *names: str) -> bool:
        """Whether the file has one of these."""
        return any(name.replace("_", "") in self.words for name in names)

    def numbers(self, names: Sequence[str], counts: Sequence[int]) -> list[float]:
        """The numbers of the one of these names that the file has."""
        entries = [words for name in names for words in self.words.get(name.replace("_", ""), [])]
        entries = [words for words in entries if words != ["0"]] or entries  # of a region of interest that is none
        expected = f"`{names[0]}` of {' or '.join(map(str, counts[:6]))} numbers below {LARGEST:.0e}"
        if len({tuple(words) for words in entries}) > 1:
            got, fix = f"{len(entries)} different ones", "write each camera to a file of its own"
            raise InputError.of(self.what, expected=f"one {expected}", got=got, fix=fix)
        words = entries[0] if entries else []
        try:
            values = [float(word) for word in words]
        except ValueError:
            values = []
        if len(values) not in counts or not all(abs(value) < LARGEST for value in values):
            fix = f"write {FORMS}" if names is MATRIX else f"check or add `{names[0]}`"
            raise InputError.of(self.what, expected=expected, got=few(words) or "none", fix=fix)
        return values

    def pinhole(self) -> list[float]:
        """fx, fy, cx, cy, pixels."""
        if not self.has(*MATRIX) and self.has("fx"):
            return [self.numbers(CENTRE.get(name, (name,)), (1,))[0] for name in ("fx", "fy", "cx", "cy")]
        values = self.numbers(MATRIX, (4, 9))
        if len(values) == 4:
            return values
        fx, skew, cx, zero, fy, cy, *last = values
        if abs(skew) > 1e-6 * abs(fx) or zero or last != [0, 0, 1]:
            expected, fix = "fx 0 cx, 0 fy cy, 0 0 1", "write it row by row; cameras with skew are not read"
            raise InputError.of(f"{self.what}, camera matrix", expected=expected, got=few(values, 9), fix=fix)
        return [fx, fy, cx, cy]

    def distortion(self) -> list[float]:
        """k1, k2, p1, p2, k3."""
        lens, other = f"the lens of {self.what}", ""
        for name, (words, *_) in self.words.items():
            text, value = " ".join([self.written[name], *words]), re.sub(r"[\s_-]", "", "".join(words).lower())
            if not MODEL_NAMES.search(name) or not words or words[0].lower() in NOT:
                continue
            if BENT.search(re.sub(r"[\s_.-]+", " ", text.lower())) or not BENT_WHOLE.isdisjoint((name, value)):
                raise InputError.of(lens, expected=READ, got=text, fix="calibrate the camera with this model")
            if OTHER.search(text.lower()) or (name == "distortionmodel" and value not in MODELS):
                other = text
        raw = [word for name in (*DISTORTION, *COEFFICIENTS) for words in self.words.get(name, []) for word in words]
        if other and any(word.strip("+-0.e") for word in raw):
            raise InputError.of(lens, expected=READ, got=other, fix="calibrate the camera with this model")
        if self.has(*DISTORTION):
            values = self.numbers(DISTORTION, (0, 4, 5, 8, 12, 14))
        else:
            values = [self.numbers((name,), (1,))[0] if self.has(name) else 0.0 for name in COEFFICIENTS]
            if not self.has(*COEFFICIENTS):
                warn_user(f"{self.what} has no distortion: its lens is read as one without")
        if any(values[5:]):
            got = f"coefficients {few(values, 14)}"
            raise InputError.of(lens, expected=READ, got=got, fix="calibrate the camera with this model")
        if len(values) == 4 and not self.has("distortion_model"):
            warn_user(f"{self.what} names no lens: its 4 coefficients are read as k1, k2, p1, p2, not as a fisheye's")
        return (values + 5 * [0.0])[:5]

    def size(self) -> tuple[int, int]:
        """Width and height of the images, pixels."""
        if self.has(*SIZE):
            width, height = self.numbers(SIZE, (2,))
        else:
            width, height = (self.numbers((f"image_{name}", name), (1,))[0] for name in ("width", "height"))
        return int(width), int(height)


def matrix_lines(name: str, rows: int, data: list[float], *, ros: bool = False) -> list[str]:
    """A matrix in YAML, of OpenCV or of ROS, from its numbers row by row."""
    cols, numbers = len(data) // rows, ", ".join(repr(float(value)) for value in data)
    kind = [] if ros else ["   dt: d"]
    head = f"{name}:" + " !!opencv-matrix" * (not ros)
    return [head, f"   rows: {rows}", f"   cols: {cols}", *kind, f"   data: [{numbers}]"]
