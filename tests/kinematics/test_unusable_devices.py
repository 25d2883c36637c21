"""Devices that a model is moved to."""

from __future__ import annotations

import pytest
import torch
from product_bank import Case

from diffeo_calib.common.device import usable
from diffeo_calib.common.errors import InputError


@pytest.mark.parametrize("device", ["foo", "cuda:99", torch.float32, 3.5, "meta"])
def test_devices_that_cannot_be_used(device: object, arm: Case) -> None:
    with pytest.raises(InputError, match="the device"):
        usable(device)
    with pytest.raises(InputError, match="the device"):
        arm.model.to(device)  # pyright: ignore[reportArgumentType]


def test_the_cpu() -> None:
    assert usable("cpu") == torch.device("cpu")
