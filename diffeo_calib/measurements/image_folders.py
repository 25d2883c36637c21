"""Folders of images of a board, one of each camera, and a table of joint values: to a table of corners."""

from __future__ import annotations

import base64
import html
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from diffeo_calib.cameras.board import BoardPrior
from diffeo_calib.cameras.detection import BENT, Board, opencv, other_dictionary, other_layout
from diffeo_calib.cameras.images import Camera, Images, first_guess
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, MeasurementError, few
from diffeo_calib.measurements.csv.lines import read_cells
from diffeo_calib.measurements.csv.sensors import CAMERA, IMAGE

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
FLIPPED, KALIBR = ("right-up", "left-down"), " (numbers run upwards, as in grids of Kalibr)"
"""Orders of grids of markers in which numbers run to the right and upwards, and what is said of them."""
THUMBNAIL_WIDTH_PX = 320
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Seen:
    """An image: its name, cells of its row, corners' numbers and pixels, and why it is refused, if it is."""

    name: str
    cells: list[str]
    numbers: np.ndarray
    pixels: np.ndarray
    refused: str
    thumbnail: str


@dataclass(frozen=True, eq=False)
class Folder:
    """Corners found in the images of a folder."""

    name: str  # of the folder, and of its camera
    board: Board  # that was looked for
    header: list[str]  # names of the joint columns
    images: list[Seen]  # in the order of the table
    size: tuple[int, int]  # width and height, pixels
    paired: str  # how rows and images were, unless the table names these

    @property
    def used(self) -> list[Seen]:
        """Images that show the board."""
        return [image for image in self.images if not image.refused]

    def rows(self, per_metre: float, decimal: str = ".") -> list[list[str]]:
        """Cells of every corner: image, joints as read, place on the board in units per metre, pixels."""

        def written(values: Iterable[float]) -> list[str]:
            return [repr(float(value)).replace(".", decimal) for value in values]

        return [
            [image.name, *image.cells, *written([*(per_metre * self.board.points[k, :2]), *uv])]
            for image in self.used
            for k, uv in zip(image.numbers.tolist(), image.pixels.tolist(), strict=True)
        ]

    def camera(self, board: BoardPrior) -> Camera:
        """Prior of lens and board: a first guess with wide deviations."""
        corners = torch.full((len(self.used), len(self.board.points), 5), torch.nan, dtype=torch.float64, device=HOST)
        for row, image in enumerate(self.used):
            whole = np.concatenate([self.board.points[image.numbers], image.pixels], 1)
            corners[row, : len(whole)] = torch.from_numpy(whole)
        return first_guess(Images(corners[..., :3], corners[..., 3:], *self.size), board)


def page(folders: Sequence[Folder]) -> str:
    """An overview in HTML: every image with its corners, or why it is refused."""
    cells = "".join(
        f'<figure><img src="data:image/jpeg;base64,{image.thumbnail}"><figcaption>'
        f"{html.escape(image.name if len(folders) == 1 else f'{folder.name}/{image.name}')}: "
        f"{html.escape(image.refused) or f'{len(image.numbers)} corners'}</figcaption></figure>"
        for folder in folders
        for image in folder.images
    )
    style = "figure{display:inline-block;margin:6px;width:320px;vertical-align:top;font:13px sans-serif}"
    used, whole = (sum(map(len, each)) for each in zip(*((own.used, own.images) for own in folders), strict=True))
    head = f"{used} of {whole} images show {html.escape(folders[0].board.text)}"
    return f"<!doctype html><meta charset=utf-8><title>{head}</title><style>{style}</style><h1>{head}</h1>{cells}"


def read_folders(
    folders: Sequence[Path], joints: Path, board: Board, sep: str = ",", progress: Progress = lambda *_: None
) -> list[Folder]:
    """Find a board in the images of a table of joint values, in a folder for each camera.

    The table's column `image`, or another one of file names of images, names the file of each row, in every folder that
    has one; without it the rows are those of the files of each folder in the order of the numbers in their names.
    ``progress`` is called as ``progress(task, done, total)``.
    Raises MeasurementError: rows and images that do not belong to one another, or a folder without an image that shows
        the board; folders of the same name.
    """
    names = [folder.resolve().name for folder in folders]
    if len(set(names)) < len(names):
        fix = "name the folder of each camera after it"
        raise MeasurementError.of("the folders of images", expected="different names", got=few(names), fix=fix)
    table = read_cells(joints, sep)
    header, rows = table.header, [cells for _, cells in table.rows]
    if CAMERA in header and len(folders) > 1:
        fix = "leave it out: the folders name the cameras"
        raise MeasurementError.of(f"file '{joints}'", expected=f"no column `{CAMERA}`", got="one", fix=fix)
    named = [k for k in range(len(header)) if all(Path(row[k]).suffix.lower() in SUFFIXES for row in rows)]
    place = header.index(IMAGE) if IMAGE in header else next(iter(named), None)
    files = _ordered(folders, joints, len(rows)) if place is None else _named(folders, [row[place] for row in rows])
    table = table.without([] if place is None else [header[place]])
    rows = [cells for _, cells in table.rows]
    searched = []
    for folder, name, paths in zip(folders, names, files, strict=True):
        whole = [(file, cells) for file, cells in zip(paths, rows, strict=True) if file is not None]
        paired = f"row 1 is {paths[0]}, row {len(paths)} is {paths[-1]}: by the numbers in the names" * (place is None)
        searched.append(_folder(folder, Folder(name, board, table.header, [], (0, 0), paired), whole, progress))
    return searched


