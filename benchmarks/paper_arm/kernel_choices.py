"""Open questions of the paper, on the RR test bed: which kernel for phi, and how to choose its parameters.

    python benchmarks/paper_arm/kernel_choices.py --out kernels.json

    kernel   the profile of K_V on the torus: Gaussian (von Mises), Matern 3/2, 5/2, 7/2, Cauchy; scales by likelihood
    choice   the criterion for the scales, with the Gaussian profile:
             likelihood     marginal likelihood of the tangent model, by gradients
             leave-one-out  mean square leave-one-out error in closed form, by gradients
             grid search    the same error on a grid of three numbers: length scale, amplitude, noise
             paper          the values of the paper's section 5, for the paper's model only

sample_efficiency.py answers the question how many measurements are needed. Random configurations, noise 1e-4, the
paper's arm. Fields of a record: `question` and `option` as above; `model` is `phi, psi` (the paper's) or
`geometry, phi, psi`; `kind` is its tangent or its flow; `train`, `seed`, `noise`; `rms`, `median`, `max` over 2000
held-out configurations [length units]; `seconds` with the choice of scales; `note` says why a fit failed or did not
converge.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product

import torch
from harness import Record, run
from rr_arm import COORDINATES
from rr_calibrations import Calibrated, calibrate, first_scales, geometric_fit
from rr_methods import GEOMETRY, PAPER_FLOW
from rr_models import Recipe, around, leave_one_out
from sample_efficiency import NOISE, Case, errors
from section_5 import section_5
from torch import Tensor

from diffeo_calib.kernels.profiles import CauchyProfile, GaussianProfile, MaternProfile
from diffeo_calib.kernels.radial import RadialKernel

PROFILES = {
    "Gaussian": GaussianProfile(),
    "Matern 3/2": MaternProfile(1.5),
    "Matern 5/2": MaternProfile(2.5),
    "Matern 7/2": MaternProfile(3.5),
    "Cauchy": CauchyProfile(),
}
MODELS = {"phi, psi": PAPER_FLOW, "geometry, phi, psi": GEOMETRY}
SIZES, SEEDS = (20, 40, 80, 160), 5
GRID_LENGTHS, GRID_AMPLITUDES, GRID_NOISES = (0.5, 0.8, 1.3, 2.0, 3.0), (0.03, 0.1, 0.3, 1.0), (1e-5, 1e-4, 1e-3, 1e-2)
PAPER_NOISE = 0.01

Choice = Callable[[Recipe, Tensor, Tensor, int], Calibrated]


def by_leave_one_out(recipe: Recipe, x: Tensor, y: Tensor, seed: int) -> Calibrated:
    """Scales with the smallest leave-one-out error."""
    return calibrate(recipe, x, y, seed, leave_one_out)


def by_grid(recipe: Recipe, x: Tensor, y: Tensor, seed: int) -> Calibrated:
    """The same on a grid of three scales; all other scales keep their start values."""
    theta = x.new_zeros(recipe.arm.parameters)
    if recipe.geometry:
        theta[:COORDINATES] = geometric_fit(x, y)
    start = first_scales(recipe, theta, x, y)[0]
    names = [name.split(" ")[0] for name, size in recipe.sizes.items() for _ in range(size)]
    data, best, best_value = around(recipe, start, theta, x, y), start, -float("inf")
    lengths = [length for length in GRID_LENGTHS if length <= recipe.longest]
    for length, amplitude, noise in product(lengths, GRID_AMPLITUDES, GRID_NOISES):
        chosen = {"length": length, "amplitude": amplitude, "noise": noise}
        values = [chosen.get(name, float(old.exp())) for name, old in zip(names, start, strict=True)]
        vector = torch.tensor(values, dtype=x.dtype).log()
        value, _ = leave_one_out(data.matrix(recipe, vector), data.target.flatten())
        if value > best_value:
            best, best_value = vector, value
    return Calibrated(recipe, best, data, x, y)


def as_published(recipe: Recipe, x: Tensor, y: Tensor, seed: int) -> Calibrated:
    """The paper's values."""
    vector = recipe.logarithms(**paper_values())
    return Calibrated(recipe, vector, around(recipe, vector, x.new_zeros(0), x, y), x, y)


def paper_values() -> dict[str, float]:
    """Scales of the paper's section 5, from its kernels."""
    spec = section_5(PAPER_NOISE).spec
    joint, task = spec.joint_kernel, spec.task_kernel
    if not isinstance(joint, RadialKernel) or not isinstance(task, RadialKernel):
        raise TypeError("the paper's kernels are radial")
    return {
        "amplitude": float(joint.variance.sqrt()),
        "length": float(joint.lengthscale[0]),
        "task_amplitude": float(task.variance.sqrt()),
        "task_length": float(task.lengthscale),
        "noise": PAPER_NOISE,
    }


CHOICES: dict[str, Choice] = {
    "likelihood": calibrate,
    "leave-one-out": by_leave_one_out,
    "grid search": by_grid,
    "paper": as_published,
}


def measure(quick: bool) -> Iterator[Record]:
    """Yield the records of both questions."""
    for seed in range(1 if quick else SEEDS):
        for size in SIZES[1:2] if quick else SIZES:
            case = Case("samples", size, NOISE, seed)
            for model, recipe in MODELS.items():
                for option, profile in PROFILES.items():
                    record: Record = {"question": "kernel", "option": option, "model": model}
                    yield from attempt(record, calibrate, replace(recipe, profile=profile), case)
                for option, choice in CHOICES.items():
                    if option != "paper" or not recipe.geometry:
                        record = {"question": "choice", "option": option, "model": model}
                        yield from attempt(record, choice, recipe, case)


def attempt(record: Record, choice: Choice, recipe: Recipe, case: Case) -> Iterator[Record]:
    """Calibrate once: a record of the tangent and one of the flow; a failure becomes a record with the reason."""
    x, y = case.measure()
    at = case.test()
    begin = time.perf_counter()
    for kind in ("tangent", "flow"):
        found: Record = record | {"kind": kind, "train": case.train, "seed": case.seed, "noise": case.noise}
        try:
            if kind == "tangent":
                model = choice(recipe, x, y, case.seed)
                predict, note = model.tangent(), None
            else:
                predict, note = model.flow()  # pyright: ignore[reportPossiblyUnboundVariable]
            seconds = time.perf_counter() - begin
            yield found | errors(predict(at) - case.truth(at)) | {"seconds": seconds, "note": note}
        except Exception as error:  # the remaining choices are still measured
            yield found | {"note": f"{type(error).__name__}: {error}"}


if __name__ == "__main__":
    run(__doc__, measure, ("question", "option", "model", "kind", "train", "seed", "rms", "seconds", "note"))
