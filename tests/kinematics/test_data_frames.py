"""Arrays of every kind at every public name: data frames by name, numbers in all forms, and what is refused."""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import numpy as np
import pandas as pd
import polars as pl
import pytest
import torch
from math_bank import constant_kernel
from product_bank import Case, usual_scales
from scipy.spatial.transform import Rotation
from section_5 import section_5
from table_bank import refused
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.robots import elastic_rr
from diffeo_calib.robots.simulated_arm import URDF_FILE

LIBRARIES = [pytest.param(pd.DataFrame, id="pandas"), pytest.param(pl.DataFrame, id="polars")]
Table = Callable[[dict[str, Any]], Any]


def shuffled(table: Table, robot: dc.Chain, q: Tensor) -> Any:
    """A data frame whose joints are in another order, among other columns."""
    columns = {name: q[:, k].numpy() for k, name in enumerate(robot.joint_names)}
    order = sorted(columns, reverse=True)
    assert order != list(columns)
    others: dict[str, Any] = {"measured": ["yes"] * len(q), "x [mm]": range(len(q))}
    return table(others | {name: columns[name] for name in order})


@pytest.mark.parametrize("table", LIBRARIES)
def test_columns_are_taken_by_name(table: Table, arm: Case, posed: Case) -> None:
    model, q = arm.model, arm.test.q[:4]
    frame = shuffled(table, arm.robot, q)
    calls: list[Callable[[Any], Any]] = [
        model,
        model.jacobian,
        model.tool_poses,
        model.tool_jacobian,
        posed.model.poses,
        arm.robot,
        arm.robot.jacobian,
        lambda q: model.inverse(model(arm.test.q[:4]), q),
        lambda q: dc.joints_outside_range(model, q),
        lambda q: dc.compensate(model, arm.robot(arm.test.q[:4]), q).q,
        lambda q: dc.rows_used_in_fit(model, q),
        lambda q: dc.Measurements(q, arm.test.points[:4], arm.robot.joint_names).q,
    ]
    pairs: list[Callable[[Any], Any]] = [model.predict, model.predict_tool_poses, posed.model.predict_poses]
    for call in calls:
        assert torch.equal(call(frame), call(q))
    for call in pairs:
        for found, expected in zip(call(frame), call(q), strict=True):
            assert torch.equal(found, expected)
    for k, name in enumerate(arm.robot.joint_names):
        assert torch.equal(model.transmission(name, frame), model.transmission(name, q[:, k]))
        assert torch.equal(model.transmission(name, frame[name]), model.transmission(name, q[:, k]))


@pytest.mark.parametrize("table", LIBRARIES)
def test_data_frames_that_cannot_be_taken(table: Table, arm: Case) -> None:
    names, model = arm.robot.joint_names, arm.model
    columns = {name: arm.test.q[:4, k].numpy() for k, name in enumerate(names)}
    missing = table({name: columns[name] for name in names[:-1]} | {"last": columns[names[-1]]})
    words, gaps = table(columns | {names[0]: ["far"] * 4}), table({name: [0.0, None] for name in names})
    twice: Any = pd.DataFrame([[0.0] * 7], columns=pd.Index([*names, names[0]]))
    kernel: Any = {"joint_kernel": constant_kernel(1.0), "task_kernel": constant_kernel(1.0), "noise": 0.1}
    plain = "`x` is a data frame, but the inputs of this map have no names"
    refused(
        (rf"has no column \['{names[-1]}'\]: expected columns .* got .*'last'", lambda: model(missing)),
        ("has no column", lambda: dc.Measurements(missing, arm.test.points[:4], names)),
        ("`q`: expected a data frame or an array, got Series", lambda: model(table(columns)[names[0]])),
        (f"column '{names[0]}' of the data frame `q` cannot be read as numbers", lambda: model(words)),
        (r"6 value\(s\) that are not finite, the first at index \[1, 0\]", lambda: model(gaps)),
        (plain, lambda: dc.Problem(lambda x: x, table({"a": [0.0, 1.0]}), [[0.0], [1.0]], **kernel)),
        (f"has several columns named \\['{names[0]}'\\]", lambda: model(twice)),
    )


def test_errors_of_every_row(pair: Case) -> None:
    data = pair.test[5:25]
    found = dc.evaluate(pair.model, data)
    frame = found.to_frame()
    away = (data.points - pair.model(data.q)).numpy()
    assert list(frame.columns) == ["row", "marker", "x", "y", "z", "error"]
    assert list(frame["row"]) == [row for row in range(5, 25) for _ in range(data.markers)]
    assert frame.groupby("marker").size().tolist() == [20] * data.markers
    np.testing.assert_allclose(frame[["x", "y", "z"]], away.reshape(-1, 3), atol=1e-15)
    np.testing.assert_allclose(frame["error"], np.linalg.norm(frame[["x", "y", "z"]], axis=1), rtol=1e-12)
    assert np.sqrt((frame["error"] ** 2).mean()) == pytest.approx(found.rms)
    some = found.rows(torch.tensor([3, 1])).to_frame()
    assert list(some["row"]) == [row for row in (8, 6) for _ in range(data.markers)]


