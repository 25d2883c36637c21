"""`python -m diffeo_calib`, and the program `diffeo-calib`.

Ctrl-C is handled before anything slow is imported: in the middle of an import it would end in a long traceback.
"""

from __future__ import annotations

from diffeo_calib.cli.interrupts import interrupts


def main() -> None:
    """Run the command line."""
    interrupts.install()
    from diffeo_calib.cli.main import main as run  # noqa: PLC0415  # the handler comes first

    run()


if __name__ == "__main__":
    main()
