"""A user's kernel that defines only its matrix, and a user's radial profile: every method, fits, files."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from math_bank import normal, tensor
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.interop import model_file
from diffeo_calib.kernels.base import Kernel, SumKernel
from diffeo_calib.kernels.profiles import Profile
from diffeo_calib.kernels.radial import RadialKernel


class Skewed(Kernel):
    """exp(-|x - y|^2 / (2 s^2)) [[1, c], [c, 1]]: a Gaussian with correlated components."""

    def __init__(self, scale: float, coupling: float) -> None:
        self.scale, self.coupling = scale, coupling

    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        kappa = (-(x[:, None] - y[None]).square().sum(-1) / (2 * self.scale**2)).exp()
        A = torch.tensor([[1.0, self.coupling], [self.coupling, 1.0]], dtype=x.dtype, device=x.device)
        return torch.kron(kappa.contiguous(), A)


class Plain(Kernel):
    """The package's Gaussian, defined by its matrix alone, to compare all defaults with the closed forms."""

    def __init__(self, scale: float, variance: float) -> None:
        self.scale, self.variance = scale, variance

    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        kappa = self.variance * (-(x[:, None] - y[None]).square().sum(-1) / (2 * self.scale**2)).exp()
        return torch.kron(kappa.contiguous(), torch.eye(x.shape[1], dtype=x.dtype, device=x.device))


PLAIN, CLOSED = Plain(0.8, 1.3), dc.Gaussian(0.8, 1.3)


