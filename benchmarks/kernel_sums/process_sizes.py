"""One posterior of many rows, dense, on the processor and on a GPU; and the sums of one field by the lazy backends.

    python benchmarks/kernel_sums/process_sizes.py --out process_sizes.json

Rows are positions of one marker on the simulated arm (6 joints, 150 unknowns), float64. `covariance` fills the matrix
of M numbers by the fields, `given` factorises it with the noise and the unknowns, `expected` predicts 100 further rows.
`field` is one Gaussian sum over N points in three dimensions. `seconds` is the wall time of the second call.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import time
from collections.abc import Callable, Iterator

import harness
import torch
from harness import Record

import diffeo_calib as dc
from diffeo_calib.kernels.spaces import Space
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.deformation import ModelSpec
from diffeo_calib.maps.linearisation import Linearisation, NodeSensitivity, Numbers
from diffeo_calib.process.scales import SCALES, Hyperparameters
from diffeo_calib.regression.conditional import BeforeData
from diffeo_calib.robots import Geometry, SimulatedArm

ROWS, QUICK_ROWS, NEW = (1000, 2000, 4000, 8000), (200,), 100
POINTS, QUICK_POINTS = (1 << 14, 1 << 16, 1 << 18, 1 << 20), (1 << 10,)
LARGEST_ON_CPU = 4000, 1 << 18
NOISE_M = 2e-5


def seconds(call: Callable[[], object], device: str) -> float:
    """Wall time of the second of two calls."""
    for _ in range(2):
        begin = time.perf_counter()
        call()
        if device != "cpu":
            torch.cuda.synchronize()
    return time.perf_counter() - begin


def rows(arm: SimulatedArm, count: int, seed: int, scales: Hyperparameters) -> Numbers:
    """Numbers of ``count`` random configurations around the nominal arm."""
    nominal, device = GeometryMap(Geometry.nominal(arm.nominal), elastic=True), scales.sensor_noise.device
    q, theta = arm.sample(count, seed), torch.zeros(nominal.parameters, dtype=torch.float64)
    points, variance = nominal(q, theta), scales.prior_variance(nominal)
    target = torch.randn(points.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 1e-4
    kernels = scales.joint_kernel(Space(arm.nominal.periodic)), scales.task_kernel()
    joint = NodeSensitivity(1.0, q.to(device), nominal.jacobian(q, theta).to(device))
    task = NodeSensitivity(1.0, points.to(device), torch.eye(3, dtype=torch.float64, device=device).expand(count, 3, 3))
    spec, S = ModelSpec(nominal, *kernels, variance, 3), nominal.sensitivities(q, theta).to(device)
    return Numbers.of(Linearisation(spec, [joint], [task], S), target.to(device))


def conditioned(count: int, device: str, scales: Hyperparameters) -> Iterator[Record]:
    """Covariance, conditioning and prediction of one size."""
    arm = SimulatedArm(seed=1)
    known, new = rows(arm, count, 1, scales), rows(arm, NEW, 2, scales).at
    noise = NOISE_M**2 * torch.eye(3, dtype=torch.float64, device=device).expand(count, 3, 3)
    prior = BeforeData(known.at.spec.prior_variance.sqrt().to(device))
    at = prior.features(known.at)
    process = prior.given(known, noise, at)
    size = {"device": device, "numbers": 3 * count}
    yield {"what": "covariance", **size, "seconds": seconds(known.at.fields.gram, device)}
    yield {"what": "given", **size, "seconds": seconds(lambda: prior.given(known, noise, at), device)}
    yield {"what": "expected", **size, "seconds": seconds(lambda: process.covariance_between(new), device)}


def measure(quick: bool) -> Iterator[Record]:
    """All sizes on all devices that are there."""
    arm = SimulatedArm(seed=1)
    result = dc.calibrate(arm.nominal, dc.Measurements(*arm.measure(40, seed=0)))
    scales = result.selection.scales
    devices = ["cpu", *["cuda"] * torch.cuda.is_available()]
    for device in devices:
        own = {name: getattr(scales, name).to(device) for name in SCALES}
        there = Hyperparameters(**own)
        for count in QUICK_ROWS if quick else ROWS:
            if device != "cpu" or count <= LARGEST_ON_CPU[0]:
                yield from conditioned(count, device, there)
    generator = torch.Generator().manual_seed(0)
    for count in QUICK_POINTS if quick else POINTS:
        points, momenta = (torch.rand(count, 3, generator=generator, dtype=torch.float64) for _ in range(2))
        for device in devices:
            if device == "cpu" and count > LARGEST_ON_CPU[1]:
                continue
            x, a = points.to(device), momenta.to(device)
            for backend in ("auto", "tiled", *["keops"] * (device != "cpu")):
                kernel = dc.Gaussian(0.5).to(x.device).using(backend)
                taken = seconds(lambda kernel=kernel, x=x, a=a: kernel.field(None, x, a), device)
                yield {"what": f"field, {backend}", "device": device, "numbers": count, "seconds": taken}


if __name__ == "__main__":
    harness.run(__doc__, lambda plan: measure(plan.quick))
