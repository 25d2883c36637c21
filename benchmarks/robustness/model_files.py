"""Fuzzing of model files: bytes, headers and arrays that are damaged or forged, with the checksum renewed.

    python benchmarks/robustness/model_files.py --count 2000

A file that is accepted must predict what the original predicts, bit for bit, or something else that is finite if its
header or an array was forged into other sound contents. The reader that needs no torch (`dc.interop.load_numpy`) must
accept the same files as `dc.load`, and agree with it.
"""

from __future__ import annotations

import copy
import json
import os
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from fuzzing import Work, run
from safetensors.torch import save_file
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibError
from diffeo_calib.interop.model_file import read
from diffeo_calib.interop.numpy_model import ENTRY, digest
from diffeo_calib.robots.simulated_arm import SimulatedArm

Rng = np.random.Generator
AGREEMENT = 1e-9


@dataclass(frozen=True)
class Sound:
    """A sound file: its bytes, its contents, and what it predicts."""

    content: bytes
    header: dict[str, Any]
    tensors: dict[str, Tensor]
    points: Tensor
    deviations: Tensor


@cache
def sound() -> tuple[Sound, ...]:
    """Models of points, of a registered robot, and of poses."""
    arm = SimulatedArm(seed=1, markers=3)
    q, points = arm.measure(16, seed=2)
    model = dc.calibrate(arm.nominal, dc.Measurements(q, points[:, :1])).model.with_tool((0.0, 0.0, 0.1))
    moved = model.registered(dc.Measurements(q[:8], points[:8, 1:2] + 0.3))
    return tuple(_sound(one) for one in (model, moved))


def _sound(model: dc.CalibratedKinematics) -> Sound:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        dc.save(model, path)
        header, tensors = read(path)
        content = path.read_bytes()
    mean, covariance = model.predict(queries())
    return Sound(content, header, tensors, mean, covariance)


def queries() -> Tensor:
    """Configurations (3, 6) at which models are compared."""
    return torch.linspace(-1, 1, 18, dtype=torch.float64, device="cpu").reshape(3, 6)


# --- mutations ------------------------------------------------------------------------------------------------------

DEEP: Any = json.loads("[" * 300 + "]" * 300)
ODD_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 3, 7, 10**5, 2**31, 2**63, 10**30, 10**400, -(10**20), 0.5, -0.1, 1e-320, 1e300),
    *(
        float("nan"),
        float("inf"),
        "",
        "m",
        "robot",
        "function",
        "x" * 5000,
        "7",
        "\x1b[31m",
        "\ud800",
        [],
        {},
        [[]],
        [1, 2],
    ),
    *({"a": 1}, {"7": 1.0}, [None] * 3, ["nan"] * 6, [1e308] * 3, [[1, 0, 0, 0]] * 4, DEEP, {"x": DEEP}),
)


def _pick(rng: Rng, items: Any) -> Any:
    return items[int(rng.integers(len(items)))]


def _places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths to all entries of a header."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, part in inner for place in ((*path, key), *_places(part, (*path, key)))]


def _holder(header: Any, path: tuple[Any, ...]) -> Any:
    for key in path[:-1]:
        header = header[key]
    return header


def _entry(header: dict[str, Any], rng: Rng) -> tuple[Any, Any, str]:
    """Where an entry is, drawn by its name: the many numbers of the joints do not outweigh the others."""
    places = _places({key: value for key, value in header.items() if key != "urdf"})
    names = sorted({str(place[-1]) if isinstance(place[-1], str) else str(place[0]) for place in places})
    name = _pick(rng, names)
    path = _pick(rng, [p for p in places if p[-1] == name] or [p for p in places if p[0] == name])
    return _holder(header, path), path[-1], ".".join(map(str, path))


def odd_entry(header: dict[str, Any], _: dict[str, Tensor], rng: Rng) -> str:
    """An entry of the header with another value."""
    holder, key, name = _entry(header, rng)
    holder[key] = copy.deepcopy(_pick(rng, ODD_VALUES))
    return f"entry {name} of another value"


def missing_entry(header: dict[str, Any], _: dict[str, Tensor], rng: Rng) -> str:
    """An entry that is not there."""
    holder, key, name = _entry(header, rng)
    del holder[key]
    return f"no entry {name}"


def renamed_entry(header: dict[str, Any], _: dict[str, Tensor], rng: Rng) -> str:
    """An entry under another name, or one more."""
    holder, key, name = _entry(header, rng)
    if isinstance(holder, dict):
        holder[_pick(rng, ("7", "", "x", key.upper(), "é"))] = holder[key] if rng.random() < 0.5 else holder.pop(key)
    else:
        holder.append(holder[key])
    return f"entry {name} renamed or repeated"


