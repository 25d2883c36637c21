"""Rows of several kinds in one table: order, subsets, splits, copies, and tables that cannot be joined."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from numbers_bank import normal as values
from table_bank import held, random_poses, says, some
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import MeasurementError
from diffeo_calib.measurements.observations import Observations
from diffeo_calib.measurements.readings import Readings

NAMES = ("a", "b")
Tables = dict[str, Any]


def tables() -> Tables:
    q = [some(5, seed=seed).q for seed in range(10, 16)]
    return {
        "position": dc.Measurements(q[0], values(5, 3), NAMES),
        "pose": dc.Measurements.from_poses(q[1], random_poses(5), NAMES),
        "socket": dc.Measurements.from_sockets(q[2], ["f/0", "f/1", "g/0", "g/1", "f/0"], NAMES),
        "distance": Readings.distances(q[3], values(5).abs() + 1.0, ["A", "A", "B", "B", "A"], NAMES, std=1e-4),
        "height": Readings.heights(q[4], values(5), ["top"] * 5, NAMES),
        "image": Readings.images(q[5][:4], values(4, 2), None, NAMES, focal=(800.0, 900.0), centre=(1.0, 2.0)),
    }


@pytest.fixture
def whole() -> Observations:
    return Observations.joined(list(tables().values()))


def test_parts_and_selections_keep_their_order(whole: Observations) -> None:
    parts = tables()
    assert len(whole) == 29
    assert [part.kind for part in whole.parts] == list(parts)
    assert whole.kinds == tuple(kind for kind, table in parts.items() for _ in range(len(table)))
    assert_close(whole.q, torch.cat([table.q for table in parts.values()]))
    assert (whole.n, whole.joint_names, whole.payload) == (2, NAMES, None)
    assert whole.device_names[15:22] == ["A", "A", "B", "B", "A", "top", "top"]
    assert whole.session_names == ("f/0", "f/1", "g/0", "g/1", "A", "B", "top", "device")
    assert held(whole.session).tolist()[14:21] == [0, 4, 4, 5, 5, 4, 6]
    assert whole.places.tolist() == [*[-1] * 10, 0, 0, 1, 1, 0, *[-1] * 14]
    chosen = [28, 0, 16, 16, 12, 5, 1]
    some_rows = whole.rows(chosen)
    assert_close(some_rows.q, whole.q[chosen])
    assert some_rows.kinds == tuple(whole.kinds[row] for row in chosen)
    assert some_rows.line_numbers.tolist() == whole.line_numbers[chosen].tolist()
    assert [len(row) for row in some_rows] == [1] * 7
    again = Observations.joined([some_rows[:3], some_rows[3:]])
    assert_close(again.q, some_rows.q)
    assert again.kinds == some_rows.kinds
    with pytest.raises(MeasurementError, match="no row"):
        whole.rows([])


def test_what_is_held_out(whole: Observations) -> None:
    train, test = whole.split(0.5, seed=1)
    assert len(train) + len(test) == len(whole)
    assert "socket" not in test.kinds
    both = tables()
    blind = Observations.joined([both["socket"], both["distance"]])
    assert blind.without_device
    for seed in range(3):
        of_train, of_test = (set(part.places.tolist()) - {-1} for part in blind.split(0.6, seed))
        assert len(of_train) + len(of_test) == 2
    same = replace(both["distance"], q=both["socket"].q)  # read while the ball rested
    for seed in range(3):
        train, test = Observations.joined([both["socket"], same]).split(0.5, seed)
        assert not {*train.q[:, 0].tolist()} & {*test.q[:, 0].tolist()}


def test_the_simplest_table_that_holds_the_rows_and_copies_of_one_kind() -> None:
    parts = tables()
    near = parts["distance"]
    back = Readings.joined([near.rows([4, 2]), near.rows([0])])
    assert isinstance(back, Readings)
    assert_close(back.values, near.values[[4, 2, 0]])
    assert back.device_names == ["A", "B", "A"]
    assert isinstance(dc.Measurements.joined([parts["pose"], parts["pose"]]), dc.Measurements)
    assert isinstance(dc.Measurements.joined([parts["pose"], parts["position"]]), Observations)
    again = Observations.joined([near.rows([0, 1]), near.rows([2])]).rows([2, 0])
    assert_close(Readings.joined([again]).values, near.values[[2, 0]])
    near, far = tables()["distance"], tables()["position"]
    assert Observations.joined([far, replace(near, q=far.q)]).copies() == []
    assert Observations.joined([far, near, near.rows([3]), far.rows([0])]).copies() == [(8, 10), (0, 11)]


def test_payloads_names_lines_and_files(whole: Observations) -> None:
    laden = whole.with_payload(torch.arange(29.0)).with_line_numbers(range(100, 129)).with_joint_names(["u", "v"])
    assert held(laden.payload).tolist() == list(range(29))
    assert held(laden.parts[1].payload).tolist() == [5, 6, 7, 8, 9]
    assert laden.rows([28, 3]).line_numbers.tolist() == [128, 103]
    assert laden.parts[4].joint_names == ("u", "v")
    own = tables()["distance"]
    lengths = own, own.with_payload(1.0), replace(own, std=None)
    different = laden, whole, whole.rows(range(28)), whole.rows([1, 0]), *lengths
    assert len({data.sha256 for data in different}) == len(different)
    assert laden.to("cpu").sha256 == laden.sha256
    files = [part.with_columns(file_sha256=name) for part, name in zip(whole.parts, "aba", strict=False)]
    assert [part.sha256 for part in files] == ["a", "b", "a"]
    assert Observations.joined(files[::2]).file_sha256 == "a"
    assert Observations.joined(files[:2]).file_sha256 is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: [], "tables to join: expected at least one"),
        (lambda t: [t["position"], t["position"].q], "dc.Measurements or dc.Readings, got Tensor"),
        (lambda t: [t["position"], t["height"].with_joint_names(["u", "v"])], "the tables differ in joint_names"),
        (lambda t: [t["position"], t["height"].with_payload(1.0)], "the tables differ in payload"),
        (lambda t: [t["pose"].with_payload(1.0, "x"), t["height"].with_payload(1.0)], "differ in payload_at"),
        (lambda t: [Readings.heights(values(3, 3)), t["image"]], "the tables differ in n, joint_names"),
        (lambda t: [t["height"].with_tips(["l"]), t["distance"].with_tips(["r"])], "expected one tip, got l, r"),
        (lambda t: [replace(t["socket"], distances=(("f/0", "f/1", own),)) for own in (1.0, 2.0)], "in distances"),
        (lambda t: [t["position"], dc.Measurements(values(1, 2), values(1, 2, 3), NAMES), t["height"]], "in markers"),
    ],
)
def test_tables_that_cannot_be_joined(change: Callable[[Tables], list[dc.Measurements]], said: str) -> None:
    with pytest.raises(MeasurementError, match=says(said)):
        Observations.joined(change(tables()))


def test_deviations_of_readings_and_positions_beside_images() -> None:
    q = values(3, 2)
    assert held(Readings.distances(q, 1.0, std=[1.0, 2.0, 3.0]).std)[:, 0].tolist() == [1.0, 2.0, 3.0]
    seen = Readings.images(q, values(3, 2), focal=(10.0, 20.0), centre=(1.0, 2.0), std=0.2)
    assert_close(held(seen.std)[0].tolist(), [0.02, 0.01])
    assert_close(held(seen.reported_std)[0].tolist(), [0.2, 0.2])
    assert_close(seen.reported, values(3, 2))
    for std, said in ((0.0, "positive"), ([1.0, 2.0], "std"), (float("nan"), "std")):
        with pytest.raises(MeasurementError, match=said):
            Readings.heights(q, std=std)
    with pytest.raises(MeasurementError, match=r"pass 2 per row\W*$"):  # pixels, no metres
        Readings.images(q, values(3, 3), focal=(10.0, 20.0), centre=(1.0, 2.0))
    data = some(4, markers=2)
    known = dc.Measurements(data.q, data.points, std=torch.linspace(1e-5, 8e-5, 8, dtype=torch.float64).view(4, 2))
    found = known.beside_images()
    assert len(found) == 2
    for marker, (own, rows) in enumerate(found):
        assert rows.tolist() == [0, 1, 2, 3]
        assert_close((own.values, own.std), (known.points[:, marker], held(known.std)[:, marker]), rtol=0, atol=0)
    ((posed, _),) = dc.Measurements.from_poses(data.q, random_poses(4)).beside_images()
    assert_close(posed.poses, random_poses(4))
