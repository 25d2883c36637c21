"""Write the outputs that tutorials show anew: python tests/write_documentation.py [PAGE ...]."""

import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / name) for name in ("tests", "tests/banks", "scripts", "benchmarks/robustness", "benchmarks")]

from documentation_bank import with_outputs, write_tables  # noqa: E402

PAGES = [ROOT / f"scripts/docs/pages/tutorials/{name}.md" for name in ("tracker", "block", "year_later")]
"""In an order in which every command finds its files."""


def main(folder: Path) -> None:
    write_tables(folder)

    def output_of(command: str) -> list[str]:
        _, *options = shlex.split(command)
        done = subprocess.run(
            [sys.executable, "-m", "diffeo_calib", *options],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "96"},
            check=False,
        )
        if done.returncode:
            sys.exit(f"{command}\n{done.stdout}")
        return done.stdout.splitlines()

    for page in PAGES:
        page.write_text(with_outputs(page.read_text(encoding="utf-8"), output_of), encoding="utf-8")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        main(Path(made))
