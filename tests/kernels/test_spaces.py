"""Spaces and feature maps: distances, adjoints and second derivatives."""

import pytest
import torch
from math_bank import central_difference, circle, line, normal, tensor, uniform

from diffeo_calib.common.errors import InputError
from diffeo_calib.kernels.spaces import FeatureMap, Space

MAPS = {
    "lines": FeatureMap((0, 1, 2), (False,) * 3, tensor([0.5, 2.0, 0.3])),
    "circles": FeatureMap((0, 1, 2), (True,) * 3, tensor([0.5, 2.0, 0.3])),
    "mixed": FeatureMap((0, 1, 2), (True, False, True), tensor([0.5, 2.0, 0.3])),
    "one scale": FeatureMap((0, 1, 2), (False, True, False), tensor(0.7)),
    "some columns": FeatureMap((0, 2), (False, True), tensor([0.7, 0.4])),
    "one column": FeatureMap((1,), (True,), tensor(1.3)),
}
every_map = pytest.mark.parametrize("features", MAPS.values(), ids=MAPS.keys())


@every_map
def test_derivatives_of_maps(features: FeatureMap) -> None:
    """Push is the derivative of lift, pull its adjoint, and pull has a derivative of its own."""
    x, dx = uniform(5, 3, seed=1), normal(5, 3, seed=2)
    g = normal(*features.lift(x).shape, seed=3)
    pushed, bent = features.push(x, dx), features.pull_derivative(x, dx, g)
    torch.testing.assert_close(pushed, central_difference(features.lift, x, dx), rtol=1e-10, atol=1e-10)
    left, right = (pushed * g).sum(-1), (dx * features.pull(x, g)).sum(-1)
    torch.testing.assert_close(left, right, rtol=1e-13, atol=1e-13)
    expected = central_difference(lambda at: features.pull(at, g), x, dx)
    torch.testing.assert_close(bent, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("count", [0, 2, 4])
def test_wrong_number_of_scales(count: int) -> None:
    with pytest.raises(InputError, match=rf"expected 1 or 3, got {count}\b"):
        FeatureMap((0, 1, 2), (False,) * 3, torch.ones(count, dtype=torch.float64))


def test_products_of_spaces() -> None:
    space = circle(1) * line(2)
    assert space == Space((True, False, False))
    assert space.dim == 3
