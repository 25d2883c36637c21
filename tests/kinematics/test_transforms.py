"""torch.func and torch.compile pass through models: they give what the model's own Jacobian gives."""

from __future__ import annotations

import pytest
import torch
from deformation_bank import fitted_plain, made, model_of, queries
from robots_bank import CHAINS
from torch import Tensor
from torch.func import hessian, jacfwd, jacrev, vmap

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.fitting.fitted_map import FittedMap

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script`:DeprecationWarning")  # torch's own, in jacfwd


def same(found: Tensor, expected: Tensor, atol: float = 1e-10) -> None:
    torch.testing.assert_close(found, expected, rtol=0, atol=atol)


@pytest.mark.parametrize("name", ["slides", "mimic joints", "mimic slides", "arm", "a plain map"])
def test_jacobians(name: str) -> None:
    """In both modes, one row and all rows, at control points too."""
    model = fitted_plain("matern32") if name == "a plain map" else made(name)
    q = queries(model)
    expected = model.jacobian(q)

    def f(row: Tensor) -> Tensor:
        return model(row[None])[0]

    same(vmap(f)(q), model(q), 1e-12)
    same(vmap(jacrev(f))(q), expected)
    same(vmap(jacfwd(f))(q), expected)
    same(jacrev(f)(q[0]), expected[0])
    same(jacfwd(f)(q[0]), expected[0])
    same(vmap(lambda row: model.jacobian(row[None])[0])(q), expected)


def test_second_derivatives_against_differences_of_the_jacobian() -> None:
    model, h = made("slides", profile="matern72"), 1e-5
    q = queries(model)
    found = vmap(hessian(lambda row: model(row[None])[0]))(q)  # (N, 1, 3, n, n)
    for joint in range(q.shape[1]):
        step = h * torch.eye(q.shape[1], dtype=torch.float64)[joint]
        change = (model.jacobian(q + step) - model.jacobian(q - step)) / (2 * h)
        same(found[..., joint], change, 1e-7)


@pytest.mark.parametrize("frame", ["base", "measuring"])
def test_derivatives_of_tool_poses(frame: str) -> None:
    """Not zero, although the poses of plain queries are detached."""
    model = made("arm")
    q = queries(model)
    slopes = vmap(jacfwd(lambda row: model.tool_poses(row[None], frame=frame)[0]))(q)  # (N, 4, 4, n)
    poses, expected = model.tool_poses(q, frame=frame), model.tool_jacobian(q, frame=frame)
    spin = slopes[:, :3, :3].movedim(-1, 1) @ poses[:, None, :3, :3].mT  # (N, n, 3, 3) of [w]x
    turning = torch.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], 1)
    same(torch.cat([slopes[:, :3, 3], turning], 1), expected)
    same(vmap(lambda row: model.tool_jacobian(row[None], frame=frame)[0])(q), expected)
    posed = made("arm", markers=3)
    same(vmap(lambda row: posed.poses(row[None])[0])(q), posed.poses(q), 1e-12)


def test_values_are_checked_outside_of_transforms_only() -> None:
    model = made("arm")
    q = queries(model)
    q[1, 2] = torch.nan
    with pytest.raises(InputError, match="not finite"):
        model(q)
    finite = vmap(lambda row: model(row[None])[0])(q).isfinite().flatten(1).all(1)
    assert finite.tolist() == [True, False, *[True] * (len(q) - 2)]


def test_adaptive_steps_are_refused() -> None:
    model = model_of(CHAINS["one joint"], dc.TorchDiffEq("dopri5"))
    with pytest.raises(InputError, match=r"dc\.RK4 or dc\.RK8, got TorchDiffEq"):
        jacrev(lambda row: model(row[None])[0])(model.configurations[0])


def compiled_agrees(model: dc.CalibratedKinematics | FittedMap) -> None:
    q = queries(model)
    same(torch.compile(model.jacobian, fullgraph=True, backend="eager")(q), model.jacobian(q))
    live = q.clone().requires_grad_()
    values = torch.compile(model, fullgraph=True, backend="aot_eager")(live)
    same(values.detach(), model(q), 1e-12)
    (slope,) = torch.autograd.grad(values.sum(), live)
    same(slope, model.jacobian(q).flatten(1, -2).sum(1))


class Wrapped(torch.nn.Module):
    """A model as a module."""

    def __init__(self, model: object) -> None:
        super().__init__()
        self.model = model

    def forward(self, q: Tensor) -> Tensor:
        return self.model(q)  # pyright: ignore[reportCallIssue]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # torch's own
def test_compiled_without_graph_breaks() -> None:
    torch.compiler.reset()
    compiled_agrees(fitted_plain("matern52"))
    robot = made("mimic slides")
    q = queries(robot)
    same(torch.compile(robot, fullgraph=True, backend="eager")(q), robot(q), 1e-12)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_exported_for_any_number_of_rows() -> None:
    """A robot with poses; a strict export is the capture of `torch.compile` and what this one does with it."""
    model = made("one joint", markers=3)
    q, rows = queries(model), ({0: torch.export.Dim("rows")},)
    program = torch.export.export(Wrapped(model), (q,), dynamic_shapes=rows, strict=False).module()
    for some in (q[:1], q, q.repeat(9, 1)):
        same(program(some), model(some), 1e-12)
