"""Poses of a board in rendered images, as the script writes them. Skipped without opencv-python."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

cv2 = pytest.importorskip("cv2", reason="needs opencv-python")

SCRIPT = Path(__file__).parents[2] / "scripts" / "board_poses.py"
K = np.array([[1400.0, 0.0, 640.0], [0.0, 1400.0, 480.0], [0.0, 0.0, 1.0]])
SQUARES, SQUARE, PIXELS = (8, 6), 0.03, 100
SIZE = SQUARES[0] * SQUARE, SQUARES[1] * SQUARE


def rendered(turn: np.ndarray, place: np.ndarray) -> np.ndarray:
    """The board, its middle at ``place`` [m] and turned by a rotation vector, as the camera K sees it."""
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard(SQUARES, SQUARE, 0.022, markers)
    flat = board.generateImage((SQUARES[0] * PIXELS, SQUARES[1] * PIXELS), marginSize=0)
    per_pixel = SQUARE / PIXELS  # pixel centres are at half numbers
    to_board = np.array([[per_pixel, 0, 0.5 * per_pixel - SIZE[0] / 2], [0, per_pixel, 0.5 * per_pixel - SIZE[1] / 2]])
    R = Rotation.from_rotvec(turn).as_matrix()
    homography = K @ np.column_stack([R[:, :2], place]) @ np.vstack([to_board, [0, 0, 1]])
    return cv2.warpPerspective(flat, homography, (1280, 960), flags=cv2.INTER_AREA, borderValue=255)


def test_poses_of_rendered_boards(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    turns, places = rng.uniform(-0.5, 0.5, (6, 3)), rng.uniform((-0.03, -0.03, 0.4), (0.03, 0.03, 0.6), (6, 3))
    with (tmp_path / "joints.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["image", "joint_1"])
        for k, (turn, place) in enumerate(zip(turns, places, strict=True)):
            cv2.imwrite(str(tmp_path / f"{k}.png"), rendered(turn, place))
            table.writerow([f"{k}.png", 0.1 * k])
        cv2.imwrite(str(tmp_path / "white.png"), np.full((960, 1280), 255, np.uint8))
        table.writerow(["white.png", 1.0])
    np.savez(tmp_path / "camera.npz", K=K, dist=np.zeros(5))
    options = ["--squares", "8,6", "--square", "0.03", "--marker", "0.022"]
    files = [tmp_path / name for name in ("joints.csv", "camera.npz", "boards.csv")]
    done = subprocess.run([sys.executable, SCRIPT, *files, *options], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "white.png: fewer than" in done.stdout
    with files[2].open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["joint_1"] for row in rows] == [str(0.1 * k) for k in range(6)]
    found = np.array([[float(row[name]) for name in ("x", "y", "z", "rx", "ry", "rz")] for row in rows])
    away = Rotation.from_rotvec(found[:, 3:]) * Rotation.from_rotvec(turns).inv()
    assert np.abs(found[:, :3] - places).max() < 5e-4, "m"
    assert away.magnitude().max() < 5e-3, "rad"
