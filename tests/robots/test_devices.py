"""Robots do not depend on torch's default device: every tensor is made on the device of its input, or on the CPU."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from robots_bank import crooked, draw
from torch import Tensor

from diffeo_calib.robots import Chain, Geometry, SimulatedArm, elastic_rr, from_dh, load_urdf, se3
from diffeo_calib.robots.gravity import GravitySag

URDF = Path(se3.__file__).with_name("simulated_arm.urdf")


def mixed() -> Chain:
    """Turns, a slide, a fixed joint and a mimic joint."""
    return crooked(["revolute", "prismatic", "fixed", "revolute", "revolute"], {4: {"j0": -1.0}})


def geometry() -> Geometry:
    chain = mixed()
    errors = se3.twist_transform(draw(chain.moving, 6, seed=1, size=0.1))
    return replace(Geometry.nominal(chain, 2), joint_errors=errors)


def theta() -> Tensor:
    return draw(geometry().size, seed=3, size=0.1)


def sag() -> tuple[GravitySag, Tensor]:
    made = GravitySag(mixed())
    return made, draw(made.size, seed=4)


def measured() -> tuple[Tensor, ...]:
    arm = SimulatedArm(seed=1, markers=2)
    q, points = arm.measure(4, seed=2)
    parts = arm.components(q)
    return q, points, arm.gravity_torques(q), parts.transmission, parts.gravity, parts.geometry


def constants(chain: Chain) -> tuple[Tensor, ...]:
    described = (chain.limits, chain.coupling, chain.coupling_offset, chain.axes, chain.offsets, chain.tip_offsets[0])
    return *described, chain.motion_terms, torch.tensor(chain.reach, dtype=torch.float64, device="cpu")


def urdf_and_table() -> tuple[Tensor, ...]:
    table = from_dh([(0.1, 0.2, 0.3), (0.4, 0.5, 0.6, 0.7, "prismatic")], "craig")
    standard = from_dh([(0.1, 0.2, 0.3)])
    return *constants(load_urdf(URDF, "base_link", "flange")), *constants(table), *constants(standard)


Q = draw(3, 3)
CALLS: dict[str, Callable[[], Tensor | tuple[Tensor, ...]]] = {
    "chain": lambda: mixed()(Q),
    "chain of lists": lambda: mixed()(Q.tolist()),  # pyright: ignore[reportArgumentType]
    "chain's jacobian": lambda: mixed().jacobian(Q),
    "chain's frames": lambda: mixed().joint_frames(Q),
    "chain's constants": lambda: constants(mixed()),
    "urdf and dh": urdf_and_table,
    "poses": lambda: geometry().poses(Q),
    "points": lambda: geometry().points(Q),
    "points at theta": lambda: geometry().points(Q, theta()),
    "jacobian": lambda: geometry().jacobian(Q, theta()),
    "sensitivities": lambda: geometry().sensitivities(Q, theta()),
    "absorb": lambda: geometry().absorb(theta()).points(Q),
    "gravity features": lambda: sag()[0].features(Q),
    "gravity twists": lambda: sag()[0].twists(Q, sag()[1]),
    "gravity slopes": lambda: sag()[0].twist_slopes(Q, sag()[1]),
    "gravity sensitivities": lambda: sag()[0].sensitivities(Q, draw(3, 2, 4, 6, seed=5)),
    "gravity tables": lambda: (sag()[0].joints, sag()[0].own, sag()[0].components),
    "simulated arm": measured,
    "elastic arm": lambda: (elastic_rr.grid(3), elastic_rr.real_links(Q[:, :2]), elastic_rr.nominal(Q[:, :2])),
    "nearest rotations": lambda: se3.nearest_rotations(draw(4, 3, 3, seed=6)),
    "right jacobian": lambda: se3.right_jacobian(Q),
}


@contextmanager
def default_device(name: str) -> Iterator[None]:
    before = torch.get_default_device()
    torch.set_default_device(name)
    try:
        yield
    finally:
        torch.set_default_device(None if before.type == "cpu" else before)


def results(call: Callable[[], Tensor | tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
    found = call()
    return (found,) if isinstance(found, Tensor) else found


@pytest.mark.parametrize("name", CALLS)
def test_the_default_device_changes_nothing(name: str) -> None:
    expected = results(CALLS[name])
    with default_device("meta"):
        found = results(CALLS[name])
    for one, other in zip(found, expected, strict=True):
        assert one.device.type == "cpu"
        assert one.dtype == other.dtype
        assert torch.equal(one, other)


@pytest.mark.parametrize("name", ["chain", "points at theta", "gravity slopes", "simulated arm", "urdf and dh"])
def test_the_default_dtype_changes_nothing(name: str) -> None:
    """float32 is torch's default already: here it is float16, which would show."""
    expected = results(CALLS[name])
    torch.set_default_dtype(torch.float16)
    try:
        found = results(CALLS[name])
    finally:
        torch.set_default_dtype(torch.float32)
    assert all(torch.equal(one, other) for one, other in zip(found, expected, strict=True))
