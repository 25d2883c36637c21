"""The command line: fit, evaluate, predict, correct, export, plan, recalibrate, compare, report, demo.

Exit codes: 0 success; 1 the input or the model file cannot be used (one sentence says why), or `evaluate` found rows
out of step with their joints, or a median error above a tenth of the robot's reach (the errors are printed first): such
numbers say nothing about the robot, and a script must not take them for a result; 2 wrong usage; 3 the fit stopped
before it converged (the model is written); 130 interrupted by Ctrl-C (the best model so far is written).

The modules in declarations/ only declare the commands. Each command imports its work when it runs, so that help, the
version and shell completion load neither torch nor SciPy and appear at once.
"""

from __future__ import annotations

import sys
import warnings

from diffeo_calib.cli.app import app
from diffeo_calib.cli.declarations import (  # noqa: F401  # declared in this order
    calibrate,
    campaign,
    model,
    plan,
    recalibrate,
    report,
    simulate,
)
from diffeo_calib.cli.interrupts import EXIT_INTERRUPTED, interrupts
from diffeo_calib.cli.record import record
from diffeo_calib.cli.streams import forgiving_streams
from diffeo_calib.common.errors import DiffeoCalibError, DiffeoCalibWarning

EXIT_ERROR = 1


def main() -> None:
    """Run the command line; every error of this package becomes one sentence and an exit code."""
    interrupts.install()
    with forgiving_streams(), warnings.catch_warnings():
        warnings.simplefilter("always", DiffeoCalibWarning)
        warnings.showwarning = _show_warning
        try:
            app()
        except DiffeoCalibError as error:
            from diffeo_calib.cli.console import show_error  # noqa: PLC0415

            show_error(error)
            sys.exit(EXIT_ERROR)
        except KeyboardInterrupt:
            sys.exit(EXIT_INTERRUPTED)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Takes the place of :func:`warnings.showwarning`."""
    from diffeo_calib.cli.console import show_warning  # noqa: PLC0415

    record.warn(str(message))
    show_warning(message)
