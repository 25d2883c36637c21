"""The parts of the benchmark on real robots: descriptors, splits, baselines, summary, figure, the program."""

from __future__ import annotations

import json
import math
from argparse import Namespace
from pathlib import Path

import baselines
import harness
import learning_curves
import numpy as np
import protocols
import pytest
import real_robots
import robot_data
import torch
from harness import Record
from robot_data import BUILT_IN, DESCRIPTOR, RobotData, data_folder, find, read

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibError, InputError, MeasurementError, RobotError
from diffeo_calib.measurements.csv_files import write_measurements
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.simulated_arm import SimulatedArm

QUARTER = math.pi / 2
TABLE = [[0.0, QUARTER, 0.3], [0.0, -QUARTER, 0.4], [0.0, 0.0, 0.2, 0.3, "prismatic"], [0.1, QUARTER, 0.1], [0, 0, 0.1]]
COLUMNS = ["q1", "q2", "q3", "q4", "q5"]
DH = {
    "robot": {"dh": TABLE, "convention": "standard"},
    "csv": "table.csv",
    "joints": COLUMNS,
    "position": [["ax", "ay", "az"], ["bx", "by", "bz"]],
    "length": "mm",
    "angle": "deg",
    "sep": ";",
    "decimal": ",",
}


def sliding() -> tuple[dc.Chain, dc.Measurements]:
    """A robot with a slide and two markers on its tool."""
    robot = dc.from_dh(TABLE, names=COLUMNS)
    rng = np.random.default_rng(0)
    q = torch.from_numpy(rng.uniform((-2, -2, 0.1, -2, -2), (2, 2, 0.6, 2, 2), (40, 5)))
    tool = torch.tensor([[0.05, 0.02, 0.1], [-0.04, 0.0, 0.06]], dtype=torch.float64)
    points = tool @ robot(q)[:, :3, :3].mT + robot(q)[:, None, :3, 3]
    return robot, dc.Measurements(q, points, COLUMNS)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three data sets: a DH table with two markers, a URDF with columns of other names, and no data set."""
    robot, data = sliding()
    for name in ("dh", "urdf", "neither"):
        (tmp_path / name).mkdir()
    table = TableFormat("mm", "deg", ";", ",")
    write_measurements(tmp_path / "dh" / "table.csv", data, table, joints=robot, position=DH["position"])
    (tmp_path / "dh" / DESCRIPTOR).write_text(json.dumps(DH))
    arm = SimulatedArm(seed=3)
    arm.write_urdf(tmp_path / "urdf" / "arm.urdf")
    columns = [f"angle {k}" for k in range(6)]
    measured = dc.Measurements(*arm.measure(30))
    write_measurements(tmp_path / "urdf" / "table.csv", measured, TableFormat("m", "rad"), joints=columns)
    entries = {
        "robot": {"urdf": "arm.urdf", "base": "base_link", "tip": "flange"},
        "csv": "table.csv",
        "joints": columns,
        "position": ["x", "y", "z"],
        "length": "m",
        "angle": "rad",
    }
    (tmp_path / "urdf" / DESCRIPTOR).write_text(json.dumps(entries))
    return tmp_path


# --- data sets ----------------------------------------------------------------------------------------------------


def test_data_sets_of_a_folder(folder: Path) -> None:
    found = find(folder)
    assert list(found) == ["dh", "urdf"]
    robot, data = sliding()
    two = read(folder / "dh", found["dh"])
    assert two.robot.kinds == robot.kinds
    torch.testing.assert_close(two.measurements.points, data.points, rtol=0, atol=1e-12)
    torch.testing.assert_close(two.measurements.q, data.q, rtol=0, atol=1e-12)
    arm = read(folder / "urdf", found["urdf"])
    assert arm.measurements.joint_names == arm.robot.joint_names
    assert list(find(folder, ["urdf"])) == ["urdf"]


@pytest.mark.parametrize(
    "change",
    [
        "csv",
        {"lenght": "mm"},
        {"sep": 1},
        {"robot": {"dh": []}},
        {"robot": []},
        {"robot": {"dh": 3, "convention": "craig"}},
        {"rotation": {"columns": []}},
    ],
)
def test_bad_descriptors(folder: Path, change: str | dict[str, object]) -> None:
    entries = {name: value for name, value in DH.items() if name != change}
    (folder / "dh" / DESCRIPTOR).write_text(json.dumps(entries | (change if isinstance(change, dict) else {})))
    word = change if isinstance(change, str) else next(iter(change))
    with pytest.raises(InputError, match=f"(?s){word}.*dataset.json|dataset.json.*{word}|'dh' in .*dataset.json"):
        find(folder)


@pytest.mark.parametrize("text", ["{", "[1]", ""])
def test_descriptors_that_are_no_objects(folder: Path, text: str) -> None:
    (folder / "dh" / DESCRIPTOR).write_text(text)
    with pytest.raises(InputError, match=r"dataset\.json"):
        find(folder)


def test_a_table_without_joint_columns(folder: Path) -> None:
    entries = {name: value for name, value in DH.items() if name != "joints"}
    (folder / "dh" / DESCRIPTOR).write_text(json.dumps(entries))
    with pytest.raises(InputError, match="joints"):
        find(folder)


def test_too_few_joint_columns(folder: Path) -> None:
    entries = find(folder)["urdf"] | {"joints": ["angle 0"]}
    with pytest.raises(RobotError, match="joints"):
        read(folder / "urdf", entries)


def test_unknown_data_sets(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none_such"):
        find(folder, ["none_such"])
    with pytest.raises(InputError, match="data sets"):
        find(folder / "neither")


def test_where_the_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DIFFEO_CALIB_DATA", str(tmp_path))
    assert data_folder(None) == tmp_path
    with pytest.raises(InputError, match="existing folder"):
        data_folder(tmp_path / "none")
    monkeypatch.delenv("DIFFEO_CALIB_DATA")
    with pytest.raises(InputError, match="DIFFEO_CALIB_DATA"):
        data_folder(None)


def test_built_in_descriptors_follow_the_format() -> None:
    for name, entries in BUILT_IN.items():
        robot_data._check(Path(name), json.loads(json.dumps(entries)))


def test_orientations_are_asked_for(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The arguments that the reader of orientations takes; without it, a clear word."""
    entries = find(folder)["urdf"] | {"rotation": {"columns": ["rx"], "convention": "XYZ", "angle": "deg"}}
    data = read(folder / "urdf", entries).measurements
    asked: dict[str, object] = {}

    def reader(
        *_: object, rotation: object = None, convention: str = "", rotation_angle: str = "", **__: object
    ) -> object:
        asked.update(rotation=rotation, convention=convention, rotation_angle=rotation_angle)
        return data

    def without(path: object, joints: object, position: object, **__: object) -> object:
        return data

    monkeypatch.setattr(dc, "read_measurements", reader)
    read(folder / "urdf", entries, poses=True)
    assert asked == {"rotation": ["rx"], "convention": "XYZ", "rotation_angle": "deg"}
    monkeypatch.setattr(dc, "read_measurements", without)
    with pytest.raises(MeasurementError, match="--poses"):
        read(folder / "urdf", entries, poses=True)


