"""Does a change make calibrations worse? Every verb on every kind of measurement, against recorded results.

    python benchmarks/guard.py --jobs 2 --baseline new.json                        # measure and write
    python benchmarks/guard.py --jobs 2 --against benchmarks/baselines/guard.json  # and judge: exit code 1
    python benchmarks/guard.py --read new.json --against benchmarks/baselines/guard.json  # judge what was measured

Simulated robots of every kind (`guard_kinds.py`, `guard_cameras.py`, three arms each), measured robots and tables with
wrong rows (`guard_tables.py`). `guard_verbs.py` defines the fields. A case is a verb on a table, over arms, splits or
draws. Judged are: no error (`error`, `true`; geometric mean over arms) more than 5 % worse; the geometric mean of all
errors of a verb not worse; shares in 95 % regions (`new`, `inside`; mean) within 0.90 to 0.99, or not farther from that
than before; no more false alarms of a verb (`alarms`), no fewer faults named (`named`); processor time of a verb, in
units of a fixed work that is timed beside it, at most 1.1 times that of the baseline. Whatever is better is recorded by
writing a new baseline.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before torch
REPOSITORY = Path(__file__).parents[1]
for _folder in ("benchmarks/robustness", "benchmarks/real_robots", "tests/banks", "scripts/examples"):
    sys.path.append(str(REPOSITORY / _folder))

import argparse
import json
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from math import exp, log
from multiprocessing import get_context
from typing import Any

import guard_cameras
import guard_kinds
import guard_tables
import guard_verbs
import harness
import torch
from guard_verbs import Record
from rich.progress import track
from robot_data import VARIABLE

KINDS = {**guard_kinds.KINDS, **guard_cameras.KINDS}
ARMS = (1, 2, 3)
QUICK = (("simulated", "positions", 1), ("simulated", "heights", 1))
FIELDS = ("error", "true", "new", "inside", "said", "alarms", "named", "expected", "seconds", "reference", "note")
WORSE, COVERAGE, SLACK, TIME = 1.05, (0.90, 0.99), 0.01, 1.1
"""Factor on an error; range of shares, and what they may be farther from it by chance; factor on a verb's time."""
Job = tuple[Any, ...]
"""Name of a function below or in guard_tables.py, and its arguments."""


def jobs(quick: bool, data: Path | None) -> list[Job]:
    """What is measured, long work first."""
    if quick:
        return list(QUICK)
    found: list[Job] = []
    if data is not None:
        T = guard_tables
        found += [("again", name, data) for name in T.SERIES]
        found += [("calibrated", "UR10 D", T.ALL_ROWS, split, data) for split in range(T.ALL_SPLITS)]
        found += [("left_out", name, place, data) for name, (_, count) in T.SOCKETS.items() for place in range(count)]
    found += [("simulated", kind, arm) for arm in ARMS for kind in reversed(KINDS)]
    found += [
        ("contaminated", arm, share, size)
        for size in guard_tables.SIZES_MM
        for share in guard_tables.SHARES
        for arm in ARMS
    ]
    if data is not None:
        found += [("calibrated", "UR10 D", rows, split, data) for rows in T.SIZES for split in range(T.SPLITS)]
        found += [("calibrated", "UR10 A", 60, split, data) for split in range(T.SPLITS)]
        found += [("calibrated", "Franka", 0, split, data) for split in range(T.SPLITS)]
    return found


def simulated(kind: str, arm: int) -> Iterator[Record]:
    """Every verb on one robot of a kind."""
    yield from guard_verbs.records(kind, KINDS[kind](arm), arm)


def measured(job: Job) -> list[Record]:
    """The records of a job; one that says why it failed."""
    torch.set_num_threads(1)
    name, *given = job
    found: list[Record] = []
    try:
        found += (simulated if name == "simulated" else getattr(guard_tables, name))(*given)
    except Exception as error:  # the others are still measured
        words = [str(one) for one in given if not isinstance(one, Path)]
        found.append({"verb": name, "case": ", ".join(words), "arm": 0, "note": f"{type(error).__name__}: {error}"})
    return found


