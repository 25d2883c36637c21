"""The registration of a model in its file: one entry of the header, and tensors of their own.

Readers that know nothing of registrations must refuse such a file: the markers of the fit are not those of the model.
"""

from __future__ import annotations

from math import inf
from typing import Any

from torch import Tensor

from diffeo_calib.common.checks import as_tensor, check_number
from diffeo_calib.common.errors import InputError
from diffeo_calib.kinematics.re_registration.registered_map import Registration
from diffeo_calib.robots.se3 import rigid

PREFIX = "registration_"
ARRAYS = ("transform", "markers", "covariance", "centre", "q", "gain", "noise")
REGISTRATION = tuple(PREFIX + name for name in ARRAYS)
"""Names of the tensors."""
SHIFT = "shift"
NUMBERS = ("lever", "rms_before", "rms_after", "left_out_rms", "excess", "same_place")
OPTIONAL = ("lever", "rms_before", "same_place")
ENTRIES = {*NUMBERS, "same", "free", "outliers", "undetermined", SHIFT}


def describe_registration(found: Registration) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Its entry in the header, and its tensors."""
    entry = {name: getattr(found, name) for name in (*NUMBERS, "same", "free")}
    shift = None if found.shift is None else found.shift.tolist()
    entry |= {"outliers": list(found.outliers), "undetermined": list(found.undetermined), SHIFT: shift}
    return entry, {PREFIX + name: getattr(found, name) for name in ARRAYS}


def rebuild_registration(entry: Any, tensors: dict[str, Tensor], n: int) -> Registration:
    """The inverse of :func:`describe_registration`; ``n`` is the number of joints.

    Raises:
        InputError: entries that are missing or do not fit together.
    """
    if not isinstance(entry, dict) or set(entry) != ENTRIES:
        got = sorted(entry) if isinstance(entry, dict) else entry
        raise InputError.of("the entry registration", expected=sorted(ENTRIES), got=got)
    for name in NUMBERS:
        if not (entry[name] is None and name in OPTIONAL):
            check_number(entry[name], f"the entry {name} of the registration", above=-1e-300, below=inf)
    if not isinstance(entry["same"], bool) or entry["free"] not in ("both", "base", "marker"):
        expected = "a boolean `same`, and `free` of both, base or marker"
        raise InputError.of("the entry registration", expected=expected, got=(entry["same"], entry["free"]))
    arrays = {name: tensors[PREFIX + name] for name in ARRAYS}
    markers, rows = len(arrays["markers"]), len(arrays["q"])
    k, m = 6 + 3 * markers, 3 * markers
    shapes = {"markers": (markers, 3), "covariance": (k, k), "centre": (3,), "q": (rows, n), "gain": (k, m * rows)}
    for name, shape in (shapes | {"noise": (m, m)}).items():
        as_tensor(arrays[name], PREFIX + name, shape)
    rigid(arrays["transform"], PREFIX + "transform")
    shift = None if entry[SHIFT] is None else as_tensor(entry[SHIFT], SHIFT, (markers, 3))
    words = {"outliers": tuple(map(int, entry["outliers"])), "undetermined": tuple(map(str, entry["undetermined"]))}
    return Registration(**arrays, **words, shift=shift, **{name: entry[name] for name in (*NUMBERS, "same", "free")})
