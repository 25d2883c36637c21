"""The benchmarks on the elastic RR arm: the extended arm, known answers, records, summary, figure, the programs."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import sample_efficiency
import torch
from kernel_choices import MODELS
from rr_calibrations import Predict, calibrate
from torch import Tensor

from diffeo_calib.robots import elastic_rr

FAST = ("geometry", "GP", "geometry, phi, psi: flow")


def uniform(count: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2 * math.pi * torch.rand(count, 2, dtype=torch.float64, generator=generator) - math.pi


def rms(predict: Predict, truth: Tensor, x: Tensor) -> float:
    return float((predict(x) - truth).square().sum(1).mean().sqrt())


# --- known answers --------------------------------------------------------------------------------------------------


def test_tangent_and_flow_agree_where_deformations_are_small() -> None:
    x, test = uniform(30), uniform(50, 1)
    y = elastic_rr.real(x, 1e-3)
    model = calibrate(MODELS["geometry, phi, psi"], x, y, 0)
    flow, note = model.flow()
    assert note is None
    torch.testing.assert_close(flow(test), model.tangent()(test), rtol=0, atol=2e-6)
    assert rms(flow, elastic_rr.real(test, 1e-3), test) < 5e-6  # of 1e-4 that the nominal arm leaves


# --- cases and records ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_program(tmp_path: Path) -> None:
    out, figure = tmp_path / "samples.json", tmp_path / "samples.svg"
    given = ["--methods", *FAST, "--protocol", "samples", "--sizes", "6", "--noises", "0", "1e-3", "--seeds", "1"]
    sample_efficiency.run(sample_efficiency.arguments([*given, "--out", str(out), "--figure", str(figure)]))
    found = json.loads(out.read_text())
    assert set(found) == {"machine", "versions", "commit", "records"}
    assert len(found["records"]) == 2 * len(FAST)
    assert {record["method"] for record in found["records"] if record["ours"]} == {"geometry, phi, psi: flow"}
    assert all(f"<!-- {name} -->" in figure.read_text() for name in FAST)
    figure.unlink()
    sample_efficiency.run(sample_efficiency.arguments(["--from", str(out), "--figure", str(figure)]))
    assert all(f"<!-- {name} -->" in figure.read_text() for name in FAST)
