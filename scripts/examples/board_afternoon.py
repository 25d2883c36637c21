"""An arm, a printed board, an afternoon: from a folder of images to a calibrated robot with its camera.

    python scripts/examples/board_afternoon.py [FOLDER]

You need the arm and its URDF, a camera on the wrist with its focus locked, and `pip install 'diffeo_calib[camera]'`.

1. Print a ChArUco board (OpenCV: `cv2.aruco.CharucoBoard`), glue it on a flat plate, fix it where the arm reaches all
   around it. Measure 200 mm of squares with a caliper: the robot's size is that of the board.
2. Drive to 40 to 60 poses that see the board 0.25 to 0.6 m away, tilted by up to 45 degrees, turned about the view,
   the board everywhere in the image. Turn all joints. Stand still, save the image, and write its name and the joint
   values into a row of a table.
3. Run the commands below: `images` finds the corners, `fit` calibrates arm, lens, board and hand-eye together and says
   which errors are the arm's and which the camera's, `export` writes them for OpenCV and ROS.

Here the images are rendered, of a simulated arm, so that the true errors are known: 30 of them, to be quick; more poses
lower the errors. `fit` prints the error to expect over all joint ranges of its rows, the example the true one at poses
that see the board, which is smaller. The images stay in FOLDER if it is given.
A fixed camera may see a board on the tool instead: leave `--camera-on-tool` out.
"""

from __future__ import annotations

import csv
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import cv2

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks" / "real_robots"))  # for the renderer of images

from rendered_board import BOARD, FACING, rendered, texture
from simulated_camera import CameraArm, camera_arm

import diffeo_calib as dc
from diffeo_calib.calibration.identification.registration import register
from diffeo_calib.robots.placement import rigid_fit

POSES = 30
TABLE = ["--length", "mm", "--angle", "deg"]


def photograph(folder: Path) -> CameraArm:
    """Images of the board, the table of joint values, and the URDF: what an afternoon at the robot gives."""
    seen, page = camera_arm(POSES), texture()
    seen.arm.write_urdf(folder / "robot.urdf")
    with (folder / "joints.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["image", *seen.arm.nominal.joint_names])
        for k, (q, pose) in enumerate(zip(seen.q, seen.boards, strict=True)):
            cv2.imwrite(str(folder / f"{k:03}.png"), rendered(pose @ FACING, page, seed=k))
            table.writerow([f"{k:03}.png", *q.rad2deg().tolist()])
    return seen


def command(folder: Path, *words: str) -> None:
    """Run `diffeo-calib` in the folder, and show what it says."""
    print("\n$ diffeo-calib", " ".join(words))
    done = subprocess.run(
        [sys.executable, "-m", "diffeo_calib", *words], cwd=folder, capture_output=True, text=True, check=False
    )
    print(done.stdout, done.stderr, sep="")
    done.check_returncode()


def true_errors(folder: Path, seen: CameraArm) -> None:
    """Of the nominal arm and of the model, at new poses that see the board, the robot's place apart."""
    model = dc.load(folder / "robot.safetensors")
    new = camera_arm(300)
    truth = seen.arm.true_points(new.q).flatten(0, 1)
    nominal = register(seen.arm.nominal, seen.q, seen.arm.true_points(seen.q)).geometry.points
    for name, kinematics in (("nominal arm", nominal), ("calibrated", model)):
        points = kinematics(new.q).detach().flatten(0, 1)
        T = rigid_fit(points, truth)
        miss = points @ T[:3, :3].mT + T[:3, 3] - truth
        print(f"true error of the camera's pose, {name}: {1e3 * float(miss.square().sum(1).mean().sqrt()):.3f} mm RMS")


def main(folder: Path) -> None:
    """Photograph, find the corners, calibrate, export, and compare with the truth."""
    seen = photograph(folder)
    command(
        *(folder, "images", ".", "joints.csv", "--board", BOARD, "--board-std", "0.0002", "--length", "mm"),
        *("-o", "corners.csv", "--report", "overview.html"),
    )
    command(
        *(folder, "fit", "corners.csv", "--robot", "robot.urdf", "--base", "base_link", "--tip", "flange", *TABLE),
        *("--reading", "corners=corners.yaml", "--camera-on-tool", "--holdout", "0"),
        *("-o", "robot.safetensors", "--report", "report.html"),
    )
    command(folder, "export", "robot.safetensors", "--urdf", "calibrated.urdf", "--camera", "camera")
    true_errors(folder, seen)


if __name__ == "__main__":
    warnings.simplefilter("ignore", dc.DiffeoCalibWarning)
    if len(sys.argv) > 1:
        Path(sys.argv[1]).mkdir(parents=True, exist_ok=True)
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
