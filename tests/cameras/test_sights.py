"""Lens, board and poses from images: derivatives, truth, a second implementation, the whole posterior, bad input."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from board_bank import CAMERA, images
from torch.autograd.functional import jacobian
from torch.testing import assert_close

from diffeo_calib.cameras.board import LENS, BoardPrior, project, project_slopes, real_board
from diffeo_calib.cameras.files import camera_text, read_camera
from diffeo_calib.cameras.images import UNKNOWNS, Images, first_guess, sees, shown, sighted, sighted_by_several
from diffeo_calib.common.device import seeded
from diffeo_calib.common.errors import DiffeoCalibWarning, InputError, MeasurementError
from diffeo_calib.robots.se3 import rotation, transforms

NOISE = 0.2
IMAGES, POSES = images(40, NOISE)
FOUND = sighted(IMAGES)


def pose_errors(found: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """(N, 6) shifts, m, and turns, rad, in the camera's axes."""
    turn = found[:, :3, :3] @ truth[:, :3, :3].mT
    turn = 0.5 * (turn - turn.mT)
    return torch.cat([(found - truth)[:, :3, 3], torch.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], 1)], 1)


def test_derivatives_of_pixels_and_those_of_opencv() -> None:
    lens = CAMERA.lens
    points = torch.tensor([[0.1, -0.07, 0.5], [-0.2, 0.1, 0.4], [0.0, 0.0, 1.0]], dtype=torch.float64)
    by_point, by_lens = project_slopes(points, lens)
    full: Any = jacobian(lambda p: project(p, lens), points)
    assert_close(by_point, torch.stack([full[i, :, i] for i in range(3)]), rtol=0, atol=1e-9)
    assert_close(by_lens, jacobian(lambda own: project(points, own), lens), rtol=0, atol=1e-9)
    cv2 = pytest.importorskip("cv2")
    points = torch.tensor([[0.1, -0.07, 0.5], [-0.2, 0.1, 0.4]], dtype=torch.float64)
    fx, fy, cx, cy, *distortion = CAMERA.lens.tolist()
    matrix, zero = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.zeros(3)
    pixels, _ = cv2.projectPoints(points.numpy(), zero, zero, matrix, np.array(distortion))
    assert_close(project(points, CAMERA.lens), torch.from_numpy(pixels[:, 0]), rtol=0, atol=1e-9)


def test_the_formula_of_a_board_and_what_a_camera_sees() -> None:
    """Boards as those of its images were: not nearer, farther, behind, outside or folded into the image."""
    point, board = FOUND.poses.new_tensor([0.03, 0.02, 0.0]), FOUND.poses.new_tensor([1e-3, 2e-3, 0.01, 0.02, 0.03])
    bent = 0.1 * (0.01 * 0.3**2 + 0.02 * 0.3 * 0.2 + 0.03 * 0.2**2)
    expected = torch.tensor([1.003 * 0.03, 0.999 * 0.02, bent], dtype=torch.float64)
    assert_close(real_board(point, board, 0.1), expected, rtol=1e-12, atol=1e-15)
    camera, poses = FOUND.camera, FOUND.poses
    assert camera.view is not None
    assert bool(sees(camera, poses).all())
    middle = poses[:, :3, :3] @ camera.corners.mean(0) + poses[:, :3, 3]
    away = middle.norm(dim=1)
    cosines = (poses[:, :3, 2] * middle).sum(1) / away
    found = camera.view.near, camera.view.far, camera.view.facing
    assert found == pytest.approx([float(each) for each in (away.min(), away.max(), cosines.min())])
    behind = rotation(torch.tensor([[torch.pi, 0.0, 0.0]], dtype=torch.float64)) @ poses[:, :3, :3]
    R = poses[:, :3, :3]
    wrong = [(R, factor * middle) for factor in (0.4, 2.0, -1.0)] + [(behind, middle), (R, middle + away.max())]
    for turn, place in wrong:
        assert not bool(sees(camera, transforms(turn, place - turn @ camera.corners.mean(0))).any())
    folding = replace(camera, unknowns=camera.unknowns.clone())
    folding.unknowns[4:9] = torch.tensor([-0.3, 0.0, 0.0, 0.0, 0.0])
    aside = middle.new_tensor([0.72, 0.0, 0.4]).expand(len(R), 3)  # tangent 1.8 comes back to 0.05
    assert not bool(shown(folding, transforms(R, aside)).any())


