"""Names that rows carry: those of their session or of their socket."""

from __future__ import annotations

from collections.abc import Iterable
from math import isnan

from torch import Tensor

from diffeo_calib.common.errors import MeasurementError, as_written


def row_names(names: object, rows: int, what: str) -> list[str]:
    """Names of rows as texts, without spaces around them.

    Raises:
        MeasurementError: not one per row, or rows without a name: None, NaN or an empty text.
    """
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise MeasurementError.of(what, expected=f"{rows} names, one per row", got=as_written(names))
    given = names.tolist() if isinstance(names, Tensor) else list(names)
    if len(given) != rows:
        got = len(given)
        raise MeasurementError.of(what, expected=f"{rows} names, one per row", got=got)
    empty = [name is None or (isinstance(name, float) and isnan(name)) for name in given]  # NaN in data frames
    texts = ["" if none else str(name).strip() for none, name in zip(empty, given, strict=True)]
    unnamed = [row for row, text in enumerate(texts) if not text]
    if unnamed:
        text = f"{what}: {len(unnamed)} row(s) have no name, the first is row {unnamed[0]}"
        raise MeasurementError.of(text, fix="name every row")
    return texts
