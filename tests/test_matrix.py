"""Every verb works on every kind of measurement.

A verb is a function below; it calls the verb for real, in Python or through the command line in this process, and
checks a small claim about what it gives.
"""

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import kind_bank
import pytest
import torch
from command_bank import STAGES, VALIDATOR, Command, Outcome, leave_undrawn
from kind_bank import FREE, HELD_OUT, KINDS, QUICK, UNITS, Kind, kind_named, table_rows
from numbers_bank import rigid_rms
from torch.testing import assert_close

import diffeo_calib as dc

pytestmark = pytest.mark.filterwarnings("ignore::diffeo_calib.DiffeoCalibWarning")  # few rows

NEW_ROWS_FACTOR = 1.6
"""A model of fewer or of newly placed rows may be worse than that of the fit by this factor."""
EXPECTED_FACTOR = 2.5
"""Largest error per error that the model expects."""


WHAT = {
    "ball in sockets": {("spread", "m")},
    "mixture": {("errors", "m"), ("spread", "m")},
    "distances": {("readings", "m")},
    "heights": {("readings", "m")},
    "images": {("readings", "px")},
    "several kinds": {("errors", "m"), ("readings", "m"), ("readings", "px")},
    "laser beams": {("errors", "m"), ("readings", "m")},
    "inclinations": {("errors", "m"), ("readings", "mrad")},
    "images and a tracker": {("errors", "m"), ("readings", "m")},
}
"""What an evaluation holds, and in which unit, where it does not hold errors of measured positions alone."""
BY_ALL_CORNERS = ("images of a board", "two cameras", "two cameras on the tool", "images and a tracker")
"""Kinds whose poses follow from all corners of a table."""
SHOWN = {"m": "mm"}

TITLES = {"errors": "Position errors", "spread": "Spread within sockets"}


@dataclass(frozen=True)
class Bench:
    """A kind, the command line, and a folder for what a verb writes."""

    kind: Kind
    command: Command
    folder: Path

    @property
    def mass(self) -> list[str]:
        return ["--payload", "4"] * (self.kind.name == "payloads")

    @property
    def one_tip(self) -> list[str]:
        tips = self.kind.robot.tips
        return ["--tip", tips[0]] * (len(tips) > 1)

    def run(self, *words: object, code: int = 0) -> Outcome:
        done = self.command(*words)
        assert done.code == code, done.err
        return done

    def json(self, *words: object) -> dict[str, Any]:
        path = self.folder / "results.json"
        return results(path, self.run(*words, "--json", path))

    def judged(self, *words: object) -> dict[str, Any]:
        """Of a command that tells errors: of every kind in its unit, in the JSON and in the text, which is "said"."""
        path = self.folder / "judged.json"
        done = self.run(*words, "--json", path)
        said, found = done.out, results(path, done)
        own = WHAT.get(self.kind.name, {("errors", "m")})
        shown = {(what, SHOWN.get(unit, unit)) for what, unit in own}
        leaves = {kind: list(_leaves(entry)) for kind, entry in found["kinds"].items()}
        assert {leaf for each in leaves.values() for leaf in each} == shown
        assert bool(found["errors"]) == any(what == "errors" for what, _ in own)
        text = " ".join(said.split())
        for kind, each in leaves.items():
            (what, unit), *_ = each
            title, printed = TITLES.get(what, f"Errors of {kind}s"), re.findall(rf"{kind} [\d.]+ {unit}", text)
            assert f"{title} in {unit}" in text or len(printed) >= min(2, len(each)), (kind, text)
        return found | {"said": text}

    def joints(self, more: Sequence[str] = ()) -> Path:
        """A table of four rows, and columns of 4."""
        path, rows = self.folder / "joints.csv", [[*row, *[4] * len(more)] for row in self.kind.q(4).rad2deg().tolist()]
        path.write_text("\n".join(",".join(map(str, row)) for row in [[*self.kind.robot.joint_names, *more], *rows]))
        return path