def test_truth_is_found_within_its_deviations() -> None:
    away = (FOUND.camera.unknowns - CAMERA.unknowns) / FOUND.camera.deviations
    assert float(away.abs().max()) < 4.0
    assert abs(FOUND.camera.noise / NOISE - 1) < 0.05
    errors = pose_errors(FOUND.poses, POSES)
    known = FOUND.covariance + FOUND.shared @ FOUND.shared.mT
    squares = (errors[:, None] @ torch.linalg.solve(known, errors[..., None])).flatten()
    assert 0.3 < float(squares.mean()) / 6 < 1.7


def test_images_of_one_camera_in_two_parts_with_a_known_lens_tell_the_same() -> None:
    """The one board counts once: twice its prior would make its scale too certain by the square root of two."""
    held = replace(CAMERA, half_size=0.0)
    whole = sighted(IMAGES, held)
    assert_close(whole.camera.lens, CAMERA.lens, rtol=0, atol=0)
    assert float(whole.camera.deviations[: len(LENS)].max()) == 0.0
    assert float(whole.camera.deviations[len(LENS) :].min()) > 0.0
    assert float(whole.shared.norm()) < float(FOUND.shared.norm())
    rows = torch.arange(len(IMAGES.points)) % 3 == 0
    parts = [replace(IMAGES, points=IMAGES.points[some], pixels=IMAGES.pixels[some]) for some in (rows, ~rows)]
    found = sighted_by_several(parts, [held, held])
    for own, some in zip(found, (rows, ~rows), strict=True):
        assert_close(own.camera.board, whole.camera.board, rtol=0, atol=1e-5)
        assert_close(own.camera.deviations, whole.camera.deviations, rtol=0.05, atol=0)
        assert_close(own.poses, whole.poses[some], rtol=0, atol=5e-5)
        ours, theirs = (each @ each.flatten(0, 1).mT for each in (own.shared, whole.shared[some]))
        assert_close(ours, theirs, rtol=0, atol=0.05 * float(theirs.abs().max()))


def test_poses_and_shared_errors_are_the_whole_posterior() -> None:
    few, _ = images(5, NOISE, seed=3)
    found = sighted(few)
    N, scale = len(found.poses), found.camera.noise

    def pixels(unknowns: torch.Tensor) -> torch.Tensor:
        steps, own = unknowns[: 6 * N].view(N, 6), unknowns[6 * N :]
        R = rotation(steps[:, 3:]) @ found.poses[:, :3, :3]
        camera = replace(found.camera, unknowns=own)
        seen = camera.pixels(transforms(R, found.poses[:, :3, 3] + steps[:, :3]), few.points)
        return seen[few.seen].flatten()

    at = torch.cat([torch.zeros(6 * N, dtype=torch.float64), found.camera.unknowns])
    S = jacobian(pixels, at) / scale
    prior = torch.zeros(len(at), dtype=torch.float64)
    prior[6 * N :] = first_guess(few, BoardPrior()).deviations ** -2
    whole = torch.linalg.inv(S.mT @ S + torch.diag(prior))
    shared = found.shared.flatten(0, 1)
    ours = torch.block_diag(*found.covariance) + shared @ shared.mT
    size = ours.diagonal().sqrt()
    assert_close(ours / size / size[:, None], whole[: 6 * N, : 6 * N] / size / size[:, None], rtol=0, atol=0.25)
    own = whole[6 * N :, 6 * N :].diagonal().sqrt()
    assert float((found.camera.deviations / own - 1).abs().max()) < 0.25  # every image has a noise of its own


def test_opencv_finds_the_same_lens() -> None:
    """With a board that is known, and weights that are equal, both minimise the same sum."""
    cv2 = pytest.importorskip("cv2")
    exact = sighted(IMAGES, None, BoardPrior(1e-12, 1e-12, 1e-12))
    seen = [own.nonzero()[:, 0] for own in IMAGES.seen]
    points = [IMAGES.points[k, own].float().numpy() for k, own in enumerate(seen)]
    pixels = [IMAGES.pixels[k, own].float().numpy() for k, own in enumerate(seen)]
    size = (IMAGES.width, IMAGES.height)
    _, matrix, distortion, *_ = cv2.calibrateCamera(points, pixels, size, None, None)
    theirs = torch.tensor([*matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *distortion.ravel()[:5]], dtype=torch.float64)
    away = (exact.camera.lens - theirs) / exact.camera.deviations[: len(LENS)]
    assert float(away.abs().max()) < 0.7


