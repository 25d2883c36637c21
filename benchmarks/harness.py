"""Shared by all benchmark programs: arguments, provenance, timing, the table and the JSON file.

A benchmark is a program `python benchmarks/ROOM/NAME.py [--quick] [--out FILE.json]` that measures flat records and
ends with `run(__doc__, measure, columns)`. The file contains `{"machine": ..., "versions": ..., "commit": ...,
"records": [...]}`, but no host name and no path.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track
from rich.table import Table

from diffeo_calib.common.errors import DiffeoCalibError, InputError

Value = str | float | int | bool | None
Record = dict[str, Value]

PACKAGES = ("torch", "numpy", "pykeops", "jax", "diffrax", "scipy", "scikit-learn", "diffeo_calib")
WIDTH = 180  # of the table if the output is not a terminal


def parser(description: str | None) -> argparse.ArgumentParser:
    """Return the parser of `--quick` and `--out`, to which a benchmark may add its own options."""
    summary = (description or "").strip().partition("\n")[0]
    arguments = argparse.ArgumentParser(description=summary)
    arguments.add_argument("--quick", action="store_true", help="the smallest case only, as a check")
    arguments.add_argument("--out", type=Path, metavar="FILE.json", help="write the records to this file")
    return arguments


def count(text: str) -> int:
    """Read a number of at least one from the command line."""
    value = int(text)
    if value < 1:
        raise ValueError(text)
    return value


Option = Mapping[str, object]
"""Keyword arguments of :meth:`argparse.ArgumentParser.add_argument`."""
DATA: Option = {"type": Path, "metavar": "FOLDER", "help": "folder of data sets; default: $DIFFEO_CALIB_DATA"}


def number(default: int | None, text: str | None = None) -> Option:
    """Describe an option with one number, of at least one."""
    return {"type": count, "default": default, "metavar": "N", "help": text}


def numbers(default: Sequence[int], text: str | None = None) -> Option:
    """Describe an option with several numbers."""
    return {**number(None, text), "nargs": "+", "default": list(default)}


def names(choices: Iterable[str], default: Iterable[str] | None = None, text: str | None = None) -> Option:
    """Describe an option with several of some names, by default all of them."""
    every = list(choices)
    chosen = every if default is None else list(default)
    return {"nargs": "+", "choices": every, "default": chosen, "metavar": "NAME", "help": text or ", ".join(every)}


def run(
    description: str | None,
    measure: Callable[[argparse.Namespace], Iterable[Record]],
    columns: Sequence[str] = (),
    *,
    quick: Mapping[str, object] | None = None,
    **options: Option,
) -> None:
    """Run a benchmark: parse the arguments, measure, report.

    Args:
        description: the program's docstring; its first line is the help text.
        measure: called with the arguments; yields the records.
        columns: fields of the records to print; by default all of the first record.
        quick: values of the options with `--quick`.
        options: by their names, with underscores.
    """
    arguments = parser(description)
    for name, option in options.items():
        arguments.add_argument(f"--{name.replace('_', '-')}", **option)  # pyright: ignore[reportArgumentType]
    plan = arguments.parse_args()
    if plan.quick:
        vars(plan).update(quick or {})
    guarded(lambda: report(measure(plan), plan.out, columns))


def report(records: Iterable[Record], out: Path | None, columns: Sequence[str] = ()) -> list[Record]:
    """Collect records and print them as a table; return them.

    The file `out`, if given, is rewritten after every record, so that a later failure loses no measurement.
    """
    if out is not None:
        _check_place(out)  # before hours of work
    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    done: list[Record] = []
    document = {"machine": machine(), "versions": versions(), "commit": commit(), "records": done}
    for record in track(records, "measuring", console=console, transient=True):
        done.append(record)
        if out is not None:
            out.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    console.print(table(done, columns))
    if out is not None:
        console.print(f"wrote {out}")
    return done


def earlier(paths: Sequence[Path], key: Sequence[str]) -> list[Record]:
    """Read the records of earlier measurements; of repeated measurements the last file's counts.

    Args:
        paths: files written by `report`.
        key: fields that identify a measurement.

    Raises:
        InputError: a file that this program did not write.
    """
    records: dict[tuple[object, ...], Record] = {}
    for path in paths:
        try:
            found = json.loads(path.read_text(encoding="utf-8"))["records"]
            known = bool(found) and all(set(key) <= set(record) for record in found)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError.of(f"'{path}' cannot be read as records ({error})") from error
        if not known:
            raise InputError.of(f"'{path}'", expected="records of this program", got="other records, or none")
        records |= {tuple(record[name] for name in key): record for record in found}
    return list(records.values())


def guarded(program: Callable[[], object]) -> None:
    """Run; an error that the user can correct prints one sentence and exits with code 1."""
    try:
        program()
    except DiffeoCalibError as error:
        sys.exit(f"error: {error}")


def _check_place(out: Path) -> None:
    try:
        out.open("a", encoding="utf-8").close()
    except OSError as error:
        raise InputError.of(f"'{out}' cannot be written ({error.strerror})", fix="name another file") from error


def table(records: Sequence[Record], columns: Sequence[str] = ()) -> Table:
    """Lay out records as a table; missing fields stay blank."""
    columns = columns or list(dict.fromkeys(name for record in records for name in record))
    result = Table(*(name.replace("_", "\n") for name in columns), box=SIMPLE_HEAD)
    for record in records:
        result.add_row(*(_cell(record.get(name)) for name in columns))
    return result


def _cell(value: Value) -> str:
    return "" if value is None else f"{value:.5g}" if isinstance(value, float) else str(value)


def interleaved(functions: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, list[float]]:
    """Time functions in turn, so that a slow spell of the machine affects all of them.

    Args:
        functions: what to call, by name. Each is called once before, untimed, to compile and to fill caches.
        repeats: number of timed calls of each.

    Returns:
        `repeats` wall times [s] for every name; take their median.
    """
    for function in functions.values():
        function()
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            _wait()
            begin = time.perf_counter()
            function()
            _wait()
            seconds[name].append(time.perf_counter() - begin)
    return seconds


def _wait() -> None:
    """Wait until the accelerator has finished."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def machine() -> Record:
    """Describe the hardware, without the computer's name."""
    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": torch.get_num_threads(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "gpu": torch.cuda.get_device_name(0) if torch.cuda.is_available() else None,
        "system": f"{platform.system()} {platform.machine()}",
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor()


def versions() -> dict[str, str | None]:
    """Versions of Python and of the relevant packages; null for a package that is not installed."""
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def commit() -> str | None:
    """Return the checked-out commit, or None outside of a repository."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
