"""Does a change make calibrations worse? Every verb on every kind of measurement, against recorded results.

    python benchmarks/guard.py --arms 1 --jobs 2 --against benchmarks/baselines/guard.json  # one arm of each kind
    python benchmarks/guard.py --jobs 2 --baseline new.json                        # measure and write
    python benchmarks/guard.py --jobs 2 --against benchmarks/baselines/guard.json  # and judge: exit code 1
    python benchmarks/guard.py --read new.json --against benchmarks/baselines/guard.json  # judge what was measured

Simulated robots of every kind (`guard_kinds.py`, `guard_cameras.py`, three arms each), measured robots and tables with
wrong rows (`guard_tables.py`). `guard_verbs.py` defines the fields. A case is a verb on a table, over arms, splits or
draws. Judged are

- errors (`error`, `true`; geometric mean over arms): none more than 5 % worse, their geometric mean over all not worse;
- shares in 95 % regions (`new`, `inside`; mean): 0.90 to 0.99, or not farther from that than before, within 0.01;
- the factor between expected and true error (`said`; geometric mean over arms): at most 1.5 times as large as before;
- false alarms of a verb (`alarms`): not more; faults that it names (`named`): not fewer;
- processor time of a verb, in units of a fixed work that is timed beside it: at most 1.1 times that of the
  baseline, if that is 10 s or more.

Whatever is better is recorded by writing a new baseline. The package is called by its public names alone.
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
import re
from collections.abc import Iterator, Sequence
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
QUICK = (("simulated", "heights", 1), ("simulated", "positions", 1))
FIELDS = ("rows", "error", "true", "new", "inside", "said", "alarms", "named", "expected", "distance")
FIELDS += ("seconds", "reference", "note")
COVERAGE = 0.90, 0.99
"""Range of shares in 95 % regions."""
SHORTEST = 10.0
"""Seconds of a verb from which its time is judged."""
Job = tuple[Any, ...]
"""Name of a function below or in guard_tables.py, and its arguments."""


def jobs(quick: bool, data: Path | None, arms: int = len(ARMS)) -> list[Job]:
    """What is measured: one arm of everything, tables of measured robots, then the other arms."""
    if quick:
        return list(QUICK)
    T, found = guard_tables, list[Job]()
    for arm in ARMS[:arms]:
        found += [("simulated", kind, arm) for kind in KINDS]
        found += [("contaminated", arm, share, size) for size in T.SIZES_MM for share in T.SHARES]
        if arm == ARMS[0] and data is not None:
            found += [("again", name, rows, data) for rows in T.AGAIN_SIZES for name in T.SERIES]
            found += [("calibrated", "UR10 D", rows, split, data) for split in range(T.SPLITS) for rows in T.SIZES]
            found += [("calibrated", "UR10 D", T.ALL_ROWS, split, data) for split in range(T.ALL_SPLITS)]
            found += [("calibrated", "UR10 A", 60, split, data) for split in range(T.SPLITS)]
            found += [("calibrated", "Franka", 0, split, data) for split in range(T.SPLITS)]
            found += [
                ("left_out", name, place, data) for name, (_, places) in T.SOCKETS.items() for place in range(places)
            ]
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
    work = [
        job
        for job in jobs(plan.quick, Path(data) if data else None, plan.arms)
        if re.search(plan.only, " ".join(map(str, job)))
    ]
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
    """Factors on errors of a case, on the geometric mean of all, on how far the expected error is from the true one,
    and on the time of a verb; slack of shares.
    """

    case: float = 1.05
    mean: float = 1.002
    said: float = 1.5
    share: float = 0.01
    time: float = 1.1


def both(now: dict[str, list[Any]], before: dict[str, list[Any]], name: str) -> list[tuple[Any, Any]]:
    """Values of a field now and before, of the arms that were measured now and have a number in the baseline."""
    was = dict(zip(before["arm"], before.get(name, []), strict=False))
    values = zip(now["arm"], now.get(name, [None] * len(now["arm"])), strict=True)
    return [(value, was[arm]) for arm, value in values if was.get(arm) is not None]


def outside(share: float) -> float:
    """How far a share is from the range."""
    return max(COVERAGE[0] - share, share - COVERAGE[1], 0.0)


def geometric(values: Sequence[float]) -> float:
    """Their geometric mean."""
    return exp(sum(map(log, values)) / len(values))


def of_case(where: str, pairs: dict[str, list[tuple[Any, Any]]], allowed: Tolerance) -> tuple[list[float], list[str]]:
    """Ratios of errors of a case, and sentences about what is worse."""
    ratios, worse = [], []
    for name in ("error", "true", "new", "inside", "said"):
        values = pairs[name]
        if any(now is None for now, _ in values):
            worse.append(f"{where}: no {name} any more")
        elif values and name in ("error", "true"):
            now, was = map(geometric, zip(*values, strict=True))
            ratios.append(now / was)
            if now > allowed.case * was:
                worse.append(f"{where}: {name} {was:.4g} -> {now:.4g}, {100 * (now / was - 1):+.1f} %")
        elif values and name == "said":
            now, was = (geometric([max(one, 1.0 / one) for one in each]) for each in zip(*values, strict=True))
            if now > allowed.said * was:
                worse.append(f"{where}: expected and true error are a factor {now:.3g} apart, {was:.3g} before")
        elif values:
            now, was = (sum(each) / len(each) for each in zip(*values, strict=True))
            if outside(now) > outside(was) + allowed.share:
                worse.append(f"{where}: {name} {was:.3f} -> {now:.3f}, not in {COVERAGE}")
    return ratios, worse


def judged(found: Cases, old: Cases, allowed: Tolerance) -> tuple[list[Record], list[str]]:
    """A row for every verb and one for all, and sentences about what is worse."""
    rows, worse, every = [], [], list[float]()
    both_times = [
        pair for key, now in found.items() if key in old for pair in both(now, old[key], "reference") if pair[0]
    ]
    speed = sum(was for _, was in both_times) / (sum(now for now, _ in both_times) or 1.0)
    for verb in dict.fromkeys(verb for verb, _ in found):
        ratios, sums = list[float](), {name: list[tuple[Any, Any]]() for name in FIELDS}
        for (name, case), now in found.items():
            before = old.get((name, case))
            if name == verb and before is not None:
                pairs = {field: both(now, before, field) for field in FIELDS}
                own, sentences = of_case(f"{verb}, {case}", pairs, allowed)
                ratios, worse = ratios + own, worse + sentences
                sums = {field: sums[field] + pairs[field] for field in FIELDS}
        rows.append({"verb": verb, **errors_row(ratios), **sums_row(sums, speed)})
        worse += worse_verb(rows[-1], sums, allowed)
        every += ratios
    rows.append({"verb": "all", **errors_row(every)})
    mean = rows[-1].get("mean_ratio", 0.0)
    return rows, worse + [f"the geometric mean of errors: {mean:.4f} times the baseline"] * (mean > allowed.mean)


def errors_row(ratios: list[float]) -> Record:
    """What is printed of errors."""
    known = {"mean_ratio": geometric(ratios), "worst_ratio": max(ratios), "best_ratio": min(ratios)} if ratios else {}
    return {"errors": len(ratios), **known}


def sums_row(sums: dict[str, list[tuple[Any, Any]]], speed: float) -> Record:
    """What is printed of expected errors, counts and times; ``speed`` of the processor, in units of the earlier one."""
    row: Record = {}
    said = [pair for pair in sums["said"] if pair[0]]
    if said:
        row["said_over_true"], row["before"] = map(geometric, zip(*said, strict=True))
    for name in ("alarms", "named"):
        if sums[name]:
            now, was = (sum(value or 0 for value in each) for each in zip(*sums[name], strict=True))
            row[name] = f"{now} ({was})"
    if sums["seconds"]:
        now, was = (sum(value or 0.0 for value in each) for each in zip(*sums["seconds"], strict=True))
        row |= {"seconds": now, "seconds_before": was, "time_ratio": speed * now / was}
    return row


def worse_verb(row: Record, sums: dict[str, list[tuple[Any, Any]]], allowed: Tolerance) -> list[str]:
    """Sentences about a verb as a whole."""
    worse, verb = [], row["verb"]
    if row.get("time_ratio", 0.0) > allowed.time and row["seconds_before"] > SHORTEST:
        worse.append(f"{verb}: {row['time_ratio']:.2f} times the processor time of the baseline")
    for name, sign in (("alarms", 1), ("named", -1)):
        more = sum(sign * ((now or 0) - was) for now, was in sums[name])
        if more > 0:
            worse.append(
                f"{verb}: {more} {'more false alarms' if sign > 0 else 'fewer faults named'} than the baseline"
            )
    return worse


COLUMNS = ("verb", "errors", "mean_ratio", "worst_ratio", "best_ratio", "said_over_true", "before", "alarms", "named")
COLUMNS += ("seconds", "seconds_before", "time_ratio")


def arguments(given: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="two kinds, one arm: less than a minute")
    parser.add_argument(
        "--arms", type=harness.count, default=len(ARMS), metavar="N", help="simulated arms of each kind"
    )
    parser.add_argument("--jobs", type=harness.count, default=1, metavar="N", help="processes")
    parser.add_argument("--only", default="", metavar="REGEX", help="jobs whose words match")
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
