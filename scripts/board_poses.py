"""From images of a ChArUco board to the table that `diffeo-calib fit --camera-on-tool` reads. Needs opencv-python.

    python scripts/board_poses.py joints.csv camera.npz boards.csv --squares 8,6 --square 0.03 --marker 0.022

joints.csv has a column `image` (files beside it) and one column for each joint. camera.npz holds `K` (3, 3) and `dist`
of cv2.calibrateCamera. boards.csv gets the same columns, and x, y, z [m] and rx, ry, rz (rotation vector, rad) of the
board in the camera's frame:

    diffeo-calib fit boards.csv --robot robot.urdf --base base_link --tip flange --camera-on-tool \\
        --position x,y,z --rotation rx,ry,rz --convention rotvec --rotation-angle rad --length m --angle rad -o model

The board's origin is put in the middle of its corners, where the camera knows its position best.
"""

import argparse
import csv
from pathlib import Path

LEAST_CORNERS = 8


def main() -> None:
    """Find the board in every image; images that do not show it are named and have no row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("joints", type=Path)
    parser.add_argument("camera", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--squares", required=True, help="their numbers along x and y, such as 8,6")
    parser.add_argument("--square", type=float, required=True, help="side of a square, m")
    parser.add_argument("--marker", type=float, required=True, help="side of a marker, m")
    parser.add_argument("--dictionary", default="DICT_5X5_100")
    given = parser.parse_args()
    import cv2  # pyright: ignore[reportMissingImports]  # noqa: PLC0415  # --help needs none of them
    import numpy as np  # noqa: PLC0415

    across, down = (int(word) for word in given.squares.split(","))
    markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, given.dictionary))
    board = cv2.aruco.CharucoBoard((across, down), given.square, given.marker, markers)
    detector, middle = cv2.aruco.CharucoDetector(board), board.getChessboardCorners().mean(0)
    camera = np.load(given.camera)
    with given.joints.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with given.output.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow([*rows[0], "x", "y", "z", "rx", "ry", "rz"])
        for row in rows:
            image = cv2.imread(str(given.joints.parent / row["image"]), cv2.IMREAD_GRAYSCALE)
            corners, ids = (None, None) if image is None else detector.detectBoard(image)[:2]
            if ids is None or len(ids) < LEAST_CORNERS:
                print(f"{row['image']}: fewer than {LEAST_CORNERS} corners of the board, no row")
                continue
            points, pixels = board.matchImagePoints(corners, ids)
            _, turn, place = cv2.solvePnP(points - middle, pixels, camera["K"], camera["dist"])
            table.writerow([*row.values(), *place.ravel().tolist(), *turn.ravel().tolist()])


if __name__ == "__main__":
    main()
