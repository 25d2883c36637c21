"""Calibrated models as programs of torch: for torch.export, torch.compile, torch.jit.trace, and ONNX.

Straight-line code on buffers, without choices by values or sizes: the constants of runtime/ and its formulas, with
operations that all of these understand, in double or single precision.
"""

from __future__ import annotations

import io
import json
import logging
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from importlib import import_module
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import embedding

from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import InputError, NumericalError, as_written
from diffeo_calib.common.files import check_writable, write_whole
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.tool import ToolKinematics, program_of, tool_points, tool_transform
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.measurements.poses import POINTS, of_frames, poses_of_triangles
from diffeo_calib.robots.se3 import twist_transform
from diffeo_calib.runtime.chain import tip_poses
from diffeo_calib.runtime.flow import advanced
from diffeo_calib.runtime.tables import TURN

OUTPUTS = ("points", "tool_poses", "poses")
PRECISIONS = {torch.float64: 1e-9, torch.float32: 1e-4}
"""Largest accepted difference between a program and its model, m, by the type of its numbers."""
EXAMPLE_ROWS = 3  # rows of the input with which programs are recorded; they run on any number
DESCRIPTION = "diffeo_calib.json"  # name of the description inside ``.pt2`` files


class Constants(nn.Module):
    """A record of runtime/ as its formulas take it: floating-point arrays as buffers, other arrays as lists.

    Args:
        record: a flow, a chain, or a part of these.
    """

    def __init__(self, record: Any) -> None:
        super().__init__()
        for name in getattr(record, "_fields", None) or [field.name for field in fields(record)]:
            value = getattr(record, name)
            if isinstance(value, np.ndarray) and value.dtype == np.float64:
                tensor = torch.tensor(np.ascontiguousarray(value), dtype=torch.float64, device=HOST)
                self.register_buffer(name, tensor)
            elif isinstance(value, np.ndarray):
                setattr(self, name, value.tolist())
            elif name == "terms":
                self.terms = nn.ModuleList(map(Constants, value))
            elif name != "stages":  # tables: their cells are buffers
                setattr(self, name, Constants(value) if is_dataclass(value) or hasattr(value, "_fields") else value)


def _rigid_inverse(poses: Tensor) -> Tensor:
    R = poses[..., :3, :3].mT
    top = torch.cat([R, -R @ poses[..., :3, 3:]], -1)
    return torch.cat([top, poses[..., 3:, :]], -2)


def _cells_around(starts: Tensor, cells: Tensor, t: Tensor) -> Sequence[Tensor]:
    """See runtime/tables.py: by halving, since ONNX has no search in sorted numbers."""
    place = torch.zeros_like(t, dtype=torch.int64)
    for power in reversed(range(len(starts).bit_length() - 1)):
        further = place + (1 << power)
        place = torch.where(starts[further] <= t, further, place)
    return embedding(place, cells.mT).unbind(-1)


def _combined(x: Tensor, coefficients: Tensor, slopes: Sequence[Tensor]) -> Tensor:
    """x + sum_k c_k slope_k. (Not with single numbers: onnxruntime rounds those beside a product of matrices.)"""
    if not slopes:
        return x
    return x + (torch.stack(list(slopes)) * coefficients[: len(slopes), None, None]).sum(0)


TORCH = SimpleNamespace(
    sin=torch.sin,
    cos=torch.cos,
    exp=torch.exp,
    sqrt=torch.sqrt,
    relu=torch.relu,
    clip=torch.clamp,
    within_turn=lambda x: x - TURN * torch.floor(x * (1.0 / TURN)),
    stack=torch.stack,
    concatenate=torch.cat,
    ones_like=torch.ones_like,
    broadcast_to=torch.broadcast_to,
    at_least=lambda values, floor: values.clamp(min=floor),
    cells_around=_cells_around,
    combined=_combined,
    transforms=twist_transform,
    inverse=_rigid_inverse,
)
"""See NUMPY in runtime/arrays.py."""


class _ConstantPoints(Constants):
    """Points of the flange from the constants of a model: (N, n) -> (N, 3 P)."""

    markers: Tensor
    on: tuple[int, ...]

    def forward(self, q: Tensor) -> Tensor:
        tips = tip_poses(self.chain, advanced(self.joint_flow, q, TORCH), TORCH)[:, list(self.on)]  # (N, P, 4, 4)
        placed = (tips[..., :3, :3] @ self.markers[..., None]).squeeze(-1) + tips[..., :3, 3]
        return advanced(self.task_flow, placed.reshape(-1, 3), TORCH).reshape(-1, self.markers.numel())


