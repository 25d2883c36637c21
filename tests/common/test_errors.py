"""The grammar of messages, and where warnings point; quantiles, which are those of scipy.stats without importing it."""

import subprocess
import sys
from math import inf, nan

import pytest
import torch
from torch.testing import assert_close

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError, MeasurementError, few, listed, sentence, warn_user
from diffeo_calib.common.quantiles import binomial_band, chi2_above, chi2_median, f_below, known, largest_known


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, "`q`."),
        ({"fix": "repair it"}, "`q`; repair it."),
        ({"expected": 3, "got": 4}, "`q`: expected 3, got 4."),
        ({"got": 0, "fix": "repair it"}, "`q`: got 0; repair it."),
    ],
)
def test_a_message_is_one_sentence(given: dict[str, object], expected: str) -> None:
    assert sentence("`q`", **given) == expected  # pyright: ignore[reportArgumentType]
    error = MeasurementError.of("`q`", **given)  # pyright: ignore[reportArgumentType]
    assert type(error) is MeasurementError
    assert isinstance(error, (InputError, ValueError, dc.DiffeoCalibError))
    assert str(error) == expected


def test_long_lists_are_cut_short() -> None:
    assert few([1, 2, 3]) == "1, 2, 3"
    assert few(range(9)) == "0, 1, 2, 3, 4 and 4 more"
    assert listed(["x", "y"]) == "['x', 'y']"
    assert listed([str(k) for k in range(20)]).endswith("'11' and 8 more]")


def test_warnings_point_at_the_line_outside_the_package() -> None:
    with pytest.warns(dc.DiffeoCalibWarning, match="^odd$") as direct:
        warn_user("odd")
    with pytest.warns(dc.DiffeoCalibWarning, match="degrees") as nested:
        dc.Measurements([[90.0]], [[1, 2, 3]])  # through two functions of the package
    assert [one.filename for one in (*direct, *nested)] == [__file__] * 2
    assert nested[0].lineno == direct[0].lineno + 2


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


def test_largest_known_values_and_bands() -> None:
    values = torch.tensor([[1.0, nan, 3.0], [nan, nan, nan], [-5.0, -7.0, nan], [inf, nan, 0.0]], dtype=torch.float64)
    expected = torch.tensor([3.0, nan, -5.0, inf], dtype=torch.float64)
    assert_close(largest_known(values), expected, rtol=0, atol=0, equal_nan=True)
    assert_close(largest_known(values.T, 0), expected, rtol=0, atol=0, equal_nan=True)
    assert known(values).tolist() == [1.0, 3.0, -5.0, -7.0, inf, 0.0]
    assert binomial_band(10, 0.5, 0.05) == (2, 8)  # at most 1 of 10 coins: 11 of 1024
    for count, share in ((20, 0.95), (300, 0.9), (7, 0.3)):
        low, high = binomial_band(count, share, 0.01)
        assert (count - high, count - low) == binomial_band(count, 1.0 - share, 0.01)
