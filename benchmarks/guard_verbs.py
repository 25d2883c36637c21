"""What every verb does on a simulated robot, judged by the truth: records of guard.py."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from math import prod
from typing import Any

import torch
from guard_kinds import JOINT, LATER, NEW, TRAIN, WORN, Robot, Rows
from scipy.stats import chi2
from simulated_camera import LEVER
from torch import Tensor

import diffeo_calib as dc

Record = dict[str, Any]
"""verb, case, arm, and where they make sense:

`error` of held-out measurements in the unit of their device (mm, px, mrad), `true` error in mm; `new`, the share of
held-out measurements in their 95 % regions, `inside`, that of true places, `said`, expected over true error; `alarms`,
false ones, `named`, faults that were; `seconds` of the processor, and `reference`, those of a fixed work. Not judged:
`rows` of a calibration, mm that are `expected` after a plan, and the error of a known `distance`.
"""
PLANNED = {"positions": 20, "poses": 15}
"""Kinds whose robot is calibrated with so many planned rows."""
COMPARED = ("positions", "several kinds")
CAMPAIGNS = ("positions", "distances", "images of a board")
CAMPAIGN_ROWS, FAULT_M = 40, 3e-3
TURNS = torch.tensor([[1.0] * 3 + [LEVER] * 3], dtype=torch.float64)


def timed(work: Callable[[], Any]) -> tuple[Any, Record]:
    """The result, the processor's seconds, and those of a fixed work just before, `reference`."""
    reference = fixed_work()
    begin = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return work(), {"seconds": time.process_time() - begin, "reference": reference}


def fixed_work() -> float:
    """Seconds of small matrices, a larger one, and Python."""
    begin = time.process_time()
    A = torch.eye(300, dtype=torch.float64) + 1.0
    for _ in range(5):
        torch.linalg.cholesky(A @ A).exp()
    for _ in range(500):
        torch.add(A[:6, :6] @ A[:6, 6:12], 1.0)
    sum(k * k for k in range(20_000))
    return time.process_time() - begin


def rms(errors: Tensor) -> float:
    """Root mean square of the lengths of errors (..., k), without those that are NaN."""
    seen = errors[~errors.isnan().any(-1)]
    return float(seen.square().sum(-1).mean().sqrt())


def covered(errors: Tensor, covariance: Tensor) -> Tensor:
    """Which errors (..., k) lie in the 95 % regions of covariances (..., k, k), without those that are NaN."""
    seen = ~errors.isnan().any(-1)
    own, C = errors[seen], covariance[seen]
    squares = (own * torch.linalg.solve(C, own[..., None])[..., 0]).sum(-1)
    return squares < float(chi2.ppf(0.95, errors.shape[-1]))


def twists(true: Tensor, found: Tensor) -> Tensor:
    """Shifts [m] and small turns [rad] (..., 6) from found poses (..., 4, 4) to true ones."""
    R = true[..., :3, :3] @ found[..., :3, :3].mT
    turn = 0.5 * torch.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1
    )
    return torch.cat([true[..., :3, 3] - found[..., :3, 3], turn], -1)


def aligned(points: Tensor, onto: Tensor) -> Tensor:
    """Points (N, P, 3) after the rigid motion that brings them closest to others."""
    a, b = points.flatten(0, 1), onto.flatten(0, 1)
    U, _, Vh = torch.linalg.svd((a - a.mean(0)).mT @ (b - b.mean(0)))
    signs = torch.ones(3, dtype=a.dtype)
    signs[2] = torch.linalg.det(U @ Vh)
    return ((a - a.mean(0)) @ (U * signs) @ Vh + b.mean(0)).view_as(points)


def predicted(model: Any, q: Tensor, poses: bool, noise: bool) -> tuple[Tensor, Tensor]:
    """Points (N, P, 3) or poses (N, T, 4, 4), and their covariances."""
    if not poses:
        return model.predict(q, noise=noise)
    mean, covariance = model.predict_poses(q, noise=noise)
    return mean.view(len(q), -1, 4, 4), covariance.view(len(q), -1, 6, 6)


def errors_of(mean: Tensor, true: Tensor) -> Tensor:
    """(N, P, 3) or (N, T, 6)."""
    return true - mean if mean.shape[-1] == 3 else twists(true, mean)


def judged(robot: Robot, model: Any, part: int) -> Record:
    """Errors and regions at true places."""
    model, truth = robot.loaded(model), robot.truth[part](robot.q)
    mean, covariance = predicted(model, robot.q, truth.shape[-1] == 4, noise=False)
    return compared(mean, covariance, aligned(truth, mean) if robot.free else truth)


def compared(mean: Tensor, covariance: Tensor, truth: Tensor) -> Record:
    """Errors and regions of predicted points or poses."""
    errors = errors_of(mean, truth)
    weights = TURNS[0, : errors.shape[-1]]
    expected = (covariance.diagonal(dim1=-2, dim2=-1) * weights**2).sum(-1).mean().sqrt()
    true = rms(errors * weights)
    return {
        "true": 1e3 * true,
        "inside": float(covered(errors, covariance).double().mean()),
        "said": float(expected) / true,
    }


def held_out(robot: Robot, model: Any, rows: Rows) -> Record:
    """Errors, their geometric mean over devices, and regions of measured values."""
    model, errors, inside = robot.loaded(model), [], []
    devices = {own.device: own for own in model.predict_readings(rows.q)}
    for name, values in rows.values.items():
        if name in ("points", "poses"):
            mean, covariance = predicted(model, rows.q, name == "poses", noise=True)
            own, scale = errors_of(mean[:, : values.shape[1]], values), 1e3
            covariance = covariance[:, : values.shape[1]]
        else:
            own, covariance, scale = values - devices[name].mean, devices[name].covariance, 1.0
        errors.append(scale * own * TURNS[0, : own.shape[-1]])
        inside.append(covered(own, covariance))
    if not errors:
        return {}
    return {
        "error": prod(map(rms, errors)) ** (1 / len(errors)),
        "new": float(torch.cat(inside).double().mean()),
    }


