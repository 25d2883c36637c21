"""Corners of printed boards in images, by OpenCV's own detectors: `pip install 'diffeo_calib[camera]'`.

A board is written as one text, lengths in m: `charuco:ACROSSxDOWN:SQUARE:MARKER:DICT` (squares, their sides and those
of the markers), `chessboard:ACROSSxDOWN:SQUARE` (inner corners), `aruco:ACROSSxDOWN:SIDE:GAP:DICT` (a grid of markers,
AprilTags by their dictionaries) or `tag:SIDE:DICT:NUMBER`. Behind a grid may stand its first number, `:0` by default,
and where numbers run where markers stand upright, `:right-down` by default. The board's frame is in its middle.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import product
from typing import Any

import numpy as np

from diffeo_calib.common.errors import InputError, few

MOST_SQUARES = 10_000  # of a board
FORMS = {"charuco": (5,), "chessboard": (3,), "aruco": (5, 6, 7), "tag": (4,)}
"""Kinds of boards, and words of their texts."""
FEWEST_CORNERS = 8
BLURRED_PX, MOVED_RATIO = 5.0, 1.6
"""Median width of edges at corners, pixels, from which an image is blurred, and how much wider than edges in another
direction, from which something moved. A lens that blurs by a standard deviation of 0.7 px makes widths of 2."""
HALF_PATCH_PX = 8  # half of the side of the patch around a corner in which edges are measured, pixels
ACROSS, DOWN = ("right", "left"), ("down", "up")
ORDERS = [f"{one}-{other}" for first, then in ((ACROSS, DOWN), (DOWN, ACROSS)) for one in first for other in then]
"""Where the numbers of a grid of markers run, first within a line."""
PLANE_SHARE, PLANE_PX = 0.12, 2.0
"""Median distance of corners from those of a plane, as a share of their spread and in pixels, from which it is none."""
BENDS = (0.0, 0.1, 0.2, -0.1, -0.2, -0.3, -0.4, -0.5, -0.6)
"""Distortions b with which a plane is tried: r / (1 + b r^2), with r = 1 from the image's middle to its corners."""
SNAPPED_PX, SNAPPED_SHARE = 0.5, 0.13
"""Median distance from a plane from which corners of markers are sought again, within this share of a marker's side:
those that touch squares, as in grids of Kalibr, are found too far inside."""
WIDEST = 16  # squares or markers across other boards that are tried
REFINED_PX = 5
"""Half of the side of the window in which corners of a ChArUco board are refined: detectors leave twice the error."""
Found = tuple[np.ndarray, np.ndarray]  # numbers (K,) of corners, and their pixels (K, 2)
NONE: Found = np.zeros(0, int), np.zeros((0, 2))
Made = tuple[np.ndarray, Callable[[np.ndarray], Found], Callable[[np.ndarray], Found], dict[int, np.ndarray]]
"""Points, find, markers and layout of a board."""
BENT = "corners that no plane explains"  # the reason of an image whose corners contradict the board


