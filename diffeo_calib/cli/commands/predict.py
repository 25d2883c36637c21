"""`diffeo-calib predict`: marker positions, or poses, for a table of joint configurations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from torch import Tensor

from diffeo_calib.cli.console import Progress, progress_bar, say
from diffeo_calib.cli.models import as_fitted, check_payload_column, load_kinematics, provenance_lines
from diffeo_calib.cli.options import Rows
from diffeo_calib.cli.record import record
from diffeo_calib.cli.tables import TableOptions, joint_columns, table_format, with_rows
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import OutsideRange
from diffeo_calib.measurements.csv.files import open_joints
from diffeo_calib.measurements.csv.tables import TableFile
from diffeo_calib.measurements.csv.writing import write_pose_predictions, write_predictions
from diffeo_calib.measurements.table_format import TableFormat, flat_names

Block = TypeVar("Block", bound=Sized)
PERCENT = 100
CHECKING = "checking, %"


def check(file: TableFile, model: CalibratedKinematics, progress: Progress) -> None:
    """Find all mistakes in a table, and warn of rows outside the joint ranges of the fit."""
    outside = OutsideRange(model)
    file.check(lambda values: outside.add(values.q), lambda part: progress(CHECKING, int(PERCENT * part), PERCENT))
    outside.warn()


def counted(blocks: Iterable[Block], rows: int, progress: Progress) -> Iterator[Block]:
    """The same blocks of rows; the bar moves when each has been used."""
    done = 0
    progress("rows", done, rows)
    for block in blocks:
        yield block
        done += len(block)
        progress("rows", done, rows)


def run(model: Path, given: TableOptions, output: Path) -> None:
    """Read joint values, and write them with predictions and their standard deviations, block by block.

    Raises:
        InputError: options of a rotation for a model that was calibrated with points.
    """
    kinematics = load_kinematics(model)
    for line in provenance_lines(kinematics):
        say(line)
    table, joints = _written_as_read(kinematics, given)
    robot, with_poses = kinematics.robot, kinematics.lever is not None
    if not with_poses and (table.convention or table.rotation_angle):
        what = "--convention and --rotation-angle say how orientations are written, but this model has none"
        raise InputError.of(what, fix="leave them out, or calibrate with measured poses")
    names = joint_columns(joints, robot)
    check_payload_column(kinematics, table.payload)
    prefixes = kinematics.bodies.prefixes(kinematics)
    write = write_pose_predictions if with_poses else write_predictions
    with open_joints(given.csv, names, table, kinds=robot.kinds) as file, progress_bar() as progress:
        check(file, kinematics, progress)
        laden = counted((_Rows(*rows) for rows in file.laden_joints()), file.rows, progress)
        blocks = ((rows.q, *_with_deviations(*rows.predicted(kinematics))) for rows in laden)
        write(output, blocks, table, joints=names, kinds=robot.kinds, prefixes=prefixes)
    record.add(rows=file.rows, files={"table": output})
    what = "poses" if with_poses else "positions"
    say(f"{file.rows} predictions written to {output}: joints, {what} and standard deviations of a new measurement")
    if with_poses:
        say(f"`evaluate` and `fit` read these poses with {reading_options(table, prefixes)}")


def _written_as_read(model: CalibratedKinematics, given: TableOptions) -> tuple[TableFormat, str | None]:
    """The format of the predictions, and the names of the joint columns, by default those of the fit."""
    rows, units = given.rows, given.units
    read, stated = as_fitted(model, rows, units)
    if units.length is None or units.angle is None:
        rotation_angle = rows.rotation_angle or read.rotation_angle
        rows = Rows(convention=rows.convention or read.convention, rotation_angle=rotation_angle, payload=read.payload)
    return with_rows(table_format(stated), rows), stated.joints


@dataclass(frozen=True)
class _Rows:
    """Joint values (B, n), rad or m, and payloads (B,) if they are known."""

    q: Tensor
    masses: Tensor | None

    def __len__(self) -> int:
        return len(self.q)

    def predicted(self, model: CalibratedKinematics) -> tuple[Tensor, Tensor]:
        """Markers, or poses, of a model under the payloads of the rows, with covariances."""
        loaded = model if self.masses is None else model.at_payloads(self.masses)
        return model.bodies.written(loaded, self.q)


def reading_options(table: TableFormat, prefixes: Sequence[str] = ("",)) -> str:
    """The options with which `evaluate` and `fit` read the poses that `predict` writes in this format."""
    options = []
    for prefix in prefixes:
        written = table.for_writing(rotation_std=False, prefixes=[prefix])
        columns = flat_names(written.rotation)
        unit = f" --rotation-angle {written.rotation_angle}" * (len(columns) == 3)
        options += [f"--position {','.join(prefix + axis for axis in 'xyz')} --rotation {','.join(columns)}"]
    return f"{' '.join(options)} --convention {written.convention}{unit}"


def _with_deviations(mean: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Means and standard deviations of covariances: (..., k, k) -> (..., k)."""
    return mean, covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
