"""Where a model comes from: when it was fitted, with what, and to which table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
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
        return cls(date, _version(), measurements.sha256, note, table=table)

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


def _version() -> str:
    try:
        return version(PACKAGE)
    except PackageNotFoundError:  # copied instead of installed
        return "unknown"
