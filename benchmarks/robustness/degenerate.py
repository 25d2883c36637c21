"""Campaigns that leave something open: are predictions ever confidently wrong, and do the warnings say what is missing?

Every campaign of `campaigns.py` is measured on simulated arms whose truth is known, with one marker, three markers and
poses. The model is asked for rows like those of the campaign and for rows all over the workspace. `worst` is the
largest Mahalanobis distance of a body's error in claimed deviations, expressed as the number of deviations of one
normal variable that is as improbable; `beyond` is the share of rows beyond 4.

    python benchmarks/robustness/degenerate.py [--out FILE.json] [--seeds 1] [--only CAMPAIGN ...]
        [--kinds KIND ...] [--rows N ...]
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import time
import warnings
from functools import partial
from itertools import product

import harness
import torch
from campaigns import CAMPAIGNS, joints
from scipy.stats import chi2, norm
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import DiffeoCalibError, DiffeoCalibWarning
from diffeo_calib.measurements.poses import rotation_numbers
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.se3 import rotation, transforms
from diffeo_calib.robots.simulated_arm import SimulatedArm

KINDS = ("1 marker", "3 markers", "poses")
ROWS = (15, 40, 100)
TESTED = 60
MOST_DEVIATIONS = 4.0
COLUMNS = ("campaign", "kind", "rows", "seed", "near_mm", "near_worst", "near_beyond", "far_mm", "far_claimed_mm")
COLUMNS = (*COLUMNS, "far_worst", "far_beyond", "warned", "seconds")


def arm_of(kind: str, seed: int) -> SimulatedArm:
    """The simulated arm with the markers of a kind of measurement."""
    return SimulatedArm(seed, markers=1 if kind == "1 marker" else 3)


def measured(arm: SimulatedArm, kind: str, q: Tensor, generator: torch.Generator) -> dc.Measurements:
    """What the tracker says, 0.02 mm of noise per coordinate and, for poses, 0.05 mrad."""
    points = arm.true_points(q)
    noise = partial(torch.randn, dtype=torch.float64, generator=generator)
    if kind != "poses":
        return dc.Measurements(q, points + arm.noise * noise(*points.shape), doubt=False)
    tips = torch.stack([rigid_fit(arm.truth.tool, body) for body in points])
    held = transforms(rotation(torch.tensor([0.4, -0.3, 0.8], dtype=torch.float64)), arm.truth.tool[0])
    poses = tips @ held
    turned = rotation(5e-5 * noise(len(q), 3)) @ poses[:, :3, :3]
    return dc.Measurements.from_poses(
        q, transforms(turned, poses[:, :3, 3] + arm.noise * noise(len(q), 3)), doubt=False
    )


def deviations(model: dc.CalibratedKinematics, data: dc.Measurements) -> tuple[Tensor, Tensor, Tensor]:
    """Errors m (N,), claimed m (N,), and each body's distance as deviations of one normal variable (bodies,)."""
    if data.poses is None:
        mean, covariance = model.predict(data.q)
        error = data.points - mean
        freedom = 3
    else:
        mean, covariance = model.predict_poses(data.q)
        turned = data.poses[:, :3, :3] @ mean[:, :3, :3].mT
        error = torch.cat([data.poses[:, :3, 3] - mean[:, :3, 3], rotation_numbers(turned, "rotvec")], 1)[:, None]
        covariance, freedom = covariance[:, None], 6
    squares = (error * torch.linalg.solve(covariance, error[..., None])[..., 0]).sum(-1).flatten()
    distance = torch.from_numpy(norm.isf(chi2.sf(squares.clamp(max=1200).numpy(), freedom) / 2))
    claimed = covariance[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()
    return error[..., :3].norm(dim=-1).flatten(), claimed.flatten(), distance


def record(campaign: str, kind: str, rows: int, seed: int) -> harness.Record:
    """One calibration, its predictions near and far, and its warnings."""
    generator = torch.Generator().manual_seed(1000 * seed + rows)
    arm = arm_of(kind, seed)
    plan = CAMPAIGNS[campaign](arm, rows + TESTED, generator)
    data = measured(arm, kind, plan, generator)
    far = measured(arm, kind, joints(arm, TESTED, generator), generator)
    found: harness.Record = {"campaign": campaign, "kind": kind, "rows": rows, "seed": seed}
    begin = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DiffeoCalibWarning)
        try:
            model = dc.calibrate(arm.nominal, data.rows(slice(0, rows))).model
        except DiffeoCalibError as error:
            return found | {"refused": str(error)}
    found["seconds"] = round(time.perf_counter() - begin, 1)
    for name, rest in (("near", data.rows(slice(rows, None))), ("far", far)):
        error, claimed, distance = deviations(model, rest)
        found[f"{name}_mm"] = 1e3 * float(error.square().mean().sqrt())
        found[f"{name}_claimed_mm"] = 1e3 * float(claimed.square().mean().sqrt())
        found[f"{name}_worst"] = float(distance.max())
        found[f"{name}_beyond"] = float((distance > MOST_DEVIATIONS).double().mean())
    texts = [str(one.message) for one in caught]
    return found | {"warned": len(texts), "warnings": " | ".join(texts)}


def main() -> None:
    """Command line."""
    parser = harness.parser(__doc__)
    parser.add_argument("--seeds", type=harness.count, default=1)
    parser.add_argument("--only", nargs="+", default=list(CAMPAIGNS), choices=list(CAMPAIGNS), metavar="CAMPAIGN")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--rows", nargs="+", type=harness.count, default=list(ROWS))
    given = parser.parse_args()
    cases = product(range(given.seeds), given.only, given.kinds, given.rows)
    if given.quick:
        cases = product((0,), CAMPAIGNS, KINDS[:1], ROWS[:1])
    records = (record(campaign, kind, rows, seed) for seed, campaign, kind, rows in cases)

    def program() -> None:
        harness.report(records, given.out, COLUMNS)

    harness.guarded(program)


if __name__ == "__main__":
    main()
