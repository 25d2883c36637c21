"""Calibrated robots without torch: a model file in, positions, poses and Jacobians out. Needs NumPy alone.

For controllers and scripts where torch is too large or starts too slowly. The formulas are those of the torch model in
a second implementation (runtime/); both agree to 1e-12 m. Uncertainty and fitting need the whole package.

A model file has arrays by name in safetensors, and a JSON header. A SHA-256 checksum over both detects damaged and
edited files. Reading executes nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open

from diffeo_calib.common.data_frames import named_columns, real_array
from diffeo_calib.common.errors import InputError, ModelFileError
from diffeo_calib.common.files import as_path
from diffeo_calib.runtime.arrays import MOST_STEPS, TABLEAUS, Array
from diffeo_calib.runtime.build import calibrated_chain, nominal_chain, recorded_flow, recorded_stages
from diffeo_calib.runtime.chain import tip_poses
from diffeo_calib.runtime.program import LONGEST_TOOL, Program, check_frame

FORMAT = 3  # version of the file layout; files of other versions are refused
ENTRY = "diffeo_calib"  # key of the header in the file's metadata

UNSOUND = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""Raised by contents that do not fit together: a forged header can hold any value in any place."""

Header = dict[str, Any]


def read_arrays(path: Path) -> tuple[Header, dict[str, np.ndarray]]:
    """Header and arrays of a file; ModelFileError: it cannot be read, or has another format or a wrong checksum."""
    if not path.is_file():
        raise ModelFileError.of(f"there is no model file {path}", fix="check the path")
    unreadable, written = f"{path} cannot be read as a model file", "pass a file written by `save` or `fit -o`"
    try:
        with path.open("rb") as file:
            beginning = file.read(9)  # eight bytes of length, then a JSON header
    except OSError as error:
        raise ModelFileError.of(f"{unreadable} ({error.strerror})", fix="pass the name of a readable file") from error
    if len(beginning) == 9 and beginning[8:] != b"{":  # what is cut short has its own sentence
        kind = "a URDF" if path.suffix.lower() in (".urdf", ".xml", ".xacro") else "another kind of file"
        raise ModelFileError.of(f"{unreadable}: it is {kind}", fix=written)
    try:
        with safe_open(path, framework="np") as file:
            text = (file.metadata() or {}).get(ENTRY)
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # not a dict
        header = json.loads(text) if text is not None else None
        sealed = isinstance(header, dict) and header.pop("digest", None) == digest(header, arrays)
    except (SafetensorError, OSError, *UNSOUND) as error:
        fix = "it is damaged or cut short: copy or save it again"
        raise ModelFileError.of(f"{unreadable} ({error})", fix=fix) from error
    if not isinstance(header, dict):
        raise ModelFileError.of(f"{path} is not a diffeo_calib model", fix=written)
    if header.get("format") != FORMAT:
        what, fix = f"{path} has format version {header.get('format')!r}", "read it with the version that wrote it"
        raise ModelFileError.of(what, expected=FORMAT, fix=fix)
    if not sealed:
        what = f"{path} was damaged or edited: its checksum does not match"
        raise ModelFileError.of(what, fix="save the model again")
    return header, arrays


def digest(header: Header, arrays: Mapping[str, Any]) -> str:
    """SHA-256 over a header (without its checksum) and the arrays, or tensors on the CPU."""
    sha = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        shape = tuple(int(size) for size in arrays[name].shape)
        sha.update(f"{name} torch.{array.dtype} {shape}".encode())
        sha.update(array.tobytes())
    return sha.hexdigest()


