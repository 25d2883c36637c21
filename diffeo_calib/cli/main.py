"""The command line, and what its exit codes mean.

Exit codes: 0 success; 1 the input or the model file cannot be used (one sentence says why), or `evaluate` found rows
out of step with their joints, or a median error above a tenth of the robot's reach (the errors are printed first), or
`fit` found such errors in a quarter of the rows (the model is written); 2 wrong usage;
3 the fit stopped before it converged (the model is written); 130 interrupted by Ctrl-C (the best model so far is
written).

Each command imports its work when it runs, so that help, the version and shell completion load neither torch nor SciPy
and appear at once.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from diffeo_calib.cli.app import app
from diffeo_calib.cli.console import interrupts, show
from diffeo_calib.cli.record import EXIT_ERROR, record
from diffeo_calib.common.errors import DiffeoCalibError, DiffeoCalibWarning


def main() -> None:
    """Run the command line; every error of this package becomes one sentence and an exit code."""
    interrupts.install()
    with forgiving_streams(), warnings.catch_warnings():
        warnings.simplefilter("always", DiffeoCalibWarning)
        warnings.showwarning = _show_warning
        try:
            app()
        except DiffeoCalibError as error:
            show("error", error)
            sys.exit(EXIT_ERROR)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Takes the place of :func:`warnings.showwarning`."""
    record.warnings.append(str(message))
    show("warning", message)


class ForgivingStream:
    """A text stream, or the lack of one, whose failures to write end the output, not the program."""

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream if stream is not None else open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115

    def write(self, text: str) -> int:
        """Write, or drop the text where that fails."""
        self._try(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Flush, or drop what is buffered where that fails."""
        self._try(self._stream.flush)

    def _try(self, action: Any, *given: str) -> None:
        try:
            action(*given)
        except (OSError, ValueError):
            with suppress(OSError, ValueError):  # the buffer, too, is flushed again when the interpreter ends
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def forgiving_streams() -> Iterator[None]:
    """Forgive failures of standard output and standard error inside."""
    for number in range(3):  # closed ones: the next file would be number 1 or 2, and take what others print
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (ForgivingStream(stream) for stream in before)  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = before
