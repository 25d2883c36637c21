"""Arrays that run backwards, complex numbers, huge directions: right answers or one clear sentence."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from product_bank import Case

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.runtime.chain import perpendicular


def test_arrays_that_run_backwards(arm: Case) -> None:
    q = arm.test.q[:5].numpy()
    assert torch.equal(arm.model(q[::-1]), arm.model(q[::-1].copy()))


def test_complex_numbers_are_refused(arm: Case) -> None:
    q = arm.test.q[:2]
    for complex_q in (q.numpy() + 1j, q + 1j):
        with pytest.raises(InputError, match="complex numbers"):
            arm.model(complex_q)


def test_directions_of_any_length(arm: Case) -> None:
    model, q = arm.model, arm.test.q[:5]
    poses = model.tool_poses(q)
    places, directions = poses[:, :3, 3] + 1e-4, poses[:, :3, 2]
    usual = dc.compensate(model, places, q, axis=directions)
    assert bool(usual.reached.any())
    for factor in (1e300, 1e-300):
        again = dc.compensate(model, places, q, axis=factor * directions)
        assert float((again.q - usual.q).abs().max()) < 1e-12
    with pytest.raises(InputError, match="`tool_axis`: expected 'x', 'y' or 'z'"):
        dc.compensate(model, places, q, axis=directions, tool_axis=[1])  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("axis", "rows"),
    [
        ((0.0, 0.0, 1.0), ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0))),
        ((0.0, 1.0, 0.0), ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))),
        ((1.0, 0.0, 0.0), ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))),
        ((0.0, 0.0, -1.0), ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0))),
    ],
)
def test_lateral_directions_of_gravity_sag(axis: tuple[float, ...], rows: tuple[tuple[float, ...], ...]) -> None:
    """Coefficients in model files refer to these directions: they must never change."""
    found = torch.from_numpy(perpendicular(np.array(axis, dtype=np.float64)))
    np.testing.assert_allclose(found.numpy(), np.array(rows), rtol=0, atol=1e-15)