def results(path: Path, done: Outcome) -> dict[str, Any]:
    """Those of a file for programs, which is as the schema says; beside them the exit code and the warnings."""
    written = json.loads(path.read_text(encoding="utf-8"))
    VALIDATOR.validate(written)
    assert written["exit_code"] == done.code
    assert written["warnings"] == [line.removeprefix("warning: ") for line in done.warnings]
    assert all(Path(own).is_file() for own in written["results"].get("files", {}).values())
    return written["results"]


THROUGHOUT = ("positions", "mixture")
"""Kinds that every verb calibrates and registers for itself. The rows of the others are compared with those of one."""
FORMS = ("positions", "poses", "hidden markers", "several tips", "payloads", "markers mounted anew", "mixture")
FORMS += ("images of a board",)
"""Kinds whose models differ in form: in their markers, tips, poses, payload and tool."""
PROPOSED = ("positions", "hidden markers", "sessions", "payloads", "ball in sockets", "mixture", "heights")
"""Kinds whose tables differ for `init`, which takes seconds; the tests of the command have poses, images and wires."""
Verb = Callable[[Bench], None]
VERBS: dict[str, tuple[Verb, tuple[str, ...]]] = {}
"""Name -> function, and the kinds that differ for it."""


def verb(name: str, *kinds: str) -> Callable[[Verb], Verb]:
    """Enter a function as a verb, for all kinds by default."""

    def enter(function: Verb) -> Verb:
        VERBS[name] = function, kinds or KINDS
        return function

    return enter


def _leaves(entry: Any) -> Iterator[tuple[str, str]]:
    if "unit" in entry:
        yield entry["what"], entry["unit"]
    else:
        for own in entry.values():
            yield from _leaves(own)


def evaluations(found: Any) -> list[Any]:
    return list(found.values()) if isinstance(found, Mapping) else [found]


@verb("calibrate")
def _(bench: Bench) -> None:
    kind, found = bench.kind, bench.kind.result
    kind_bank.check_accuracy(kind, found.model)
    q = kind.q()
    nominal = rigid_rms(found.registration.geometry.points(q), kind.source.truth(q))
    error = 1e-3 * kind.error_mm(kind_bank.of_payload(kind)(q), q)
    assert error < 0.5 * nominal
    assert error < EXPECTED_FACTOR * found.expected.workspace
    assert found.model.summary.rows == len(kind.data)
    assert len(found.leave_one_out.errors) == len(kind.data)


@verb("fit")
def _(bench: Bench) -> None:
    """With a fifth of the rows held out for some kinds; most are calibrated once, in Python, with the rows read."""
    kind, path = bench.kind, bench.folder / "fit.safetensors"
    page = bench.folder / "report.html"

    def calibrate(robot: dc.Tree, rows: Any, **options: Any) -> Any:
        assert robot.joint_names == kind.robot.joint_names
        assert type(rows) is type(kind.part)
        kind_bank.check_same_rows(rows, kind.part)
        given = {**options, "hyperparameters": kind.scales}
        return dc.calibrate(robot, rows, **given) if kind.name in THROUGHOUT else kind.of_part

    leave_undrawn(bench.command.monkeypatch)  # tests/cli/test_kinds_judged.py draws them
    bench.command.monkeypatch.setattr("diffeo_calib.cli.commands.fit.calibrate", calibrate)
    csv_file, options = kind.table()
    table = [csv_file, *kind.robot_options, *options]
    written = ["-o", path, "--report", page]
    holdout = "0.2" if kind.name in HELD_OUT else "0"
    found = bench.judged("fit", *table, "--holdout", holdout, *written)
    assert {"status", "errors", "files", "parts", "outliers", "leave_one_out_rms_m"} <= set(found)
    assert set(found["leave_one_out"]) == set(found["kinds"])
    assert (found["leave_one_out_rms_m"] is None) == (not found["errors"])
    model: Any = dc.load(path)
    kind_bank.check_accuracy(kind, model, NEW_ROWS_FACTOR)
    assert model.summary.rows == len(kind.part)
    text = page.read_text(encoding="utf-8")
    assert "<svg" in text
    if kind.name == "ball in sockets":
        assert "spread" in text.lower()