@dataclass(frozen=True, eq=False)
class Board:
    """A printed board."""

    text: str  # as it was written
    points: np.ndarray  # (K, 3) its corners, m, from its middle
    find: Callable[[np.ndarray], Found]  # grey image -> corners, which may be none
    # grey image -> numbers of all markers and their corners (M, 4, 2), pixels; none of a chessboard
    markers: Callable[[np.ndarray], Found]
    layout: dict[int, np.ndarray]  # number of each marker of the board -> its corners (4, 3), m
    fewest: int  # corners that an image must show

    @classmethod
    def of(cls, text: str) -> Board:
        """The board that a text describes.

        Raises:
            InputError: no such board, or OpenCV is not installed.
        """
        cv2 = opencv()
        kind, *words = text.split(":")
        if kind not in FORMS or len(words) + 1 not in FORMS[kind]:
            expected = "charuco:5x7:0.04:0.03:DICT_5X5_100, chessboard:7x5:0.03, aruco:4x5:0.04:0.01:DICT or "
            raise InputError.of("the board", expected=expected + "tag:0.1:DICT_APRILTAG_36h11:3", got=text)
        try:
            make = {"charuco": _charuco, "chessboard": _chessboard, "aruco": _grid, "tag": _tag}[kind]
            points, find, markers, layout = make(cv2, words)
        except (ValueError, AttributeError, SystemError, cv2.error) as error:
            fix = "lengths in m, numbers of squares as 5x7, a dictionary of OpenCV such as DICT_5X5_100"
            what, expected = f"the board {text}", "numbers and a dictionary"
            raise InputError.of(what, expected=expected, got=str(error), fix=fix) from None
        middle = (points.min(0) + points.max(0)) / 2
        return cls(text, points - middle, find, markers, layout, min(FEWEST_CORNERS, len(points)))

    def corners(self, grey: np.ndarray) -> Found:
        """Numbers and pixels of the corners in an image.

        Raises:
            InputError: none or too few, two boards, a blurred image, another layout; the reason is the message.
        """
        counts = Counter(number for number in self.markers(grey)[0].tolist() if number in self.layout)
        repeated = [number for number, count in counts.items() if count > 1]
        if repeated:
            raise InputError.of("two boards", got=f"marker {few(sorted(repeated))} twice", fix="cover one of them")
        numbers, pixels = self.find(grey)
        if len(numbers) < self.fewest:
            if len(self.find(np.ascontiguousarray(grey[:, ::-1]))[0]) >= self.fewest:
                raise InputError.of("a mirrored board", fix="print it anew, or mirror the images back")
            got = len(numbers) or "none"
            raise InputError.of("corners of the board", expected=f"{self.fewest} or more", got=got)
        away, share = misfit(self.points[numbers], pixels, grey)
        if share > PLANE_SHARE and away > PLANE_PX:
            raise InputError.of(f"{BENT}, by {away:.1f} px")
        widths = edge_widths(grey, pixels)
        if widths.max() > BLURRED_PX:
            moved = widths.max() > MOVED_RATIO * widths.min()
            what = "the camera or the board moved during the exposure" if moved else "a blurred image"
            raise InputError.of(what, expected=f"edges at most {BLURRED_PX:g} px wide", got=f"{widths.max():.1f} px")
        return numbers, pixels


def opencv() -> Any:
    """OpenCV; InputError if it is not installed."""
    try:
        import cv2  # noqa: PLC0415
    except ImportError:
        what, fix = "boards are found by OpenCV, which is not installed", "pip install 'diffeo_calib[camera]'"
        raise InputError.of(what, fix=fix) from None
    return cv2


def misfit(points: np.ndarray, pixels: np.ndarray, grey: np.ndarray) -> tuple[float, float]:
    """Median distance, pixels, of corners (K, 2) from the best image of a plane with corners (K, 3), m; and its share.

    The share is that of the corners' spread in the grey image. Four corners are an image of any plane.
    """
    cv2, best = opencv(), (0.0, 0.0) if len(points) <= 4 else (np.inf, np.inf)
    middle, flat = np.array(grey.shape[::-1]) / 2, np.column_stack([points[:, :2], np.ones(len(points))])
    for bend in BENDS if len(points) > 4 else ():
        undistorted = (pixels - middle) / (1 + bend * ((pixels - middle) ** 2).sum(1) / (middle**2).sum())[:, None]
        H = cv2.findHomography(points[:, :2], undistorted)[0]
        if H is not None:
            ideal = flat @ H.T
            away = float(np.median(np.linalg.norm(ideal[:, :2] / ideal[:, 2:] - undistorted, axis=1)))
            best = min(best, (away / float(undistorted.std(0).max()), away))
        if best[0] > 4 * PLANE_SHARE:  # more than any lens bends
            break
    return best[1], best[0]


