"""Calibrations that end early: Ctrl-C in every stage, and fits that do not converge."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from product_bank import Case
from torch.testing import assert_close

import diffeo_calib as dc


def interrupting(task: str, at: int):
    """A progress callback that behaves as if Ctrl-C came at this place, once."""
    state = {"done": False}

    def progress(name: str, done: int, total: int) -> None:
        if name == task and done >= at and not state["done"]:
            state["done"] = True
            raise KeyboardInterrupt

    return progress


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:leave-one-out errors contradict the selected scales")  # they are not selected yet
@pytest.mark.parametrize(("task", "at"), [("hyper-parameters", 1), ("cross-validation", 2), ("Gauss-Newton", 1)])
def test_ctrl_c_keeps_a_usable_model(task: str, at: int, arm: Case) -> None:
    scales = arm.result.selection.scales if task == "Gauss-Newton" else None
    result = dc.calibrate(arm.robot, arm.train, hyperparameters=scales, progress=interrupting(task, at))
    assert result.interrupted
    assert "interrupted" in result.status
    geometry = dc.evaluate(result.identification.geometry.points, arm.test).rms
    assert dc.evaluate(result.model, arm.test).rms < geometry
    assert bool(torch.isfinite(result.model.predict(arm.test.q[:3])[1]).all())


@pytest.mark.slow
def test_ctrl_c_in_the_second_search_keeps_the_first(arm: Case) -> None:
    """The first climbs from two starts, the second from their result, where it is interrupted at once."""
    began = []

    def progress(name: str, done: int, total: int) -> None:
        if name == "hyper-parameters" and done == 1:
            began.append(total)
            if len(began) == 2:
                raise KeyboardInterrupt

    result = dc.calibrate(arm.robot, arm.train, progress=progress)
    assert len(began) == 2
    assert began[0] != began[1]
    assert result.interrupted
    assert result.selection.interrupted
    assert not result.fit.solution.interrupted
    assert result.status.startswith(
        "interrupted in the search for scales, the best so far are kept; fitted with them: "
    )
    assert result.status.count("interrupted") == 1
    assert (
        dc.evaluate(result.model, arm.test).rms < 0.5 * dc.evaluate(result.identification.geometry.points, arm.test).rms
    )


def test_ctrl_c_before_the_first_step_leaves_geometry(arm: Case) -> None:
    given = arm.result.selection.scales
    result = dc.calibrate(arm.robot, arm.train, hyperparameters=given, progress=interrupting("Gauss-Newton", 0))
    assert result.interrupted
    assert "after 0 iterations" in result.status
    assert result.status.count("interrupted") == 1
    assert_close(result.model(arm.test.q), result.identification.geometry.points(arm.test.q), rtol=0, atol=1e-13)


def test_ctrl_c_before_there_is_anything_to_keep(arm: Case) -> None:
    for task in ("registration", "geometry"):
        with pytest.raises(KeyboardInterrupt):
            dc.calibrate(arm.robot, arm.train, progress=interrupting(task, 0))


def test_a_fit_that_does_not_converge_gives_advice_that_can_be_followed(arm: Case) -> None:
    """Solver and time steps are not arguments of `calibrate`."""
    short = dc.fit(arm.result.fit.problem, dc.GaussNewton(max_iterations=1))
    result = replace(arm.result, fit=replace(arm.result.fit, solution=short.solution))
    assert not result.fit.converged
    assert "stopped at the limit of 1 iterations; judge it by held-out errors" in result.status
    assert "measure more poses or pass fewer `controls`" in result.status
    assert "max_iterations" not in result.status
    assert "advice" not in arm.result.status
    assert "judge it" not in arm.result.status