def test_wrong_corners_a_longer_focal_length_and_sentences() -> None:
    pixels = IMAGES.pixels.clone()
    pixels[::3, 5] += 30.0
    away = (sighted(replace(IMAGES, pixels=pixels)).camera.unknowns - CAMERA.unknowns) / FOUND.camera.deviations
    assert float(away.abs().max()) < 5.0
    whole = FOUND.camera.root
    assert_close(whole @ FOUND.camera.longer, FOUND.camera.unknowns * (torch.arange(len(whole)) < 2))
    board = torch.randn(5, 5, dtype=whole.dtype, generator=seeded(0))
    exact = replace(FOUND.camera, root=torch.cat([torch.zeros_like(whole[: len(LENS), :5]), board]))
    assert not bool(exact.longer.any())  # and not what rounding makes of it
    text = " ".join([*FOUND.camera.sentences(), FOUND.camera.board_sentence()])
    assert all(name in text for name in LENS)
    assert "lengths in the images are the board's" in text
    assert set(UNKNOWNS) < set(FOUND.camera.entry())


def test_files_keep_a_camera(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(camera_text(FOUND.camera))
    same = read_camera(path)
    assert_close(same.unknowns, FOUND.camera.unknowns, rtol=0, atol=0)
    assert_close(same.root, FOUND.camera.root, rtol=0, atol=0)
    assert (same.width, same.height, same.half_size) == (1280, 960, FOUND.camera.half_size)
    assert same.noise == FOUND.camera.noise
    path.write_text(camera_text(FOUND.camera, ros=True))
    assert (read_camera(path).half_size, read_camera(path).root.shape) == (0.0, (len(UNKNOWNS), 0))
    K, _, R, P = (torch.tensor(json.loads(data)) for data in re.findall(r"data: (\[[^]]*\])", path.read_text()))
    assert_close(P.view(3, 4), torch.nn.functional.pad(K.view(3, 3), (0, 1)), rtol=0, atol=0)
    assert_close(R.view(3, 3), torch.eye(3), rtol=0, atol=0)


NINE, FIVE = "500.0, 0.0, 310.0, 0.0, 510.0, 235.0, 0.0, 0.0, 1.0", "-0.1, 0.02, 0.001, -0.0002, 0.0"
ECHO = "height: 480\nwidth: 640\ndistortion_model: {}\nD: [{}]\nK: [" + NINE + "]\nroi:\n  height: 0\n  width: 0\n"
KALIBR = "cam0:\n  camera_model: {}\n  distortion_coeffs: [{}]\n  distortion_model: {}\n  resolution: [640, 480]\n"
CHAIN = KALIBR.format("pinhole", FIVE[:-5], "radtan") + "  intrinsics: [500.0, 510.0, 310.0, 235.0]\n"
STORAGE = "%YAML:1.0\n---\nimage_size: [ 640, 480 ]\nK: !!opencv-matrix\n   rows: 3\n   data: [ " + NINE + " ]\n"
LENSES = {
    "topic echo of ROS 1": ECHO.format("plumb_bob", FIVE),
    "eight coefficients without the last three": ECHO.format("rational_polynomial", FIVE + ", 0.0, 0.0, 0.0"),
    "topic echo of ROS 2": "height: 480\nwidth: 640\ndistortion_model: plumb_bob\nd:\n- {}\nk:\n- {}\n---\n".format(
        *(numbers.replace(", ", "\n- ") for numbers in (FIVE, NINE))
    ),
    "Kalibr": CHAIN,
    "OpenCV": STORAGE + "D: !!opencv-matrix\n   rows: 1\n   dt: d\n   data: [ " + FIVE + " ]\nfisheye_model: 0\n",
    "XML": "<?xml version='1.0'?>\n<opencv_storage><image_Width>640</image_Width><image_Height>480</image_Height>"
    f"<Camera_Matrix type_id='opencv-matrix'><rows>3</rows><data>{NINE}</data></Camera_Matrix>"
    f"<Distortion_Coefficients><data>\n{FIVE}</data></Distortion_Coefficients></opencv_storage>".replace(",", ""),
    "plain": "fx: 500\nfy: 510\ncx: 310\ncy: 235\nk1: -0.1  # of a fit\nk2: 0.02\np1: 0.001\np2: -0.0002\n"
    "width: 640\nheight: 480",
    "another spelling": ECHO.format("Plumb Bob", FIVE)
    + "fisheye: False\nsensor: OmniVision [OV\nmodel: DS-2CD2043\n".replace("[", "# ["),
    "JSON of intrinsics": '{"image_size":[640,480],"intrinsics":[{"fx":500.0,"fy":510.0,"cx":310,"cy":235}],'
    '"distortion_model":"brown-conrady","coeffs":[' + FIVE + "]}",
    "JSON": '{"width":640,"height":480,"fx":500.0,"fy":510.0,"ppx":310,"ppy":235,"model":"brown","coeffs":['
    + FIVE
    + "]}",
}
REFUSED = {
    "fisheye of ROS": (ECHO.format("equidistant", FIVE[:-5]), "equidistant"),
    "omni": (KALIBR.format("omni", FIVE[:-5], "radtan") + "  intrinsics: [1.2, 500, 510, 310, 235]", "omni"),
    "KannalaBrandt8": ("Camera.type: 'KannalaBrandt8'\nCamera.fx: 500.\nCamera.k1: 0.1\n", "KannalaBrandt8"),
    "division": (ECHO.format("division", "-0.2"), "division"),
    "rational": (ECHO.format("rational_polynomial", FIVE + ", 0.1, 0.0, 0.0"), "0.1, 0.0, 0.0"),
    "two cameras": (CHAIN + CHAIN.replace("-0.1", "-0.2"), "2 different"),
    "columns": (ECHO.format("plumb_bob", FIVE).replace(NINE, "500, 0, 0, 0, 510, 0, 310, 235, 1"), "row by row"),
    "no size": (STORAGE.replace("image_size", "size") + f"D: [{FIVE}]\n", "image_width"),
    "nothing": ("", r"camera\.yaml.*camera_matrix"),
    "a tag without an end": ("<" + 900_000 * "a", "camera_matrix"),  # which quadratic time would not read
    "no lens": ("a: [1, 2]\nimage_width: 3\nimage_height: 3\nd: [0, 0, 0, 0]", r"`camera_matrix`.*`k`.*Kalibr.*fx"),
}


@pytest.mark.parametrize("form", LENSES)
def test_usual_files_of_cameras_are_read(form: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(LENSES[form])
    found = read_camera(path)
    assert (found.width, found.height) == (640, 480)
    assert found.lens.tolist() == [500.0, 510.0, 310.0, 235.0, -0.1, 0.02, 0.001, -0.0002, 0.0]


def test_lenses_that_files_leave_open_are_said(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    for text, message in ((f"D: [{FIVE[:-5]}]\n", "not as a fisheye"), ("", "no distortion")):
        path.write_text(STORAGE + text)
        with pytest.warns(DiffeoCalibWarning, match=message):
            read_camera(path)


FILE = camera_text(FOUND.camera)
DAMAGED = {
    "a number that is none": (r"image_width: \d+", "image_width: e", "image_width"),
    "no row of the root": (r"root:(.*)data: \[[^,]*, ", r"root:\1data: [", "root"),
    "no root": (r"root:(.*)data: \[.*\]", r"root:\1data: []", "root"),
    "a matrix without an end": (r"\]", "", "camera_matrix"),
    "a number beyond all cameras": (r"data: \[", "data: [1e300, ", "distortion_coefficients"),
    "no text": (r"camera_matrix", "\udcff", "utf-8"),
}
for damage, (pattern, other, message) in DAMAGED.items():
    REFUSED[damage] = re.sub(pattern, other, FILE, flags=re.S), rf"camera\.yaml.*{message}"
for piece in ("camera_matrix:\n", "camera_matrix:\n data: [", " "):  # nor these
    REFUSED[f"long {piece}"] = "camera_matrix:" + piece * (900_000 // len(piece)), "camera_matrix"
    REFUSED[f"too long {piece}"] = piece * (1_100_000 // len(piece)), "too large for a camera file: .* at most 1 MB"


@pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")
@pytest.mark.parametrize("form", REFUSED)
def test_other_and_damaged_files_are_refused(form: str, tmp_path: Path) -> None:
    text, message = REFUSED[form]
    path = tmp_path / "camera.yaml"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match=message):
        read_camera(path)


def test_corners_that_tell_no_pose_are_refused() -> None:
    pixels, points = IMAGES.pixels.clone(), IMAGES.points.clone()
    pixels[3, 4:] = torch.nan
    line = torch.zeros(1, 8, 3, dtype=torch.float64)
    line[0, :, 0] = torch.arange(8)
    points[..., 2] += 1e-3 * (torch.arange(points.shape[1]) % 3)
    for wrong, message in (
        (replace(IMAGES, pixels=pixels), "image 3"),
        (Images(line, line[..., :2].clone(), 100, 100), r"image 0.*line"),
        (replace(IMAGES, points=points), "plane"),
    ):
        with pytest.raises(MeasurementError, match=message):
            sighted(wrong)
