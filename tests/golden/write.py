"""Golden numbers in a file: long tensors as their norm, some entries and some projections, each with its tolerance.

Errors are relative to the norm of a quantity, since its small entries are as uncertain as its large ones. As a program
it writes the numbers anew. The tolerance of a quantity is ten times what it changes where measured numbers differ in
their last digit, and at least 1e-9.

    python tests/golden/write.py                  everything
    python tests/golden/write.py sockets poses    some cases
    python tests/golden/write.py --keep           new numbers of this machine; tolerances as in the file
"""

import argparse
import json
import sys
import warnings
from collections.abc import Mapping
from math import ceil, floor, inf, log10
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

if __name__ == "__main__":
    FOLDERS = "", "tests/banks", "benchmarks/real_robots", "benchmarks/robustness", "scripts/examples"
    sys.path[:0] = [str(Path(__file__).parents[2] / name) for name in FOLDERS]

import again_bank
from kind_bank import kind_named
from source_bank import SOURCES

import diffeo_calib as dc
from diffeo_calib.measurements.rows import with_attributes
from diffeo_calib.robots import SimulatedArm

NOTE = (
    "Written by tests/golden/write.py. Tolerances are relative to the norm of each quantity. Those of cases whose "
    "scales are searched are wider: the search amplifies rounding. Long tensors: four entries, four projections on "
    "random directions of length one."
)
SHAKES, MARGIN, ROUNDING = (1, 2), 10.0, 2.0**-52
FILE = Path(__file__).with_name("numbers.json")
SMALLEST_TOLERANCE = 1e-9
SOLVED = ("theta, ", "evaluation", "frames of sessions")
"""What follows from the solution of the exact model, which ends at a residual of 1e-5, where rounding lets it end."""
SOLVED_TOLERANCE = 5e-6
HELD_NORM = 1e-7
"""Of parameters that are held at zero: what rounding leaves of them."""
WHOLE, ENTRIES, PROJECTIONS = 12, 4, 4
"""Numbers up to which all of them are kept, and what is kept of more."""
Entry = dict[str, Any]
Cases = dict[str, dict[str, Entry]]


def entry(values: Tensor) -> Entry:
    """What the file keeps of a quantity; NaN counts as 0, and is counted."""
    whole = values.detach().numpy().astype(np.float64).ravel()
    flat, count = np.nan_to_num(whole), int(np.isnan(whole).sum())
    kept = flat if len(flat) <= WHOLE else np.concatenate([_entries(flat), _projections(flat)])
    found: Entry = {"shape": list(values.shape), "norm": _rounded(np.linalg.norm(flat))}
    found["numbers"] = [_rounded(number) for number in kept]
    return {**found, "hidden": count} if count else found


def _entries(flat: np.ndarray) -> np.ndarray:
    return flat[np.linspace(0, len(flat) - 1, ENTRIES).astype(int)]


def _projections(flat: np.ndarray) -> np.ndarray:
    """On random directions of length one."""
    directions = np.random.default_rng(len(flat)).standard_normal((PROJECTIONS, len(flat)))
    return directions @ flat / np.linalg.norm(directions, axis=1)


def _rounded(number: float | np.floating) -> float:
    return float(f"{number:.15g}")


def difference(found: Entry, known: Entry) -> float:
    """Largest difference relative to the norm; infinite for another shape, or where 0 became another number."""
    if any(found.get(name) != known.get(name) for name in ("shape", "hidden")):
        return inf
    ours, theirs = ([one["norm"], *one["numbers"]] for one in (found, known))
    largest = max(abs(a - b) for a, b in zip(ours, theirs, strict=True))
    return largest / known["norm"] if known["norm"] else (inf if largest else 0.0)


def mistakes(found: dict[str, Entry], known: dict[str, Entry]) -> list[str]:
    """A sentence for each quantity that is missing, new or different."""
    lines = [f"{name}: not in the file" for name in found if name not in known]
    lines += [f"{name}: missing" for name in known if name not in found]
    for name in known.keys() & found.keys():
        error = difference(found[name], known[name])
        tolerance = known[name].get("tolerance", SMALLEST_TOLERANCE)
        if name.startswith(SOLVED):
            tolerance = max(tolerance, SOLVED_TOLERANCE)
        held = max(found[name]["norm"], known[name]["norm"]) < HELD_NORM
        if not held and not error <= tolerance:
            lines.append(f"{name}: {error:.2g} of its norm away, tolerance {tolerance:.2g}")
    return sorted(lines)


def read() -> Cases:
    return json.loads(FILE.read_text(encoding="utf-8"))["cases"]


