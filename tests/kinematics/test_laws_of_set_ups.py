"""Laws of set-ups: moved devices, and markers mounted anew, in the frame of a model."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from kind_bank import kind_named, marked
from math_bank import normal
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.kinematics.hand_eye import HandEye, SetUp
from diffeo_calib.measurements.poses import mark_points, poses_from_marks
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table_format import LEVER
from diffeo_calib.robots.se3 import rotation, transforms, twist_transform
from diffeo_calib.sensors.set_ups import MeasuringFrames, MountedFrames, MountedMarkers, SetUps

ROWS, NAMES, STEP = 20, ("here", "there"), 1e-6


def frames(count: int, seed: int, size: float = 1.0) -> Tensor:
    return transforms(rotation(size * normal(count, 3, seed=seed)), size * normal(count, 3, seed=seed + 1))


TIPS, MOVED = frames(ROWS, 1), torch.cat([torch.eye(4).double()[None], frames(1, 3, 0.1)])
SESSION = torch.arange(ROWS) % 2


def points(tips: Tensor) -> Tensor:
    """(N, 3, 3) of the model's tool: three points that mark a frame, m."""
    return mark_points(tips, LEVER)


def measured(kind: type[SetUps]) -> Any:
    """Rows of two set-ups, the first one that of the model."""
    q, names = normal(ROWS, 2), [NAMES[k] for k in SESSION.tolist()]
    if kind is MeasuringFrames:
        T = MOVED[SESSION]
        return dc.Measurements(q, points(TIPS) @ T[:, :3, :3].mT + T[:, None, :3, 3]).with_sessions(names)
    shifts = 0.01 * normal(3, 3, seed=5) * SESSION[:, None, None]
    return dc.Measurements(q, points(TIPS) + shifts @ TIPS[:, :3, :3].mT).with_sessions(names, remounted=True)


def found(kind: type[SetUps], tips: Tensor = TIPS) -> SetUps:
    """Where they fit the points of a model."""
    own = kind.of(points(tips), measured(kind), lambda _: tips[:, None, :3, :3].expand(-1, 3, -1, -1))
    return own.with_reference(0)


@pytest.mark.parametrize("kind", [MeasuringFrames, MountedMarkers])
def test_rows_of_all_set_ups_are_those_of_the_model(kind: type[SetUps]) -> None:
    own = found(kind)
    assert own.elsewhere.tolist() == [False, True]
    assert_close(own.aligned(measured(kind)).points, points(TIPS), rtol=0, atol=1e-9)
    there = points(own.view(1, TIPS))[SESSION == 1] if kind is MeasuringFrames else points(TIPS)[SESSION == 1]
    shifts = torch.zeros(3, 3).double() if kind is MeasuringFrames else own.constants[1].view(3, 3)
    there = there + shifts @ TIPS[SESSION == 1][:, :3, :3].mT
    assert_close(measured(kind).points[SESSION == 1], there, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", [MeasuringFrames, MountedMarkers])
def test_increments_are_what_steps_do_to_the_rows(kind: type[SetUps]) -> None:
    own, data, centre, eye = found(kind), measured(kind), normal(3, seed=7), torch.eye(9, dtype=torch.float64)
    by_tool = torch.stack([torch.block_diag(*[T[:3, :3]] * 3) for T in TIPS])
    effects = own.increments(points(TIPS), eye.expand(ROWS, -1, -1), by_tool, centre)[..., :9]
    steps = normal(1, effects.shape[2], seed=8)
    if kind is MeasuringFrames:  # and markers, which it leaves where they are
        steps[:, 6:] = 0.0

    def rows(h: float) -> Tensor:
        moved = own.moved([1], h * steps, 0.0 * own.deviations[1:], centre, torch.eye(4, dtype=torch.float64))
        return moved.aligned(data).points.flatten(1)

    change = (rows(-STEP) - rows(STEP)) / (2 * STEP)  # of the model's own points against the rows
    assert_close((effects @ steps[0])[SESSION == 1], change[SESSION == 1], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("kind", [MeasuringFrames, MountedMarkers])
def test_carried_set_ups_belong_to_the_other_model(kind: type[SetUps]) -> None:
    T, own = frames(1, 11)[0], found(kind)
    tips, none = T @ TIPS, torch.zeros(3, 3, dtype=torch.float64)
    constants = own.carried(T, points(TIPS), points(tips), none)
    other = replace(own, constants=constants, turns=found(kind, tips).turns if kind is MountedMarkers else None)
    data = measured(kind)
    if kind is not MeasuringFrames:  # what is on the tool goes with the device
        data = with_attributes(data, points=data.points @ T[:3, :3].mT + T[:3, 3])
    assert_close(other.aligned(data).points, points(tips), rtol=0, atol=1e-9)


def test_the_deviations_of_markers_are_those_of_means() -> None:
    noise, turns = 1e-4 * normal(ROWS, 3, 3, seed=9), TIPS[:, None, :3, :3].expand(-1, 3, -1, -1)
    data = measured(MountedMarkers)
    own = MountedMarkers.of(points(TIPS), with_attributes(data, points=data.points + noise), lambda _: turns)
    away = (noise @ TIPS[:, :3, :3])[SESSION == 1]
    assert_close(own.deviations[1].view(3, 3), away.std(0, correction=0) / len(away) ** 0.5)


def test_frames_that_are_found_in_rows_of_known_ones_lead_on_from_these() -> None:
    first, second = (MountedFrames(NAMES, frames(2, k, 0.1).flatten(1), normal(2, 6, seed=k)) for k in (21, 23))
    for number in range(2):
        there = first.view(number, second.view(number, TIPS))
        assert_close(second.after(first).view(number, TIPS), there)


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
