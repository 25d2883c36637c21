"""Model files: exact round trips of robots, functions, kernels and coarse models; the contents of the header."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from math_bank import constant_kernel
from model_file_bank import header_of, planar
from product_bank import Case
from safetensors import safe_open
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.interop import model_header
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.robots import elastic_rr


@pytest.mark.parametrize("name", ["arm", "posed"])
def test_robot_models_come_back_bit_for_bit(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    """Of the other kinds: tests/test_laws_of_kinds.py."""
    case: Case = request.getfixturevalue(name)
    model, q = case.model, case.test.q[:50]
    dc.save(model, tmp_path / "model.safetensors")
    again = dc.load(tmp_path / "model.safetensors")
    assert isinstance(again, dc.CalibratedKinematics)
    assert torch.equal(again.jacobian(q), model.jacobian(q))
    for mine, theirs in zip(again.predict(q), model.predict(q), strict=True):
        assert torch.equal(mine, theirs)
    assert (again.report, again.lever) == (model.report, case.train.lever)
    assert again.robot.to_config() == model.robot.to_config()
    dc.save(again, tmp_path / "again.safetensors")
    assert torch.equal(dc.load(tmp_path / "again.safetensors")(q), model(q))


def test_plain_functions_must_be_passed_again(tmp_path: Path) -> None:
    fit, path = planar(), tmp_path / "plain.safetensors"
    dc.save(fit.model, path)
    x = torch.rand(30, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    again = dc.load(path, nominal=elastic_rr.nominal)
    assert isinstance(again, FittedMap)
    assert torch.equal(again(x), fit.model(x))
    assert torch.equal(again.predict(x)[1], fit.model.predict(x)[1])
    with pytest.raises(InputError, match=r"`nominal` is missing.*same function again"):
        dc.load(path)


def test_models_of_robots_are_loaded_without_a_function(sound: bytes, tmp_path: Path) -> None:
    (tmp_path / "model").write_bytes(sound)
    with pytest.raises(InputError, match="`nominal` was given, but the file holds its robot"):
        dc.load(tmp_path / "model", nominal=elastic_rr.nominal)


@pytest.mark.parametrize("other", [lambda x: x[:, :1], lambda x: x, elastic_rr.real])
def test_another_function_is_noticed(other: Callable[[Tensor], Tensor], tmp_path: Path) -> None:
    path = tmp_path / "plain.safetensors"
    dc.save(planar().model, path)
    with pytest.raises(InputError, match="`nominal` is not the map that the model was fitted to"):
        dc.load(path, nominal=other)


KERNELS: dict[str, Callable[[], Kernel]] = {
    "gaussian": lambda: dc.Gaussian((0.7, 1.1), 0.02),
    "matern32": lambda: dc.Matern(0.9, 1.5, 0.02),
    "matern52": lambda: dc.Matern(0.9, 2.5, 0.02),
    "matern72": lambda: dc.Matern(0.9, 3.5, 0.02, space=dc.Space((True, False))),
    "cauchy": lambda: dc.Cauchy(0.8, (0.01, 0.02)),
    "constant": lambda: constant_kernel(0.05),
    "von mises": lambda: dc.VonMises((1.0, 2.0), (0.02, 0.01)),
    "per joint": lambda: dc.PerJoint((0.5, 0.9), (0.01, 0.02), dc.Space((True, False))),
    "sum": lambda: (
        dc.PerJoint((0.5, 0.9), (0.01, 0.0), dc.Space((True, True))) + dc.Cauchy(1.0, 0.01) + constant_kernel(1e-3)
    ),
}


@pytest.mark.parametrize("name", KERNELS)
def test_every_kernel_comes_back(name: str, tmp_path: Path) -> None:
    fit, path = planar(KERNELS[name](), KERNELS[name]()), tmp_path / "model.safetensors"
    dc.save(fit.model, path)
    x = torch.linspace(-2, 2, 24, dtype=torch.float64).reshape(12, 2)
    again = dc.load(path, nominal=elastic_rr.nominal)
    assert torch.equal(again(x), fit.model(x))
    assert torch.equal(again.predict(x)[1], fit.model.predict(x)[1])
    nominal = elastic_rr.nominal(x)
    assert float((fit.model(x) - nominal).abs().max()) > 1e-3  # large enough to notice a lost kernel


def test_the_header_describes_the_model(arm: Case, tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    dc.save(arm.model, path)
    header = header_of(path)
    assert header["format"] == model_header.FORMAT
    assert header["units"] == {"length": "m", "angle": "rad"}
    robot = header["nominal"]
    assert (robot["name"], robot["base"], robot["tip"]) == ("simulated_arm", "base_link", "flange")
    report = header["report"]
    assert report["coupling residual"] <= 1e-4
    assert report["end residual"] <= 1e-4
    assert report["diffeomorphic rms [m]"] < report["geometry rms [m]"] < report["registration rms [m]"]
    assert report["status"] == arm.result.fit.status
    with safe_open(path, framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    assert all(t.dtype == torch.float64 for t in tensors.values())
    assert tensors["x"].shape == (60, 6)


@pytest.mark.parametrize(
    "integrator",
    [dc.RK8(1), dc.TorchDiffEq("dopri5", adjoint=True, step_size=0.5, rtol=1e-6, atol=1e-9)],
    ids=["rk8", "torchdiffeq"],
)
def test_coarse_models_keep_their_data_and_integrator(integrator: dc.RK8 | dc.TorchDiffEq, tmp_path: Path) -> None:
    """Fewer control points than measurements: the covariance needs the measured configurations too."""
    x = elastic_rr.grid(5)
    kernels = {"joint_kernel": dc.VonMises(1.0, 0.1), "task_kernel": dc.Gaussian(0.7, 0.1)}
    problem = dc.Problem(elastic_rr.nominal, x, elastic_rr.real(x), noise=0.05, **kernels)  # pyright: ignore[reportArgumentType]
    model = dc.fit(problem, dc.GaussNewton(max_iterations=2), integrator, controls=12).model
    dc.save(model, tmp_path / "coarse.safetensors")
    again = dc.load(tmp_path / "coarse.safetensors", elastic_rr.nominal)
    assert isinstance(again, FittedMap)
    assert again.deformation.integrator == integrator
    assert (len(again.deformation.x), len(again.x)) == (12, 25)
    for actual, expected in zip(again.predict(x[:3]), model.predict(x[:3]), strict=True):
        torch.testing.assert_close(actual, expected, rtol=0, atol=0)
