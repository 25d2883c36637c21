"""Analysis of rows of any kinds: errors of each in its own unit, and the error to expect of positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from diffeo_calib.calibration.expected_errors import expected_errors
from diffeo_calib.calibration.findings import Part, parts
from diffeo_calib.common.device import HOST
from diffeo_calib.fitting.result import Progress, silent
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.evaluation import check_rows, place, placement_sentences, residuals, rows_used_in_fit
from diffeo_calib.reports.analysis.stages import Deviations, Kinematics, placed_stages
from diffeo_calib.sensors.errors import ERRORS, Evaluation, Evaluations
from diffeo_calib.sensors.places import Places

STEPS = 2
"""Of the analysis, as they are told."""


@dataclass(frozen=True, eq=False, repr=False)
class Findings:
    """Numbers of a report about rows of any kinds.

    Args:
        model: the model. stages: kinematics to compare: nominal, geometric, calibrated.
        kinds: kind -> stage -> errors of the rows shown; empty without rows.
        new: whether the model has not seen these rows. devices: where devices are and what was found from the rows.
        expected: stage -> RMS error of positions that the model expects over the joint ranges of its rows, m.
        deviations: what it expects at random configurations there, and at those of the fit.
        parts: what explains how much.
    """

    model: CalibratedKinematics
    stages: Mapping[str, Kinematics]
    kinds: Mapping[str, Mapping[str, Evaluation]]
    new: bool
    devices: Sequence[str]
    expected: Mapping[str, float]
    deviations: Deviations
    parts: Sequence[Part]

    @property
    def repeatability(self) -> float | None:
        """RMS distance of measurements of the same configuration from their mean, m, if poses were repeated."""
        return None

    @property
    def judged(self) -> tuple[float, str]:
        """The RMS error, m, that is compared with a tolerance, and of what it is.

        Positions that the model has not seen decide. A spread or an error of readings is no accuracy, but the model is
        not more accurate than these.
        """
        own = [list(stages.values())[-1] for stages in self.kinds.values()] if self.new else []
        found = [(one.rms, f"of these rows ({one.label})") for one in own if one.unit == "m"]
        if not any(one.what == ERRORS for one in own):
            expected = self.deviations.error.whole
            found.append((expected, "expected of positions over the joint ranges of the fit"))
        return max(found)

    @property
    def count(self) -> int:
        """Number of rows shown."""
        return sum(len(next(iter(stages.values())).errors) for stages in self.kinds.values())


def of_positions_alone(model: CalibratedKinematics, data: Any) -> bool:
    """Whether a device measured a position, or pose, of every marker of the model in all rows."""
    others = model.ball or model.map.unregistered.slopes is not None
    return not others and (data is None or {part.kind for part in data.parts} <= {"position", "pose"})


def find_kinds(
    model: CalibratedKinematics,
    data: Any,
    *,
    stages: Mapping[str, Kinematics] | None = None,
    places: Mapping[str, Places] | None = None,
    progress: Progress = silent,
) -> Findings:
    """Compute what a report shows of rows of any kinds.

    Args:
        model: a calibrated model. data: rows; those of the fit are left out unless there are no others.
        stages: kinematics to compare, the model last; found anew by default.
        places: of the devices beside each stage, by its name; by default they are placed on the rows.
        progress: called as ``progress(task, done, total)``.
    """
    progress("analysis", 0, STEPS)
    stages = placed_stages(model) if stages is None else stages
    kinds, new, devices = dict[str, dict[str, Evaluation]](), False, list[str]()
    if data is not None:
        check_rows(model, data)
        used = rows_used_in_fit(model, data.q).to(HOST)
        new = not bool(used.all())
        found, devices = _errors(model, data, stages, places)
        shown = ~used if new else torch.ones_like(used)
        for name, errors in found.items():
            for kind, own in errors.rows(shown).items():
                kinds.setdefault(kind, {})[name] = own
    devices += placement_sentences(model)
    progress("analysis", 1, STEPS)
    deviations = Deviations.of(model)
    expected = expected_errors(model, stages, deviations.error)
    progress("analysis", STEPS, STEPS)
    return Findings(model, stages, kinds, new, devices, expected, deviations, parts(model))


def _errors(
    model: CalibratedKinematics, data: Any, stages: Mapping[str, Kinematics], places: Mapping[str, Places] | None
) -> tuple[dict[str, Evaluations], list[str]]:
    """Errors of all rows by stage, and what was found from them."""
    if places is not None:
        return {name: residuals(own, places[name], data) for name, own in stages.items()}, []
    beside = place(model, data)
    found = dict[str, Evaluations]()
    for name, kinematics in stages.items():
        own = place(kinematics, data)
        own = replace(own, frames=own.frames or beside.frames, ball=beside.ball)
        found[name] = residuals(kinematics, own, data)
    return found, list(beside.found)
