"""Corners of printed boards in images, by OpenCV's own detectors: `pip install 'diffeo_calib[camera]'`.

A board is written as one text, lengths in m: `charuco:ACROSSxDOWN:SQUARE:MARKER:DICT` (squares, their sides and those
of the markers), `chessboard:ACROSSxDOWN:SQUARE` (inner corners), `aruco:ACROSSxDOWN:SIDE:GAP:DICT` (a grid of markers,
AprilTags by their dictionaries) or `tag:SIDE:DICT:NUMBER`. The board's frame is in its middle.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np

from diffeo_calib.common.errors import InputError, few

FORMS = {"charuco": 5, "chessboard": 3, "aruco": 5, "tag": 4}
"""Kinds of boards, and words of their texts."""
FEWEST_CORNERS = 8
BLURRED_PX, MOVED_RATIO = 5.0, 1.6
"""Median width of edges at corners, pixels, from which an image is blurred, and how much wider than edges in another
direction, from which something moved. A lens that blurs by a standard deviation of 0.7 px makes widths of 2."""
HALF_PATCH_PX = 8
"""Half of the side of the patch around a corner in which edges are measured, pixels."""

REFINED_PX = 5
"""Half of the side of the window in which corners of a ChArUco board are refined: detectors leave twice the error."""
Found = tuple[np.ndarray, np.ndarray]
"""Numbers (K,) of corners, and their pixels (K, 2)."""
NONE: Found = np.zeros(0, int), np.zeros((0, 2))


@dataclass(frozen=True, eq=False)
class Board:
    """A printed board.

    Args:
        text: as it was written. points: (K, 3) its corners, m, from its middle.
        find: grey image -> corners, which may be none. markers: grey image -> numbers of all markers; none of a
            chessboard. fewest: corners that an image must show.
    """

    text: str
    points: np.ndarray
    find: Callable[[np.ndarray], Found]
    markers: Callable[[np.ndarray], list[int]]
    fewest: int

    @classmethod
    def of(cls, text: str) -> Board:
        """The board that a text describes.

        Raises:
            InputError: no such board, or OpenCV is not installed.
        """
        cv2 = opencv()
        kind, *words = text.split(":")
        if kind not in FORMS or len(words) + 1 != FORMS[kind]:
            expected = "charuco:5x7:0.04:0.03:DICT_5X5_100, chessboard:7x5:0.03, aruco:4x5:0.04:0.01:DICT or "
            raise InputError.of("the board", expected=expected + "tag:0.1:DICT_APRILTAG_36h11:3", got=text)
        try:
            made = {"charuco": _charuco, "chessboard": _chessboard, "aruco": _grid, "tag": _tag}[kind](cv2, words)
        except (ValueError, AttributeError, cv2.error) as error:
            fix = "lengths in m, numbers of squares as 5x7, a dictionary of OpenCV such as DICT_5X5_100"
            what, expected = f"the board {text}", "numbers and a dictionary"
            raise InputError.of(what, expected=expected, got=str(error), fix=fix) from None
        points, find, markers = made
        middle = (points.min(0) + points.max(0)) / 2
        return cls(text, points - middle, find, markers, min(FEWEST_CORNERS, len(points)))

    def corners(self, grey: np.ndarray) -> Found:
        """Numbers and pixels of the corners in an image.

        Raises:
            InputError: none or too few, two boards, a blurred image; the reason is the message.
        """
        repeated = [number for number, count in Counter(self.markers(grey)).items() if count > 1]
        if repeated:
            raise InputError.of("two boards", got=f"marker {few(sorted(repeated))} twice", fix="cover one of them")
        numbers, pixels = self.find(grey)
        if len(numbers) < self.fewest:
            if len(self.find(np.ascontiguousarray(grey[:, ::-1]))[0]) >= self.fewest:
                raise InputError.of("a mirrored board", fix="print it anew, or mirror the images back")
            got = "none" if not len(numbers) else len(numbers)
            raise InputError.of("corners of the board", expected=f"{self.fewest} or more", got=got)
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
        raise InputError.of(
            "boards are found by OpenCV, which is not installed", fix="pip install 'diffeo_calib[camera]'"
        ) from None
    return cv2


def other_dictionary(grey: np.ndarray) -> str | None:
    """Name of the dictionary of most markers in an image; None if there are few of any."""
    cv2 = opencv()
    counts = {}
    for name in (name for name in dir(cv2.aruco) if name.startswith("DICT_")):
        detector = cv2.aruco.ArucoDetector(_dictionary(cv2, name))
        counts[name] = len(_all_markers(detector, grey))
    best = max(counts, key=lambda name: counts[name])
    return best if counts[best] >= 3 else None


def edge_widths(grey: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Median widths (4,) of the sharpest edges near corners along four directions, pixels: contrast per slope."""
    steps = np.array([[1.0, 0.0], [0.0, 1.0], [0.5**0.5, 0.5**0.5], [0.5**0.5, -(0.5**0.5)]])
    found = []
    for column, row in np.rint(pixels).astype(int):
        patch = grey[
            max(row - HALF_PATCH_PX, 0) : row + HALF_PATCH_PX + 1,
            max(column - HALF_PATCH_PX, 0) : column + HALF_PATCH_PX + 1,
        ].astype(float)
        if min(patch.shape) > HALF_PATCH_PX:
            down, right = np.gradient(patch)
            slopes = np.abs(right[..., None] * steps[:, 0] + down[..., None] * steps[:, 1]).max((0, 1))
            found.append(np.ptp(patch) / np.maximum(slopes, 1e-9))
    return np.median(found, 0) if found else np.zeros(4)


