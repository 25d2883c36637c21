"""The planar test bed against the numbers published for it, and against its own limits."""

from collections.abc import Callable
from math import pi

import pytest
import torch

from diffeo_calib.common.errors import InputError
from diffeo_calib.robots import elastic_rr

# torch compiles its forward-mode rules on first use with torch.jit.script, which it has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated:DeprecationWarning")


def uniform(count: int) -> torch.Tensor:
    return 2 * pi * torch.rand(count, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - pi


def test_error_of_the_nominal_model() -> None:
    x = uniform(100_000)
    error = (elastic_rr.nominal(x) - elastic_rr.real(x)).norm(dim=1)
    assert float(error.mean()) == pytest.approx(0.108, abs=5e-4)
    assert float(error.max()) == pytest.approx(0.184, abs=5e-4)


def test_hanging_straight_down_the_arm_only_stretches() -> None:
    x = torch.tensor([[-pi / 2, 0.0]], dtype=torch.float64)
    stretched = 1.08 * (1 + 2 / 200) + 0.46 * (1 + 1 / 200)
    expected = torch.tensor([[0.04, -0.03 - stretched]], dtype=torch.float64)
    torch.testing.assert_close(elastic_rr.real(x), expected, rtol=0, atol=1e-14)


def test_stretched_out_the_arm_sags_as_a_cantilever(monkeypatch: pytest.MonkeyPatch) -> None:
    # One uniform beam under its tip load alone bends by W L^3 / (3 EI), to first order in the load.
    monkeypatch.setattr(elastic_rr, "LOADS", (0.0, 1e-6))
    monkeypatch.setattr(elastic_rr, "BENDING_STIFFNESS", (6.0, 6.0))
    sag = elastic_rr.real(torch.zeros(1, 2, dtype=torch.float64))[0, 1] - elastic_rr.BASE_OFFSET[1]
    assert float(sag) == pytest.approx(-1e-6 * (1.08 + 0.46) ** 3 / (3 * 6.0), rel=1e-6)


def test_links_are_continuous_and_end_at_the_tip() -> None:
    x = uniform(20)
    links = elastic_rr.real_links(x, samples=50)
    assert links.shape == (20, 2, 51, 2)
    torch.testing.assert_close(links[:, 1, -1], elastic_rr.real(x), rtol=0, atol=1e-15)
    torch.testing.assert_close(links[:, 0, -1], links[:, 1, 0], rtol=0, atol=1e-15)
    base = torch.tensor(elastic_rr.BASE_OFFSET, dtype=torch.float64).expand(20, 2)
    torch.testing.assert_close(links[:, 0, 0], base, rtol=0, atol=1e-15)
    begins = links[:, :, 1] - links[:, :, 0]
    turned = torch.atan2(begins[:, 0, 1], begins[:, 0, 0]) - x[:, 0]
    assert float(turned.sin().abs().max()) < 2e-3  # a clamped beam begins along its joint


def test_scale_of_the_discrepancies() -> None:
    x = uniform(100)
    nominal = elastic_rr.nominal(x)
    torch.testing.assert_close(elastic_rr.real(x, 0.0), nominal, rtol=0, atol=1e-15)
    torch.testing.assert_close(elastic_rr.real(x, 1.0), elastic_rr.real(x), rtol=0, atol=0)
    small, half = ((elastic_rr.real(x, scale) - nominal).norm() for scale in (1e-6, 5e-7))
    assert float(half / small) == pytest.approx(0.5, rel=1e-5)


@pytest.mark.parametrize("k0", [elastic_rr.nominal, elastic_rr.real])
def test_smooth_and_periodic(k0: Callable[[torch.Tensor], torch.Tensor]) -> None:
    x = uniform(5)
    turns = torch.tensor([2 * pi, -4 * pi], dtype=torch.float64)
    torch.testing.assert_close(k0(x + turns), k0(x), rtol=0, atol=1e-13)
    assert torch.autograd.gradcheck(k0, (x.requires_grad_(),))
    each = torch.func.vmap(torch.func.jacrev(lambda z: k0(z[None])[0]))(x.detach())
    both = torch.func.vmap(torch.func.jacfwd(lambda z: k0(z[None])[0]))(x.detach())
    torch.testing.assert_close(each, both)
    with pytest.raises(InputError, match=r"`x` has the wrong shape: expected \(N, 2\), got \(4, 3\)"):
        k0(torch.zeros(4, 3))