def _folder(folder: Path, empty: Folder, rows: Sequence[tuple[str, list[str]]], progress: Progress) -> Folder:
    """Find the board in the files of one folder, with the cells of their rows."""
    board = empty.board
    cv2 = opencv()
    read = [cv2.imread(str(folder / file), cv2.IMREAD_GRAYSCALE) for file, _ in rows]
    sizes = Counter(image.shape for image in read if image is not None)
    if not sizes:
        raise MeasurementError.of(f"the images of '{folder}'", expected="files that OpenCV reads", got="none")
    usual = sizes.most_common(1)[0][0]
    images = []
    for row, image in zip(rows, read, strict=True):
        progress("images", len(images), len(rows))
        images.append(_seen(*row, image, board, usual))
    filled = replace(empty, images=images, size=(usual[1], usual[0]))
    if len(filled.used) <= sum(image.refused.startswith(BENT) for image in images):
        some = [image for image in read if image is not None][:3]
        layout = other_layout(some, board)
        likely = None if layout else next(filter(None, map(other_dictionary, some)), None)
        fix = "check the lengths and numbers of the board, and the images"
        if layout:
            fix = f"give the board as {layout}, which explains the corners{KALIBR * layout.endswith(FLIPPED)}"
        elif likely and likely.rpartition("_")[0] not in board.text.upper():
            fix = f"most markers are of {likely}: check --board"
        what = f"images of '{folder}' that show {board.text}"
        got = few([f"{image.name}: {image.refused}" for image in images if image.refused])
        raise MeasurementError.of(what, expected="some", got=got, fix=fix)
    return filled


def _named(folders: Sequence[Path], names: Sequence[str]) -> list[list[str | None]]:
    """The file of each row in every folder, by its name."""
    files = [[name if (folder / name).is_file() else None for name in names] for folder in folders]
    missing = [name for name, *matches in zip(names, *files, strict=True) if not any(matches)]
    if missing:
        where = " or ".join(f"'{folder}'" for folder in folders)
        raise MeasurementError.of(f"images in {where}", expected="those of the table", got=f"no {few(missing)}")
    return files


def _ordered(folders: Sequence[Path], joints: Path, count: int) -> list[list[str]]:
    """The file of each row in every folder, in the order of the numbers in their names: 2.png before 10.png."""
    parts = re.compile(r"(\D*)(\d*)")
    names = ([file.name for file in folder.iterdir() if file.suffix.lower() in SUFFIXES] for folder in folders)
    places = (
        {name: [(text, int(k or -1)) for text, k in parts.findall(name.lower())] for name in group} for group in names
    )
    files = [sorted(order, key=lambda name: (order[name], name)) for order in places]
    others = [f"{len(each)} in '{folder}'" for folder, each in zip(folders, files, strict=True) if len(each) != count]
    if others:
        expected, fix = f"{count} images, one for each row of '{joints}'", "name their files in a column `image`"
        raise MeasurementError.of("images without names in the table", expected=expected, got=few(others), fix=fix)
    return files


def _seen(name: str, cells: list[str], grey: np.ndarray | None, board: Board, usual: tuple[int, ...]) -> Seen:
    nothing, pixels, refused = np.zeros(0, int), np.zeros((0, 2)), ""
    if grey is None:
        return Seen(name, cells, nothing, pixels, "cannot be read", "")
    try:
        if grey.shape != usual:
            expected, got = f"{usual[1]} x {usual[0]} pixels as the others", f"{grey.shape[1]} x {grey.shape[0]}"
            raise InputError.of("a resized or cut image", expected=expected, got=got)
        nothing, pixels = board.corners(grey)
    except InputError as error:
        refused = str(error).rstrip(".")
    return Seen(name, cells, nothing, pixels, refused, _thumbnail(grey, pixels))


def _thumbnail(grey: np.ndarray, pixels: np.ndarray) -> str:
    cv2 = opencv()
    share = THUMBNAIL_WIDTH_PX / grey.shape[1]
    small = cv2.cvtColor(cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    for column, row in (share * pixels).tolist():
        cv2.circle(small, (round(column), round(row)), 3, (0, 0, 255), 1, cv2.LINE_AA)
    return base64.b64encode(cv2.imencode(".jpg", small)[1].tobytes()).decode()