# --- splits -------------------------------------------------------------------------------------------------------


def repeated() -> dc.Measurements:
    """50 configurations, each measured twice."""
    q, points = SimulatedArm(seed=1).measure(50)
    return dc.Measurements(torch.cat([q, q + 1e-5]), torch.cat([points, points + 1e-6]))


def keys(data: dc.Measurements) -> set[tuple[float, ...]]:
    return {tuple(row) for row in data.q.mul(1e3).round().tolist()}


def test_repeats_stay_on_one_side_and_all_rows_are_used() -> None:
    data = repeated()
    found = list(protocols.splits(data, protocols.PROTOCOLS, [30, None], seeds=2))
    assert [(split.protocol, split.size, split.index) for split in found] == [
        *(("kfold", "all", fold) for fold in range(5)),
        *(("curve", size, seed) for seed in range(2) for size in ("30", "all")),
        ("extrapolate", "all", 0),
    ]
    for split in found:
        assert keys(split.train).isdisjoint(keys(split.test))
        assert len(split.train) == (30 if split.size == "30" else 100 - len(split.test))


def test_curves_are_nested_and_drawn_from_the_same_split() -> None:
    data = repeated()
    small, large, whole = protocols.curve(data, [60, 30, 5000, None], seed=1)
    train, test = data.split(0.7, 1)
    assert [len(split.train) for split in (small, large, whole)] == [30, 60, len(train)]
    assert keys(small.train) < keys(large.train) <= keys(train)
    for split in (small, large, whole):
        assert torch.equal(split.test.q, test.q)


