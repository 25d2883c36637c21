"""The page about rows of any kinds: a ball in sockets, readings, and mixtures of these with measured positions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from diffeo_calib.common.errors import printable
from diffeo_calib.reports.analysis.kinds import KindFindings
from diffeo_calib.reports.html.document import Picture, Section, Table, millimetres, panel
from diffeo_calib.reports.html.sections import PER_LETTER, UNDER_LEGEND
from diffeo_calib.reports.plots.errors import draw_before_after, draw_distributions
from diffeo_calib.reports.plots.joints import PART_WIDTH, draw_expected, draw_parts, short
from diffeo_calib.reports.plots.style import Frame
from diffeo_calib.sensors.errors import Evaluation

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
    """What the errors are of, in words."""
    if not found.kinds:
        return "none, because no rows were passed"
    return f"{found.count} rows that the model has not seen" if found.new else f"{found.count} rows of its own fit"


def verdict(found: KindFindings) -> str:
    """The result in one line."""
    *before, (_, own) = found.expected.items()
    listed = ", ".join(f"{1e3 * value:.2f} mm {printable(name)}" for name, value in before)
    line = f"{listed}, {1e3 * own:.3f} mm calibrated: RMS errors of positions that the model expects over the joint "
    return f"{line}ranges of its rows. {'; '.join(_by_kind(found))}"


def _by_kind(found: KindFindings) -> Iterator[str]:
    for stages in found.kinds.values():
        *_, own = stages.values()
        unit, per_unit = own.shown
        yield f"{own.title}: {per_unit * own.rms:.3f} {unit} RMS"


def advice(found: KindFindings) -> Iterator[str]:
    """What to do next."""
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
    """What the page shows before its record."""
    yield _how_good(found)
    yield _expected(found)
    yield from devices(found.devices)
    longest = max(len(short(part.name)) for part in found.parts)
    frame = Frame((PART_WIDTH, 0.9 + 0.24 * len(found.parts)), left=0.3 + PER_LETTER * longest)
    picture = panel("parts", "What each part explains (parts may cancel).", draw_parts, found.parts, frame=frame)
    yield Section("why", "Why", "What each part of the model explains.", pictures=[picture], notes=[NO_POSITIONS])


def devices(lines: Sequence[str]) -> Iterator[Section]:
    """Where devices are, if there is anything to say."""
    if lines:
        see = (
            "Where devices and sockets stand, and what was found from the rows shown because the model did not know it."
        )
        yield Section("devices", "Devices", see, text=[printable(line) for line in lines])


def _how_good(found: KindFindings) -> Section:
    """Errors of every kind by stage."""
    pictures = list[Picture]()
    for number, stages in enumerate(found.kinds.values()):
        label = next(iter(stages.values())).label
        shares = f"Share of rows whose {label} is at most a value."
        pictures.append(panel(f"distributions-{number}", shares, draw_distributions, stages, frame=UNDER_LEGEND))
        against = f"Every row: {label} of the calibrated model against that of the stage before it."
        pictures.append(panel(f"before-after-{number}", against, draw_before_after, stages, frame=UNDER_LEGEND))
    present = {next(iter(stages.values())).what for stages in found.kinds.values()}
    notes = [text for what, text in FLATTERING.items() if what in present]
    see = f"Errors on {rows_of(found)}, each kind in its own unit; units are never mixed."
    see = see if found.kinds else "No rows were passed: pass some (--data) to see errors of each kind in its own unit."
    return Section("errors", "How good", see, [_table(own) for own in found.kinds.values()], None, pictures, notes)


def _table(stages: Mapping[str, Evaluation]) -> Table:
    """Errors of one kind by stage."""
    one = next(iter(stages.values()))
    unit, per_unit = one.shown
    rows = [
        [name, *(f"{per_unit * value:.4f}" for value in (own.rms, own.median, own.p95, own.max))]
        for name, own in stages.items()
    ]
    return Table(f"{one.title} by stage", ["stage", f"RMS [{unit}]", "median", "95 %", "max"], rows)


def _expected(found: KindFindings) -> Section:
    """What the model expects of its own positions."""
    robot, free = found.model.robot, found.model.map.workspace is not None
    rows = [[name, millimetres(value)] for name, value in found.expected.items()]
    pictures = [
        panel(f"expected-{joint}", f"Expected error against {printable(name)}.", draw_expected, robot, joint,
              found.deviations, key=joint == 0)
        for joint, name in enumerate(robot.joint_names)
    ]  # fmt: skip
    see = "RMS errors of positions that the model itself expects over the joint ranges of its rows"
    see += ", after a rigid fit, because no device says where the robot stands" * free
    see += f": {printable(found.deviations.error.sentence)}."
    table = Table("Expected error of positions by stage", ["stage", "RMS [mm]"], rows)
    return Section("expected", "What to expect", see, [table], None, pictures)
