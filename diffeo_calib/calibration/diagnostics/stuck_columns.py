"""Columns in which a device reports one value in all of its rows: a sensor that is stuck, or a column of constants.

Such a column may be right: the height of a planar robot, the gauge of a ball that touches a surface. It is wrong where
the robot moves what the column tells, and the other rows contradict it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.calibration.identification.registration import spread
from diffeo_calib.calibration.scales.tangent_data import TangentData
from diffeo_calib.common.device import HOST
from diffeo_calib.common.errors import MOST_NAMES, few, sentence, warn_user

OF_DEVIATIONS = "std_"
"""Prefix of columns of known standard deviations, which may well be equal."""


class Stuck(NamedTuple):
    """A column in which a device reports one value.

    Args:
        words: the column and its device. rows: (M,) numbers of the rows in which that device reports it.
    """

    words: str
    rows: Tensor


class DeviceRows(NamedTuple):
    """Rows of one kind that one device, or a device in one set-up, measured: its name, and their numbers (M,)."""

    words: str
    rows: Tensor
    table: Any


def device_rows(data: Any) -> Iterator[DeviceRows]:
    """The rows of any table by kind and device."""
    for part, numbers in zip(data.parts, data.index, strict=True):
        names = part.device_names
        for name in dict.fromkeys(names):
            own = [row for row, other in enumerate(names) if other == name]
            words = f"{part.kind}s" + f" of '{name}'" * bool(name)
            yield DeviceRows(words, numbers[own], part.rows(own))


def stuck_columns(data: Any) -> list[Stuck]:
    """Columns of any table in which a device reports one value in all rows where it reports any."""
    found = []
    for words, rows, table in device_rows(data):
        for name, values in table.measured().items():
            if not isinstance(values, Tensor) or name.startswith(OF_DEVIATIONS):
                continue
            seen = ~values.isnan()
            if int(seen.sum()) >= gates.STUCK_ROWS and bool((values[seen] == values[seen][0]).all()):
                found.append(Stuck(f"'{name}' of the {words}", rows[seen.to(rows.device)]))
    return found


def stuck_words(stuck: Sequence[Stuck]) -> str:
    """The columns in words; empty without any."""
    if not stuck:
        return ""
    several = len(stuck) > 1
    names = few([one.words for one in stuck], MOST_NAMES)
    return f"{names} hold{'s' * (not several)} one value in all of {'their' if several else 'its'} rows"


def warn_of_stuck(data: TangentData, stuck: Sequence[Stuck]) -> None:
    """Warn of columns of one value although the robot moves what they tell.

    Args:
        data: the rows around the geometric calibration. stuck: columns.
    """
    size, bad = spread(data.points.unflatten(1, (-1, 3))), []
    for one in stuck:
        rows, shape = one.rows.to(data.values.device), (data.noise_model.bodies, -1)
        least = _smallest_motion(data.values[rows].unflatten(1, shape), data.visible[rows].unflatten(1, shape))
        bad += [(one, least)] if least > gates.GEOMETRIC_RESIDUAL * size else []
    if bad:
        what = stuck_words([one for one, _ in bad])
        expected = f"values that change by {1e3 * min(least for _, least in bad):.3g} mm or more, as the robot moves"
        fix = "check the sensor and the columns, or leave these rows out"
        warn_user(sentence(what, expected=expected, fix=fix))


def warn_of_outliers(wrong: Sequence[int], data: Any, reason: str, stuck: Sequence[Stuck]) -> None:
    """Warn if so many rows, of all or of one device, are outliers that the inliers may be the wrong ones.

    Args:
        wrong: numbers of the outlying rows. data: the table. reason: what is wrong with the worst row.
        stuck: columns of one value.
    """
    flags = torch.zeros(len(data), dtype=torch.bool, device=HOST)
    flags[list(wrong)] = True
    devices = list(device_rows(data))
    many = [one for one in devices if float(flags[one.rows].double().mean()) > gates.GROSS_SHARE]
    counts = few([f"{int(flags[one.rows].sum())} of {len(one.rows)} {one.words}" for one in many], MOST_NAMES)
    held = [one for one in stuck if bool(flags[one.rows].any())]
    also = f"; {stuck_words(held)}: a stuck sensor?" * bool(held)
    expected, got = f"at most {100 * gates.GROSS_SHARE:.0f} %", f"for the worst row: {reason}"
    if float(flags.double().mean()) > gates.GROSS_SHARE:
        what = f"{len(wrong)} of {len(data)} rows are outliers: do not rely on this calibration"
        fix = "check that rows pair joints with their own points, and that markers keep their numbers"
        fix += f"; most of them are {counts}" * (0 < len(many) < len(devices))
        warn_user(sentence(what, expected=expected, got=got, fix=fix + also))
    elif many:
        what = f"{counts} are outliers, so that they hardly count"
        fix = (
            "check these devices, their columns and units; of a set-up, whether more has moved than was said: leave it "
        )
        fix += "out, and recalibrate the model with its rows alone, which finds both device and markers" + also
        warn_user(sentence(what, expected=expected, got=got, fix=fix))


def _smallest_motion(values: Tensor, seen: Tensor) -> float:
    """Smallest RMS deviation of a body's numbers from their mean along any direction, m; zero without any.

    Args:
        values: (M, P, r) m of P bodies. seen: (M, P, r) boolean, the numbers that were measured.
    """
    own = [values[:, body, flags] for body, flags in enumerate(seen.all(0)) if bool(flags.any())]
    spreads = [float(torch.linalg.svdvals(body - body.mean(0))[-1]) for body in own]
    return min(spreads, default=0.0) / len(values) ** 0.5
