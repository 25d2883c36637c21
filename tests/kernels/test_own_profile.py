"""A user's radial profile: its derivatives are checked, a model with it is saved and loaded."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from math_bank import tensor
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.interop import model_header
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.radial import RadialKernel


@dataclass(frozen=True)
class RationalQuadratic(Profile):
    """(1 + r2 / (2 alpha))^-alpha; ``wrong`` multiplies one derivative."""

    alpha: float = 1.5
    wrong: tuple[int, float] = (0, 1.0)
    name: str = "rq"  # pyright: ignore[reportAssignmentType]

    def derivative(self, r2: Any, order: int) -> Any:
        factor = self.wrong[1] if order == self.wrong[0] else 1.0
        for k in range(order):
            factor *= -(self.alpha + k) / (2 * self.alpha)
        return factor * (-(self.alpha + order) * (1.0 + r2 / (2 * self.alpha)).log()).exp()


class Short(RationalQuadratic):
    """Two derivatives of three."""

    def derivative(self, r2: Any, order: int) -> Any:
        return (super().derivative(r2, order),)[max(order - 2, 0)]


class Needy(RationalQuadratic):
    """Has no usual parameter."""

    def __init__(self, alpha: float) -> None:
        super().__init__(alpha)


@pytest.mark.parametrize("alpha", [0.1, 1.5, 80.0])
def test_right_derivatives_are_accepted(alpha: float) -> None:
    RadialKernel(RationalQuadratic(alpha))


@pytest.mark.parametrize(
    ("profile", "words"),
    [
        (
            RationalQuadratic(wrong=(1, 2.0)),
            r"`derivative` of order 1 at r2 = 0\.31: expected -0\.391[^;]* got -0\.782",
        ),
        (RationalQuadratic(wrong=(2, 1.01)), "`derivative` of order 2"),
        (RationalQuadratic(wrong=(3, -1.0)), "`derivative` of order 3"),
        (RationalQuadratic(wrong=(3, float("nan"))), "`derivative` of order 3"),
        (RationalQuadratic(wrong=(0, 2.0)), r"expected kappa = 1, got 2\.0"),
        (RationalQuadratic(name="gaussian"), "`name` = 'gaussian' of a profile of the package"),
        (Short(), r"no `derivative` of order 3 \(IndexError.*expected orders 0 to 3"),
    ],
)
def test_a_wrong_profile_is_refused(profile: Profile, words: str) -> None:
    with pytest.raises(InputError, match=words):
        RadialKernel(profile)


def nominal(x: Tensor) -> Tensor:
    return torch.stack([x[:, 0], x[:, 1], x.sin().sum(1)], 1)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    x = torch.cartesian_prod(*[torch.linspace(-1, 1, 3, dtype=torch.float64)] * 2)
    y = nominal(x) + 0.05 * x.cos().sum(1, keepdim=True)
    kernel = RadialKernel(RationalQuadratic(2.5), lengthscale=0.9)
    problem = dc.Problem(nominal, x, y, joint_kernel=kernel, task_kernel=dc.Gaussian(1.0), noise=0.01)
    fit, path = dc.fit(problem, integrator=dc.RK4(2)), tmp_path_factory.mktemp("own") / "own.safetensors"
    dc.save(fit.model, path)
    return fit.model, path


def test_a_model_with_it_is_loaded(saved: tuple[Any, Path]) -> None:
    model, path = saved
    at = tensor([[0.3, -0.2]])
    again: Any = dc.load(path, nominal, kernels={"rq": RationalQuadratic(2.5)})
    torch.testing.assert_close(again(at), model(at), rtol=0, atol=0)


@pytest.mark.parametrize(
    ("kernels", "words"),
    [
        ({}, r"uses the profile 'rq', which is not part of diffeo_calib.*load\(path, kernels=\{'rq': "),
        (
            {"rq": RationalQuadratic(2.4)},
            "profile 'rq' passed in `kernels` is not that of the model: expected kappa = 1, ",
        ),
        ({"rq": RationalQuadratic}, "is not that of the model"),  # called without arguments
        ({"rq": Needy}, "needs arguments"),
        ({"rq": RationalQuadratic(2.5, wrong=(2, 1.1))}, "`derivative` of order 2"),
    ],
)
def test_another_profile_is_refused(kernels: Any, words: str, saved: tuple[Any, Path]) -> None:
    with pytest.raises(InputError, match=words) as caught:
        dc.load(saved[1], nominal, kernels=kernels)
    assert "save the model again" not in str(caught.value)


def test_a_file_of_an_old_version_has_no_values_to_compare(saved: tuple[Any, Path]) -> None:
    header, tensors = model_header.describe(saved[0])
    header = json.loads(json.dumps(header))
    assert header["joint_kernel"][0].pop("profile_probe")[0] == 1.0
    with pytest.warns(dc.DiffeoCalibWarning, match="profile 'rq' is that of its fit is not checked"):
        model_header.rebuild(header, tensors, nominal, {"rq": RationalQuadratic(2.5)})
