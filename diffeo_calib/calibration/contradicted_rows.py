"""Rows that a calibrated model contradicts: rows that took no part in its fit, blocks of rows, rows out of step."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import log

import torch
from torch import Tensor

from diffeo_calib.calibration.findings import FALSE_ALARM_PROBABILITY, Outlier, found_outliers
from diffeo_calib.common.errors import sentence, warn_user
from diffeo_calib.common.hidden_values import known
from diffeo_calib.common.quantiles import chi2_above, chi2_median
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import expected_error
from diffeo_calib.kinematics.laden_rows import laden, of_one_payload
from diffeo_calib.kinematics.re_registration.motions import motions
from diffeo_calib.kinematics.row_order import LIMITS as STEP_LIMITS
from diffeo_calib.kinematics.row_order import Step, out_of_step
from diffeo_calib.kinematics.socket_errors import with_markers_of
from diffeo_calib.measurements.pose_frames import by_frame, transforms_of_frames, visible_rotation_numbers
from diffeo_calib.measurements.table import Measurements
from diffeo_calib.sensors.tables import Coordinates


@dataclass(frozen=True)
class BlockLimits:
    """When wrong rows count as a block.

    Args:
        wrong: share of the rows of a block that are wrong.
        fewest_rows: smallest number of wrong rows.
        chance: probability that wrong rows which are spread at random look like a block.
        excess: factor by which an error must exceed what the model's deviations exclude by chance: outside of the
            rows of its fit a model may be overconfident.
    """

    wrong: float = 0.9
    fewest_rows: int = 4
    chance: float = 1e-3
    excess: float = 3.0


LIMITS = BlockLimits()
PAIR = "pair every configuration with its own measured values: was a line lost or doubled there?"


def contradicted(model: CalibratedKinematics, data: Measurements) -> list[Outlier]:
    """Measurements that took no part in a fit and that its model excludes, the worst first.

    Their distances are judged by the model's own deviations, or by the median distance if the model is overconfident.
    """
    data = with_markers_of(model, data)
    errors, squares = _errors(model, data)
    freedom = errors.shape[-1]
    seen = known(squares)
    size = max(1.0, float(seen.median()) / chi2_median(freedom))
    limit = LIMITS.excess**2 * size * chi2_above(FALSE_ALARM_PROBABILITY / len(seen), freedom)
    return found_outliers(model, data, squares > limit, errors[..., :3].norm(dim=-1))


def _errors(model: CalibratedKinematics, data: Measurements) -> tuple[Tensor, Tensor]:
    """Errors (N, bodies, 3 or 6) in m and rad, and their squared distances (N, bodies) by the model's deviations.

    NaN for hidden markers.
    """
    if data.frames is None:
        mean, covariance = laden(model, data).predict(data.q)
        errors = data.points - mean
    else:
        poses, covariance = map(by_frame, laden(model, data).predict_poses(data.q))
        away = transforms_of_frames(data.frames[..., :3, :3] @ poses[..., :3, :3].mT, data.frames[..., :3, 3])
        turns = visible_rotation_numbers(away, "rotvec", "rad")
        errors = torch.cat([data.frames[..., :3, 3] - poses[..., :3, 3], turns], 2)
    solved = torch.linalg.solve(covariance, errors[..., None])[..., 0]
    return errors, (errors * solved).sum(-1)


def steps_of(model: CalibratedKinematics, data: Measurements) -> list[Step]:
    """Rows whose measured values belong to the joints of other lines, judged by a model."""
    return out_of_step(laden(model, data)(data.q).detach(), data.points, data.line_numbers, expected_error(model, data))


def step_text(step: Step) -> str:
    """One sentence about rows out of step."""
    return sentence(step.sentence, got=f"{step.rows} rows that fit there, and not at their own joints", fix=PAIR)


def block_text(model: CalibratedKinematics, data: Measurements, wrong: list[Outlier]) -> str | None:
    """One sentence about wrong rows that follow one another, with their common cause if there is one; else None."""
    order = data.line_numbers.argsort()
    flags = torch.zeros(len(data), dtype=torch.bool, device=order.device)
    flags[[one.row for one in wrong]] = True
    place = find_block(flags[order])
    if place is None:
        return None
    start, end = place
    block = data.rows(order[start:end])
    lines, last = block.line_numbers.tolist(), " to the end of the table" * (end == len(data))
    size = float((laden(model, block)(block.q) - block.points).norm(dim=-1).nanmedian())
    seen, rows = of_one_payload(model, block)
    causes = motions(seen.map, seen.nominal, seen.lever, rows)
    why = "; " + ", ".join(cause.sentence for cause in causes) if causes else ", for no common reason"
    count = int(flags[order[start:end]].sum())
    return sentence(
        f"{count} rows look wrong that follow one another: lines {lines[0]} to {lines[-1]}{last}",
        got=f"a median error of {1e3 * size:.3g} mm{why}",
        fix="check what happened there; calibrate without these lines, or measure them again",
    )


def warn_of_contradictions(
    model: CalibratedKinematics, own: Coordinates | None, wrong: list[Outlier], moved: str | None
) -> None:
    """Warn of the best explanation of wrong rows of a fit.

    Args:
        model: the fitted model. own: its rows that tell coordinates. wrong: the outliers among all rows.
        moved: a sentence about something that moved, which explains wrong rows after it.

    Warns:
        DiffeoCalibWarning: rows are out of step, follow one another, or something moved.
    """
    text = moved
    if own is not None:
        place = {row: number for number, row in enumerate(own.rows.tolist())}
        wrong = [replace(one, row=place[one.row]) for one in wrong if one.row in place]
        steps = steps_of(model, own.table) if len(wrong) >= STEP_LIMITS.fewest_rows else []
        text = step_text(steps[0]) if steps else moved or block_text(model, own.table, wrong)
    if text is not None:
        warn_user(text)


def find_block(wrong: Tensor, limits: BlockLimits = LIMITS) -> tuple[int, int] | None:
    """First and last + 1 of the rows (N,), in order, where wrong ones follow one another beyond chance; or None.

    The segment with the largest likelihood ratio of ``limits.wrong`` against the overall share (S. Karlin,
    S. Altschul, "Methods for assessing the statistical significance of molecular sequence features", 1990).
    """
    count, n = int(wrong.sum()), len(wrong)
    share = count / n
    if count < limits.fewest_rows or share >= limits.wrong:
        return None
    gain, loss = log(limits.wrong / share), log((1 - limits.wrong) / (1 - share))
    best, score, start, place = log(n / limits.chance), 0.0, 0, None
    for row, bad in enumerate(wrong.tolist()):
        if score <= 0:
            score, start = 0.0, row
        score += gain if bad else loss
        if score > best:
            best, place = score, (start, row + 1)
    return place
