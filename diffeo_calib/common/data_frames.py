"""Data frames of pandas, polars and pyarrow: their columns by name. None of these libraries is imported to read them.

Results become data frames of pandas, which is imported then and need not be installed otherwise.

Objects as notebooks show them: small tables of names and values.

Arrays that come from outside, as float64: all kinds that hold real numbers, and no other kind. NumPy alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diffeo_calib.common.errors import InputError, listed


def is_data_frame(value: object) -> bool:
    """Whether this is a table whose columns have names."""
    kind = type(value)  # not the value: polars resolves the columns of a lazy frame when it is asked for them
    return hasattr(kind, "columns") and (hasattr(kind, "to_numpy") or hasattr(kind, "__dataframe__"))


def column_names(frame: Any) -> list[str]:
    """Names of a data frame's columns, in its order."""
    return list(frame.column_names if hasattr(type(frame), "column_names") else frame.columns)


def named_columns(value: object, names: Sequence[str], what: str) -> Any:
    """The columns with these names, in the order of the names; anything but a data frame is returned as it is.

    Other columns are ignored, whatever they hold.

    Args:
        value: a data frame, or something else.
        names: names of the columns.
        what: the argument's name, for messages.

    Returns:
        (N, len(names)) float64 array.

    Raises:
        InputError: columns that are missing, that exist twice or that hold no numbers; a single row or column of a
            data frame, which has lost the names of its columns.
    """
    if not is_data_frame(value):
        _refuse_series(value, what)
        return value
    frame: Any = value
    have = column_names(frame)
    missing = [name for name in names if name not in have]
    if missing:
        fix = "rename its columns, or pass an array whose columns are in this order"
        text = f"the data frame `{what}` has no column {listed(missing)}"
        raise InputError.of(
            text, expected=f"columns {listed(names)}", got=listed([str(name) for name in have]), fix=fix
        )
    twice = [name for name in names if have.count(name) > 1]
    if twice:
        fix = "keep one column of each name"
        raise InputError.of(f"the data frame `{what}` has several columns named {listed(twice)}", fix=fix)
    return np.column_stack([_numbers(frame, name, what) for name in names])


def data_frame(columns: Mapping[str, Any], index: Any = None) -> Any:
    """A pandas.DataFrame.

    Args:
        columns: name -> values of the N rows. index: names of the rows, by default their numbers.

    Raises:
        ImportError: pandas is not installed.
    """
    try:
        import pandas  # noqa: PLC0415  # optional
    except ImportError as error:
        raise ImportError("data frames need pandas: pip install 'diffeo_calib[notebooks]'") from error
    values = {name: value.cpu().numpy() if hasattr(value, "cpu") else value for name, value in columns.items()}
    return pandas.DataFrame(values, index=index)


def refuse_data_frame(value: object, what: str) -> None:
    """Raise InputError for a data frame where columns have no names to match."""
    _refuse_series(value, what)
    if is_data_frame(value):
        text = f"`{what}` is a data frame, but the inputs of this map have no names"
        fix = "pass an array with the columns in the order of the map's inputs, such as `frame[[...]].to_numpy()`"
        raise InputError.of(text, expected="an array", fix=fix)


def _refuse_series(value: object, what: str) -> None:
    """A series is a row or a column: nothing tells which."""
    if hasattr(type(value), "to_numpy") and len(getattr(value, "shape", ())) == 1:
        fix = "pass a data frame, of one row as `frame.iloc[[0]]` (pandas) or `frame[0]` (polars)"
        raise InputError.of(f"`{what}`", expected="a data frame or an array", got=type(value).__name__, fix=fix)


def _numbers(frame: Any, name: str, what: str) -> np.ndarray:
    """One column as float64."""
    try:
        return real_array(np.asarray(frame[name]))
    except (TypeError, ValueError, OverflowError) as error:
        text = f"column {name!r} of the data frame `{what}` cannot be read as numbers ({error})"
        raise InputError.of(text, fix="convert it to numbers, and remove rows without a value") from error


ARRAY_KINDS = {
    "b": "booleans",
    "c": "complex numbers",
    "m": "time differences",
    "M": "dates",
    "V": "records with named fields",
}
"""Kinds of arrays that NumPy would convert to real numbers without a warning."""


def real_array(value: object) -> np.ndarray:
    """Convert anything but a tensor to a float64 array.

    Raises:
        TypeError, ValueError, OverflowError, RecursionError: no real numbers.
    """
    array = value if isinstance(value, np.ndarray) else np.asarray(value)
    if array.dtype.kind in ARRAY_KINDS:
        raise TypeError(ARRAY_KINDS[array.dtype.kind])
    if isinstance(array, np.ma.MaskedArray) and bool(np.ma.getmaskarray(array).any()):
        raise ValueError("masked values, which are missing")
    if array.dtype == object and any(isinstance(entry, (bool, np.bool_, np.datetime64)) for entry in array.flat):
        raise TypeError("objects that are no numbers")
    # torch wants memory that may be written to, and forwards; columns of data frames are often read-only
    return np.require(array, np.float64, ["C", "W", "E"])
