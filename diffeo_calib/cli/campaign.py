"""A campaign file: the options of `fit` in a TOML file beside the table, so that they are written once.

    csv = "measurements.csv"            robot = "robot.urdf"
    base = "base_link"                  tip = "flange"
    position = ["x,y,z"]                length = "mm"
    angle = "deg"                       output = "robot.safetensors"

`diffeo-calib fit campaign.toml` runs as if the options had been typed. Options that are typed as well win,
also those that may be repeated, such as `--tip`. Paths are relative to the folder of the file.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import IO, Any, NamedTuple, get_args, get_origin

from diffeo_calib.cli.console import EXIT_INTERRUPTED, say, show_error
from diffeo_calib.cli.options import CORNERS
from diffeo_calib.common.errors import InputError, as_written

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

SUFFIX = ".toml"
COMMAND, LIVE = "fit", "campaign"
JOINED = ("rotation-std",)
"""Entries that may be lists of columns although the option can be repeated."""
LONGEST_FILE = 1 << 20
"""Bytes: a file of options is short."""


Known = Mapping[str, Mapping[str, Any]]
"""Command -> name of an option, without dashes, or of an argument -> type of its value."""


def expanded(arguments: Sequence[str], known: Known) -> list[str]:
    """The same command line with a campaign file written out, for `campaign` without what only `fit` knows."""
    words = list(arguments)
    at = next((place for place, word in enumerate(words) if not word.startswith("-")), 0)
    if len(words) < at + 2 or words[at] not in (COMMAND, LIVE) or not words[at + 1].lower().endswith(SUFFIX):
        return words
    path = Path(words[at + 1])
    options = known[words[at]]
    entries = {name: value for name, value in _read(path).items() if name in options or name not in known[COMMAND]}
    unknown = [name for name in entries if name not in options]
    if unknown:
        expected = f"options of `{words[at]}`: {', '.join(options)}"
        raise InputError.of(f"{path}: {', '.join(unknown)}", expected=expected, fix="correct the names")
    if "csv" not in entries:
        raise InputError.of(f"{path} has no entry csv", fix='add csv = "measurements.csv", the table to calibrate with')
    typed = {word.removeprefix("--").partition("=")[0] for word in words[at + 2 :] if word.startswith("--")}
    table = _text(path, "csv", entries.pop("csv"), options["csv"])
    kept = {name: value for name, value in entries.items() if name not in typed}
    written = [word for name, value in kept.items() for word in _words(path, name, value, options[name])]
    return [*words[: at + 1], table, *written, *words[at + 2 :]]


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > LONGEST_FILE:
            raise InputError.of(f"{path}", expected="a file of options", got="more than 1 MiB")
        entries = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        return {name.replace("_", "-"): value for name, value in entries.items()}
    except OSError as error:
        raise InputError.of(f"{path} cannot be read ({error.strerror})", fix="check the path") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError.of(
            f"{path} is no TOML", got=str(error), fix='write one option per line: length = "mm"'
        ) from error


def _words(path: Path, name: str, value: object, hint: Any) -> list[str]:
    """One entry as words of a command line."""
    if isinstance(value, bool):
        return [f"--{name}"] * value
    values = value if isinstance(value, list) else [value]
    if isinstance(value, list) and (name in JOINED or not has(hint, list)):
        values = [",".join(map(str, value))]
    return [word for one in values for word in (f"--{name}", _text(path, name, one, hint))]


def _text(path: Path, name: str, value: object, hint: Any) -> str:
    """A value as a word; files relative to the folder of the campaign."""
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise InputError.of(f"{path}: {name}", expected="text or a number", got=as_written(value))
    begin = CORNERS if str(value).startswith(CORNERS) and str(value).endswith(".yaml") else ""
    file = str(value).removeprefix(begin)
    return f"{begin}{path.parent / file}" if begin or has(hint, Path) else file


def has(hint: Any, part: type) -> bool:
    """Whether a type, or a part of it, is this one."""
    return part in {hint, get_origin(hint)} or any(has(one, part) for one in get_args(hint))


OPTION = "--jobs"
MOST_FAILED = 125
"""Largest exit code that counts: a shell uses those above for itself."""
LOOK_SECONDS = 0.05
"""Time between two looks at the processes."""
OF_ONE_CAMPAIGN = ("-o", "--output", "--figure", "--report", "--json")
"""Options that name a file, which campaigns cannot share."""
OUTPUTS = ("-o", "--output")


class Fleet(NamedTuple):
    """Campaigns to run.

    Args:
        campaigns: their files. options: words that follow all of them. jobs: how many run at a time.
    """

    campaigns: list[str]
    options: list[str]
    jobs: int


def asked(arguments: Sequence[str], known: Known) -> Fleet | None:
    """The campaigns that a command line names; None where it names one command, or one campaign without --jobs."""
    if not arguments or arguments[0] != COMMAND:
        return None
    words, jobs = _without_jobs(list(arguments[1:]))
    campaigns = [word for word in words if word.lower().endswith(SUFFIX) and not word.startswith("-")]
    if jobs is None and len(campaigns) < 2:
        return None
    if not campaigns:
        fix = "write the options of each robot to a file (`diffeo-calib init` proposes one)"
        raise InputError.of(f"{OPTION} runs campaign files", expected="files that end with .toml", fix=fix)
    options = [word for word in words if word not in campaigns]
    shared = [word for word in options if word.partition("=")[0] in OF_ONE_CAMPAIGN]
    if shared:
        what = f"{', '.join(shared)} would name one file for all campaigns"
        raise InputError.of(what, fix="write the entry to each campaign file instead")
    _check_outputs(campaigns, options, known)
    return Fleet(campaigns, options, 1 if jobs is None else jobs)


def _without_jobs(words: list[str]) -> tuple[list[str], int | None]:
    """The words without --jobs N, and N."""
    for k, word in enumerate(words):
        name, equal, value = word.partition("=")
        if name == OPTION:
            text = value if equal else words[k + 1] if k + 1 < len(words) else ""
            if not (text.isascii() and text.isdigit() and int(text) > 0):
                raise InputError.of(OPTION, expected="how many campaigns run at a time, such as 2", got=repr(text))
            return words[:k] + words[k + (1 if equal else 2) :], int(text)
    return words, None


def _check_outputs(campaigns: Sequence[str], options: Sequence[str], known: Known) -> None:
    """Read every campaign before any runs."""
    writers: dict[str, str] = {}
    for campaign in campaigns:
        words = expanded([COMMAND, campaign, *options], known)
        models = [os.path.abspath(after) for word, after in pairwise(words) if word in OUTPUTS]
        for model in models[-1:]:
            if model in writers:
                what = f"{writers[model]} and {campaign} write the same model, {Path(model).name}"
                raise InputError.of(what, fix="name another output in one of them")
            writers[model] = campaign


class _Job:
    """A campaign that runs in a process of its own, out of reach of the terminal's Ctrl-C."""

    def __init__(self, campaign: str, fleet: Fleet) -> None:
        self.campaign, self.begin = campaign, time.monotonic()
        self.output: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  # read when the process has ended
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        threads = str(max(1, cores // fleet.jobs))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "diffeo_calib", COMMAND, campaign, *fleet.options],
            stdin=subprocess.DEVNULL,
            stdout=self.output,
            stderr=subprocess.STDOUT,
            env={"OMP_NUM_THREADS": threads, **os.environ},
            start_new_session=True,
        )

    def report(self) -> str:
        """Its output, under a heading."""
        self.output.seek(0)
        text = self.output.read().decode("utf-8", "replace")
        self.output.close()
        code, seconds = self.process.returncode, time.monotonic() - self.begin
        end = "done" if code == 0 else f"exit code {code}" if code > 0 else f"ended by signal {-code}"
        return f"== {self.campaign}: {end}, {seconds:.0f} s\n{text}"


def run(fleet: Fleet) -> int:
    """Run all campaigns; the exit code of the program."""
    waiting, running, failed = list(fleet.campaigns), list[_Job](), list[str]()
    stops: list[int] = []

    def forward(number: int, _frame: FrameType | None) -> None:
        stops.append(number)
        waiting.clear()
        for job in running:
            if job.process.poll() is None:
                job.process.send_signal(number)

    before = {number: signal.signal(number, forward) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        while waiting or running:
            while waiting and len(running) < fleet.jobs:
                running.append(job := _Job(waiting.pop(0), fleet))
                if stops:  # since it was started
                    job.process.send_signal(stops[-1])
            for job in [job for job in running if job.process.poll() is not None]:
                running.remove(job)
                print(job.report(), flush=True)
                failed += [job.campaign] if job.process.returncode else []
            time.sleep(LOOK_SECONDS)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    count = len(fleet.campaigns)
    if stops:
        show_error("interrupted; campaigns that had begun keep what their output names.")
        return EXIT_INTERRUPTED
    say(f"{count - len(failed)} of {count} campaigns done" + (f"; failed: {', '.join(failed)}" if failed else ""))
    return min(len(failed), MOST_FAILED)