@verb("evaluate")
def _(bench: Bench) -> None:
    kind, path = bench.kind, bench.folder / "residuals.csv"
    own: Any = dc.evaluate(kind.model, kind.new)
    each = evaluations(own)
    assert isinstance(own, Mapping) == (kind.name == "mixture" or isinstance(kind.data, dc.Observations))
    assert sum(one.count for one in each) == len(kind.new)
    assert {(one.what, one.unit) for one in each} == WHAT.get(kind.name, {("errors", "m")})
    assert own.numbers == 0 or kind.name in ("ball in sockets", "mixture"), "a model knows the devices of its fit"
    if kind.name not in FREE:
        assert 1e3 * each[0].rms < 2 * kind.source.worst_mm
    enough, too_little = {"images": ("50px", "0.0001px")}.get(kind.name, ("20mm", "0.00001mm"))
    table, options = kind.table("new")
    found = bench.judged("evaluate", kind.file, table, *options, "-o", path, "--tolerance", enough)
    assert found["accepted"]
    for one in each:
        assert 0.0 < one.rms < math.inf
        assert 0.0 < one.median < (1e-3 if one.unit == "m" else 5.0)
        assert len(one.devices) == len(one.errors)
        entry = found["kinds"][one.kind]["all"]
        assert (entry["what"], entry["unit"]) == (one.what, one.shown[0])
        if kind.name not in BY_ALL_CORNERS:
            assert entry["rms"] == pytest.approx(one.shown[1] * one.rms, rel=1e-3)
    if kind.name in kind_bank.POSITIONED or kind.name in kind_bank.WITH_POSES:
        assert found["errors"]["all"]["rows"] == len(kind.new)
    rows = table_rows(path)
    assert list(rows[0]) == ["line", "used_in_fit", "kind", "device", "marker", "dx", "dy", "dz", "size", "unit"]
    assert {row["kind"] for row in rows} - {"orientation"} == set(found["kinds"])
    assert len({row["line"] for row in rows}) == len(kind.new)
    if kind.name in kind_bank.WITH_POSES:
        assert {"rad", "deg", "mrad"} & {row["unit"] for row in rows}
    assert ("expected over the joint ranges" in found["said"]) == (kind.name in FREE and kind.name != "images")  # px
    if kind.name in (*QUICK, "images"):
        bench.run("evaluate", kind.file, table, *options, "--tolerance", too_little, code=4)


@verb("register")
def _(bench: Bench) -> None:
    kind, path = bench.kind, bench.folder / "moved.safetensors"
    kind_bank.check_accuracy(kind, kind.registered, NEW_ROWS_FACTOR)
    table, options = kind.table("moved")

    def registered(model: dc.CalibratedKinematics, rows: Any, *, free: str, learn: bool) -> dc.CalibratedKinematics:
        assert (free, learn, model.markers) == ("both", False, kind.model.markers)
        kind_bank.check_same_rows(rows, kind.moved)
        return kind.registered

    numbered_anew = ("two cameras", "two cameras on the tool")  # in the order in which a table's rows show them
    shared = kind.name not in (*THROUGHOUT, *numbered_anew)
    if shared:
        bench.command.monkeypatch.setattr(dc.CalibratedKinematics, "registered", registered)
    bench.run("evaluate", kind.file, table, *options, "--free", "both", "-o", path)
    model: Any = dc.load(path)
    if shared:  # what is written is what was found
        one, other = (found.map.deformation(kind.q(5)) for found in (model, kind.registered))
        assert_close(one, other, rtol=0, atol=1e-12)
    else:
        kind_bank.check_accuracy(kind, model, NEW_ROWS_FACTOR)
    if kind.name in THROUGHOUT:  # in the new frame
        assert 1e3 * evaluations(dc.evaluate(model, kind.moved))[0].rms < 2 * kind.source.worst_mm


