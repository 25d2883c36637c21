"""What the fuzzing programs share: outcomes, the clock against hangs, counts, the command line.

A program defines `case(seed)`, which draws a mutation by the seed alone and returns its name and the work that tries
it. `python benchmarks/robustness/PROGRAM.py --seed 17 --only` repeats case 17 and prints what was found.
"""

from __future__ import annotations

import argparse
import faulthandler
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from types import FrameType

sys.path.insert(0, str(Path(__file__).parents[1]))

from rich.console import Console
from rich.table import Table

from diffeo_calib.common.errors import DiffeoCalibError, DiffeoCalibWarning

LONGEST_CPU_S = 60.0
"""Time of the processor after which a case counts as a hang, whatever else the machine does."""
LONGEST_S = 900.0
LONGEST_SENTENCE = 1500


class Outcome(str, Enum):
    """How a case ended; those in capital letters are defects."""

    right = "accepted, right"
    warned = "accepted, with a warning"
    refused = "refused with one sentence"
    traceback = "TRACEBACK"
    hang = "HANG"
    wrong = "SILENTLY WRONG"

    @property
    def defect(self) -> bool:
        """Whether the package did something that it must not."""
        return self.value.isupper()


@dataclass(frozen=True)
class Finding:
    """One case: its name, how it ended, and the sentence or the traceback."""

    name: str
    outcome: Outcome
    text: str
    seconds: float


class HangError(BaseException):
    """Raised by the clock inside of the work."""


Work = Callable[[], str]
"""Tries a mutation; returns what is wrong with an accepted result, or nothing."""
Case = Callable[[int], tuple[str, Work]]
"""Draws a case: its mutation and its work."""


def is_sentence(text: str) -> bool:
    """Whether a message is one sentence on one line, of a length that can be read."""
    return "\n" not in text and text.endswith((".", "?", "!")) and len(text) <= LONGEST_SENTENCE


@contextmanager
def clock() -> Iterator[None]:
    """Raise HangError inside after a minute of the processor, or a quarter of an hour."""

    def stop(_signal: int, _frame: FrameType | None) -> None:
        raise HangError

    kinds = ((signal.SIGVTALRM, signal.ITIMER_VIRTUAL, LONGEST_CPU_S), (signal.SIGALRM, signal.ITIMER_REAL, LONGEST_S))
    before = {number: signal.signal(number, stop) for number, _, _ in kinds}
    faulthandler.dump_traceback_later(2 * LONGEST_S, exit=True)  # where compiled code hangs, which sees no signal
    try:
        for _, timer, seconds in kinds:
            signal.setitimer(timer, seconds)
        yield
    finally:
        for number, timer, _ in kinds:
            signal.setitimer(timer, 0)
            signal.signal(number, before[number])
        faulthandler.cancel_dump_traceback_later()


def judged(work: Work) -> tuple[Outcome, str]:
    """Try a mutation."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            with clock():
                wrong = work()
        except DiffeoCalibError as error:
            text = str(error)
            return (Outcome.refused, text) if is_sentence(text) else (Outcome.traceback, f"no sentence: {text!r}")
        except HangError:
            return Outcome.hang, "no end"
        except Exception:  # this is what the program looks for
            return Outcome.traceback, traceback.format_exc()
    ours = [str(one.message) for one in caught if issubclass(one.category, DiffeoCalibWarning)]
    strange = [str(one.message) for one in caught if issubclass(one.category, (RuntimeWarning, FutureWarning))]
    if strange:
        return Outcome.traceback, f"a warning of a library: {strange[0]}"
    if ours:
        return Outcome.warned, " | ".join(ours)
    return (Outcome.wrong, wrong) if wrong else (Outcome.right, "")


def findings(program: str, case: Case, seeds: range) -> Iterator[Finding]:
    """Try the cases of these seeds."""
    for seed in seeds:
        mutation, work = case(seed)
        begin = time.perf_counter()
        outcome, text = judged(work)
        yield Finding(f"{program} --seed {seed} ({mutation})", outcome, text, time.perf_counter() - begin)


def defects(program: str, case: Case, seeds: range) -> list[str]:
    """The defects among these cases, for tests: name, kind and last line of each."""
    found = (one for one in findings(program, case, seeds) if one.outcome.defect)
    return [f"{one.name}: {one.outcome.value}: {one.text.strip().splitlines()[-1]}" for one in found]


def run(program: str, case: Case, description: str | None, count: int) -> None:
    """The command line of a fuzzing program; its exit code is 1 if there was a defect."""
    parser = argparse.ArgumentParser(description=(description or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=count, metavar="N", help=f"number of cases, {count} by default")
    parser.add_argument("--seed", type=int, default=0, metavar="K", help="the first case")
    parser.add_argument("--only", action="store_true", help="this case alone, with everything that it says")
    given = parser.parse_args()
    console = Console(width=160, soft_wrap=True, highlight=False, markup=False)
    counts, slowest = Counter[Outcome](), Finding("none", Outcome.right, "", 0.0)
    with suppress(KeyboardInterrupt):  # the counts so far
        for one in findings(program, case, range(given.seed, given.seed + (1 if given.only else given.count))):
            counts[one.outcome] += 1
            slowest = max(slowest, one, key=lambda finding: finding.seconds)
            if one.outcome.defect or given.only:
                console.print(f"{one.outcome.value}: {one.name}\n{one.text}")
    table = Table(title=f"{counts.total()} cases of {program}, from seed {given.seed}")
    for outcome in Outcome:
        table.add_column(outcome.value, justify="right")
    table.add_row(*(str(counts[outcome]) for outcome in Outcome))
    console.print(table)
    console.print(f"longest: {slowest.seconds:.1f} s, {slowest.name}")
    sys.exit(any(counts[outcome] for outcome in Outcome if outcome.defect))
