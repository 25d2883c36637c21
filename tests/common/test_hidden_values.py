"""Statistics that leave missing values out."""

from math import inf, nan

import torch
from torch.testing import assert_close

from diffeo_calib.common.quantiles import known, largest_known


def test_largest_known_value() -> None:
    values = torch.tensor([[1.0, nan, 3.0], [nan, nan, nan], [-5.0, -7.0, nan], [inf, nan, 0.0]], dtype=torch.float64)
    expected = torch.tensor([3.0, nan, -5.0, inf], dtype=torch.float64)
    assert_close(largest_known(values), expected, rtol=0, atol=0, equal_nan=True)
    assert_close(largest_known(values.T, 0), expected, rtol=0, atol=0, equal_nan=True)
    assert known(values).tolist() == [1.0, 3.0, -5.0, -7.0, inf, 0.0]