class TorchProgram(nn.Module):
    """A calibrated model as a torch module without checks and without choices by values: it can be recorded.

    All that a query needs is kept in buffers on the CPU, so that ``.to(device)`` works (not for models with their own
    functions or kernels), and ``torch.export``,
    ``torch.compile(fullgraph=True)``, ``torch.jit.trace`` and ONNX take it. It is differentiable by autograd and by
    ``torch.func``. Values that are not finite are not refused: they lead to results that are not finite. Every row
    takes memory for all control points: pass long tables in parts of some thousand rows.

    Args:
        model: a calibrated robot, or a fitted map (``fit.model``), whose function torch must be able to record.
        output: "points" for what ``model(q)`` returns, (N, P, 3) or (N, m) [m]; "tool_poses" for
            :meth:`CalibratedKinematics.tool_poses`, "poses" for :meth:`CalibratedKinematics.poses`, (N, 4, 4) or of
            several frames (N, T, 4, 4) [m].
        tool, frame: for "tool_poses", as there.
        dtype: of all numbers, input and output too: ``torch.float64``, or ``torch.float32`` (some micrometres).

    Raises InputError: an unknown output or type, a tool for another output; a model in the paper's Eulerian formulation
    or with time stepping by torchdiffeq.
    """

    def __init__(
        self,
        model: CalibratedKinematics | FittedMap,
        output: str = "points",
        *,
        tool: object = None,
        frame: str = "base",
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        _check_arguments(model, output, tool, dtype)
        model, robot = model.to(HOST), isinstance(model, CalibratedKinematics)
        self.output = output
        self.to_frame: Tensor | None
        self.register_buffer("to_frame", None)
        deformation: Any = _map_of(model).deformation
        self.of_robot = robot
        program, marks = program_of(deformation) if robot else None, None
        if isinstance(model, CalibratedKinematics) and output == "tool_poses":
            transform = model.tool if tool is None else tool_transform(tool)
            body = ToolKinematics(model.map, model.nominal, transform, frame, model.tool_tip)
            deformation, marks = body.deformation, tool_points(transform)
            self.to_frame = torch.linalg.inv(body.base) if frame == "base" else None
            program = None if program is None else program.at(body.tip)
        if program is None and dtype != torch.float64:
            what = "a program of a model with its own functions or kernels, which are recorded as they are,"
            raise InputError.of(what, expected="torch.float64", got=dtype)
        if program is not None and marks is not None:
            program = replace(program, markers=marks.numpy(), on=(program.tip,) * len(marks))
        self.points = deformation if program is None else _ConstantPoints(program)
        self.to(dtype)

    def forward(self, q: Tensor) -> Tensor:
        """q (N, n) rad or m -> points or poses, see the class."""
        points = self.points(q)
        if self.of_robot:
            points = points.unflatten(1, (-1, 3))
        if self.output == "points":
            return points
        poses = of_frames(poses_of_triangles(points.unflatten(1, (-1, POINTS))))
        return poses if self.to_frame is None else self.to_frame @ poses


def export_torch(
    model: CalibratedKinematics | FittedMap, path: str | os.PathLike[str], output: str = "points", **how: Any
) -> None:
    """Write a calibrated model as a program of torch, which runs without this package.

    ``torch.export.load(path).module()`` is a function of q (N, n) for any number N of rows; AOTInductor compiles the
    file for C++. It holds what :class:`TorchProgram` computes, and no checks of its input other than its type and
    number of columns.

    Args:
        model, output: see there. path: ``*.pt2``; an existing file is replaced atomically.
        how: ``tool``, ``frame`` and ``dtype``, as there.

    Raises InputError: as :class:`TorchProgram`, or a file that cannot be written. NumericalError: the program disagrees
    with the model.
    """
    contents = io.BytesIO()
    with _recorded(model, path, output, **how) as (program, q, description):
        torch.export.save(program, contents, extra_files={DESCRIPTION: json.dumps(description)})
        outputs = program.module()(q)
    precision, how = PRECISIONS[q.dtype], {name: value for name, value in how.items() if name != "dtype"}
    expected = model(q.double())
    if isinstance(model, CalibratedKinematics) and output != "points":
        expected = model.poses(q.double()) if output == "poses" else model.tool_poses(q.double(), **how)
    difference = float((outputs - expected).abs().max())
    if not difference <= precision:
        what = f"the recorded program differs from the model by {difference:.2g} m"
        raise NumericalError.of(what, expected=f"at most {precision:g}", fix="report it with the model file")
    write_whole(path, contents.getvalue())


def export_onnx(
    model: CalibratedKinematics | FittedMap, path: str | os.PathLike[str], output: str = "points", **how: Any
) -> None:
    """Write a calibrated model as an ONNX file ``*.onnx``, for onnxruntime and other programs.

    Its input ``q`` is (N, n) with any number N of rows, its output has the name of ``output``. Arguments as of
    :func:`export_torch`. Needs the packages onnx and onnxscript: ``pip install diffeo_calib[onnx]``.

    Raises InputError: as :class:`TorchProgram`, packages that are not installed, or a file that cannot be written.
    """
    try:
        for name in ("onnx", "onnxscript"):
            import_module(name)
    except ImportError as error:
        what, fix = f"ONNX files need a package that is not installed ({error})", "pip install 'diffeo_calib[onnx]'"
        raise InputError.of(what, fix=fix) from error
    registry = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = registry.level
    registry.setLevel(logging.ERROR)  # it warns about packages that are not needed
    try:
        with _recorded(model, path, output, **how) as (program, _, description):
            table: Any = {torch.ops.aten.scalar_tensor.default: _exact_scalar}
            names = {"input_names": ["q"], "output_names": [output], "custom_translation_table": table}
            exported = torch.onnx.export(program, dynamo=True, verbose=False, **names)
    finally:
        registry.setLevel(level)
    proto = cast(torch.onnx.ONNXProgram, exported).model_proto
    for key, value in description.items():
        proto.metadata_props.add(key=key, value=value)
    write_whole(path, proto.SerializeToString())


@contextmanager
def _recorded(
    model: CalibratedKinematics | FittedMap, path: str | os.PathLike[str], output: str, **how: Any
) -> Iterator[tuple[torch.export.ExportedProgram, Tensor, dict[str, str]]]:
    """The exported program for any number of rows, some configurations of the fit, and inputs and outputs as text.

    InputError for a path that cannot be written.
    """
    check_writable(path)  # recording takes too long to find out afterwards
    module, x = TorchProgram(model, output, **how).eval(), _map_of(model).x
    q = x[torch.arange(EXAMPLE_ROWS, device=x.device) % len(x)].detach().to(how.get("dtype", torch.float64))
    description = {"output": output, "units": "m, rad"}
    if isinstance(model, CalibratedKinematics):
        description |= {"robot": model.robot.name, "joints": ", ".join(model.robot.joint_names)}
        description["frame"] = how.get("frame", "base") if output == "tool_poses" else "measuring"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's own, about its inner workings
        rows = ({0: torch.export.Dim("rows")},)
        yield torch.export.export(module, (q,), dynamic_shapes=rows, strict=False), q, description


def _map_of(model: CalibratedKinematics | FittedMap) -> FittedMap:
    return model.map if isinstance(model, CalibratedKinematics) else model


def _check_arguments(model: CalibratedKinematics | FittedMap, output: str, tool: object, dtype: torch.dtype) -> None:
    if not isinstance(model, (CalibratedKinematics, FittedMap)):
        fix = "pass `result.model` or `fit.model`"
        raise InputError.of("`model`", expected="a calibrated model", got=type(model).__name__, fix=fix)
    robot = model if isinstance(model, CalibratedKinematics) else None
    choices = OUTPUTS[:1] if robot is None else OUTPUTS
    if output not in choices:
        raise InputError.of("`output`", expected=" or ".join(map(repr, choices)), got=as_written(output))
    if output == "poses" and robot is not None and robot.lever is None:
        what, fix = "this model was calibrated with points: it has no poses", 'ask for "tool_poses" or "points"'
        raise InputError.of(what, fix=fix)
    if tool is not None and output != "tool_poses":
        raise InputError.of("`tool` was given", expected='output="tool_poses"', got=as_written(output))
    if dtype not in PRECISIONS:
        raise InputError.of("`dtype`", expected="torch.float64 or torch.float32", got=as_written(dtype))
    fitted = _map_of(model)
    deformation, got = fitted.deformation, f"the {fitted.formulation} one"
    if not isinstance(deformation, GeodesicDeformation):
        raise InputError.of("`model`", expected="an exact model", got=got, fix='fit with formulation="exact"')
    if not deformation.integrator.replayable:
        got, fix = repr(deformation.integrator), "fit with one of these"
        raise InputError.of("the time stepping of `model`", expected="dc.RK4 or dc.RK8", got=got, fix=fix)


def _exact_scalar(s: float, dtype: int = 1, layout: str = "", device: str = "", pin_memory: bool = False) -> Any:
    """A number as a constant. torch's own translation rounds it to single precision first: pi is off by 9e-8."""
    import onnx_ir  # noqa: PLC0415  # optional packages
    from onnxscript.onnx_opset import opset18  # noqa: PLC0415

    value: Any = onnx_ir.tensor(s, dtype=onnx_ir.DataType(max(dtype, 1)))
    return opset18.Constant(value=value)