def _size(word: str) -> tuple[int, int]:
    across, _, down = word.partition("x")
    return int(across), int(down)


def _dictionary(cv2: Any, name: str) -> Any:
    """A dictionary of markers by OpenCV's name for it, with or without DICT_."""
    known = [one for one in dir(cv2.aruco) if one.startswith("DICT_")]
    whole = name if name.startswith("DICT_") else f"DICT_{name}"
    if whole not in known:
        near = get_close_matches(whole, known, n=3)
        raise InputError.of("the dictionary of markers", expected=f"such as {few(near or known[:3])}", got=name)
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, whole))


def _all_markers(detector: Any, grey: np.ndarray) -> list[int]:
    numbers = detector.detectMarkers(grey)[1]
    return [] if numbers is None else numbers.ravel().tolist()


def _charuco(cv2: Any, words: list[str]) -> tuple[np.ndarray, Any, Any]:
    markers = _dictionary(cv2, words[3])
    board = cv2.aruco.CharucoBoard(_size(words[0]), float(words[1]), float(words[2]), markers)
    detectors = [cv2.aruco.CharucoDetector(board)]
    old = cv2.aruco.CharucoBoard(_size(words[0]), float(words[1]), float(words[2]), markers)
    old.setLegacyPattern(True)  # boards printed before OpenCV 4.6 begin with a marker
    detectors.append(cv2.aruco.CharucoDetector(old))

    def find(grey: np.ndarray) -> Found:
        for detector in detectors:
            corners, numbers = detector.detectBoard(grey)[:2]
            if numbers is not None and len(numbers):
                window, ended = (REFINED_PX, REFINED_PX), (3, 50, 1e-4)
                fine = cv2.cornerSubPix(grey, np.array(corners, np.float32), window, (-1, -1), ended)
                return numbers.ravel(), fine.reshape(-1, 2).astype(float)
        return NONE

    plain = cv2.aruco.ArucoDetector(markers)
    return np.array(board.getChessboardCorners(), float), find, lambda grey: _all_markers(plain, grey)


def _chessboard(cv2: Any, words: list[str]) -> tuple[np.ndarray, Any, Any]:
    across, down = _size(words[0])
    columns, rows = np.meshgrid(np.arange(across), np.arange(down))
    points = float(words[1]) * np.stack([columns.ravel(), rows.ravel(), 0 * rows.ravel()], 1)

    def find(grey: np.ndarray) -> Found:
        found, corners = cv2.findChessboardCornersSB(grey, (across, down), flags=cv2.CALIB_CB_ACCURACY)
        return (np.arange(len(points)), corners.reshape(-1, 2).astype(float)) if found else NONE

    return points, find, lambda _: []


def _grid(cv2: Any, words: list[str]) -> tuple[np.ndarray, Any, Any]:
    markers = _dictionary(cv2, words[3])
    board = cv2.aruco.GridBoard(_size(words[0]), float(words[1]), float(words[2]), markers)
    own = {number: k for k, number in enumerate(np.ravel(board.getIds()).tolist())}
    points = np.array(board.getObjPoints(), float).reshape(-1, 3)
    return points, *_of_markers(cv2, markers, own)


def _tag(cv2: Any, words: list[str]) -> tuple[np.ndarray, Any, Any]:
    half = float(words[0]) / 2
    points = half * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    return points, *_of_markers(cv2, _dictionary(cv2, words[1]), {int(words[2]): 0})


def _of_markers(cv2: Any, markers: Any, own: dict[int, int]) -> tuple[Any, Any]:
    """Corners of the markers with these numbers, four each."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(markers, parameters)

    def find(grey: np.ndarray) -> Found:
        corners, seen, _ = detector.detectMarkers(grey)
        numbers = np.zeros(0, int) if seen is None else np.ravel(seen)
        known = [k for k, number in enumerate(numbers.tolist()) if number in own]
        if not known:
            return NONE
        places = [4 * own[int(numbers[k])] + np.arange(4) for k in known]
        return np.concatenate(places), np.concatenate([corners[k].reshape(4, 2) for k in known]).astype(float)

    return find, lambda grey: [number for number in _all_markers(detector, grey) if number in own]