# --- verbs -----------------------------------------------------------------------------------------------------------


def records(name: str, robot: Robot, arm: int) -> Iterator[Record]:
    """Every verb on a robot of a kind; what fails is a record with the reason."""
    base: Record = {"case": name, "arm": arm}
    models: list[Any] = []  # calibrated, and recalibrated
    for verb, work in VERBS.items():
        try:
            record = work(name, robot, models)
        except Exception as error:  # the others are still measured
            record = {"note": f"{type(error).__name__}: {error}"}
        if record:
            yield {"verb": verb} | base | record
        if not models:
            return


def _calibrate(name: str, robot: Robot, models: list[Any]) -> Record:
    result, seconds = timed(lambda: dc.calibrate(robot.nominal, robot.rows[TRAIN].table))
    models.append(result.model)
    found = judged(robot, result.model, TRAIN) | held_out(robot, result.model, robot.rows[NEW])
    return seconds | {"rows": len(robot.rows[TRAIN].table)} | found


def _evaluate(name: str, robot: Robot, models: list[Any]) -> Record:
    found, seconds = timed(lambda: dc.evaluate(models[0], robot.rows[NEW].table))
    each = [1e3 * own.rms for own in (found.values() if isinstance(found, Mapping) else [found])]
    return seconds | {"error": prod(each) ** (1 / len(each))}  # of several kinds, each in its unit


def _predict(name: str, robot: Robot, models: list[Any]) -> Record:
    """A tool that was never measured: the flange itself."""
    model = robot.loaded(models[0])
    if robot.flange is None or robot.free:
        return timed(lambda: model.predict(robot.q))[1]
    (mean, covariance), seconds = timed(lambda: model.predict_tool_poses(robot.q, frame="measuring"))
    return seconds | compared(mean[:, None], covariance[:, None], robot.flange[:, None])  # pyright: ignore


def _registered(name: str, robot: Robot, models: list[Any]) -> Record:
    found, seconds = timed(lambda: models[0].registered(robot.rows[LATER].table))
    return seconds | judged(robot, found, LATER)


def _recalibrate(name: str, robot: Robot, models: list[Any]) -> Record:
    found, seconds = timed(lambda: dc.recalibrate(models[0], robot.rows[WORN].table))
    worn = robot.nominal.joint_names[JOINT]
    named = int(any(change.part == worn for change in found.changes.found))
    models.append(found.model)
    return seconds | {"named": named} | judged(robot, found.model, WORN)


def _compare(name: str, robot: Robot, models: list[Any]) -> Record:
    found, seconds = timed(lambda: dc.compare(models[0], robot.rows[LATER].table))
    return seconds | {"alarms": len(found.changes.found)}


def _compare_models(name: str, robot: Robot, models: list[Any]) -> Record:
    """Whether a model of the worn robot is told from the first one by the joint that has worn."""
    if name not in COMPARED:
        return {}
    found, seconds = timed(lambda: dc.compare(*models))
    worn = robot.nominal.joint_names[JOINT]
    return seconds | {"named": int(any(change.part == worn for change in found.changes.found))}


def _plan(name: str, robot: Robot, models: list[Any]) -> Record:
    candidates = robot.rows[TRAIN].q if name == "ball in sockets" else robot.q
    found, seconds = timed(lambda: dc.plan(models[0], candidates, 5))
    record: Record = seconds | {"expected": 1e3 * float(found.expected_rms[-1])}
    if name in PLANNED:
        pool = robot.rows[NEW]
        chosen = dc.plan(robot.nominal, pool.q, PLANNED[name])
        planned, _ = timed(lambda: dc.calibrate(robot.nominal, pool.table.rows(chosen.rows.tolist())))
        record |= judged(robot, planned.model, TRAIN)
    return record


def _campaign(name: str, robot: Robot, models: list[Any]) -> Record:
    """Right rows, and for positions one that is wrong."""
    if name not in CAMPAIGNS:
        return {}
    campaign, rows = dc.Campaign(robot.nominal, target=robot.q[:40]), robot.rows[TRAIN].table
    _, seconds = timed(lambda: campaign.add(rows.rows(list(range(min(len(rows), CAMPAIGN_ROWS))))))
    record: Record = seconds | {"alarms": sum(not own.accepted for own in campaign.verdicts)}
    if name == "positions":
        wrong = robot.rows[NEW].values["points"][:1] + FAULT_M / 3**0.5
        row = dc.Measurements(robot.rows[NEW].q[:1], wrong, robot.nominal.joint_names)
        (verdict,), _ = timed(lambda: campaign.add(row))
        record["named"] = int(not verdict.accepted)
    result, _ = timed(campaign.result)
    found = judged(robot, result.model, TRAIN)
    expected = campaign.expected_error
    return record | found | {"said": None if expected is None else 1e3 * expected / found["true"]}


VERBS: dict[str, Callable[[str, Robot, list[Any]], Record]] = {
    "calibrate": _calibrate,
    "evaluate": _evaluate,
    "predict": _predict,
    "registered": _registered,
    "recalibrate": _recalibrate,
    "compare": _compare,
    "compare models": _compare_models,
    "plan": _plan,
    "campaign": _campaign,
}
