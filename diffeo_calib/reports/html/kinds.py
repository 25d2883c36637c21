"""The page about rows of any kinds: a ball in sockets, readings, and mixtures of these with measured positions."""

from __future__ import annotations

from collections.abc import Iterator

from diffeo_calib.common.errors import printable
from diffeo_calib.reports.analysis.kinds import KindFindings
from diffeo_calib.reports.html.document import Section, Table, millimetres
from diffeo_calib.reports.html.sections import devices, expected_pictures, parts_picture, stage_pictures, stage_table

NO_POSITIONS = (
    "Coverage, learning curve, repeatability and the workspace in space are not shown: they compare measured positions "
    "with claimed ones, and rows in sockets and readings measure none. The bands of transmission errors are those of "
    "models of positions."
)
FLATTERING = {
    "spread": "A spread within sockets is no error: what all rows of a socket share does not show in it.",
    "readings": "Errors of readings do not show what no reading sees, such as the robot's size with heights.",
}


def rows_of(found: KindFindings) -> str:
    """Source of the errors, in words."""
    if not found.kinds:
        return "none, because no rows were passed"
    return f"{found.count} rows that the model has not seen" if found.new else f"{found.count} rows of its own fit"


def verdict(found: KindFindings) -> str:
    """The result in one line."""
    *before, (_, own) = found.expected.items()
    listed = ", ".join(f"{1e3 * value:.2f} mm {printable(name)}" for name, value in before)
    line = f"{listed}, {1e3 * own:.3f} mm calibrated: RMS errors of positions that the model expects over the joint "
    last = [[*stages.values()][-1] for stages in found.kinds.values()]
    each = "; ".join(f"{one.title}: {one.shown[1] * one.rms:.3f} {one.shown[0]} RMS" for one in last)
    return f"{line}ranges of its rows. {each}"


def advice(found: KindFindings) -> Iterator[str]:
    """Advice on the next step."""
    for stages in found.kinds.values():
        *others, own = stages.values()
        if own.rms >= min(one.rms for one in others):
            yield f"{own.title}: the model is no better than geometry alone on these rows. Measure more poses."
    if found.kinds and not found.new:
        yield "These are rows of the fit: pass rows that the model has not seen (--data)."


def figures(found: KindFindings) -> Iterator[tuple[str, str]]:
    """Name and value of the numbers at the top."""
    for name, value in found.expected.items():
        yield f"expected error, {name}", f"{1e3 * value:.3f} mm"
    for stages in found.kinds.values():
        *_, own = stages.values()
        unit, per_unit = own.shown
        yield f"{own.title}, RMS", f"{per_unit * own.rms:.3f} {unit}"


def sections(found: KindFindings) -> Iterator[Section]:
    """Contents of the page before its record."""
    yield _how_good(found)
    yield _expected(found)
    yield from devices(found.devices)
    picture = parts_picture(found.parts)
    yield Section("why", "Why", "What each part of the model explains.", pictures=[picture], notes=[NO_POSITIONS])


def _how_good(found: KindFindings) -> Section:
    """Errors of every kind by stage."""
    every = enumerate(found.kinds.values())
    pictures = [picture for number, stages in every for picture in stage_pictures(stages, f"-{number}")]
    present = {next(iter(stages.values())).what for stages in found.kinds.values()}
    notes = [text for what, text in FLATTERING.items() if what in present]
    see = f"Errors on {rows_of(found)}, each kind in its own unit; units are never mixed."
    see = see if found.kinds else "No rows were passed: pass some (--data) to see errors of each kind in its own unit."
    return Section("errors", "How good", see, [stage_table(own) for own in found.kinds.values()], None, pictures, notes)


def _expected(found: KindFindings) -> Section:
    """Expected errors of the model's positions."""
    robot, free = found.model.robot, found.model.map.workspace is not None
    rows = [[name, millimetres(value)] for name, value in found.expected.items()]
    pictures = expected_pictures(robot, found.deviations, "Expected error against {}.")
    see = "RMS errors of positions that the model itself expects over the joint ranges of its rows"
    see += ", after a rigid fit, because no device says where the robot stands" * free
    see += f": {printable(found.deviations.error.sentence)}."
    table = Table("Expected error of positions by stage", ["stage", "RMS [mm]"], rows)
    return Section("expected", "What to expect", see, [table], None, pictures)
