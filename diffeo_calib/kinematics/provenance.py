"""Where a model comes from: when it was fitted, with what, and to which table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from math import inf
from typing import Any

from diffeo_calib.common.errors import PACKAGE, InputError, as_written, printable

HASH_SHOWN = 12
"""Digits of a hash that a sentence shows."""
LONGEST_NOTE = 10_000
"""Characters of a note."""


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
    """

    date: str
    version: str
    table_sha256: str
    note: str = ""
    command: str = ""
    table: str = ""

    @classmethod
    def now(cls, measurements: Any, note: str = "") -> Provenance:
        """That of a model fitted now to these measurements.

        Raises:
            InputError: see :func:`check_note`.
        """
        check_note(note)
        date = datetime.now(timezone.utc).isoformat(timespec="seconds")
        table = "" if measurements.origin is None else measurements.origin.options
        return cls(date, package_version(), measurements.sha256, note, table=table)

    @classmethod
    def from_dict(cls, entries: Mapping[str, Any]) -> Provenance:
        """The inverse of :meth:`to_dict`.

        Raises:
            InputError: an entry is missing or unknown, or is no text.
        """
        names = [field.name for field in fields(cls)]
        if isinstance(entries, Mapping):
            entries = {"command": "", "table": "", **entries}  # the first files did not have them
        if not isinstance(entries, Mapping) or set(entries) != set(names):
            got = sorted(map(str, entries)) if isinstance(entries, Mapping) else entries
            raise InputError.of("the entry provenance", expected=names, got=got)
        for name, value in entries.items():
            if not isinstance(value, str):
                raise InputError.of(f"the entry {name!r} of the provenance", expected="text", got=as_written(value))
        return cls(**entries)

    def to_dict(self) -> dict[str, str]:
        """The fields by name, as model files hold them."""
        return asdict(self)

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


ENTRIES: dict[str, tuple[str, type]] = {
    "registration_rms": ("registration rms [m]", float),
    "geometry_rms": ("geometry rms [m]", float),
    "diffeomorphic_rms": ("diffeomorphic rms [m]", float),
    "leave_one_out_rms": ("leave-one-out rms [m]", float),
    "outliers": ("outliers", int),
    "noise_degrees_of_freedom": ("noise degrees of freedom", float),
    "coupling_residual": ("coupling residual", float),
    "end_residual": ("end residual", float),
    "energy": ("energy", float),
    "status": ("status", str),
    "scales": ("scales", str),
    "rows": ("rows", int),
    "effective_parameters": ("effective parameters", float),
    "length_in_doubt": ("length in doubt [m]", float),
    "warnings": ("warnings", str),
}
"""Field of a summary -> its name in dictionaries and model files, and its type."""
OF_POSITIONS = ("registration_rms", "geometry_rms", "diffeomorphic_rms", "leave_one_out_rms")
OPTIONAL = (*OF_POSITIONS, "noise_degrees_of_freedom", "effective_parameters", "length_in_doubt", "warnings")
"""Fields that may be None: they have no entry then. Old model files do not have the last four."""
LENGTH_UNIT = " [m]"
"""Ends the names of the parts' entries."""
INFINITE = "infinite"
"""An infinite number in a dictionary: JSON has none."""


@dataclass(frozen=True)
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

    registration_rms: float | None
    geometry_rms: float | None
    diffeomorphic_rms: float | None
    leave_one_out_rms: float | None
    outliers: int
    coupling_residual: float
    end_residual: float
    energy: float
    status: str
    scales: str
    rows: int
    parts: Mapping[str, float]
    noise_degrees_of_freedom: float | None = None
    effective_parameters: float | None = None
    length_in_doubt: float | None = None
    warnings: str | None = None

    def to_dict(self) -> dict[str, float | int | str]:
        """Entries named with their units, as model files hold them; "infinite" stands for an infinite number."""
        values: dict[str, float | int | str] = {}
        for field, (name, _) in ENTRIES.items():
            value = getattr(self, field)
            if field == "effective_parameters":  # the parts stand before it
                values |= {f"{part}{LENGTH_UNIT}": displacement for part, displacement in self.parts.items()}
            if value is not None:
                values[name] = INFINITE if value == inf else value
        return values

    @classmethod
    def from_dict(cls, entries: Mapping[str, Any], *, positions: bool = True) -> Summary:
        """The inverse of :meth:`to_dict`.

        Args:
            entries: of a file. positions: whether any was measured: old files have errors of other rows in their place.

        Raises:
            InputError: an entry is missing or unknown, or its value has another type.
        """
        known = {name for name, _ in ENTRIES.values()}
        values = {field: _value(entries, field) for field in ENTRIES}
        values |= {} if positions else dict.fromkeys(OF_POSITIONS)
        parts = {}
        for name, value in entries.items():
            if name not in known:
                if not name.endswith(LENGTH_UNIT):
                    expected = f"{', '.join(sorted(known))}, or a part with its unit{LENGTH_UNIT}"
                    raise InputError.of("an entry of the summary", expected=expected, got=as_written(name))
                parts[name.removesuffix(LENGTH_UNIT)] = _read(value, name, float)
        return cls(parts=parts, **values)


def _value(entries: Mapping[str, Any], field: str) -> Any:
    """The value of one field of a summary."""
    name, kind = ENTRIES[field]
    if name in entries:
        return _read(entries[name], name, kind)
    if field in OPTIONAL:
        return None
    raise InputError.of(f"the summary has no entry {name!r}")


def _read(value: Any, name: str, kind: type) -> Any:
    """An entry as a float, an int or a str; a whole number may stand for a float."""
    if kind is float and value == INFINITE:
        return inf
    if isinstance(value, bool) or not isinstance(value, (int, float) if kind is float else kind):
        words = {float: "a number", int: "a whole number", str: "text"}
        raise InputError.of(f"the entry {name!r} of the summary", expected=words[kind], got=as_written(value))
    return kind(value)
