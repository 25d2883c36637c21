"""Where a model comes from: when it was fitted, with what, and to which table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from math import inf
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from diffeo_calib.common.errors import PACKAGE, InputError, as_written, printable

HASH_SHOWN = 12  # digits of a hash that a sentence shows
LONGEST_NOTE = 10_000  # characters of a note


@dataclass(frozen=True)
class Provenance:
    """When a model was fitted, with which version and to which measurements.

    Args:
        date: in UTC, ISO 8601, such as ``"2026-11-22T10:00:00+00:00"``.
        version: of this package.
        table_sha256: SHA-256 of the file of measurements, or of their arrays if they came from Python; see
            :attr:`Measurements.sha256`.
        note: text of the user, such as a serial number.
        command: the command line that made the model; empty if it was made from Python.
        table: options with which the command line reads the table again; empty where they are not known.
        program_rows: of a function that made the poses of the machine, some rows of what it took, and behind them the
            places or poses that it made of them, m.
    """

    date: str
    version: str
    table_sha256: str
    note: str = ""
    command: str = ""
    table: str = ""
    program_rows: tuple[tuple[float, ...], ...] = ()

    @classmethod
    def now(cls, measurements: Any, note: str = "") -> Provenance:
        """Provenance of a model fitted now to these measurements.

        Raises:
            InputError: see :func:`check_note`.
        """
        check_note(note)
        date = datetime.now(timezone.utc).isoformat(timespec="seconds")
        table = "" if measurements.origin is None else measurements.origin.options
        return cls(date, package_version(), measurements.sha256, note, table=table)

    def sentence(self, robot: str, rows: int) -> str:
        """One line: ``fitted 2026-11-22 with diffeo_calib 0.1.0 to robot 'ur10', 442 rows, table sha256 ab12...``."""
        made = f"fitted {self.date[:10]} with {PACKAGE} {self.version} to robot '{robot}', {rows} rows"
        note = f"; note: {printable(self.note)}" if self.note else ""
        return f"{made}, table sha256 {self.table_sha256[:HASH_SHOWN]}...{note}"


def check_note(note: object) -> None:
    """Raise InputError unless this is text of reasonable length."""
    if not isinstance(note, str):
        raise InputError.of("`note`", expected="text", got=type(note).__name__)
    if len(note) > LONGEST_NOTE:
        fix = "keep longer documents beside the model"
        raise InputError.of("`note`", expected=f"at most {LONGEST_NOTE} characters", got=len(note), fix=fix)


def package_version() -> str:
    """Version of this package."""
    try:
        return version(PACKAGE)
    except PackageNotFoundError:  # copied instead of installed
        return "unknown"


LENGTH_UNIT = " [m]"  # ends the names of the parts' entries
INFINITE = "infinite"  # an infinite number among entries: JSON has none


def _entry(name: str, default: Any = MISSING) -> Any:
    """A field of another name in model files, which need not hold it if it has a default."""
    return field(default=default, metadata={"name": name})


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Results of a calibration, in SI units. Errors are those of measured positions: None where none was measured.

    Args:
        registration_rms: RMS distance of the training rows from the nominal robot after registration, m.
        geometry_rms: the same after the geometric calibration, m.
        diffeomorphic_rms: the same of the calibrated model, m.
        leave_one_out_rms: RMS distance of every marker from its prediction by all other rows, m.
        outliers: number of measurements flagged as outliers.
        coupling_residual: certificate of the fit, see :class:`Fit`; dimensionless.
        end_residual: certificate of the fit, see :class:`Fit`; dimensionless.
        energy: value of the minimised energy; dimensionless.
        status: why the fit stopped, in one sentence.
        scales: how the scales of kernels, priors and noise were chosen, in one sentence.
        rows: number of training rows.
        parts: name of each part of the model -> RMS displacement of the markers that it explains, m.
        noise_degrees_of_freedom: of Student's t; infinite for Gaussian noise, None if unknown.
        effective_parameters: effective number of parameters of the fit; None if it was not computed.
        length_in_doubt: RMS distance by which points move with a length of robot or device that is improbable, m; None
            without one.
        warnings: what the calibration warned of, one line each; None if it did not.
    """

    registration_rms: float | None = _entry("registration rms [m]", None)
    geometry_rms: float | None = _entry("geometry rms [m]", None)
    diffeomorphic_rms: float | None = _entry("diffeomorphic rms [m]", None)
    leave_one_out_rms: float | None = _entry("leave-one-out rms [m]", None)
    outliers: int
    noise_degrees_of_freedom: float | None = _entry("noise degrees of freedom", None)
    coupling_residual: float = _entry("coupling residual")
    end_residual: float = _entry("end residual")
    energy: float
    status: str
    scales: str
    rows: int
    effective_parameters: float | None = _entry("effective parameters", None)
    length_in_doubt: float | None = _entry("length in doubt [m]", None)
    warnings: str | None = None
    parts: Mapping[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Entries named with their units, as model files hold them, of what is known; the parts are the last ones."""
        given = {name: value for name, value in entries_of(self, "parts").items() if value is not None}
        return given | {f"{part}{LENGTH_UNIT}": displacement for part, displacement in self.parts.items()}

    @classmethod
    def from_dict(cls, entries: Mapping[str, Any], *, positions: bool = True) -> Summary:
        """The inverse of :meth:`to_dict`.

        Args:
            entries: of a file. positions: whether any was measured: old files have errors of other rows in their place.

        Raises:
            TypeError: an entry is missing or unknown, or its value has another type.
        """
        names = {f.metadata.get("name", f.name) for f in fields(cls)}
        others = [name for name in entries if name not in names and name.endswith(LENGTH_UNIT)]
        parts = {name.removesuffix(LENGTH_UNIT): _read(entries[name], float, name) for name in others}
        record = record_of(cls, {k: v for k, v in entries.items() if k not in others}, parts=parts)
        return record if positions else replace(record, **dict.fromkeys(OF_POSITIONS))


OF_POSITIONS = ("registration_rms", "geometry_rms", "diffeomorphic_rms", "leave_one_out_rms")


# --- dataclasses of plain values as entries of a file ----------------------------------------------------------------

Record = TypeVar("Record")


def entries_of(record: Any, *without: str) -> dict[str, Any]:
    """The fields of a dataclass, or some of them, under their names in files."""
    named = {f.metadata.get("name", f.name): getattr(record, f.name) for f in fields(record)}
    plain = {name: INFINITE if value == inf else value for name, value in named.items() if name not in without}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in plain.items()}


def record_of(kind: type[Record], entries: Mapping[str, Any], **given: Any) -> Record:
    """A dataclass of the entries of a file, and of other fields that are ``given``.

    Raises:
        TypeError: an entry is missing or unknown, or its value has another type than the field.
    """
    names: dict[str, str] = {f.metadata.get("name", f.name): f.name for f in fields(kind)}  # pyright: ignore[reportArgumentType]
    hints, values = get_type_hints(kind), {names.get(name, name): value for name, value in entries.items()}
    return kind(**{name: _read(value, hints.get(name, object), name) for name, value in values.items()}, **given)


def _read(value: Any, hint: Any, name: str) -> Any:
    """A value of a file as its type says: a float, an int, text, true or false, a tuple of these, or None."""
    if get_origin(hint) is tuple and isinstance(value, list):
        return tuple(_read(entry, get_args(hint)[0], name) for entry in value)
    kinds = get_args(hint) or (hint,)
    if value == INFINITE and float in kinds:
        return inf
    accepted = (*kinds, int) if float in kinds else kinds  # a whole number may stand for a float
    if isinstance(value, bool) is not (bool in kinds) or not isinstance(value, accepted):
        raise TypeError(f"the entry {name!r} is {as_written(value)}")
    return float(value) if float in kinds and value is not None else value
