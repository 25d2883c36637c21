"""Sentences of a report about rows of any kinds: a ball in sockets, readings, and mixtures with positions."""

from __future__ import annotations

from collections.abc import Iterator

from diffeo_calib.common.errors import printable
from diffeo_calib.reports.analysis.kinds import Findings


def rows_of(found: Findings) -> str:
    """Source of the errors, in words."""
    if not found.kinds:
        return "none, because no rows were passed"
    return f"{found.count} rows that the model has not seen" if found.new else f"{found.count} rows of its own fit"


def verdict(found: Findings) -> str:
    """The result in one line."""
    *before, (_, own) = found.expected.items()
    listed = ", ".join(f"{1e3 * value:.2f} mm {printable(name)}" for name, value in before)
    line = f"{listed}, {1e3 * own:.3f} mm calibrated: RMS errors of positions that the model expects over the joint "
    last = [[*stages.values()][-1] for stages in found.kinds.values()]
    each = "; ".join(f"{one.title}: {one.shown[1] * one.rms:.3f} {one.shown[0]} RMS" for one in last)
    return f"{line}ranges of its rows. {each}"


def advice(found: Findings) -> Iterator[str]:
    """Advice on the next step."""
    for stages in found.kinds.values():
        *others, own = stages.values()
        if own.rms >= min(one.rms for one in others):
            yield f"{own.title}: the model is no better than geometry alone on these rows. Measure more poses."
    if found.kinds and not found.new:
        yield "These are rows of the fit: pass rows that the model has not seen (--data)."


def figures(found: Findings) -> Iterator[tuple[str, str]]:
    """Name and value of the numbers at the top."""
    for name, value in found.expected.items():
        yield f"expected error, {name}", f"{1e3 * value:.3f} mm"
    for stages in found.kinds.values():
        *_, own = stages.values()
        unit, per_unit = own.shown
        yield f"{own.title}, RMS", f"{per_unit * own.rms:.3f} {unit}"