def odd_tensor(_: dict[str, Any], tensors: dict[str, Tensor], rng: Rng) -> str:
    """An array of other values, another shape or another type."""
    name = _pick(rng, sorted(tensors))
    value = tensors[name]
    changes: tuple[Callable[[Tensor], Tensor], ...] = (
        *(lambda t: -t, lambda t: 0 * t, lambda t: t * torch.nan, lambda t: t * torch.inf, lambda t: t + 1e300),
        *(
            lambda t: 1e30 * t,
            lambda t: t[:-1],
            lambda t: t[:0],
            lambda t: t.flatten(),
            lambda t: t[None],
            torch.Tensor.float,
        ),
        *(
            lambda t: t.to(torch.float16),
            torch.Tensor.long,
            torch.Tensor.bfloat16,
            lambda t: t > 0,
            lambda t: t.flip(0),
        ),
        *(lambda t: torch.cat([t, t]), lambda t: t.reshape(-1)[0], lambda t: t.mT if t.ndim > 1 else t),
    )
    number = int(rng.integers(len(changes)))
    tensors[name] = changes[number](value if value.ndim else value[None]).contiguous()
    return f"array {name}, change {number}"


def missing_tensor(_: dict[str, Any], tensors: dict[str, Tensor], rng: Rng) -> str:
    """An array that is not there, or one more."""
    name = _pick(rng, sorted(tensors))
    if rng.random() < 0.5:
        tensors[_pick(rng, ("data", "rigid_errors", "extra", "é"))] = tensors[name].clone()
        return f"array {name} twice"
    del tensors[name]
    return f"no array {name}"


FORGERIES = (odd_entry, odd_entry, odd_entry, missing_entry, renamed_entry, odd_tensor, odd_tensor, missing_tensor)


def forged(start: Sound, rng: Rng) -> tuple[str, bytes]:
    """A file of changed contents with the right checksum."""
    header, tensors = copy.deepcopy(start.header), dict(start.tensors)
    name = _pick(rng, FORGERIES)(header, tensors, rng)
    header["digest"] = "0" if any(t.dtype == torch.bfloat16 for t in tensors.values()) else digest(header, tensors)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "forged.safetensors"
        save_file(tensors, path, metadata={ENTRY: json.dumps(header)})
        return name, path.read_bytes()


def broken(content: bytes, rng: Rng) -> tuple[str, bytes]:
    """A file with bytes that are flipped, cut off, put in, or with a forged table of arrays."""
    size = struct.unpack("<Q", content[:8])[0]
    place, how = int(rng.integers(len(content) if rng.random() < 0.5 else size)), int(rng.integers(6))
    if how == 0:
        return "cut off", content[:place]
    if how == 1:
        bit = 1 << int(rng.integers(8))
        return "flipped bit", content[:place] + bytes([content[place] ^ bit]) + content[place + 1 :]
    if how == 2:
        return "bytes put in", content[:place] + rng.bytes(int(rng.integers(1, 9))) + content[place:]
    if how == 3:
        return "size of the header", struct.pack(
            "<Q", _pick(rng, (0, 1, size - 1, size + 1, 10**8, 2**63, 2**64 - 1))
        ) + content[8:]
    table = json.loads(content[8 : 8 + size])
    name = _pick(rng, sorted(set(table) - {"__metadata__"}))
    if how == 4:
        key = _pick(rng, ("dtype", "shape", "data_offsets"))
        table[name][key] = _pick(rng, ("F32", "X", [], [2**62, 4], [-1], [0, 10**12], [8, 0], None, 3, [[1]]))
    else:
        table["__metadata__"] = _pick(
            rng, (None, {}, {ENTRY: "[" * 10**5}, {ENTRY: "{}"}, {ENTRY: '{"format": 1e999}'}, {ENTRY: 3})
        )
    text = json.dumps(table).encode()
    return "table of arrays", struct.pack("<Q", len(text)) + text + content[8 + size :]


# --- judgement ------------------------------------------------------------------------------------------------------


def tried(start: Sound, content: bytes, *, legitimate: bool) -> str:
    """Load, query, save again; what is wrong, or nothing."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        path.write_bytes(content)
        try:
            plain = dc.interop.load_numpy(path)
        except DiffeoCalibError:
            plain = None
        model = dc.load(path)
        if not isinstance(model, dc.CalibratedKinematics):
            return "another kind of model"
        points, covariance = model.predict(queries())
        text = (repr(model), str(model.summary), model.report, model.registration, model.provenance)
        again = Path(folder) / "again.safetensors"
        dc.save(model, again)
        if not all(
            torch.isfinite(t).all()
            for t in (points, covariance, model.jacobian(queries()), model.tool_poses(queries()))
        ):
            return f"predictions that are not finite, {str(text)[:60]}"
        if plain is not None and np.abs(plain(queries().numpy()) - points.numpy()).max() > AGREEMENT * max(
            1.0, float(points.abs().max())
        ):
            return "load_numpy predicts other points"
        same = torch.equal(points, start.points) and torch.equal(covariance, start.deviations)
        return "" if same or legitimate else "other predictions than those of the original"


def case(seed: int) -> tuple[str, Work]:
    """The file of a seed."""
    rng = np.random.default_rng([seed, 2])
    start = _pick(rng, sound())
    legitimate = rng.random() < 0.7
    name, content = forged(start, rng) if legitimate else broken(start.content, rng)
    return name, lambda: tried(start, content, legitimate=legitimate)


if __name__ == "__main__":
    run("model_files.py", case, __doc__, 2000)
