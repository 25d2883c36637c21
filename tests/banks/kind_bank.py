"""One small table and one fitted model of every kind of measurement, and of several kinds in one table.

A part of the rows is kept for the verbs that judge. The models' numbers are held by tests/golden.
"""

import csv
import re
import tempfile
import warnings
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import pytest
import torch
import two_arms_bank
from numbers_bank import drawn, rigid_rms, tensor
from shared_bank import shared
from source_bank import KINDS, SOURCES, Source
from torch import Tensor
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.calibration.recalibration.new_rows import NewSetUp
from diffeo_calib.calibration.recalibration.register import place_again
from diffeo_calib.measurements.csv.files import write_measurements
from diffeo_calib.measurements.csv.sensors import ImageColumns
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.measurements.table_format import TableFormat
from diffeo_calib.robots import SimulatedArm
from diffeo_calib.robots.se3 import twist_transform

ELSEWHERE = tensor([0.4, -0.2, 0.3, 0.2, 0.5, -0.3])
"""Where the device stands later: shift in m, turn in rad."""
TOOL = twist_transform(tensor([0, 0, 0.1, 0, 0, 0]))
UNITS = ("--length", "mm", "--angle", "deg")
FOLDER = tempfile.TemporaryDirectory(prefix="diffeo_calib_kinds_")  # of all kinds, until this process ends
QUICK = ("positions", "poses", "mixture", "heights")
"""Kinds that every run tests; those of the others are slow tests."""
HELD_OUT = (*QUICK, "sessions", "ball in sockets", "images of a board")
"""Kinds of which some rows are held out, and two models compared."""
POSITIONED = ("positions", "hidden markers")
"""Kinds whose tables are joint values and coordinates, and nothing else."""
FREE = ("ball in sockets", "distances", "heights", "images")
"""Kinds without a measured position."""
WITH_POSES = ("poses", "several tips", "camera on the tool")
ON_TOOL = ("camera on the tool", "images of a board", "images and a tracker", "two cameras on the tool")
CAMERAS = (*ON_TOOL, "two cameras")


def marked(*names: str) -> list[Any]:
    """Kinds as parameters of a test, all by default."""
    return [pytest.param(name, marks=[pytest.mark.slow] * (name not in QUICK)) for name in names or KINDS]


