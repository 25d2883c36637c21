"""Model files for tests: fits of a planar arm, headers of files, and an editor that renews the checksum."""

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.errors import ModelFileError
from diffeo_calib.interop import model_file
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.robots import elastic_rr


def planar(kernel_x: Kernel | None = None, kernel_y: Kernel | None = None, rows: int = 20) -> dc.Fit:
    """A fit of the planar elastic robot, a plain function."""
    x = torch.from_numpy(np.random.default_rng(0).uniform(-1.5, 1.5, (rows, 2)))
    problem = dc.Problem(
        elastic_rr.nominal,
        x,
        elastic_rr.real(x),
        joint_kernel=kernel_x or dc.VonMises((1.0, 2.0), 0.1),
        task_kernel=kernel_y or dc.Gaussian(0.5, 0.01),
        noise=0.02,
    )
    return dc.fit(problem, integrator=dc.RK4(2))


def refused(path: Path) -> str:
    """The message, one clear sentence, with which a file is refused."""
    with pytest.raises(ModelFileError) as caught:
        dc.load(path)
    text = str(caught.value)
    assert "\n" not in text
    assert text.endswith(".")
    assert len(text) < 800
    return text


class Editor:
    """Edits a sound file and renews its checksum, so that the remaining checks are reached."""

    def __init__(self, sound: bytes, folder: Path) -> None:
        self.path = folder / "edited.safetensors"
        self.path.write_bytes(sound)
        self.header, self.tensors = model_file.read(self.path)

    def write(self, edit: Callable[[dict[str, Any], dict[str, Tensor]], object], *, sign: bool = True) -> Path:
        header, tensors = copy.deepcopy(self.header), {name: t.clone() for name, t in self.tensors.items()}
        digest = model_file.digest(header, tensors)
        edit(header, tensors)
        header["digest"] = model_file.digest(header, tensors) if sign else digest
        save_file(tensors, self.path, metadata={model_file.ENTRY: json.dumps(header)})
        return self.path


def set_entry(*keys: Any, value: Any) -> Callable[[Any, Any], None]:
    def edit(header: Any, _: Any) -> None:
        for key in keys[:-1]:
            header = header[key]
        header[keys[-1]] = value

    return edit


def set_tensor(name: str, change: Callable[[Tensor], Tensor | None]) -> Callable[[Any, Any], None]:
    def edit(_: Any, tensors: dict[str, Tensor]) -> None:
        new = change(tensors.pop(name))
        if new is not None:
            tensors[name] = new.contiguous()

    return edit