def same(found: object, expected: object, atol: float = 1e-13) -> None:
    torch.testing.assert_close(found, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("dim", [1, 3])
def test_defaults_agree_with_closed_forms(dim: int) -> None:
    x, c, q, a = (normal(n, dim, seed=k) for k, n in enumerate((4, 4, 5, 5)))
    dq, da = normal(5, dim, seed=5), normal(5, dim, seed=6)
    gram = x, normal(4, 2, dim, seed=7), q, normal(5, 3, dim, seed=8)
    for method, arguments in (
        ("field", (x, q, a)),
        ("field", (None, q, a)),
        ("field", (x, q, normal(5, 4, dim, seed=3))),
        ("field_and_jacobian", (x, q, a)),
        ("gradient", (x, c, q, a)),
        ("hamiltonian_gradient", (q, a)),
        ("hessian_product", (q, a, dq, da)),
        ("gram", gram),
        ("own_blocks", (x, normal(2, 3, 2 * dim, seed=9))),
    ):
        same(getattr(PLAIN, method)(*arguments), getattr(CLOSED, method)(*arguments))
    terms = PLAIN, CLOSED, dc.Matern(0.7)
    same(SumKernel(terms).gram(*gram), sum(t.gram(*gram) for t in terms))


class Forgetful(Plain):
    """Does not keep its argument."""

    def __init__(self, width: float) -> None:
        super().__init__(width, 1.0)


class Changed(Plain):
    """A matrix that is none of a kernel."""

    def __init__(self, change: Callable[[Tensor, Tensor], Tensor]) -> None:
        super().__init__(1.0, 1.0)
        self.change = change

    def matrix(self, x: Tensor, y: Tensor) -> Tensor:
        return self.change(super().matrix(x, y), x)


@pytest.mark.parametrize(
    ("kernel", "words"),
    [
        (Changed(lambda K, x: K + 0.1 * x.flatten()[:, None]), "an asymmetry of"),
        (Changed(lambda K, _: -K), "a smallest eigenvalue of -"),
        (Changed(lambda K, x: K[: len(x), : len(x)]), r"shape \(3, 3\)"),
        (Changed(lambda K, _: K.float()), "torch.float32"),
        (Skewed(1.0, 2.0), "a smallest eigenvalue of -"),
    ],
)
def test_a_matrix_that_is_no_kernel_is_refused(kernel: Kernel, words: str) -> None:
    with pytest.raises(InputError, match=f"`joint_kernel`.*{words}"):
        fitted(kernel)


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


WRONG: list[tuple[Profile, str]] = [
    (RationalQuadratic(wrong=(1, 2.0)), r"`derivative` of order 1 at r2 = 0\.31: expected -0\.391[^;]* got -0\.782"),
    (RationalQuadratic(wrong=(2, 1.01)), "`derivative` of order 2"),
    (RationalQuadratic(wrong=(3, -1.0)), "`derivative` of order 3"),
    (RationalQuadratic(wrong=(3, float("nan"))), "`derivative` of order 3"),
    (RationalQuadratic(wrong=(0, 2.0)), r"expected kappa = 1, got 2\.0"),
    (RationalQuadratic(name="gaussian"), "`name` = 'gaussian' of a profile of the package"),
    (Short(), r"no `derivative` of order 3 \(IndexError.*expected orders 0 to 3"),
]


@pytest.mark.parametrize(("profile", "words"), WRONG)
def test_a_wrong_profile_is_refused(profile: Profile, words: str) -> None:
    for alpha in (0.1, 1.5, 80.0):
        RadialKernel(RationalQuadratic(alpha))
    with pytest.raises(InputError, match=words):
        RadialKernel(profile)


def nominal(x: Tensor) -> Tensor:
    return torch.stack([x[:, 0], x[:, 1], x.sin().sum(1)], 1)


def fitted(kernel: Kernel) -> FittedMap:
    x = torch.cartesian_prod(*[torch.linspace(-1, 1, 3, dtype=torch.float64)] * 2)
    y = nominal(x) + 0.05 * x.cos().sum(1, keepdim=True)
    problem = dc.Problem(nominal, x, y, joint_kernel=kernel, task_kernel=dc.Gaussian(1.0), noise=0.01)
    return dc.fit(problem, integrator=dc.RK4(2)).model


def test_another_backend_and_kernels_that_cannot_be_saved(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="`change` of the kernel Changed cannot be saved"):
        dc.save(fitted(Changed(lambda K, _: K)), tmp_path / "x")
    with pytest.raises(InputError, match="argument `width` is not an attribute"):
        dc.save(fitted(Forgetful(0.7)), tmp_path / "x")
    assert list(tmp_path.iterdir()) == []

    class Unwarned(Skewed):
        pass

    kernel = Unwarned(0.7, 0.3)
    assert kernel.using("auto") is kernel.using("dense") is kernel
    with pytest.warns(dc.DiffeoCalibWarning, match="Unwarned .* dense matrix; .* RadialKernel"):
        kernel.using("fused")
    kernel.using("tiled")  # warnings are errors


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    model = fitted(Skewed(0.7, 0.4) + RadialKernel(RationalQuadratic(2.5), lengthscale=0.9))
    path = tmp_path_factory.mktemp("own") / "own.safetensors"
    dc.save(model, path)
    return model, path


OWN = {"Skewed": Skewed, "rq": RationalQuadratic(2.5)}
NO_CLASSES = r"`kernels`: expected names -> subclasses of dc\.Kernel, or profiles"


def test_a_model_with_kernel_and_profile_is_loaded(saved: tuple[Any, Path]) -> None:
    """By the name and the numbers of the kernel; files of an old version have no values of the profile to compare."""
    (model, path), at = saved, tensor([[0.3, -0.2]])
    again: Any = dc.load(path, nominal, kernels=OWN)
    same(again(at), model(at), 0.0)
    header, tensors = model_file.describe(model)
    header = json.loads(json.dumps(header))
    assert header["joint_kernel"][1].pop("profile_probe")[0] == 1.0
    with pytest.warns(dc.DiffeoCalibWarning, match="profile 'rq' is that of its fit is not checked"):
        model_file.rebuild(header, tensors, nominal, OWN)


@pytest.mark.parametrize(
    ("kernels", "words"),
    [
        ({"rq": OWN["rq"]}, r"uses the kernel 'Skewed', which is not part of diffeo_calib.*kernels"),
        ({"Skewed": Skewed}, r"uses the profile 'rq', which is not part of diffeo_calib.*load\(path, kernels=\{'rq': "),
        (OWN | {"rq": RationalQuadratic(2.4)}, "profile 'rq' .* is not that of the model: expected kappa = 1, "),
        (OWN | {"rq": RationalQuadratic}, "is not that of the model"),  # called without arguments
        (OWN | {"rq": RationalQuadratic(2.5, wrong=(2, 1.1))}, "`derivative` of order 2"),
        *((classes, NO_CLASSES) for classes in (["Skewed"], {"Skewed": Skewed(0.7, 0.4)}, {"Skewed": dict}, Skewed)),
    ],
)
def test_another_kernel_or_profile_is_refused(kernels: Any, words: str, saved: tuple[Any, Path]) -> None:
    with pytest.raises(InputError, match=words) as caught:
        dc.load(saved[1], nominal, kernels=kernels)
    assert "save the model again" not in str(caught.value)