def test_extrapolation_is_beyond_the_first_joint() -> None:
    train, test = protocols.beyond(repeated())
    assert float(train.q[:, 0].max()) <= float(test.q[:, 0].min()) + 1e-4
    assert len(train) == 70


# --- methods ------------------------------------------------------------------------------------------------------


def test_joint_offsets_are_recovered() -> None:
    """A slide and turning joints, two markers; the offsets that base and tool can carry too are left out."""
    robot, data = sliding()
    truth = torch.tensor([0.02, -0.01, 4e-3, 0.015, -0.03], dtype=torch.float64)
    true = Geometry.nominal(robot, 2)
    points = data.points.new_tensor([[0.05, 0.02, 0.1], [-0.04, 0.0, 0.06]])
    poses = robot(data.q + truth)
    seen = points @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
    geometry, offsets = baselines.with_offsets(robot, dc.Measurements(data.q, seen))
    assert float((geometry.points(data.q) - seen).norm(dim=-1).max()) < 1e-9
    assert offsets[1:4] == pytest.approx(truth[1:4].numpy(), abs=1e-7)
    turned = geometry.joint_errors @ torch.linalg.inv(true.joint_errors)
    assert float(turned[[0, 1, 3, 4], :3, 3].abs().max()) < 1e-12  # nothing but turns about the joints' own axes
    own = (turned[..., :3, :3] @ robot.axes[..., None])[..., 0]
    assert float((own - robot.axes).abs().max()) < 1e-12


