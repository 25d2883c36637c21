"""Constants of a program in the layout of the generated C source (c_source.py), and as its text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import inf, isinf
from typing import Any

import numpy as np

from diffeo_calib.runtime.arrays import Array
from diffeo_calib.runtime.chain import CalibratedChain, Sag
from diffeo_calib.runtime.flow import RadialTerm, RecordedFlow
from diffeo_calib.runtime.tables import JointTables

LANES = 16
"""Controls per block: inner loops of constant length, which compilers turn into vector instructions."""


def flow_constants(name: str, title: str, flow: RecordedFlow) -> dict[str, Any]:
    """A flow that does not vanish; ``name``: beginning of its C functions' names, ``title``: what it does."""
    return {
        "name": name,
        "title": title,
        "size": flow.size,
        "steps": flow.steps,
        "stages": len(flow.weights),
        "coefficients": flow.coefficients,
        "weights": flow.weights,
        "terms": [_term_constants(f"{name}_term{k}", term) for k, term in enumerate(flow.terms, 1)],
        "tables": None if flow.tables is None else _table_constants(flow.tables),
    }


def _term_constants(name: str, term: RadialTerm) -> dict[str, Any]:
    """A term whose controls come in blocks, without the components that it does not move."""
    outputs = np.flatnonzero(term.weights.any(axis=(0, 1)))
    width = len(outputs) + (len(outputs) % 2 if len(outputs) > 1 else 0)
    every, features = np.arange(term.weights.shape[2]), term.features
    weights = np.pad(term.weights[..., outputs], ((0, 0), (0, 0), (0, width - len(outputs))))
    return {
        "name": name,
        "term": term,
        "inputs": np.concatenate([every[term.lines], every[term.circles]]),
        "lines": len(term.centre),
        "outputs": outputs,
        "width": width,
        "features": _blocks(features).swapaxes(2, 3),
        "weights": _blocks(weights),
        "constant": float((term.scales[len(term.centre) :] ** 2).sum()),
    }


def _blocks(values: Array) -> Array:
    """(S, C, D) -> (S, blocks, LANES, D), filled up with zeros."""
    missing = -values.shape[1] % LANES
    return np.pad(values, ((0, 0), (0, missing), (0, 0))).reshape(len(values), -1, LANES, values.shape[2])


def _table_constants(tables: JointTables) -> dict[str, Any]:
    """Tables of all stages and joints, one after the other: knots (rows,) rad, and f, f', f'' (rows, 3) there."""
    every = [table for stage in tables.stages for table in stage]
    return {
        "joints": np.flatnonzero(tables.selection.any(0)),
        "first": [0, *np.cumsum([len(table.knots) for table in every]).tolist()],
        "knots": np.concatenate([table.knots for table in every]),
        "derivatives": np.concatenate([table.values for table in every]),
    }


def sag_constants(chain: CalibratedChain, sag: Sag) -> dict[str, Any]:
    """Gravity sag with moments as sums of o_f x c_f, in place of the matrix W of blocks -[c_f]x.

    ``masses``: (K, F, 3) c. ``moved``: (F, n_all) 1 where joint l moves place f as seen from the ground. ``shifts``:
    (K,) whether the coordinate shifts its joint, or turns it, along or about ``directions`` (K, 3).
    """
    count = len(sag.joints)
    W = sag.moments.reshape(count, 3, len(chain.nominal.offsets), 3)
    own = sag.directions.reshape(count, len(chain.nominal.axes), 2, 3)[
        np.arange(count), sag.joints
    ]  # shift, rotation vector
    shifts = np.any(own[:, 0], axis=1)
    return {
        "sag": sag,
        "count": count,
        "masses": -np.stack([W[:, 2, :, 1], W[:, 0, :, 2], W[:, 1, :, 0]], axis=-1),
        "moved": chain.nominal.moved * 1,
        "shifts": shifts,
        "directions": np.where(shifts[:, None], own[:, 0], own[:, 1]),
    }


WIDTH = 120
"""Longest line of numbers."""


def number(value: float) -> str:
    """The shortest decimal text that a compiler reads back as the same number; integers stay integers."""
    if isinstance(value, int):
        return str(value)
    if isinf(value):
        return "HUGE_VAL" if value == inf else "-HUGE_VAL"
    return repr(value)


def array(values: object) -> str:
    """An initialiser with a pair of braces for every dimension."""
    given = values.tolist() if isinstance(values, np.ndarray) else values
    if not isinstance(given, Sequence):
        raise TypeError(f"no array: {given!r}")
    return _braces(given)


def pose(transform: np.ndarray) -> str:
    """An initialiser of the generated struct Pose from a transform (4, 4)."""
    return f"{{{_row(transform[:3, :3].ravel().tolist())}, {_row(transform[:3, 3].tolist())}}}"


def poses(transforms: np.ndarray) -> str:
    """An initialiser of an array of Pose from transforms (L, 4, 4)."""
    return "{\n" + ",\n".join(f"    {pose(transform)}" for transform in transforms) + "}"


def _braces(values: Sequence) -> str:
    if not isinstance(values[0], list | tuple):
        return _row(values)
    return "{" + ",\n".join(_braces(part) for part in values) + "}"


def _row(values: Sequence) -> str:
    return "{" + ",\n".join(_lines([number(value) for value in values])) + "}"


def _lines(words: Sequence[str]) -> Iterator[str]:
    line = ""
    for word in words:
        if line and len(line) + len(word) + 3 > WIDTH:
            yield line
            line = word
        else:
            line = f"{line}, {word}" if line else word
    yield line
