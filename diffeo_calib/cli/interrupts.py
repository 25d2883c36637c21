"""What Ctrl-C means. Imports nothing slow: the handler is installed before everything else."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from types import FrameType

from diffeo_calib.common.files import remove_unfinished

EXIT_INTERRUPTED = 130
INTERRUPTED = "interrupted before there was a result to keep"
NOTHING_TO_KEEP = ("registration", "geometry")
"""Tasks of a calibration whose interruption leaves no model."""

Progress = Callable[[str, int, int], None]
"""``progress(task, done, total)``."""


class Interrupts:
    """Ctrl-C ends the program at once as long as there is no result to keep, and whenever it is pressed again.

    Otherwise the first Ctrl-C asks for the best result so far: the handler takes note of it, and the next step that
    :meth:`watching` sees raises KeyboardInterrupt. Raised wherever the signal arrives, the exception could be
    swallowed, for instance by the import of a library.

    Attributes:
        asked: whether the user asked for the best result so far.
    """

    def __init__(self) -> None:
        self.asked = self._keeping = self._raised = False
        self._note: Callable[[str], object] = print

    def install(self) -> None:
        """Handle SIGINT from now on."""
        self.asked = self._keeping = self._raised = False
        signal.signal(signal.SIGINT, self._handle)

    def watching(self, progress: Progress, note: Callable[[str], object]) -> Progress:
        """Return the same progress callback, which raises KeyboardInterrupt once after a Ctrl-C.

        Args:
            progress: called at every step. note: prints the answer to Ctrl-C beside the progress bar.
        """
        self._note = note

        def step(task: str, done: int, total: int) -> None:
            self._keeping = self._keeping or task not in NOTHING_TO_KEEP
            progress(task, done, total)
            if self.asked and not self._raised:
                self._raised = True
                raise KeyboardInterrupt

        return step

    def _handle(self, _signal: int, _frame: FrameType | None) -> None:
        if not self._keeping:
            end_process(INTERRUPTED)
        if self.asked:
            end_process("interrupted again, stopped at once")
        self.asked = True
        self._note("interrupted: finishing with the best state so far; Ctrl-C again stops at once")


def end_process(text: str) -> None:
    """Print one sentence and end the process, whatever is being imported or computed."""
    remove_unfinished()
    with suppress(RuntimeError, OSError):  # the signal may arrive while something else is being printed
        sys.stdout.flush()
    shown = "\r\x1b[2K\x1b[?25h" if sys.stderr.isatty() else ""  # over the progress bar, which hides the cursor
    os.write(2, f"{shown}error: {text}.\n".encode())
    os._exit(EXIT_INTERRUPTED)


interrupts = Interrupts()
