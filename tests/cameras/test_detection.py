"""Boards in rendered images, and folders of them: accuracy, reasons of refusal, a table that `fit` reads."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from board_bank import CAMERA, boards
from command_bank import Command

from diffeo_calib.cameras.files import read_camera
from diffeo_calib.common.errors import InputError, MeasurementError

cv2 = pytest.importorskip("cv2")

from rendered_board import BOARD, rendered, texture  # noqa: E402

from diffeo_calib.cameras.detection import Board, misfit, other_layout  # noqa: E402
from diffeo_calib.measurements.image_folders import read_folders  # noqa: E402

FOUND = Board.of(BOARD)


def flat(board: str, pixels: int = 60) -> np.ndarray:
    kind, *words = board.split(":")
    if kind == "chessboard":
        across, down = map(int, words[0].split("x"))
        sheet = 255 - 255 * np.kron(np.indices((down + 1, across + 1)).sum(0) % 2, np.ones((pixels, pixels)))
    else:
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, words[1]))
        sheet = cv2.aruco.generateImageMarker(markers, int(words[2]), 4 * pixels)
    sheet = np.pad(np.asarray(sheet, np.float32), 60, constant_values=255)
    return np.clip(cv2.GaussianBlur(sheet, (0, 0), 0.7), 0, 255).astype(np.uint8)


@cache
def image(number: int = 0, blur_px: float = 0.6) -> np.ndarray:
    return rendered(boards(8, seed=4)[number], texture(), blur_px=blur_px, seed=number)


def test_corners_are_found_to_hundredths_of_a_pixel() -> None:
    numbers, pixels = FOUND.corners(image())
    errors = pixels - CAMERA.pixels(boards(8, seed=4)[:1], torch.from_numpy(FOUND.points[numbers])[None])[0].numpy()
    assert len(errors) >= 8
    assert float(np.abs(np.median(errors, 0)).max()) < 0.03
    assert float(np.median(np.abs(errors))) < 0.04


@pytest.mark.parametrize(("text", "corners"), [("chessboard:7x5:0.03", 35), ("tag:0.1:DICT_APRILTAG_36h11:3", 4)])
def test_other_boards_are_found(text: str, corners: int) -> None:
    numbers, pixels = Board.of(text).corners(flat(text))
    assert sorted(numbers.tolist()) == list(range(corners))
    spans = np.ptp(pixels, 0) / np.ptp(Board.of(text).points[:, :2], 0)
    assert abs(spans[0] / spans[1] - 1) < 0.02


def test_texts_of_boards() -> None:
    assert len(Board.of("charuco:5x7:0.04:0.03:5X5_100").points) == 24, "a dictionary needs no prefix"
    for text, message in (
        ("charuco:5000x5000:0.03:0.02:DICT_4X4_50", "more than 10000 squares"),
        ("charuco:5x7", "the board: expected"),
        ("chess:7x5:0.03", "the board: expected"),
        ("charuco:5x7:a:b:DICT_5X5_100", "the board charuco.*could not convert"),
        ("tag:0.1:DICT_9:3", "dictionary"),
        ("charuco:5x7:0.04:0.03:4X4_10O", r"DICT_4X4_100.*got.*4X4_10O"),
    ):
        with pytest.raises(InputError, match=message):
            Board.of(text)


def seen_grid(text: str, number: int = 0, squares: bool = False) -> np.ndarray:
    """A grid of markers seen at an angle, with squares between the corners of its markers as those of Kalibr have."""
    board = Board.of(text)
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, text.split(":")[4]))
    scale = 800 / float(np.ptp(board.points[:, 0]))
    low = np.min([c.min(0) for c in board.layout.values()], 0)
    corners = {k: np.rint(scale * (c - low)[:, :2]).astype(int) + 100 for k, c in board.layout.items()}
    wide, high = (int(size) + 100 for size in np.max([c.max(0) for c in corners.values()], 0))
    sheet = np.full((high, wide), 255, np.uint8)
    gap = round(scale * float(text.split(":")[3]))
    for k, c in corners.items():
        x, y, side = *c.min(0).tolist(), int(np.ptp(c[:, 0]))
        sheet[y : y + side, x : x + side] = cv2.aruco.generateImageMarker(markers, k, side)
        for column, row in ((x - gap, y - gap), (x + side, y - gap), (x - gap, y + side), (x + side, y + side)):
            if squares:
                sheet[row : row + gap, column : column + gap] = 0
    frame = np.array([[0, 0], [wide, 0], [wide, high], [0, high]], np.float32)
    moved = np.random.default_rng(number).uniform(-40, 40, (4, 2))
    H = cv2.getPerspectiveTransform(frame, (frame * min(1000 / wide, 760 / high) + 80 + moved).astype(np.float32))
    small = cv2.warpPerspective(sheet, H, (1160, 920), flags=cv2.INTER_AREA, borderValue=255)
    return cv2.GaussianBlur(small, (0, 0), 0.7)


GRID = "aruco:{}:0.05:0.015:DICT_5X5_250{}"


@pytest.mark.parametrize(("size", "corner"), [("3x4", ":0:down-right"), ("4x3", ":30:left-up")])
def test_another_layout_is_refused_and_named(size: str, corner: str) -> None:
    real, said = (GRID.format(size, words) for words in (corner, ""))
    image = seen_grid(real)
    with pytest.raises(InputError, match=r"no plane explains, by \d+\.\d px|got none"):
        Board.of(said).corners(image)
    assert other_layout([image], Board.of(said)) == real
    assert other_layout([image], Board.of(real)) is None
    own = Board.of(real)
    numbers, pixels = own.corners(image)
    assert len(numbers) == len(own.points)
    assert misfit(own.points[numbers], pixels, image)[0] < 0.5


def test_corners_of_markers_that_touch_squares_are_exact() -> None:
    own = Board.of("aruco:4x3:0.04:0.012:DICT_APRILTAG_36h11:0:right-up")
    image = cv2.resize(seen_grid(own.text, 1, squares=True), None, fx=0.45, fy=0.45, interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    rough, corners = own.markers(image)
    points = np.concatenate([own.layout[number] for number in rough.tolist()])
    assert misfit(points, corners.reshape(-1, 2), image)[0] > 2
    numbers, pixels = own.corners(image)
    assert misfit(own.points[numbers], pixels, image)[0] < 0.2


def test_a_wide_lens_is_no_other_layout() -> None:
    own = Board.of(GRID.format("4x3", ":0:right-down"))
    image = seen_grid(own.text, 2)
    matrix = np.array([[700.0, 0, 580], [0, 700, 460], [0, 0, 1]])
    columns, rows = np.meshgrid(np.arange(image.shape[1]), np.arange(image.shape[0]))
    pixels = np.stack([columns.ravel(), rows.ravel()], 1).astype(np.float64)[:, None]
    places = cv2.undistortPoints(pixels, matrix, np.array([-0.3, 0.1, 0, 0]), P=matrix).reshape(*image.shape, 2)
    bent = cv2.remap(image, places.astype(np.float32), None, cv2.INTER_LINEAR, borderValue=255)
    numbers, pixels = own.corners(bent)
    assert len(numbers) == len(own.points)
    flat = np.column_stack([own.points[numbers][:, :2], np.ones(len(numbers))])
    straight = flat @ cv2.findHomography(own.points[numbers][:, :2], pixels)[0].T
    assert np.abs(straight[:, :2] / straight[:, 2:] - pixels).max() > 5, "far from a plane without the lens"
    with pytest.raises(InputError, match="no plane"):
        Board.of(GRID.format("4x3", ":0:right-up")).corners(bent)


ALONG = np.zeros((7, 7), np.float32)
ALONG[3] = 1 / 7
REASONS = {
    "mirrored": lambda grey: np.ascontiguousarray(grey[:, ::-1]),
    "two boards": lambda grey: np.concatenate([grey, grey], 1),
    "blurred": lambda grey: cv2.GaussianBlur(grey, (0, 0), 2.2),
    "moved": lambda grey: cv2.filter2D(grey, -1, ALONG),
    "none": lambda grey: np.full((200, 300), 90, np.uint8),
}


@pytest.mark.parametrize("reason", REASONS)
def test_refused_images_are_named(reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        FOUND.corners(REASONS[reason](image()))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image(number))
    cv2.imwrite(str(tmp_path / "small.png"), cv2.resize(image(), None, fx=0.5, fy=0.5))
    (tmp_path / "text.png").write_text("no image")
    names = ["0.png", "1.png", "2.png", "small.png", "text.png"]
    lines = ["image,q1,q2", *(f"{name},{k},{10 * k}" for k, name in enumerate(names))]
    (tmp_path / "joints.csv").write_text("\n".join(lines))
    return tmp_path


def test_a_folder_becomes_a_table(folder: Path, command: Command) -> None:
    out, page = folder / "corners.csv", folder / "page.html"
    words = ["images", folder, folder / "joints.csv", "--board", BOARD, "--length", "mm", "-o", out]
    done = command.ran(*words, "--report", page)
    assert "small.png: a resized" in done.out
    assert "text.png: cannot be read" in done.out
    lines = out.read_text().splitlines()
    assert lines[0] == "image,q1,q2,board_x,board_y,u,v"
    assert {line.split(",")[0] for line in lines[1:]} == {"0.png", "1.png", "2.png"}
    camera = read_camera(folder / "corners.yaml")
    assert (camera.width, camera.height) == (1280, 960)
    assert abs(float(camera.lens[0]) / 1200 - 1) < 0.2
    text = page.read_text()
    assert text.count("<img") == 5
    assert "3 of 5 images" in text
    (folder / "joints.csv").write_text((folder / "joints.csv").read_text().replace(",", ";"))
    done = command.ran(*words, "--sep", ";", "--decimal", ",")
    assert [line.replace(",", ".").replace(";", ",") for line in out.read_text().splitlines()] == lines


def test_ctrl_c_among_images_leaves_the_files(folder: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("diffeo_calib.measurements.image_folders._seen", Mock(side_effect=KeyboardInterrupt))
    for name in ("corners.csv", "corners.yaml"):
        (folder / name).write_text("old")
    before = {path: path.read_bytes() for path in folder.iterdir()}
    words = ["images", folder, folder / "joints.csv", "--board", BOARD, "--length", "mm", "-o", folder / "corners.csv"]
    assert command(*words, "--report", folder / "page.html").code == 130
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_another_dictionary_is_named(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), texture()[:230, :290])
    (tmp_path / "joints.csv").write_text("image,q1\n0.png,1\n")
    other = Board.of(BOARD.replace("DICT_5X5_100", "DICT_4X4_50"))
    with pytest.raises(MeasurementError, match="DICT_5X5"):
        read_folders([tmp_path], tmp_path / "joints.csv", other)


def test_images_without_rows_are_refused(folder: Path) -> None:
    table, right = folder / "joints.csv", folder / "right"
    for text, others, message in (
        ("q1,q2\n1,2\n3,4\n", [], r"2 images.*got 5 in"),
        ("image,q1\nmissing.png,2\n", [], r"missing\.png"),
        ("image,camera,q1\n0.png,left,2\n", [right], r"no column `camera`.*the folders name the cameras"),
        ("image,q1\n0.png,2\n", [right / folder.name], "different names"),
    ):
        table.write_text(text)
        with pytest.raises(MeasurementError, match=message):
            read_folders([folder, *others], table, FOUND)


def test_rows_and_images_are_paired_by_a_column_of_names_or_the_numbers_in_them(folder: Path) -> None:
    table = folder / "joints.csv"
    table.write_text("q1,file\n30,2.png\n10,0.png\n")
    (found,) = read_folders([folder], table, FOUND)
    assert [(one.name, one.cells) for one in found.used] == [("2.png", ["30"]), ("0.png", ["10"])]
    for name, new in (("2", "img10"), ("1", "img2"), ("0", "Img1")):
        (folder / f"{name}.png").rename(folder / f"{new}.png")
    for name in ("small.png", "text.png"):
        (folder / name).unlink()
    table.write_text("q1\n1\n2\n10\n")
    (found,) = read_folders([folder], table, FOUND)
    assert found.paired.startswith("row 1 is Img1.png, row 3 is img10.png")
    assert [one.cells for one in found.used] == [["1"], ["2"], ["10"]]
    assert [one.name for one in found.used] == ["Img1.png", "img2.png", "img10.png"]


def test_a_folder_of_another_layout_is_refused_with_the_fix(tmp_path: Path, command: Command) -> None:
    for number in range(2):
        cv2.imwrite(str(tmp_path / f"{number}.png"), seen_grid(GRID.format("4x3", ":0:right-up"), number))
    table = tmp_path / "joints.csv"
    table.write_text("q1\n1\n2\n")
    said = "--board", GRID.format("4x3", ""), "--length", "mm", "-o", tmp_path / "corners.csv"
    done = command("images", tmp_path, table, *said)
    assert done.code == 1
    assert all(word in done.err for word in (" px", GRID.format("4x3", ":0:right-up"), "Kalibr")), done.err


def test_folders_of_two_cameras_become_one_table(tmp_path: Path, command: Command) -> None:
    seen = {"left": (0, 1), "right": (1, 2)}
    for camera, numbers in seen.items():
        (tmp_path / camera).mkdir()
        for k in numbers:
            cv2.imwrite(str(tmp_path / camera / f"{k}.png"), image(k))
    (tmp_path / "joints.csv").write_text("image,q1\n" + "\n".join(f"{k}.png,{k}" for k in range(3)))
    folders, out = (tmp_path / "left", tmp_path / "right"), tmp_path / "corners.csv"
    command.ran("images", *folders, tmp_path / "joints.csv", "--board", BOARD, "--length", "mm", "-o", out)
    head, *lines = out.read_text().splitlines()
    assert head.endswith("v,camera")
    found = {(line.split(",")[0], line.split(",")[-1]) for line in lines}
    assert found == {(f"{k}.png", camera) for camera, numbers in seen.items() for k in numbers}
    assert (tmp_path / "left.yaml").is_file()
    assert (tmp_path / "right.yaml").is_file()