def measure(plan: argparse.Namespace) -> list[Record]:
    """All records, in the order of the jobs."""
    data = os.environ.get(VARIABLE)
    if not data and not plan.quick:
        print(f"measured robots are left out: {VARIABLE} names no folder", file=sys.stderr)
    work = [job for job in jobs(plan.quick, Path(data) if data else None) if plan.only in " ".join(map(str, job))]
    if plan.jobs == 1:
        return [record for job in track(work, "measuring", transient=True) for record in measured(job)]
    found: list[Record] = []
    with ProcessPoolExecutor(plan.jobs, get_context("spawn")) as pool:
        futures = [pool.submit(measured, job) for job in work]
        for future in track(as_completed(futures), "measuring", total=len(work), transient=True):
            found += future.result()
            if plan.baseline:  # a later failure loses no measurement
                write(plan.baseline, cases(found))
    return found


# --- files -----------------------------------------------------------------------------------------------------------

Cases = dict[tuple[str, str], dict[str, list[Any]]]
"""Verb and case -> name of every field -> its values, one for each entry of "arm"."""


def cases(records: list[Record]) -> Cases:
    """Records by case, in order; the last one of each arm counts."""
    found: Cases = {}
    last = {(record["verb"], record["case"], record["arm"]): record for record in records}
    for _, record in sorted(last.items()):
        own = found.setdefault((record["verb"], record["case"]), {})
        for name in ("arm", *FIELDS):
            own.setdefault(name, []).append(rounded(record.get(name)))
    for own in found.values():
        for name in [name for name, values in own.items() if all(value is None for value in values)]:
            del own[name]
    return found


def rounded(value: Any) -> Any:
    """Four significant digits."""
    return float(f"{value:.4g}") if isinstance(value, float) else value


def write(path: Path, found: Cases) -> None:
    """A line for every case."""
    head = {"machine": harness.machine(), "versions": harness.versions(), "commit": harness.commit(), "arms": ARMS}
    lines = [json.dumps({"verb": verb, "case": case, **own}) for (verb, case), own in found.items()]
    text = json.dumps(head)[:-1] + ', "cases": [\n' + ",\n".join(lines) + "\n]}\n"
    path.write_text(text, encoding="utf-8")


def read(*paths: Path) -> list[Record]:
    """Records of files, see :func:`write`."""
    found: list[Record] = []
    for path in paths:
        for own in json.loads(path.read_text(encoding="utf-8"))["cases"]:
            head, fields = {name: own.pop(name) for name in ("verb", "case")}, list(own)
            found += [head | dict(zip(fields, values, strict=True)) for values in zip(*own.values(), strict=True)]
    return found


# --- judgement -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tolerance:
    """Factors on errors of a case, on their mean over a verb and on the time of a verb; slack of shares."""

    case: float = WORSE
    mean: float = 1.001
    share: float = SLACK
    time: float = TIME


def both(own: dict[str, list[Any]], old: dict[str, list[Any]], name: str) -> list[tuple[Any, Any]]:
    """Values of a field now and before, of the arms that the baseline has a number for."""
    before = dict(zip(old["arm"], old.get(name, []), strict=False))
    now = dict(zip(own["arm"], own.get(name, [None] * len(own["arm"])), strict=True))
    return [(now[arm], before[arm]) for arm in now if before.get(arm) is not None]


def outside(share: float) -> float:
    """How far a share is from the range."""
    return max(COVERAGE[0] - share, share - COVERAGE[1], 0.0)


def geometric(values: list[float]) -> float:
    """Their geometric mean."""
    return exp(sum(map(log, values)) / len(values))


def judged(found: Cases, old: Cases, allowed: Tolerance) -> tuple[list[Record], list[str]]:
    """A row for every verb, and sentences about what is worse."""
    rows, worse = [], []
    for verb in dict.fromkeys(verb for verb, _ in found):
        mine = {case: own for (name, case), own in found.items() if name == verb}
        ratios, seconds, said = [], [], []
        counts = {"alarms": [0, 0], "named": [0, 0]}
        for case, own in mine.items():
            before = old.get((verb, case))
            if before is None:
                continue
            where = f"{verb}, {case}"
            for name in ("error", "true", "new", "inside"):
                pairs = both(own, before, name)
                if any(now is None for now, _ in pairs):
                    notes = [note for note in own.get("note", []) if note]
                    worse.append(f"{where}: no {name} any more: {notes[:1]}")
                elif pairs and name in ("error", "true"):
                    now, was = (geometric(list(each)) for each in zip(*pairs, strict=True))
                    ratios.append(now / was)
                    if now > allowed.case * was:
                        worse.append(f"{where}: {name} {was:.4g} -> {now:.4g}, {100 * (now / was - 1):+.1f} %")
                elif pairs:
                    now, was = (sum(each) / len(each) for each in zip(*pairs, strict=True))
                    if outside(now) > outside(was) + allowed.share:
                        worse.append(f"{where}: {name} {was:.3f} -> {now:.3f}, not in {COVERAGE}")
            seconds += [
                (*one, *two)
                for one, two in zip(both(own, before, "seconds"), both(own, before, "reference"), strict=True)
            ]
            said += both(own, before, "said")
            for name, total in counts.items():
                for now, was in both(own, before, name):
                    total[0] += now or 0
                    total[1] += was
        rows.append(of_verb(verb, ratios, seconds, said, counts))
        worse += worse_verb(rows[-1], allowed)
    return rows, worse