def test_poses_have_angles_and_rotation_vectors(posed: Case) -> None:
    data = posed.test[:6]
    frame = dc.evaluate(posed.model, data).to_frame()
    assert list(frame.columns)[-2:] == ["error", "angle"]
    turns = Rotation.from_matrix(posed.model.poses(data.q)[:, :3, :3].detach().numpy())
    measured = Rotation.from_matrix(data.poses[:, :3, :3].numpy())  # pyright: ignore[reportOptionalSubscript]
    np.testing.assert_allclose(frame["angle"], (turns.inv() * measured).magnitude(), atol=1e-9)
    table, predicted = data.to_frame(), posed.model.to_frame(data.q)
    for found, expected in ((table, measured), (predicted, turns)):
        again = Rotation.from_rotvec(found[["rx", "ry", "rz"]].to_numpy(copy=True))
        np.testing.assert_allclose(again.as_matrix(), expected.as_matrix(), rtol=0, atol=1e-9)
    _, covariance = posed.model.predict_poses(data.q)
    std = predicted[[f"std_{name}" for name in ("x", "y", "z", "rx", "ry", "rz")]]
    np.testing.assert_allclose(std**2, covariance.diagonal(dim1=1, dim2=2), rtol=1e-9)


def test_measurements_come_back(pair: Case) -> None:
    data = pair.train[[4, 2, 9]].with_joint_names(pair.robot.joint_names)
    frame = data.to_frame()
    assert list(frame.index) == [4, 2, 9]
    assert list(frame.columns)[6:] == [f"marker{k}_{axis}" for k in (1, 2) for axis in "xyz"]
    again = dc.Measurements(frame, frame.iloc[:, 6:].to_numpy().reshape(3, 2, 3), pair.robot.joint_names)
    assert torch.equal(again.q, data.q)
    assert torch.equal(again.points, data.points)
    known = dc.Measurements(data.q, data.points, std=1e-5).to_frame()
    assert (known[[f"std_marker{k}_{axis}" for k in (1, 2) for axis in "xyz"]] == 1e-5).all(axis=None)


pytestmark = [
    pytest.mark.filterwarnings("ignore::UserWarning:torch"),  # nested and sparse tensors are young
    pytest.mark.filterwarnings("ignore:torch.quantize_per_tensor"),
]


def masked(t: Tensor) -> np.ma.MaskedArray:
    array = np.ma.masked_array(t.numpy().copy(), mask=np.zeros(tuple(t.shape), bool))
    array[(0,) * t.ndim] = np.ma.masked
    return array


def deep(_: Tensor) -> object:
    return reduce(lambda inner, _: [inner], range(5000), 1.0)


REFUSED: dict[str, Callable[[Tensor], object]] = {
    "sparse": lambda t: t.to_sparse(),
    "nested": lambda t: torch.nested.nested_tensor([t, t[:1]]),
    "meta": lambda t: t.to("meta"),
    "quantized": lambda t: torch.quantize_per_tensor(t.float(), 0.1, 0, torch.qint8),
    "complex": lambda t: t.numpy() + 1j,
    "booleans": lambda t: t > 0,
    "boolean array": lambda t: t.numpy() > 0,
    "dates": lambda t: np.zeros(t.shape, "datetime64[s]"),
    "durations": lambda t: np.ones(t.shape, "timedelta64[s]"),
    "records": lambda t: np.zeros(t.shape, [("a", float)]),
    "objects": lambda t: np.full(t.shape, None, dtype=object),
    "words": lambda t: np.full(t.shape, "far"),
    "masked": masked,
    "huge integers": lambda t: np.full(t.shape, 10**400, dtype=object),
    "huge numbers": lambda t: t * 0 + 1e200,
    "deep": deep,
    "a function": lambda _: len,
    "a class": lambda _: Tensor,
}
RIGHT: dict[str, Callable[[Tensor], object]] = {
    "list": lambda t: t.tolist(),
    "backwards": lambda t: t.numpy()[::-1].copy()[::-1],
    "objects": lambda t: t.numpy().astype(object),
    "texts": lambda t: t.numpy().astype(str),
    "other byte order": lambda t: t.numpy().astype(">f8"),
    "unmasked": lambda t: np.ma.masked_array(t.numpy()),
    "parameter": torch.nn.Parameter,
    "negative view": lambda t: torch.complex(t, -t).conj().imag,
    "columns first": lambda t: np.asfortranarray(t.numpy()),
}
QUERIES = ("model", "jacobian", "predict", "tool_poses", "robot", "outside")
DOORS = (*QUERIES, "measured joints", "measured points", "deviations", "targets", "start", "tool", "values", "points")
PLAIN = ("x", "y", "noise", "controls")


