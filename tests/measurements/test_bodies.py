"""Markers and measured frames as bodies: what differs between them, and what is absent."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.measurements.bodies import Bodies, seen_board
from diffeo_calib.measurements.poses import LEVER
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots.se3 import rotation, transforms

N = 7
GENERATOR = torch.Generator().manual_seed(0)


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=GENERATOR)


def frames(tips: int) -> torch.Tensor:
    turns = torch.stack([rotation(turn) for turn in random(N * tips, 3)])
    return transforms(turns, random(N * tips, 3)).unflatten(0, (N, tips))


Q, POSES = random(N, 6), frames(2)
MARKERS = dc.Measurements(Q, random(N, 2, 3), doubt=False)
TIPS = dc.Measurements.from_poses(Q, POSES, on=("left", "right"), doubt=False)
SOCKETS = dc.Measurements.from_sockets(Q, ["a/0"] * 3 + ["b/0"] * 4, doubt=False)
MIXTURE = dc.Measurements.joined([MARKERS, SOCKETS])


def test_markers_and_frames_have_names_and_numbers() -> None:
    assert MARKERS.bodies.labels(MARKERS) == [(0, None), (1, None)]
    assert TIPS.bodies.labels(TIPS) == [(None, "left"), (None, "right")]
    assert [list(data.bodies.exchangeable(data)) for data in (MARKERS, TIPS)] == [[0, 1], []]
    single = dc.Measurements.from_poses(Q, POSES[:, 0], doubt=False)
    assert single.bodies.labels(single) == [(None, None)]
    named = TIPS.with_tips(None)
    assert named.bodies.labels(named, TIPS.on) == TIPS.bodies.labels(TIPS)


def test_only_markers_can_be_those_of_the_other_hand() -> None:
    (mirrored,) = MARKERS.bodies.mirrored(MARKERS)
    assert_close(mirrored[..., :2], MARKERS.points[..., :2])
    assert_close(mirrored[..., 2], -MARKERS.points[..., 2])
    assert not list(TIPS.bodies.mirrored(TIPS))


def test_turns_are_angles_of_frames() -> None:
    turned = POSES.clone()
    turned[..., :3, :3] = turned[..., :3, :3] @ rotation(torch.tensor([0.2, 0.0, 0.0], dtype=torch.float64))
    other = dc.Measurements.from_poses(Q, turned, on=("left", "right"), doubt=False)
    errors = other.bodies.errors(other, TIPS.points)
    assert_close(errors[..., :3], torch.zeros_like(errors[..., :3]))
    assert_close(errors[..., 3:].norm(dim=-1), torch.full_like(errors[..., 0], 0.2))


def test_the_ball_in_sockets_is_a_kind_of_its_own_beside_others_alone() -> None:
    assert MARKERS.body_kinds is None
    assert SOCKETS.body_kinds is None
    kinds = MIXTURE.body_kinds
    assert kinds is not None
    assert kinds.tolist() == [[0, 0, 1]] * (2 * N)


def test_places_are_absent_as_numbers() -> None:
    assert MARKERS.places.tolist() == MARKERS.socket_numbers.tolist() == [-1] * N
    assert SOCKETS.places.tolist() == [0] * 3 + [1] * 4
    whole = dc.Observations.joined([MARKERS, dc.Readings.heights(Q, random(N), doubt=False)])
    assert whole.places.tolist() == [-1] * (2 * N)
    assert (len(MARKERS.masses), len(MARKERS.with_payload(2.0).masses)) == (0, N)


def test_points_become_poses_with_a_lever() -> None:
    again = dc.Measurements.of_points(Q, TIPS.points, TIPS.on, LEVER)
    assert again.poses is not None
    assert_close(again.poses, POSES)
    assert dc.Measurements.of_points(Q, TIPS.points, None, None).poses is None


@pytest.mark.parametrize(("lever", "table"), [(None, MARKERS), (LEVER, TIPS)])
def test_origins_are_linear_in_points(lever: float | None, table: dc.Measurements) -> None:
    flat = table.points.flatten(1)
    expected = flat if lever is None else POSES[..., :3, 3].flatten(1)
    assert_close(flat @ Bodies(lever).averaging(flat).mT, expected)


def test_only_a_camera_on_the_tool_sees_a_board() -> None:
    assert seen_board(MARKERS) is None
    assert seen_board(dc.Measurements.from_poses(Q, POSES[:, 0], doubt=False)) is None
    camera = dc.Measurements.from_poses(Q, POSES[:, 0], camera_on_tool=True, doubt=False)
    seen = seen_board(camera)
    assert seen is not None
    assert_close(seen.origins, torch.zeros_like(seen.origins), rtol=0, atol=1e-12)  # the board's frame
    assert_close(seen.board, POSES[:, 0, :3, 3])


def test_a_row_in_a_socket_says_why_it_is_far() -> None:
    places = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)[SOCKETS.places][:, None]
    placed = with_attributes(SOCKETS, points=places)
    predicted = places.clone()
    predicted[0] = torch.tensor([1.0, 1e-3, 0.0])
    predicted[1] = torch.tensor([0.0, 0.4, 0.0])
    assert "'b/0'" in (placed.other_socket(0, predicted, 0.01) or "")
    assert "its socket" in (placed.other_socket(1, predicted, 0.01) or "")
    assert MARKERS.other_socket(0, MARKERS.points, 0.01) is None
