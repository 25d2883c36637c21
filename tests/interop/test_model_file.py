"""Model files: exact round trips of robots, functions, kernels and coarse models; the contents of the header."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from math_bank import constant_kernel
from model_file_bank import planar
from product_bank import Case

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kernels.base import SumKernel
from diffeo_calib.robots import elastic_rr


def test_robot_models_come_back_bit_for_bit(arm: Case, tmp_path: Path) -> None:
    """Of the other kinds: tests/test_laws_of_kinds.py."""
    model, q = arm.model, arm.test.q[:50]
    dc.save(model, tmp_path / "model.safetensors")
    again = dc.load(tmp_path / "model.safetensors")
    assert isinstance(again, dc.CalibratedKinematics)
    assert torch.equal(again.jacobian(q), model.jacobian(q))
    for mine, theirs in zip(again.predict(q), model.predict(q), strict=True):
        assert torch.equal(mine, theirs)
    assert again.report == model.report
    assert again.robot.to_config() == model.robot.to_config()
    assert again.rigid_errors is not None
    assert torch.equal(again.rigid_errors, arm.result.identification.geometry.joint_errors)
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
    for other in (lambda x: x[:, :1], lambda x: x, elastic_rr.real):
        with pytest.raises(InputError, match="`nominal` is not the map that the model was fitted to"):
            dc.load(path, nominal=other)


def test_models_of_robots_are_loaded_without_a_function(sound: bytes, tmp_path: Path) -> None:
    (tmp_path / "model").write_bytes(sound)
    with pytest.raises(InputError, match="`nominal` was given, but the file holds its robot"):
        dc.load(tmp_path / "model", nominal=elastic_rr.nominal)


def test_every_kernel_comes_back(tmp_path: Path) -> None:
    mixed = dc.Space((True, False))
    kernels = (
        *(dc.Gaussian((0.7, 1.1), 0.02), dc.Matern(0.9, 1.5, 0.02), dc.Matern(0.9, 2.5, 0.01)),
        *(dc.Matern(0.9, 3.5, 0.02, space=mixed), dc.Cauchy(0.8, (0.01, 0.02)), constant_kernel(0.05)),
        *(dc.VonMises((1.0, 2.0), (0.02, 0.01)), dc.PerJoint((0.5, 0.9), (0.01, 0.0), mixed)),
    )
    fit, path = planar(SumKernel(kernels), SumKernel(kernels[::-1])), tmp_path / "model.safetensors"
    dc.save(fit.model, path)
    x = torch.linspace(-2, 2, 24, dtype=torch.float64).reshape(12, 2)
    again = dc.load(path, nominal=elastic_rr.nominal)
    assert torch.equal(again(x), fit.model(x))
    assert torch.equal(again.predict(x)[1], fit.model.predict(x)[1])


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