def doors(arm: Case) -> dict[str, tuple[Callable[[Any], Any], Tensor]]:
    """Public names that take arrays, and sound arrays for them."""
    model, q, points = arm.model, arm.test.q[:4], arm.test.points[:4]
    poses = model.tool_poses(q)
    outside = lambda v: dc.joints_outside_range(model, v)  # noqa: E731
    calls = (model, model.jacobian, model.predict, model.tool_poses, arm.robot, outside)
    return dict(zip(QUERIES, ((call, q) for call in calls), strict=True)) | {
        "measured joints": (lambda v: dc.Measurements(v, points).q, q),
        "measured points": (lambda v: dc.Measurements(q, v).points, points),
        "deviations": (lambda v: dc.Measurements(q, points, std=v).std, torch.full_like(points, 1e-3)),
        "targets": (lambda v: dc.compensate(model, v, q).q, poses),
        "start": (lambda v: dc.compensate(model, poses, v).q, q),
        "tool": (lambda v: model.tool_poses(q, v), torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)),
        "values": (lambda v: model.transmission(arm.robot.joint_names[0], v), q[:, 0]),
        "points": (lambda v: model.inverse(v, q), model(q)),
    }


def plain_doors() -> dict[str, tuple[Callable[[Any], Any], Tensor]]:
    x = elastic_rr.grid(3)
    y = elastic_rr.real(x)
    kernels = {"joint_kernel": dc.VonMises((1.0, 1.0)), "task_kernel": dc.Gaussian(0.5)}

    def problem(x: object = x, y: object = y, noise: object = 0.01) -> dc.Problem:
        return dc.Problem(elastic_rr.nominal, x, y, noise=noise, **kernels)  # pyright: ignore[reportArgumentType]

    noise = 1e-4 * torch.eye(2, dtype=torch.float64).repeat(9, 1, 1)
    return {
        "x": (lambda v: problem(x=v).x, x),
        "y": (lambda v: problem(y=v).y, y),
        "noise": (lambda v: problem(noise=v).noise.covariance, noise),
        "controls": (lambda v: problem().with_controls(v).controls, x[:3]),
    }


def first(found: Any) -> Tensor:
    return (found[0] if isinstance(found, tuple) else found).detach()


@pytest.mark.filterwarnings("ignore:no gradient leads from a fit back")
@pytest.mark.parametrize("door", [*DOORS, *PLAIN])
def test_every_kind_of_array(door: str, arm: Case) -> None:
    call, sound = (plain_doors() if door in PLAIN else doors(arm))[door]
    expected = first(call(sound))
    for name, kind in RIGHT.items():
        torch.testing.assert_close(first(call(kind(sound))), expected, rtol=0, atol=1e-9, msg=f"{door}: {name}")
    for name, kind in REFUSED.items():
        with pytest.raises(InputError) as caught:
            call(kind(sound))
        text = str(caught.value)
        assert text.isprintable(), (door, name)
        assert text.endswith("."), (door, name)
        assert len(text) < 800, (door, name)


def test_rows_and_seeds(arm: Case) -> None:
    for wrong in (1.5, "one", {"a": 1}, len, torch.zeros(2, device="meta"), None, [[0, 1], [2, 3]], [1 + 1j]):
        with pytest.raises(dc.DiffeoCalibError, match="the selection of rows"):
            arm.test.rows(wrong)
    for seed in (-1, 10**20, 1.5, "7", None, True):
        calls: Any = (
            partial(arm.test.split, 0.5),
            partial(dc.calibrate, arm.robot, arm.train),
        )
        for call in calls:
            with pytest.raises(InputError, match="`seed`: expected an integer from 0 to 9223372036854775807"):
                call(seed=seed)


def test_inference_mode(arm: Case) -> None:
    """Same results, and what was made there can be differentiated outside."""
    q, few, scales = arm.test.q[:4], arm.train[:14], usual_scales(arm.robot)
    expected = dc.calibrate(arm.robot, few, hyperparameters=scales).model(q)
    with torch.inference_mode():
        robot, data = dc.load_urdf(URDF_FILE, "base_link", "flange"), dc.Measurements(few.q * 1, few.points * 1)
        model = dc.calibrate(robot, data, hyperparameters=scales).model
        torch.testing.assert_close(model(q), expected, rtol=0, atol=0)
        assert model.predict(q)[1].isfinite().all()
        dc.compensate(model, model.tool_poses(q), q)
        fit = dc.fit(section_5(k=4), dc.LBFGS(max_iterations=5), dc.RK4(1))
        inside = q * 1
    slopes = torch.autograd.functional.jacobian(lambda row: model(row)[0, 0], q[:1])
    torch.testing.assert_close(slopes[:, 0], model.jacobian(q[:1])[0, 0])
    for one, x in ((model, inside), (fit.model, elastic_rr.grid(4))):
        assert one(x.clone().requires_grad_()).requires_grad