@dataclass(frozen=True, eq=False, repr=False)
class NumpyKinematics:
    """Calibrated kinematics of a robot, see :class:`diffeo_calib.CalibratedKinematics`; made by :func:`load_numpy`.

    Args:
        program: the model as constants. joint_names: names of the n joints, in the order of the columns of ``q``.
        limits: (n, 2) their lower and upper limits, rad or m; infinite without one.
        tool: (4, 4) tool centre point in the tip's frame, m.
    """

    program: Program
    joint_names: tuple[str, ...]
    limits: Array
    tool: Array

    def __call__(self, q: object) -> Array:
        """Marker positions in the measuring frame: (N, n) rad or m -> (N, P, 3) m.

        Data frames are taken by the names of the joints, here and below.
        """
        return self.program.points(self._joints(q))

    def jacobian(self, q: object) -> Array:
        """Derivatives of the marker positions: (N, n) -> (N, P, 3, n), m/rad or m/m."""
        return self.program.points_and_jacobian(self._joints(q))[1]

    def tool_poses(self, q: object, tool: object = None, frame: str = "base", tip: str | None = None) -> Array:
        """Poses of a tool centre point: (N, n) -> (N, 4, 4) m.

        Args:
            q: (N, n) joint values, rad or m.
            tool: (4, 4) or position (3,) in the tip's frame, m; the model's own by default.
            frame: "base" of the robot, as it was found, or "measuring".
            tip: name of the tip that carries the tool, for a robot with several.

        Raises InputError: wrong shapes, values that are not finite, or another frame.
        """
        return self._at(tip, frame).poses(self._joints(q), self._tool(tool), frame)

    def tool_jacobian(self, q: object, tool: object = None, frame: str = "base", tip: str | None = None) -> Array:
        """Derivatives of :meth:`tool_poses`: (N, 6, n) linear velocity [m/rad or m/m], then angular velocity."""
        return self._at(tip, frame).poses_and_jacobian(self._joints(q), self._tool(tool), frame)[1]

    def _at(self, tip: str | None, frame: str) -> Program:
        check_frame(frame)
        tips = self.program.chain.nominal.tips
        if tip not in (*tips, None) or (tip is None and len(tips) > 1):
            raise InputError.of("`tip`", expected="the name of a tip", got=tip, fix=f"pass one of {', '.join(tips)}")
        return self.program if tip is None else self.program.at(tip)

    def _tool(self, tool: object) -> Array:
        if tool is None:
            return self.tool
        given = _numbers(tool, "tool")
        if given.shape not in ((3,), (4, 4)) or not np.isfinite(given).all():
            raise InputError.of("`tool`", expected="finite numbers, (4, 4) or (3,)", got=given.shape)
        pose = given if given.ndim == 2 else np.block([[np.eye(3), given[:, None]], [np.eye(4)[3]]])
        R, t, rest = pose[:3, :3], pose[:3, 3].tolist(), pose[3].tolist()
        if max(map(abs, t)) > LONGEST_TOOL:
            raise InputError.of("`tool`", expected=f"at most {LONGEST_TOOL:g} m", got=t, fix="pass metres")
        if rest != [0, 0, 0, 1] or np.abs(R.T @ R - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
            fix = "pass [[R, t], [0, 0, 0, 1]] in m, not its transpose"
            raise InputError.of("`tool`", expected="a rigid transform (4, 4)", got=given.tolist(), fix=fix)
        return pose

    def _joints(self, q: object) -> Array:
        values, n = _numbers(named_columns(q, self.joint_names, "q"), "q"), len(self.joint_names)
        if values.ndim != 2 or values.shape[1] != n:
            fix = f"pass one row per configuration, joints in the order {', '.join(self.joint_names)}"
            raise InputError.of("`q` has the wrong shape", expected=f"(N, {n})", got=values.shape, fix=fix)
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            row = int(bad.argmax())
            raise InputError.of(f"row {row} of `q`", expected="finite numbers", got=values[row].tolist())
        return values


def load_numpy(path: str | os.PathLike[str]) -> NumpyKinematics:
    """Read a model file of a robot without torch.

    Args:
        path: a file written by ``dc.save`` or ``diffeo-calib fit``.

    Returns a :class:`NumpyKinematics`, with the payload that the model carries. It integrates the flows' controls and
    makes tables of the transmission terms: half a second for 450 control points. Raises ModelFileError: as
    :func:`diffeo_calib.load`. InputError: a model of a plain function, with adaptive time steps, or with kernels of the
    user's own.
    """
    header, arrays = read_arrays(as_path(path))
    try:
        program, tool = _program(header, arrays), np.array(header.get("tool", np.eye(4)), dtype=np.float64)
        return NumpyKinematics(program, program.chain.nominal.names, program.chain.nominal.limits, tool)
    except UNSOUND as error:
        fix = "save the model again"
        raise ModelFileError.of(f"{path} has contents that do not fit together ({error})", fix=fix) from error


def _numbers(value: object, name: str) -> Array:
    try:
        return real_array(value)
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        fix = "pass a numeric array, rows of equal length"
        raise InputError.of(f"`{name}` cannot be read as numbers ({error})", fix=fix) from error


def _program(header: Header, arrays: Mapping[str, Array]) -> Program:
    nominal, integrator, steps = header["nominal"], header["integrator"], header["integrator"].get("steps")
    kernels = header["joint_kernel"], header["task_kernel"]
    foreign = ", ".join(term["kernel"] for terms in kernels for term in terms if "kernel" in term)
    for wrong, what, expected, got in (
        (nominal["kind"] != "robot", "the model", "that of a robot", "a plain function"),
        (integrator["kind"] not in TABLEAUS, "the time stepping", "fixed steps, of RK4 or RK8", integrator["kind"]),
        (foreign, "the model's kernels", "kernels of this package", foreign),
        (type(steps) is not int or not 1 <= steps <= MOST_STEPS, "the time steps", f"1 to {MOST_STEPS}", steps),
    ):
        if wrong:
            raise InputError.of(what, expected=expected, got=got, fix="use `dc.load`")
    chain, tool = nominal_chain(nominal), arrays["tool"]
    on = [chain.tips.index(tip) for tip in nominal.get("on", ())] or [0] * len(tool)
    theta, tableau = arrays.get("unladen_theta", arrays["theta"]), TABLEAUS[integrator["kind"]]()
    shifts = theta[6 + 6 * len(chain.axes) :][: tool.size].reshape(-1, 3)
    options = {"elastic": nominal["elastic"], "waves": nominal.get("waves", ()), "axes": nominal.get("axes", ())}
    k0 = calibrated_chain(chain, arrays["base"], arrays["joint_errors"], theta, len(tool), **options)
    joint, xi = recorded_stages(kernels[0], arrays["x"], arrays["momenta_x"], tableau, steps)
    tip, markers = tip_poses(k0, xi[0])[:, on], tool + shifts  # (N, P, 4, 4); of every control those of its session
    if "session" in arrays:
        markers = (arrays["session_tools"] + shifts)[arrays["session"].astype(np.int64)]
    z0 = (tip[..., :3, :3] @ markers[..., None])[..., 0] + tip[..., :3, 3]
    start = arrays.get("task_controls", z0.reshape(-1, 3))  # rows with payloads of their own
    task, _ = recorded_stages(kernels[1], start, arrays["momenta_y"], tableau, steps)
    flows = [recorded_flow(k, stages, *tableau) for k, stages in zip(kernels, (joint, task), strict=True)]
    points = arrays.get("registration_markers", tool + shifts)
    at = on if len(points) == len(tool) else [on[0]] * len(points)
    return Program(flows[0], k0, flows[1], points, tuple(at))