def other_layout(images: Sequence[np.ndarray], board: Board) -> str | None:
    """The text of another board with the same markers that a plane explains in grey images; None if there is none."""
    hit = [(grey, hits[0], _snapped(grey, hits[1])) for grey in images if len((hits := board.markers(grey))[0]) > 1]
    kind, size, *words = board.text.split(":")
    if not hit or kind not in ("charuco", "aruco"):
        return None
    grid, cells, every = kind == "aruco", _size(size), np.concatenate([numbers for _, numbers, _ in hit])
    best, likely = PLANE_SHARE / 2, None
    starts = dict.fromkeys([min(board.layout), int(every.min()), 0]) if grid else [0]
    for across, given in [cells, cells[::-1], *((width, 0) for width in range(2, WIDEST))]:
        for first, order in product(starts, ORDERS if grid else [""]):
            down = given or max(2, -(-(int(every.max()) + 1 - first) * (1 if grid else 2) // across))
            text = ":".join([kind, f"{across}x{down}", *words[:3], *[str(first), order] * grid])
            try:
                layout = Board.of(text).layout
            except InputError:  # more markers than the dictionary has
                continue
            if set(layout).issuperset(every.tolist()):
                each = (([layout[n] for n in numbers.tolist()], corners, grey) for grey, numbers, corners in hit)
                share = max(misfit(np.concatenate(p), at.reshape(-1, 2), grey)[1] for p, at, grey in each)
                best, likely = (share, text) if share < 0.8 * best else (best, likely)
    if likely is not None and set(board.layout).issuperset(every.tolist()):
        hits = Board.of(likely).layout
        if all(np.allclose(hits[number], board.layout[number]) for number in every.tolist()):
            return None
    return likely


def other_dictionary(grey: np.ndarray) -> str | None:
    """Name of the dictionary of most markers in an image; None if there are few of any."""
    cv2 = opencv()
    counts = {}
    for name in (name for name in dir(cv2.aruco) if name.startswith("DICT_")):
        detector = cv2.aruco.ArucoDetector(_dictionary(cv2, name))
        counts[name] = len(_all_markers(detector, grey)[0])
    best = max(counts, key=lambda name: counts[name])
    return best if counts[best] >= 3 else None


def edge_widths(grey: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Median widths (4,) of the sharpest edges near corners along four directions, pixels: contrast per slope."""
    steps = np.array([[1.0, 0.0], [0.0, 1.0], [0.5**0.5, 0.5**0.5], [0.5**0.5, -(0.5**0.5)]])
    widths = []
    for column, row in np.rint(pixels).astype(int):
        rows, columns = (slice(max(at - HALF_PATCH_PX, 0), at + HALF_PATCH_PX + 1) for at in (row, column))
        patch = grey[rows, columns].astype(float)
        if min(patch.shape) > HALF_PATCH_PX:
            down, right = np.gradient(patch)
            slopes = np.abs(right[..., None] * steps[:, 0] + down[..., None] * steps[:, 1]).max((0, 1))
            widths.append(np.ptp(patch) / np.maximum(slopes, 1e-9))
    return np.median(widths, 0) if widths else np.zeros(4)


def _size(word: str) -> tuple[int, int]:
    across, _, down = word.partition("x")
    if int(across) * int(down) > MOST_SQUARES:
        raise ValueError(f"{word}, more than {MOST_SQUARES} squares")
    return int(across), int(down)


def _dictionary(cv2: Any, name: str) -> Any:
    """A dictionary of markers by OpenCV's name for it, with or without DICT_."""
    names = [one for one in dir(cv2.aruco) if one.startswith("DICT_")]
    whole = name if name.startswith("DICT_") else f"DICT_{name}"
    if whole not in names:
        near = get_close_matches(whole, names, n=3)
        raise InputError.of("the dictionary of markers", expected=f"such as {few(near or names[:3])}", got=name)
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, whole))


def _all_markers(detector: Any, grey: np.ndarray) -> Found:
    corners, numbers, _ = detector.detectMarkers(grey)
    if numbers is None:
        return NONE
    return np.ravel(numbers), np.concatenate(corners).astype(float)


def _snapped(grey: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Corners (M, 4, 2) of markers, moved to the nearest corners of the image, pixels."""
    half = max(3, round(SNAPPED_SHARE * float(np.median(np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)))))
    start = corners.reshape(-1, 1, 2).astype(np.float32)
    return opencv().cornerSubPix(grey, start, (half, half), (-1, -1), (3, 50, 1e-4)).reshape(-1, 4, 2).astype(float)


def _layout(board: Any) -> dict[int, np.ndarray]:
    """Number of each marker -> its corners (4, 3), m."""
    each = zip(np.ravel(board.getIds()).tolist(), board.getObjPoints(), strict=True)
    return {number: np.array(corners, float).reshape(4, 3) for number, corners in each}


def _charuco(cv2: Any, words: list[str]) -> Made:
    markers = _dictionary(cv2, words[3])
    board, old = (cv2.aruco.CharucoBoard(_size(words[0]), *map(float, words[1:3]), markers) for _ in range(2))
    old.setLegacyPattern(True)  # boards printed before OpenCV 4.6 begin with a marker
    detectors = [cv2.aruco.CharucoDetector(pattern) for pattern in (board, old)]

    def find(grey: np.ndarray) -> Found:
        for detector in detectors:
            corners, numbers = detector.detectBoard(grey)[:2]
            if numbers is not None and len(numbers):
                window, ended = (REFINED_PX, REFINED_PX), (3, 50, 1e-4)
                fine = cv2.cornerSubPix(grey, np.array(corners, np.float32), window, (-1, -1), ended)
                return numbers.ravel(), fine.reshape(-1, 2).astype(float)
        return NONE

    plain = cv2.aruco.ArucoDetector(markers)
    points = np.array(board.getChessboardCorners(), float)
    return points, find, lambda grey: _all_markers(plain, grey), _layout(board)


def _chessboard(cv2: Any, words: list[str]) -> Made:
    across, down = _size(words[0])
    columns, rows = np.meshgrid(np.arange(across), np.arange(down))
    points = float(words[1]) * np.stack([columns.ravel(), rows.ravel(), 0 * rows.ravel()], 1)

    def find(grey: np.ndarray) -> Found:
        complete, corners = cv2.findChessboardCornersSB(grey, (across, down), flags=cv2.CALIB_CB_ACCURACY)
        return (np.arange(len(points)), corners.reshape(-1, 2).astype(float)) if complete else NONE

    return points, find, lambda _: NONE, {}


def _grid(cv2: Any, words: list[str]) -> Made:
    markers, (across, down) = _dictionary(cv2, words[3]), _size(words[0])
    order = next((word for word in words[4:] if not word.isdecimal()), ORDERS[0])
    if order not in ORDERS:
        raise ValueError(f"the order {order}, none of {few(ORDERS, 8)}")
    numbers = np.arange(across * down) + int(next(filter(str.isdecimal, words[4:]), 0))
    grid = numbers.reshape(down, across) if order.startswith(ACROSS) else numbers.reshape(across, down).T
    grid = grid[:: -1 if "up" in order else 1, :: -1 if "left" in order else 1]
    board = cv2.aruco.GridBoard((across, down), float(words[1]), float(words[2]), markers, grid.flatten())
    return _of_markers(cv2, markers, _layout(board))


def _tag(cv2: Any, words: list[str]) -> Made:
    half = float(words[0]) / 2
    points = half * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    return _of_markers(cv2, _dictionary(cv2, words[1]), {int(words[2]): points})


def _of_markers(cv2: Any, markers: Any, layout: dict[int, np.ndarray]) -> Made:
    """Corners of the markers with these numbers, four each."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector, points = cv2.aruco.ArucoDetector(markers, parameters), np.concatenate([*layout.values()])
    first = {number: 4 * k for k, number in enumerate(layout)}

    def find(grey: np.ndarray) -> Found:
        numbers, corners = _all_markers(detector, grey)
        listed = [k for k, number in enumerate(numbers.tolist()) if number in layout]
        if not listed:
            return NONE
        places = np.concatenate([first[int(numbers[k])] + np.arange(4) for k in listed])
        pixels = corners[listed].reshape(-1, 2)
        away = misfit(points[places], pixels, grey)[0]
        if away > SNAPPED_PX:
            snapped = _snapped(grey, corners[listed]).reshape(-1, 2)
            pixels = snapped if misfit(points[places], snapped, grey)[0] < away / 2 else pixels
        return places, pixels

    return points, find, lambda grey: _all_markers(detector, grey), layout