@verb("predict")
def _(bench: Bench) -> None:
    kind, path, q = bench.kind, bench.folder / "predicted.csv", bench.kind.q(4)
    mean, covariance = kind_bank.of_payload(kind).predict(q)
    assert mean.shape == covariance.shape[:-1] == kind.source.truth(q).shape
    assert float(torch.linalg.eigvalsh(covariance).min()) > 0.0
    payload = ["--payload", "payload"] * (kind.name == "payloads")
    bench.run("predict", kind.file, bench.joints(payload[1:]), *UNITS, *payload, "-o", path)
    rows = table_rows(path)
    assert len(rows) == 4
    assert all(math.isfinite(float(cell)) for row in rows for cell in row.values())
    if kind.name in ("distances", "heights", "images", "several kinds"):
        assert any(kind.data.device_names[-1] in name for name in rows[0])  # what the device will read


@verb("report", *QUICK, *FREE[:2], "hidden markers", "images", "camera on the tool", "several kinds")
def _(bench: Bench) -> None:
    """Of the rows of the fit, each predicted by all others; tests/cli/test_kinds_judged.py draws those of new rows."""
    kind, path = bench.kind, bench.folder / "report.html"
    leave_undrawn(bench.command.monkeypatch)
    table, options = kind.table()
    found = bench.json("evaluate", kind.file, table, "--report", path, *options)
    assert found["left_out"]
    assert tuple(found["errors"]) in ((), STAGES)
    page = path.read_text(encoding="utf-8")
    assert "<svg" in page
    assert not re.search(r"\b[Nn]a[Nn]\b", page)


@verb("plan")
def _(bench: Bench) -> None:
    kind, path = bench.kind, bench.folder / "next.csv"
    resting = kind.name == "ball in sockets"
    found = dc.plan(kind.model, kind.data.q if resting else kind.q(30), 3)
    assert found.q.shape == (3, kind.robot.n)
    assert 0.0 < float(found.expected_rms[-1]) < float(found.expected_rms[0])
    drawn = ["--candidates", kind.table()[0]] if resting else ["--draw", "40"]
    planned = bench.json("plan", kind.file, "-n", "3", *drawn, *UNITS, "-o", path)
    assert len(table_rows(path)) == 3
    assert len(planned["expected_rms_m"]) == 4
    assert planned["expected_rms_m"] == sorted(planned["expected_rms_m"], reverse=True)
    assert "tracker" not in json.dumps(planned) or kind.name not in FREE


@verb("correct")
def _(bench: Bench) -> None:
    kind, path = bench.kind, bench.folder / "corrected.csv"
    done = bench.json("correct", kind.file, bench.joints(), *UNITS, *bench.one_tip, *bench.mass, "-o", path)
    assert sum(done["statuses"].values()) == 4
    assert len(table_rows(path)) == 4


@verb("compare with a table", *HELD_OUT, "distances", "images", "several kinds", "inclinations")
def _(bench: Bench) -> None:
    kind = bench.kind
    kind_bank.share_places(kind, "recalibrate", bench.command.monkeypatch)
    found: Any = dc.compare(kind.model, kind.moved)
    assert not found.changes.found
    bench.command.monkeypatch.setattr("diffeo_calib.cli.commands.recalibrate.compare", lambda *_, **__: found)
    table, options = kind.table("moved")
    bench.judged("recalibrate", kind.file, table, *options)


@verb("compare two models", *HELD_OUT)
def _(bench: Bench) -> None:
    kind = bench.kind
    found: Any = dc.compare(kind.model, kind.of_part.model)
    assert not found.changes.found
    assert 0.0 < found.rms < EXPECTED_FACTOR * found.expected


