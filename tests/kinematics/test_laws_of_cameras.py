"""What is known of a camera and its board is what small changes of the fit's parameters do to their poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from kind_bank import kind_named, marked
from torch import Tensor

from diffeo_calib.kinematics.hand_eye import HandEye, SetUp
from diffeo_calib.measurements.poses import poses_from_marks
from diffeo_calib.robots.se3 import twist_transform

STEP = 1e-6


def changes(pose: Callable[[Tensor], Tensor], count: int) -> Tensor:
    """(6, count) shift and turn of a pose, along the axes of its frame, by unit steps."""
    columns = []
    for step in STEP * torch.eye(count, dtype=torch.float64):
        ahead, behind = pose(step), pose(-step)
        turn = ahead[:3, :3] @ behind[:3, :3].mT
        small = 0.5 * torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        columns.append(torch.cat([(ahead - behind)[:3, 3], small]) / (2 * STEP))
    return torch.stack(columns, 1)


@pytest.mark.parametrize("name", marked("two cameras", "two cameras on the tool"))
def test_covariances_are_those_of_small_changes(name: str) -> None:
    """Also of the camera whose frame or place on the tool is not the model's: shifts of the fit move it."""
    model, on_tool = kind_named(name).model, "on the tool" in name
    g, fitted, lever = model.geometry, model.map, model.bodies.pose_lever()
    for camera in HandEye.of_each(model, camera_on_tool=on_tool):
        own, found = SetUp.of(model, camera), HandEye.of(model, camera_on_tool=on_tool, camera=camera)
        carried, standing = (found.camera, found.board) if on_tool else (found.board, found.camera)
        shifts = own.columns.nonzero()[:, 0]

        def poses(step: Tensor, own: SetUp = own) -> tuple[Tensor, Tensor]:
            theta, moved = step.split([g.size, own.of_mount.shape[1]])
            after = g.absorb(theta)
            mount, frame = twist_transform(own.of_mount @ moved) @ own.mount, twist_transform(own.of_frame @ moved)
            standing = torch.linalg.inv(own.transform @ frame @ after.base)
            return poses_from_marks(after.tool[None], lever)[0] @ mount, standing

        for number, (known, part) in enumerate(((carried, "tool"), (standing, "base"))):
            numbers = torch.arange(g.size)[g.slices[part]]
            J = changes(lambda step, number=number: poses(step)[number], g.size + len(shifts))
            which = torch.cat([numbers, len(fitted.geodesic.spec.prior_variance) + shifts])
            J = J[:, torch.cat([numbers, g.size + torch.arange(len(shifts))])]
            left = J[:, : len(numbers)] @ fitted.open_directions[numbers]
            expected = J @ fitted.parameter_covariance(which) @ J.mT + left @ left.mT
            size = known.deviations[:, None] * known.deviations
            torch.testing.assert_close(known.covariance / size, expected / size, rtol=0, atol=0.02)


@pytest.mark.slow
def test_a_mount_that_no_row_of_the_fit_tells_of_is_known_as_before() -> None:
    """Its deviations, along the axes of the model's tool, are added."""
    model, std = kind_named("two cameras on the tool").model, 1e-3 * torch.arange(1.0, 7.0).double()
    mounts, *others = sorted(model.placement, key=lambda own: own.kind != "mounted frame")
    tool, mount = (
        poses_from_marks(model.geometry.tool[None], model.bodies.pose_lever())[0],
        mounts.constants[1].view(4, 4),
    )
    known = []
    for deviations in (torch.zeros_like(std), std):
        alone = replace(mounts, rows=mounts.rows[:0], device=mounts.device[:0], deviations=deviations.expand(2, 6))
        own = model.changed(placement=(alone, *others))
        known.append(HandEye.of(own, camera_on_tool=True, camera=mounts.names[1]).camera.covariance)
    J = changes(lambda step: tool @ twist_transform(step) @ mount, 6) * std
    torch.testing.assert_close(known[1] - known[0], J @ J.mT, rtol=1e-6, atol=1e-14)