def of_verb(
    verb: str, ratios: list[float], seconds: list[Any], said: list[Any], counts: dict[str, list[int]]
) -> Record:
    """What is printed of a verb."""
    row: Record = {"verb": verb, "errors": len(ratios)}
    if ratios:
        row |= {"mean_ratio": geometric(ratios), "worst_ratio": max(ratios), "best_ratio": min(ratios)}
    some = [(now, was) for now, was in said if now]
    if some:
        row |= {"said_over_true": geometric([now for now, _ in some]), "before": geometric([was for _, was in some])}
    row |= {name: f"{now} ({was})" for name, (now, was) in counts.items() if now or was}
    row |= {f"{name}_counts": each for name, each in counts.items()}
    timed = [each for each in seconds if all(each)]
    if timed:
        now, was, reference, earlier = (sum(each) for each in zip(*timed, strict=True))
        row |= {"seconds": now, "seconds_before": was, "time_ratio": now / reference / (was / earlier)}
    return row


def worse_verb(row: Record, allowed: Tolerance) -> list[str]:
    """Sentences about a verb as a whole."""
    found, verb = [], row["verb"]
    if row.get("mean_ratio", 0.0) > allowed.mean:
        found.append(f"{verb}: the geometric mean of errors is {row['mean_ratio']:.4f} times that of the baseline")
    if row.get("time_ratio", 0.0) > allowed.time:
        found.append(f"{verb}: {row['time_ratio']:.2f} times the processor time of the baseline")
    (alarms, before), (named, known) = row["alarms_counts"], row["named_counts"]
    if alarms > before:
        found.append(f"{verb}: {alarms} false alarms, {before} in the baseline")
    if named < known:
        found.append(f"{verb}: {named} faults named, {known} in the baseline")
    return found


COLUMNS = ("verb", "errors", "mean_ratio", "worst_ratio", "best_ratio", "said_over_true", "before", "alarms", "named")
COLUMNS += ("seconds", "seconds_before", "time_ratio")


def arguments(given: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="two kinds, one arm: less than a minute")
    parser.add_argument("--jobs", type=harness.count, default=1, metavar="N", help="processes")
    parser.add_argument("--only", default="", metavar="TEXT", help="jobs whose words hold this text")
    parser.add_argument("--baseline", type=Path, metavar="FILE.json", help="write what was measured")
    parser.add_argument("--against", type=Path, metavar="FILE.json", help="judge by this baseline")
    parser.add_argument(
        "--read", type=Path, nargs="+", metavar="FILE.json", help="take what these files hold and measure nothing"
    )
    return parser.parse_args(given)


def run(plan: argparse.Namespace) -> int:
    """Measure, write, judge: the exit code."""
    found = cases(read(*plan.read) if plan.read else measure(plan))
    if plan.baseline:
        write(plan.baseline, found)
    console = harness.Console(width=harness.WIDTH)
    for (verb, case), own in found.items():
        for note in {note for note in own.get("note", []) if note}:
            console.print(f"{verb}, {case}: {note}", markup=False)
    if not plan.against:
        return 0
    rows, worse = judged(found, cases(read(plan.against)), Tolerance())
    console.print(harness.table(rows, COLUMNS))
    for sentence in worse:
        console.print(f"worse: {sentence}", markup=False)
    console.print(f"{len(worse)} worse" if worse else "nothing is worse")
    return int(bool(worse))


if __name__ == "__main__":
    sys.exit(run(arguments()))