def test_an_offset_that_the_poses_do_not_show_stays_small() -> None:
    """A joint that hardly turns: base and tool can do what its offset does."""
    arm = SimulatedArm(seed=1)
    q = arm.sample(60)
    q[:, 4] = 0.5 + 1e-3 * q[:, 4]
    _, offsets = baselines.with_offsets(arm.nominal, dc.Measurements(q, arm.true_points(q)))
    assert float(np.abs(offsets).max()) < 2 * baselines.OFFSET_PRIOR


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The learners with little effort."""
    monkeypatch.setattr(baselines, "RESTARTS", 0)
    monkeypatch.setattr(baselines, "TREES", baselines.TREES | {"n_estimators": 30})
    monkeypatch.setattr(baselines, "GRID_TREES", {"max_depth": (3,)})
    monkeypatch.setattr(baselines, "GRID_NETWORK", {"hidden_layer_sizes": ((8,),), "alpha": (1.0, 10.0)})
    monkeypatch.setattr(baselines, "NETWORK_STEPS", 50)


def arm_data(rows: int, **options: int) -> tuple[dc.Chain, dc.Measurements, dc.Measurements]:
    arm = SimulatedArm(seed=1, **options)
    q, points = arm.measure(rows + 100, seed=2)
    return arm.nominal, dc.Measurements(q[:rows], points[:rows]), dc.Measurements(q[rows:], points[rows:])


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_every_method_on_a_small_arm() -> None:
    robot, train, test = arm_data(60)
    split = protocols.Split("curve", "60", 0, train, test)
    records = {
        method: real_robots.attempt(RobotData("arm", robot, train), split, method) for method in baselines.METHODS
    }
    assert [record["note"] for record in records.values()] == [None] * len(records)
    rms = {method: record["rms_mm"] for method, record in records.items()}
    assert all(isinstance(value, float) for value in rms.values())
    error = {method: float(str(value)) for method, value in rms.items()}
    assert error["registration"] > error["joint offsets"] > error["geometry"] > error["diffeo_calib"]
    for learner in ("GP", "boosting", "network"):
        assert error[f"geometry + {learner}"] < 1.05 * error["geometry"]
    assert error["GP alone"] > error["registration"]  # 60 poses say little without a robot
    assert 0.7 < float(str(records["diffeo_calib"]["coverage_95"])) <= 1.0
    assert set(real_robots.COLUMNS) - set(records["geometry"]) == set()


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("method", ["geometry + GP", "geometry + boosting", "geometry + network", "GP alone"])
def test_learners_take_slides_and_several_markers(method: str) -> None:
    robot, data = sliding()
    fitted = baselines.METHODS[method](robot, data[:30], 0)
    assert fitted.kinematics(data.q).shape == (40, 2, 3)
    assert float((fitted.kinematics(data.q[:30]) - data.points[:30]).norm(dim=-1).mean()) < 0.1


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_a_learner_finds_what_is_there() -> None:
    """The process predicts a smooth residual, and says on how many rows it chose its scales."""
    robot, train, test = arm_data(120)

    def wave(q: torch.Tensor) -> torch.Tensor:
        return 1e-3 * torch.stack([q[:, 0].sin(), q[:, 1].cos(), (q[:, 0] + q[:, 1]).sin()], dim=1)[:, None]

    data = dc.Measurements(train.q, wave(train.q))
    fitted = baselines.corrected(lambda q: torch.zeros(len(q), 1, 3), robot, data, 0, baselines.processes)
    assert dc.evaluate(fitted.kinematics, dc.Measurements(test.q, wave(test.q))).rms < 1e-4
    assert fitted.note is None


@pytest.mark.usefixtures("quick")
def test_a_subset_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "MOST_SELECTED", 20)
    monkeypatch.setattr(baselines, "MOST_ROWS", 30)
    robot, train, _ = arm_data(40)
    note = baselines.METHODS["geometry + GP"](robot, train, 0).note
    assert note == "settings chosen on 20 of 40 training rows; conditioned on 30 rows"
    assert baselines.METHODS["geometry + network"](robot, train, 0).note == "settings chosen on 20 of 40 training rows"


def test_a_failure_is_a_record(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> baselines.Fitted:
        raise ValueError("not today")

    def missing(*_: object) -> baselines.Fitted:
        raise ModuleNotFoundError("No module named 'sklearn'", name="sklearn")

    robot, train, test = arm_data(20)
    split = protocols.Split("curve", "20", 0, train, test)
    for method, word in ((broken, "not today"), (missing, "pip install")):
        monkeypatch.setitem(baselines.METHODS, "geometry", method)
        record = real_robots.attempt(RobotData("arm", robot, train), split, "geometry")
        assert word in str(record["note"])
        assert "rms_mm" not in record


def test_errors_of_orientations_are_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    _, _, test = arm_data(20)
    fitted = baselines.Fitted(lambda q: torch.zeros(len(q), 1, 3, dtype=torch.float64))
    assert real_robots.errors(fitted, test)["rms_deg"] is None
    found = Namespace(rms=1.0, median=1.0, p95=1.0, max=1.0, angles=torch.zeros(1), angle_rms=0.25)
    monkeypatch.setattr(dc, "evaluate", lambda *_: found)
    assert real_robots.errors(fitted, test)["rms_deg"] == 0.25


def test_coverage_counts_what_lies_inside() -> None:
    q, points = torch.zeros(4, 2), torch.zeros(4, 1, 3)
    points[:, 0, 0] = torch.tensor([0.0, 2.7, 2.9, 30.0])  # sqrt(7.8147) = 2.795
    covariance = torch.eye(3, dtype=torch.float64).expand(4, 1, 3, 3)
    data = dc.Measurements(q, points, doubt=False)
    assert real_robots.coverage(torch.zeros(4, 1, 3, dtype=torch.float64), covariance, data) == 0.5


# --- summary, figure, program -------------------------------------------------------------------------------------


def made(method: str, size: str, seed: int, rms: float | None, dataset: str = "arm") -> Record:
    train = 142.0 if size == "all" else float(size)
    record: Record = {"dataset": dataset, "protocol": "curve", "size": size, "method": method, "fold_or_seed": seed}
    return (
        record | {"train": train, "test": 60} | ({"note": "failed"} if rms is None else {"rms_mm": rms, "note": None})
    )


RECORDS = [
    made(method, size, seed, level * (1 + 0.1 * seed) / 10**shrink, dataset)
    for dataset in ("arm", "other")
    for method, level in (("geometry", 0.4), ("diffeo_calib", 0.2), ("unheard of", 0.3))
    for shrink, size in ((0.0, "60"), (0.2, "120"), (0.3, "all"))
    for seed in range(3)
]


def test_means_over_seeds() -> None:
    rows = learning_curves.summary([*reversed(RECORDS), made("geometry", "60", 3, None)])
    names = [(row["dataset"], row["size"], row["method"]) for row in rows]
    methods = ("geometry", "diffeo_calib", "unheard of")
    assert names == [(d, s, m) for d in ("arm", "other") for s in ("60", "120", "all") for m in methods]
    assert (rows[0]["runs"], rows[0]["failed"]) == (3, 1)
    assert rows[0]["rms_mm"] == pytest.approx(0.44)
    assert rows[0]["coverage_95"] is None


def test_nothing_but_failures() -> None:
    (row,) = learning_curves.summary([made("geometry", "60", 0, None)])
    assert (row["runs"], row["failed"], row["rms_mm"]) == (0, 1, None)


def test_the_figure_is_drawn(tmp_path: Path) -> None:
    for name in ("curves.png", "curves.svg"):
        learning_curves.draw(RECORDS, tmp_path / name)
        assert (tmp_path / name).stat().st_size > 20_000
    labels = (tmp_path / "curves.svg").read_text()
    assert all(
        f"<!-- {name} -->" in labels for name in ("geometry", "diffeo_calib", "unheard of", "arm", "other", "142")
    )


def test_a_method_far_above_is_written_in_numbers(tmp_path: Path) -> None:
    records = [made("registration", "60", 0, 0.8), made("geometry", "60", 0, 0.4), made("GP alone", "60", 0, 38.6)]
    learning_curves.draw(records, tmp_path / "curves.svg")
    assert "<!-- GP alone: 38.6 mm -->" in (tmp_path / "curves.svg").read_text()


def test_figures_that_cannot_be_drawn(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="protocol curve"):
        learning_curves.draw([record | {"protocol": "kfold"} for record in RECORDS], tmp_path / "curves.png")
    for place in (tmp_path / "curves.xyz", tmp_path / "none" / "curves.png"):
        with pytest.raises(InputError, match="curves"):
            learning_curves.draw(RECORDS, place)


def test_the_program(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Measure, write, and draw from the file again."""
    out = tmp_path / "out.json"
    given = ["--data", str(folder), "--protocol", "curve", "--methods", "registration", "geometry", "--seeds", "1"]
    real_robots.run(real_robots.arguments([*given, "--sizes", "15", "all", "--out", str(out)]))
    records = json.loads(out.read_text())["records"]
    assert len(records) == 2 * 2 * 2
    assert {record["dataset"] for record in records} == {"dh", "urdf"}
    assert "Means" in capsys.readouterr().out
    figure = tmp_path / "curves.png"
    real_robots.run(real_robots.arguments(["--from", str(out), str(out), "--figure", str(figure)]))
    assert figure.stat().st_size > 20_000
    assert harness.earlier([out, out], real_robots.KEY) == records  # counted once
    out.write_text('{"records": [{"backend": "tiled"}]}')
    with pytest.raises(DiffeoCalibError, match="records of this program"):
        harness.earlier([out], real_robots.KEY)
    out.write_text("[]")
    with pytest.raises(DiffeoCalibError, match="cannot be read"):
        harness.earlier([out], real_robots.KEY)


def test_a_place_that_cannot_be_written_is_said_before_the_work(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["real_robots.py", "--data", str(folder), "--figure", str(folder / "x" / "y.png")])
    with pytest.raises(SystemExit, match="error: the figure cannot be written"):
        harness.guarded(lambda: real_robots.run(real_robots.arguments()))


def test_records_that_cannot_be_written_are_said_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(DiffeoCalibError, match="cannot be written"):
        harness.report(iter([]), tmp_path / "none" / "x.json")


def test_quick() -> None:
    plan = real_robots.arguments(["--quick"])
    assert (plan.protocol, plan.sizes, plan.seeds) == (["curve"], [60, 150], 1)
    assert plan.methods == ["registration", "geometry", "diffeo_calib"]
