"""The benchmark of regions: its arms, its records and its summary."""

from __future__ import annotations

from argparse import Namespace

import numpy as np
import pytest
import region_limits
import regions
from coverage import INSIDE_95
from reading_bank import scales
from varied_arms import KINDS, OUTLIER_M, Kind, VariedArm

import diffeo_calib as dc


def test_an_arm_is_measured_with_its_noise() -> None:
    own = VariedArm(regions.chains(None)[0], Kind(noise=3e-5), 4)
    q = own.rows(2000, 0)
    errors = own.measured(q, 0) - own.true_points(q)
    assert float(errors.std()) == pytest.approx(3e-5, rel=0.05)
    wrong = VariedArm(own.nominal, Kind(outliers=0.02), 4)
    assert float((wrong.measured(q, 0) - wrong.true_points(q)).abs().max()) > OUTLIER_M


@pytest.mark.parametrize("kind", ["usual", "repeated", "motions", "small"])
def test_rows_of_a_kind(kind: str) -> None:
    own = VariedArm(regions.chains(None)[0], KINDS[kind], 0)
    q = own.rows(30, 0)
    apart = (q[1:] - q[:-1]).norm(dim=1)
    assert q.shape == (30, 6)
    assert int((apart == 0).sum()) == (20 if kind == "repeated" else 0)
    low, high = own.nominal.limits.unbind(1)
    assert bool(((q >= low) & (q <= high)).all())
    reach = float(((q - 0.5 * (low + high)).abs() / (0.5 * (high - low))).max())
    assert reach < (0.31 if kind == "small" else 1.01)
    assert float(apart.median()) < 1.0 if kind == "motions" else float(apart.max()) > 1.0


def test_another_date_moves_the_device_and_drifts() -> None:
    own = regions.arm("usual", 0, None)
    q = own.rows(20, 0)
    same, drifted = (own.later(7000, drift).true_points(q)[:, 0] for drift in (0.0, 0.2))
    here = own.true_points(q)[:, 0]
    assert float((same - here).norm(dim=1).min()) > 0.1
    assert 1e-5 < float((drifted - same).norm(dim=1).mean()) < 5e-3


def test_summary_counts_sets_within_the_targets() -> None:
    keys = {"seed": 0, "drift": None, "robot": None, "rms_mm": 0.1, "seconds": 1.0}
    values = ((0.91, 1.0), (0.95, 1.2), (0.985, 1.1))
    records = [
        keys | {"method": method, "case": "usual", "rows": rows, "new": new, "sharpness": sharp}
        for method, rows in (("fresh", 20), ("fresh", 60), ("registered", 20))
        for new, sharp in values
    ]
    failed = {"method": "fresh", "case": "usual", "rows": 20, "seed": 1, "note": "it failed"}
    found = regions.summary([*records, failed])
    assert [row["sets"] for row in found] == [3, 3, 3]
    np.testing.assert_allclose([float(row["within"] or 0) for row in found], [1.0, 1 / 3, 2 / 3])
    assert all(row["sharp"] == pytest.approx(2 / 3) and row["robot"] == "" for row in found)


def test_a_failure_is_a_record() -> None:
    keys: regions.Record = {"method": "fresh", "case": "unknown"}
    assert "unknown" in str(regions.measured(keys, "unknown", 20, 0, Namespace(data=None))["note"])


@pytest.mark.slow
def test_one_record() -> None:
    (record,) = regions.measure(regions.arguments(["--quick"]))
    for name in ("new", "robot"):
        assert 0.3 < float(record[name] or 0) <= 1.0, name
    assert 0.3 < float(record["sharpness"] or 0) < 3.0


def test_right_regions_hold_nineteen_of_twenty_in_the_mean() -> None:
    own = regions.case("usual", 15, 0, None)
    model = dc.calibrate(own.robot, own.train, hyperparameters=scales()).model
    inside = (region_limits.squares(model, own.test.q[:60], 300, 0) < INSIDE_95).double().mean(0)
    assert float(inside.mean()) == pytest.approx(0.95, abs=0.01)
    assert 0.03 < float(inside.std()) < 0.2  # more than chance in 60 rows gives: errors have a cause in common
