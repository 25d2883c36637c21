"""Wrong rows that fit well under another label than theirs: a session's border that is late, a wrong payload."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from diffeo_calib.calibration.diagnostics import gates
from diffeo_calib.common.errors import few, sentence


class OtherLabel(NamedTuple):
    """How M rows would err with another label than theirs.

    Args:
        name: in words. applies: (M,) boolean, the rows that do not have it. errors: (M,) m.
    """

    name: str
    applies: Tensor
    errors: Tensor


def label_text(errors: Tensor, wrong: Tensor, lines: Tensor, labels: Sequence[OtherLabel]) -> str | None:
    """A sentence about the label that most wrong rows fit.

    Args:
        errors: (M,) of the rows as they are labelled, m. wrong: (M,) boolean. lines: (M,). labels: others.
    """
    found = [(wrong & one.applies & (one.errors < gates.REMAINING_UNDER_LABEL * errors), one) for one in labels]
    rows, label = max(found, key=lambda each: int(each[0].sum()), default=(wrong & ~wrong, None))
    if label is None or int(rows.sum()) < gates.LABEL_ROWS:
        return None
    before, after = (1e3 * float(each[rows].median()) for each in (errors, label.errors))
    what = (
        f"{int(rows.sum())} rows look wrong and fit {label.name}: lines {few(lines[rows.to(lines.device)].tolist(), 5)}"
    )
    got = f"median errors of {before:.3g} mm, and of {after:.3g} mm so"
    return sentence(what, expected="rows that fit under their own label", got=got, fix="correct these labels")
