"""`python -m diffeo_calib`, and the program `diffeo-calib`.

Ctrl-C is handled before anything slow is imported: in the middle of an import it would end in a long traceback. So is
the way in which threads wait, which OpenMP reads when torch is loaded: those that sleep leave the core to others, those
that spin (OpenMP's default) make a calibration on a busy machine many times slower. See diffeo_calib/common/threads.py.
"""

from __future__ import annotations

import os

from diffeo_calib.cli.console import interrupts


def main() -> None:
    """Run the command line."""
    interrupts.install()
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from diffeo_calib.cli.main import main as run  # noqa: PLC0415  # the handler comes first

    run()


if __name__ == "__main__":
    main()
