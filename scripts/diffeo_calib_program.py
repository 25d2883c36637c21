"""The program `diffeo-calib`. The package takes a second to import: Ctrl-C is taken over before."""

from __future__ import annotations

import os
import signal

EXIT_INTERRUPTED = 130


def main() -> None:
    """Run the command line."""
    signal.signal(signal.SIGINT, _stop)
    from diffeo_calib.cli.main import main as run  # noqa: PLC0415

    run()


def _stop(*_: object) -> None:
    os.write(2, b"error: interrupted before there was a result to keep.\n")
    os._exit(EXIT_INTERRUPTED)
