"""Write the golden numbers anew, with tolerances that hold on other processors: `python tests/golden/write.py`.

All cases run once as they are, and again with the arithmetic of other processors (instruction sets, libraries, threads)
and with measured numbers that differ in their last digit. The tolerance of a quantity is ten times the largest
difference, and at least 1e-9. It takes ten minutes on an idle machine.

    python tests/golden/write.py                  everything
    python tests/golden/write.py sockets poses    some cases
    python tests/golden/write.py --keep           new numbers of this machine; tolerances as in the file
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from math import ceil, floor, inf, log10
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
sys.path[:0] = [
    str(REPOSITORY),
    *(str(REPOSITORY / name) for name in ("tests/banks", "benchmarks/real_robots", "benchmarks/robustness")),
]
import golden_file  # noqa: E402

ARITHMETICS: tuple[dict[str, str], ...] = (
    {"ATEN_CPU_CAPABILITY": "default"},
    {"ATEN_CPU_CAPABILITY": "avx2"},
    {"MKL_CBWR": "COMPATIBLE"},
    {"MKL_ENABLE_INSTRUCTIONS": "AVX2"},
    {"MKL_ENABLE_INSTRUCTIONS": "SSE4_2"},
    {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": "AVX512F"},
    {"OMP_NUM_THREADS": "2"},
    {"MKL_CBWR": "COMPATIBLE", "ATEN_CPU_CAPABILITY": "default", "OPENBLAS_CORETYPE": "Sandybridge"},
)
SHAKES = (1, 2, 3)
MARGIN = 10.0
NOTE = (
    "Written by tests/golden/write.py. Tolerances are relative to the norm of each quantity: ten times what it changes "
    "with other arithmetic or in the last digit of the measurements. Those of cases whose scales are searched, and of "
    "rows that wrong starts lead to, are wider: the search amplifies rounding. Long tensors: four entries, four "
    "projections on random directions of length one."
)


def computed(names: list[str], shake: int | None) -> golden_file.Cases:
    from golden_bank import golden

    return {name: {key: golden_file.entry(values) for key, values in golden(name, shake).items()} for name in names}


def elsewhere(names: list[str], environment: dict[str, str], shake: int | None = None) -> golden_file.Cases:
    """The numbers of another process."""
    program = [sys.executable, __file__, *names, "--print", *([] if shake is None else ["--shake", str(shake)])]
    surroundings = {**os.environ, "OMP_NUM_THREADS": "1", **environment}
    done = subprocess.run(program, env=surroundings, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def upwards(value: float) -> float:
    """Rounded up to one digit."""
    unit = 10.0 ** floor(log10(value))
    return float(f"{ceil(value / unit - 1e-9) * unit:.0e}")


def with_tolerances(known: golden_file.Cases, others: dict[str, golden_file.Cases]) -> None:
    """Write ten times the largest difference beside each quantity."""
    for case, quantities in known.items():
        for name, entry in quantities.items():
            each = {how: golden_file.difference(cases[case][name], entry) for how, cases in others.items()}
            largest, how = max((error, how) for how, error in each.items())
            if largest == inf:
                print(f"{case}: {name} is not the same with {how}: no tolerance covers it", file=sys.stderr)
            elif MARGIN * largest > golden_file.SMALLEST_TOLERANCE:
                entry["tolerance"] = upwards(MARGIN * largest)


def with_old_tolerances(known: golden_file.Cases) -> None:
    for case, quantities in golden_file.read().items():
        for name, old in quantities.items():
            if "tolerance" in old and name in known.get(case, {}):
                known[case][name]["tolerance"] = old["tolerance"]


def with_new_tolerances(known: golden_file.Cases) -> None:
    names = list(known)
    others = {"the same again": elsewhere(names, {})}
    for number, environment in enumerate(ARITHMETICS):
        others[str(environment)] = elsewhere(names, environment)
        print(f"{number + 1} of {len(ARITHMETICS) + len(SHAKES)}: {environment}", flush=True)
    others |= {f"shake {seed}": elsewhere(names, {}, seed) for seed in SHAKES}
    with_tolerances(known, others)


def main() -> None:
    from golden_bank import CASES

    parser = argparse.ArgumentParser(description="Write the golden numbers anew.")
    parser.add_argument("names", nargs="*", metavar="CASE", help="some cases; all by default")
    parser.add_argument("--keep", action="store_true", help="keep the tolerances of the file")
    parser.add_argument("--print", action="store_true", help="print the numbers of this process")
    parser.add_argument("--shake", type=int, help="seed of changes of the measured numbers in their last digit")
    given = parser.parse_args()
    names = given.names or list(CASES)
    if given.print:
        print(json.dumps(computed(names, given.shake)))
        return
    known = elsewhere(names, {})
    (with_old_tolerances if given.keep else with_new_tolerances)(known)
    known = {**golden_file.read(), **known}
    golden_file.write({name: known[name] for name in CASES}, NOTE)


if __name__ == "__main__":
    main()