def write(cases: Cases) -> None:
    """One line for each quantity."""
    lines = ["{", f' "note": {json.dumps(NOTE)},', ' "cases": {']
    for number, (name, quantities) in enumerate(cases.items()):
        rows = [f"   {json.dumps(key)}: {json.dumps(value)}" for key, value in quantities.items()]
        end = "" if number == len(cases) - 1 else ","
        lines += [f"  {json.dumps(name)}: {{", ",\n".join(rows), f"  }}{end}"]
    FILE.write_text("\n".join([*lines, " }", "}", ""]), encoding="utf-8")


def upwards(value: float) -> float:
    """Rounded up to one digit."""
    unit = 10.0 ** floor(log10(value))
    return float(f"{ceil(value / unit - 1e-9) * unit:.0e}")


def computed(name: str, shake: int | None = None) -> dict[str, Entry]:
    """All numbers of a case; ``shake``: seed of changes of the measured numbers by their last digit."""
    kind = kind_named(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # few rows
        result: Any = kind.result
        if shake is not None:
            result = dc.calibrate(kind.robot, shaken(kind.data, shake), hyperparameters=kind.scales)
        found = {**numbers(result, kind.data, kind.q(5)), **(used(result) if name == "positions" else {})}
    return {key: entry(values) for key, values in found.items()}


def shaken(rows: Any, seed: int) -> Any:
    """The same measurements, each number in its last digit another one."""
    rng = np.random.default_rng(seed)

    def near(values: Tensor) -> Tensor:
        return values * (1 + ROUNDING * torch.from_numpy(rng.integers(-1, 2, tuple(values.shape))))

    return with_attributes(rows, q=near(rows.q))


def numbers(result: Any, rows: Any, q: Tensor) -> dict[str, Tensor]:
    """What users see of a result, as tensors."""
    mean, covariance = result.model.predict(q, noise=False)
    left_out, scales, geometry = result.leave_one_out, result.selection.scales, result.model.nominal.geometry
    theta = result.fit.solution.momenta.theta
    judged = dc.evaluate(result.model, rows)
    found = {f"theta, {name}": theta[part] for name, part in geometry.slices.items()}
    found |= {"theta, gravity": theta[geometry.size :], "scales": scales.logarithms()}
    for own in result.placement:
        devices = own.devices
        found |= {f"{devices.kind}s": devices.constants, f"{devices.kind}s, deviations": devices.deviations}
    return found | {
        "k1": mean,
        "slope": result.model.jacobian(q),
        "covariance": covariance,
        "noise of new rows": result.model.predict(q, noise=True)[1] - covariance,
        "left out, errors": left_out.errors,
        "left out, squares": left_out.squares,
        "outliers": one(*(number for each in result.outliers for number in (each.row, each.marker or 0))),
        "evaluation": one(*(each.rms for each in (judged.values() if isinstance(judged, Mapping) else [judged]))),
        "expected error": one(result.expected.workspace),
    }


def one(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def used(result: Any) -> dict[str, Tensor]:
    """A model is registered by ten rows and recalibrated by twenty of a device elsewhere; each with its tool."""
    arm, tool = SimulatedArm(seed=1), torch.eye(4, dtype=torch.float64)
    q, tool[2, 3] = arm.sample(5, seed=78), 0.1
    ten, twenty, others = (again_bank.positions(arm, rows, seed) for rows, seed in ((10, 11), (20, 12), (15, 13)))
    model = result.model.with_tool(tool)
    again = dc.recalibrate(model, twenty)
    found = {"recalibrated, transform": again.moved.transform}
    for name, own in (("registered", model.registered(ten)), ("recalibrated", again.model)):
        mean, covariance = own.predict(q, noise=False)
        found |= {f"{name}, k1": mean, f"{name}, covariance": covariance, f"{name}, tool": own.tool_poses(q)}
        found[f"{name}, evaluation"] = one(dc.evaluate(own, others).rms)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description="Write the golden numbers anew.")
    parser.add_argument("names", nargs="*", metavar="CASE", help="some cases; all by default")
    parser.add_argument("--keep", action="store_true", help="keep the tolerances of the file")
    given = parser.parse_args()
    known = read()
    for name in given.names or SOURCES:
        found, old = computed(name), known.get(name, {})
        others = [] if given.keep else [computed(name, seed) for seed in SHAKES]
        for key, own in found.items():
            largest = max((difference(other[key], own) for other in others), default=0.0)
            if given.keep and "tolerance" in old.get(key, {}):
                own["tolerance"] = old[key]["tolerance"]
            elif SMALLEST_TOLERANCE < MARGIN * largest < inf:
                own["tolerance"] = upwards(MARGIN * largest)
        known[name] = found
    write({name: known[name] for name in SOURCES})


if __name__ == "__main__":
    main()