@verb("recalibrate")
def _(bench: Bench) -> None:
    kind = bench.kind
    one_tip = kind.name != "several tips"
    kind_bank.share_places(kind, "recalibrate", bench.command.monkeypatch)
    found = kind.recalibrated
    assert not found.changes.found
    kind_bank.check_accuracy(kind, found.model, NEW_ROWS_FACTOR)
    assert not one_tip or found.model.tool_poses(kind.q(2)).shape[-2:] == (4, 4)
    assert found.model.summary is not None
    kept = {(own.kind, name) for own in found.model.placement for name in own.names}
    assert {(own.kind, name) for own in kind.model.placement for name in own.names} <= kept
    assert all(bool(own.mean.isfinite().all()) for own in found.model.predict_readings(kind.q(3)))
    bench.command.monkeypatch.setattr("diffeo_calib.cli.commands.recalibrate.recalibrate", lambda *_, **__: found)
    table, options = kind.table("moved")
    bench.judged("recalibrate", kind.file, table, *options, "-o", bench.folder / "again.safetensors")


@verb("export")
def _(bench: Bench) -> None:
    """Rigid kinematics from the rows of the fit; models that differ in form in every format."""
    kind, folder, q = bench.kind, bench.folder, bench.kind.q(3)
    names = {"--urdf": "a.urdf"}
    if kind.name in FORMS:
        names |= {"--dh": "dh.csv", "--joint-offsets": "o.csv", "--correction-tables": "t.csv", "--c": "robot.c"}
    written = [word for option, name in names.items() for word in (option, folder / name)]
    said = bench.run("export", kind.file, *written, *bench.mass, *bench.one_tip).out
    positions = any(what == "errors" for what, _ in WHAT.get(kind.name, {("errors", "m")}))
    assert ("from the measured positions of the fit, mm" in said) == positions
    robot = dc.load_urdf(folder / "a.urdf", kind.robot.base, kind.robot.tips[0])
    assert set(robot.joint_names) <= set(kind.robot.joint_names)
    if kind.name in FORMS:
        assert "markers" in (folder / "robot.h").read_text()
        program = dc.interop.TorchProgram(kind.model)
        assert_close(program(q), kind.model(q).detach(), rtol=0, atol=1e-9)


@verb("init", *PROPOSED)
def _(bench: Bench) -> None:
    path = bench.folder / "campaign.toml"
    table, options = bench.kind.table()
    bench.run("init", table, bench.kind.urdf, "-o", path)
    text = path.read_text(encoding="utf-8")
    missing = [name for name in options if name.startswith("--") and name[2:] not in text]
    assert not set(missing) - {"--distance", "--distance-std"}, missing  # lengths of a block are in no table


@verb("DiffeoRegressor", *THROUGHOUT, "poses", "hidden markers", "several tips", "ball in sockets")
def _(bench: Bench) -> None:
    kind, data = bench.kind, bench.kind.data

    def calibrate(robot: dc.Tree, rows: Any, *, hyperparameters: Any, **_: Any) -> Any:
        assert (robot, hyperparameters) == (kind.robot, kind.scales)
        kind_bank.check_same_rows(rows, data)
        return kind.result

    if kind.name not in THROUGHOUT:
        bench.command.monkeypatch.setattr("diffeo_calib.interop.sklearn.calibrate", calibrate)
    plain = isinstance(data, dc.Measurements) and kind.name in ("positions", "hidden markers")
    found = dc.interop.DiffeoRegressor(kind.robot, hyperparameters=kind.scales)
    found.fit(data.q.numpy(), data.points.flatten(1).numpy() if plain else data)
    kind_bank.check_accuracy(kind, found.model_)


PAIRS = [
    pytest.param(name, kind, id=f"{name}-{kind}", marks=[pytest.mark.slow] * (kind not in QUICK))
    for name, (_, kinds) in VERBS.items()
    for kind in kinds
]


@pytest.mark.parametrize(("name", "kind"), PAIRS)
def test_the_verb_works_on_the_kind(name: str, kind: str, command: Command, tmp_path: Path) -> None:
    VERBS[name][0](Bench(kind_named(kind), command, tmp_path))