@dataclass(frozen=True, eq=False)
class Kind:
    """A table of one kind, the model of its first rows, and files of both."""

    name: str
    source: Source
    folder: Path

    @property
    def robot(self) -> dc.Tree:
        return self.source.robot

    @property
    def scales(self) -> Any:
        return self.source.scales

    @cached_property
    def tables(self) -> tuple[Any, Any]:
        """Rows of the fit, and new rows of the same devices: a quarter, every place of a block as a whole."""
        rows: Any = self.source.rows
        new = torch.arange(len(rows)) // 3 % 4 == 3
        if rows.places is not None:
            new = torch.where(rows.places < 0, new, rows.places == rows.places.max())
        return rows.rows(~new), rows.rows(new)

    @property
    def data(self) -> Any:
        return self.tables[0]

    @property
    def new(self) -> Any:
        return self.tables[1]

    @cached_property
    def moved(self) -> Any:
        """The new rows of a device that measures coordinates and stands elsewhere; devices of readings stay."""
        return _seen_from(self.new, twist_transform(ELSEWHERE))

    @cached_property
    def registered(self) -> dc.CalibratedKinematics:
        """The model, its device found anew with ``moved``."""
        return shared(f"registered {self.name}", lambda: self.model.registered(self.moved))

    @cached_property
    def recalibrated(self) -> Any:
        """The model with a tool, of robots with one tip, recalibrated with ``moved``."""
        model = self.model if self.name == "several tips" else self.model.with_tool(TOOL)
        return shared(f"recalibrated {self.name}", lambda: dc.recalibrate(model, self.moved))

    @cached_property
    def placed_again(self) -> NewSetUp:
        """Where a comparison and a recalibration with ``moved`` begin."""
        return place_again(self.model, self.moved)

    @cached_property
    def result(self) -> Any:
        return shared(f"kind {self.name}", lambda: self._calibrated(self.data))

    @property
    def model(self) -> dc.CalibratedKinematics:
        return self.result.model

    @cached_property
    def part(self) -> Any:
        """Rows of ``data``, those of `fit --holdout 0.2` where some are held out."""
        return self.data.split(0.8)[0] if self.name in HELD_OUT else self.data

    @cached_property
    def of_part(self) -> Any:
        """The calibration of ``part``."""
        held_out = self.name in HELD_OUT
        return shared(f"part of {self.name}", lambda: self._calibrated(self.part)) if held_out else self.result

    def _calibrated(self, rows: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # few rows
            return dc.calibrate(self.robot, rows, hyperparameters=self.scales)

    def q(self, count: int = 40) -> Tensor:
        """Configurations within the joint ranges of the fit; for the camera those in which it sees its board."""
        if self.name in CAMERAS:
            return self.source.rows.q[:count]
        low, high = self.data.q.min(0).values, self.data.q.max(0).values
        return low + (high - low) * (0.1 + 0.8 * drawn(count, self.robot.n, seed=5))

    def error_mm(self, points: Tensor, q: Tensor) -> float:
        """RMS distance of points (N, P, 3) at q from the true ones after a rigid fit, mm."""
        return 1e3 * rigid_rms(points, self.source.truth(q))

    # --- files ----------------------------------------------------------------------------------------------------

    @property
    def urdf(self) -> Path:
        return self.folder / "robot.urdf"

    @cache  # noqa: B019  # kinds live as long as the tests
    def table(self, which: str = "data") -> tuple[Path, list[str]]:
        """The file of ``data``, ``new`` or ``moved``, and what a command is told of it."""
        path = self.folder / f"{which}.csv"
        return path, [*UNITS, *table_options(self.written(getattr(self, which), path))]

    def written(self, rows: Any, path: Path) -> TableFormat:
        named = rows.with_joint_names(self.robot.joint_names)
        turned = {"convention": "rotvec", "rotation_angle": "deg"} if self.name in (*WITH_POSES, "inclinations") else {}
        table = TableFormat("mm", "deg", camera_on_tool=self.name in ON_TOOL, **turned)  # pyright: ignore
        return write_measurements(path, named, table)

    @property
    def robot_options(self) -> list[str]:
        ends = self.robot.tips if self.name == "several tips" else [self.robot.tip]
        return ["--robot", str(self.urdf), "--base", self.robot.base, *_each("--tip", ends)]

    @cached_property
    def file(self) -> Path:
        """The model's file."""
        path = self.folder / "model.safetensors"
        dc.save(self.model, path)
        return path


@cache
def kind_named(name: str) -> Kind:
    """The kind, made once."""
    folder = Path(FOLDER.name) / re.sub(r"\W", "_", name)
    folder.mkdir()
    kind = Kind(name, SOURCES[name](), folder)
    if name == "several tips":
        kind.urdf.write_text(two_arms_bank.urdf())
    else:
        SimulatedArm(seed=0).write_urdf(kind.urdf)
    return kind


def _each(option: str, values: Any) -> list[str]:
    return [word for value in values for word in (option, str(value))]


def table_options(table: TableFormat) -> list[str]:
    """The options that describe a table written by :func:`write_measurements`, but for its units."""
    found = _each("--position", [",".join(triple) for triple in table.position or ()])
    if table.rotation is not None:
        groups = [table.rotation] if isinstance(table.rotation[0], str) else table.rotation
        found += _each("--rotation", [",".join(names) for names in groups])
        found += ["--convention", str(table.convention), "--rotation-angle", str(table.rotation_angle)]
    found += ["--camera-on-tool"] * (
        table.camera_on_tool or any(getattr(own, "camera_on_tool", 0) for own in table.readings)
    )
    found += ["--remounted"] * table.remounted
    found += [] if table.payload is None else ["--payload", table.payload]
    if table.sockets is not None:
        known = table.sockets
        found += ["--socket", ",".join(known.names)]
        found += _each("--distance", [f"{a},{b}={1e3 * length}" for (a, b), length in (known.distances or {}).items()])
        found += [] if known.distance_std is None else ["--distance-std", str(1e3 * known.distance_std)]
    found += _each("--reading", [_reading(own) for own in table.readings])
    devices: Any = (own.device for own in table.readings if own.device)
    session = table.session or next(devices, None)
    return found + ([] if session is None else ["--session", session])


def _reading(own: Any) -> str:
    if isinstance(own, ImageColumns):
        size = own.camera if isinstance(own.camera, tuple) else own.camera["left"]
        return f"corners={size[0]},{size[1]}"
    names = ",".join(own.values) if isinstance(own.values, tuple) else str(own.values)
    more = "".join(f",{value}" for value in own.intrinsics) if own.kind == "image" else ""
    return f"{'displacement' if own.offset_std else own.kind}={names}{more}"


def _seen_from(rows: Any, T: Tensor) -> Any:
    if isinstance(rows, dc.Observations):
        return dc.Observations([_seen_from(part, T) for part in rows.parts], rows.index)
    if isinstance(rows, dc.Readings) or (rows.kind == "socket"):
        return rows
    if rows.corners is not None:
        return rows  # the board stays
    if rows.board is not None:
        boards = torch.linalg.inv(rows.frames[:, 0]) @ T
        return dc.Measurements.from_poses(rows.q, boards, rows.joint_names, camera_on_tool=True, lever=rows.lever)
    moved = rows.in_frames(T.expand(len(rows), 4, 4))
    return with_attributes(rows, points=moved.points) if rows.poses is None else moved


def of_payload(kind: Kind) -> dc.CalibratedKinematics:
    """The model at the payload of the truth."""
    return kind.model.with_payload(4.0) if kind.name == "payloads" else kind.model


NUMBERED = ("line_numbers", "device", "session", "socket")
FROM_IMAGES = ("points", "poses", "board", "pose_covariance", "pose_shared", "pose_larger")
"""Columns that follow from the corners of all images of a table."""


def check_accuracy(kind: Kind, model: dc.CalibratedKinematics, factor: float = 1.0) -> None:
    q = kind.q()
    loaded = model.with_payload(4.0) if kind.name == "payloads" else model
    assert kind.error_mm(loaded(q), q) < factor * kind.source.worst_mm


def check_same_rows(found: Any, rows: Any) -> None:
    """But for the last digits that a table does not hold."""
    assert_close(found.q, rows.q, rtol=0, atol=1e-12)
    assert found.device_names == rows.device_names
    assert [part.kind for part in found.parts] == [part.kind for part in rows.parts]
    for one, other in zip(found.parts, rows.parts, strict=True):
        for name, values in other.columns.items():
            if name == "corners":  # padding is not written
                ours, theirs = (own[own.isfinite()] for own in (one.columns[name], values))
                assert_close(ours, theirs, rtol=0, atol=1e-9)
            elif name not in NUMBERED and not (name in FROM_IMAGES and other.corners is not None):
                assert_close(one.columns[name], values, rtol=0, atol=1e-9, equal_nan=True)


def share_places(kind: Kind, module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Find the places of ``moved`` once for all verbs that begin with them."""

    def place_again(model: dc.CalibratedKinematics, new: Any, marker: str = "evidence") -> NewSetUp:
        assert (model.map, new, marker) == (kind.model.map, kind.moved, "evidence")
        return kind.placed_again

    monkeypatch.setattr(f"diffeo_calib.calibration.recalibration.{module}.place_again", place_again)


def table_rows(path: Path, sep: str = ",") -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file, delimiter=sep))
