"""Quantiles are those of scipy.stats, which is not imported for them."""

from __future__ import annotations

import subprocess
import sys

import pytest

from diffeo_calib.common.quantiles import chi2_above, chi2_median, f_below


@pytest.mark.parametrize("freedom", [1, 2, 3, 6, 17.5, 400])
@pytest.mark.parametrize("probability", [1e-8, 0.05, 0.5, 0.95])
def test_quantiles_are_those_of_scipy(freedom: float, probability: float) -> None:
    from scipy.stats import chi2, f

    assert chi2_above(probability, freedom) == pytest.approx(chi2.isf(probability, freedom), rel=1e-12)
    assert chi2_median(freedom) == pytest.approx(chi2.median(freedom), rel=1e-12)
    assert f_below(probability, 3, freedom) == pytest.approx(f.ppf(probability, 3, freedom), rel=1e-9)


def test_scipy_stats_stays_away() -> None:
    program = "import sys\nfrom diffeo_calib.common import quantiles as q\nq.chi2_median(3)\nq.f_below(0.9, 3, 9)\n"
    done = subprocess.run([sys.executable, "-c", program + "sys.exit('scipy.stats' in sys.modules)"], check=False)
    assert done.returncode == 0
