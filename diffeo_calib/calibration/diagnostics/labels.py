"""Wrong rows that fit well under another label than theirs: a session's border that is late, a wrong payload."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from diffeo_calib.common.errors import few, sentence

REMAINING_ERROR_SHARE = 0.3
"""Part of a row's error that may remain under the other label."""
FEWEST_ROWS = 2
MOST_MASSES = 10
"""Payloads up to which each is a label; more of them are measured values."""


class Label(Protocol):
    """See :class:`~diffeo_calib.calibration.placing.placement.OtherLabel`."""

    @property
    def name(self) -> str:
        """In words."""
        ...

    @property
    def applies(self) -> Tensor:
        """(M,) boolean: the rows that do not have it."""
        ...

    @property
    def errors(self) -> Tensor:
        """(M,) with this label, m."""
        ...


def label_text(errors: Tensor, wrong: Tensor, lines: Tensor, labels: Sequence[Label]) -> str | None:
    """A sentence about the label that most wrong rows fit.

    Args:
        errors: (M,) of the rows as they are labelled, m. wrong: (M,) boolean. lines: (M,). labels: others.
    """
    found = [(wrong & one.applies & (one.errors < REMAINING_ERROR_SHARE * errors), one) for one in labels]
    rows, label = max(found, key=lambda each: int(each[0].sum()), default=(wrong & ~wrong, None))
    if label is None or int(rows.sum()) < FEWEST_ROWS:
        return None
    before, after = (1e3 * float(each[rows].median()) for each in (errors, label.errors))
    what = (
        f"{int(rows.sum())} rows look wrong and fit {label.name}: lines {few(lines[rows.to(lines.device)].tolist(), 5)}"
    )
    got = f"median errors of {before:.3g} mm, and of {after:.3g} mm so"
    return sentence(what, expected="rows that fit under their own label", got=got, fix="correct these labels")
