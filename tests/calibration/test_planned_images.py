"""Planned images of a board: its camera sees it, what an image there tells, and whether it comes true."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from kind_bank import Kind, kind_named
from simulated_camera import BOARD_PRIOR, HEIGHT, WIDTH, camera_arm, fixed_camera_arm, seen_corners, true_camera
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.planning.board_images import BoardImages
from diffeo_calib.calibration.planning.candidates import candidates
from diffeo_calib.calibration.planning.sensors_of_model import sensor_of
from diffeo_calib.cameras.images import Images, sighted
from diffeo_calib.cameras.seeing import expected, sees, shown
from diffeo_calib.measurements.pose_frames import inverse_poses
from diffeo_calib.measurements.poses import LEVER, poses_from_marks
from diffeo_calib.robots.se3 import rotation

pytestmark = [
    pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning"),  # few rows
    pytest.mark.slow,
]

FEWEST = 4


def wrist() -> Kind:
    return kind_named("images of a board")


def cameras(kind: Kind) -> list[Any]:
    return [one for one in sensor_of(kind.model) if isinstance(one, BoardImages)]


@cache
def drawn(kind: str) -> Tensor:
    """Half of them where a camera sees the board, half anywhere."""
    model, q = kind_named(kind).model, []
    for one in cameras(kind_named(kind)):
        where = one.where(model)
        q.append(candidates(model.robot, 40, keep=where.keep, ranges=where.ranges))
    return torch.cat([*q, candidates(model.robot, 40)])


def corners_in_truth(q: Tensor, arm: Any, *, on_tool: bool) -> Tensor:
    """(N,) corners of the real board that the real camera sees from its front."""
    poses = poses_from_marks(arm.arm.true_points(q), LEVER)
    boards = inverse_poses(poses) if on_tool else poses
    from_above = inverse_poses(boards)[:, 2, 3] > 0
    return (~seen_corners(boards, 0.0, camera=arm.camera)[..., 3].isnan()).sum(1) * from_above * (boards[:, 2, 3] > 0)


SEEN: dict[str, tuple[Any, tuple[str, ...]]] = {
    "images of a board": (lambda second: camera_arm(60), ("camera",)),
    "two cameras": (lambda second: fixed_camera_arm(70, second=second), ("left", "right")),
    "two cameras on the tool": (lambda second: camera_arm(70, second=second), ("left", "right")),
}


@pytest.mark.parametrize("name", SEEN)
def test_the_camera_sees_the_board_in_the_poses_that_are_planned_for_it(name: str) -> None:
    model, (arm_of, names) = kind_named(name).model, SEEN[name]
    arms = {own: arm_of(own == "right") for own in names}
    plan = dc.plan(model, drawn(name), 12)
    assert set(plan.devices) <= set(names)
    for own, q in zip(plan.devices, plan.q, strict=True):
        assert int(corners_in_truth(q[None], arms[own], on_tool=name != "two cameras")) >= FEWEST
    last = cameras(kind_named(name))[-1]
    alone = dc.plan(model, drawn(name), 6, sensor=last)
    assert int(corners_in_truth(alone.q, arms[last.name or names[-1]], on_tool=name != "two cameras").min()) >= FEWEST


def test_candidates_that_no_camera_sees_are_refused() -> None:
    q = candidates(wrist().robot, 40)
    with pytest.raises(dc.DiffeoCalibError, match=r"candidates that can be measured: expected at least 5.*its board"):
        dc.plan(wrist().model, q, 5)


@pytest.mark.parametrize("kind", ["images of a board", "two cameras", "two cameras on the tool"])
def test_images_of_the_fit_are_what_they_were(kind: str) -> None:
    """Their noise and what lens and board do to them, by the poses of the model alone."""
    model = kind_named(kind).model
    placed = next(own for own in model.placement if own.cameras)
    for number, one in enumerate(cameras(kind_named(kind))):
        rows = placed.rows[placed.device == number]
        points = model(model.configurations[rows]).detach().flatten(1)
        assert float(sees(one.camera, one.boards(points)).double().mean()) > 0.9
        known, by_lens = one.tells(points)
        shared = model.map.noise.shared[rows].clone()
        if one.set_up.columns is not None:
            shared[..., one.set_up.columns] = 0.0
        assert float((by_lens @ one.effects - shared).norm() / shared.norm()) < 0.02
        sizes = [each.diagonal(dim1=1, dim2=2).sum(1) for each in (known, model.map.noise.covariance[rows])]
        assert 0.7 < float((sizes[0] / sizes[1]).median()) < 1.0


def test_an_image_tells_what_its_pose_shows() -> None:
    """Against poses and effects that are found from corners."""
    arm = camera_arm(60)
    corners = arm.shown(0.1)[1]
    whole = (~corners[..., 3].isnan()).all(1)
    found = sighted(Images(corners[whole, :, :3], corners[whole, :, 3:], WIDTH, HEIGHT), None, BOARD_PRIOR)
    covariance, effects = expected(found.camera, found.poses)
    ratio = covariance.diagonal(dim1=1, dim2=2) / found.covariance.diagonal(dim1=1, dim2=2)
    assert 0.6 < float(ratio.median()) < 1.6  # an image's noise is its own
    assert_close(effects @ found.camera.root, found.shared, rtol=0, atol=0.02 * float(found.shared.abs().max()))


def test_views() -> None:
    """Too near, too far, too flat, from behind, behind the camera, outside of the image, and folded back into it."""
    camera, arm = true_camera(), camera_arm(60)
    points, pixels = arm.shown(0.1)[1].split([3, 2], 2)
    images = Images(points, pixels, WIDTH, HEIGHT)
    view = sighted(images, None, BOARD_PRIOR).camera.view
    assert (len(view.points), view.fewest) == (35, int(images.seen.sum(1).min()))
    camera = replace(camera, view=replace(view, near=0.3, far=0.6, facing=-0.4))
    ahead = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    ahead[2, 3] = 0.4
    assert sees(camera, ahead[None]).tolist() == [True]

    def seen(shift: tuple[float, float, float] = (0.0, 0.0, 0.0), turn: float = 0.0) -> bool:
        pose = ahead.clone()
        pose[:3, :3] = rotation(pose.new_tensor([[turn, 0.0, 0.0]]))[0] @ pose[:3, :3]
        pose[:3, 3] += pose.new_tensor(shift)
        return bool(sees(camera, pose[None]))

    assert not seen((0.0, 0.0, -0.12))
    assert not seen((0.0, 0.0, 0.25))
    assert not seen((0.3, 0.0, 0.0))
    assert not seen((0.0, 0.0, -0.8))
    assert seen(turn=1.0)
    assert not seen(turn=1.3)
    assert not seen(turn=3.1)
    folding = replace(camera, unknowns=camera.unknowns.clone(), view=replace(camera.view, far=9.0, facing=-0.1))  # pyright: ignore
    folding.unknowns[4:9] = torch.tensor([-0.3, 0.0, 0.0, 0.0, 0.0])
    aside = ahead.clone()
    aside[0, 3] = 0.4 * 1.8  # tangent 1.8 comes back to 0.05
    assert not bool(shown(folding, aside[None]).any())


def test_planned_images_come_true() -> None:
    """Ten more images, measured in simulation and fitted, at those that are planned."""
    arm, kind = camera_arm(60), wrist()
    q = drawn("images of a board")
    plan = dc.plan(kind.model, q, 10)
    boards = inverse_poses(poses_from_marks(arm.arm.true_points(plan.q), LEVER))
    corners = seen_corners(boards, 0.1, 3, arm.camera)
    first_q, first = arm.shown(0.1)
    count = len(first) * 3 // 4
    known: Any = {"board": BOARD_PRIOR, "camera_on_tool": True}
    both = dc.Measurements.from_images(
        torch.cat([first_q[:count], plan.q]), torch.cat([first[:count], corners]), (WIDTH, HEIGHT), **known
    )
    model = dc.calibrate(kind.robot, both, hyperparameters=kind.scales).model
    expected_mm, true_mm = 1e3 * float(plan.expected_rms[-1]), kind.error_mm(model(q).detach(), q)
    assert true_mm < 1.6 * expected_mm


def test_a_campaign_proposes_what_its_camera_sees() -> None:
    arm = camera_arm(60)
    rows: Any = arm.images(0.1).rows(slice(0, 14))
    campaign = dc.Campaign(wrist().robot, seed=1)
    campaign.add(rows)
    found = campaign.next(5)
    assert len(found.q) == 5
    assert int(corners_in_truth(found.q, arm, on_tool=True).min()) >= FEWEST
    given = dc.Campaign(wrist().robot, candidates=torch.cat([rows.q[:3], candidates(wrist().robot, 20)]), seed=1)
    given.add(rows)
    proposed = given.next(5)
    assert sorted(proposed.rows) == [0, 1, 2]
