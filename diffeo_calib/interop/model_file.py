"""Model files: tensors in safetensors, everything else in its JSON header. Loading executes nothing.

container.py reads the file, model_header.py defines its contents.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from safetensors.torch import save as safetensors
from torch import Tensor

from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.errors import DiffeoCalibError, InputError, ModelFileError, as_written, printable
from diffeo_calib.common.files import write_whole
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.interop.container import ENTRY, UNSOUND, Header, digest, read_arrays
from diffeo_calib.interop.model_header import (
    KernelClasses,
    MissingArgumentError,
    Tensors,
    describe,
    rebuild,
)
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kinematics.calibrated import CalibratedKinematics

LOG = logging.getLogger(__name__)


def save(model: CalibratedKinematics | FittedMap, path: str | os.PathLike[str]) -> None:
    """Write a calibrated model to one file; an existing file is replaced atomically.

    Args:
        model: ``result.model`` of a calibration, or ``fit.model``. If the nominal map is a plain function, only the
            deformation is stored: pass the function to :func:`load` again.
        path: the file, usually ``*.safetensors``.

    Raises:
        InputError: not a calibrated model, a model in the paper's Eulerian formulation (which cannot be stored), or a
            file that cannot be written.
    """
    header, tensors = describe(model)
    header["digest"] = digest(header, tensors)
    write_whole(path, safetensors(tensors, metadata={ENTRY: json.dumps(header)}))
    LOG.info("model written to %s", printable(str(path)))


@outside_inference_mode
def load(
    path: str | os.PathLike[str],
    nominal: Callable[[Tensor], Tensor] | None = None,
    *,
    kernels: KernelClasses | None = None,
) -> CalibratedKinematics | FittedMap:
    """Read a model that :func:`save` wrote; nothing in the file is executed.

    Args:
        path: the file.
        nominal: the nominal map, for a model of a plain function; files of robots contain theirs.
        kernels: kernel classes that are not part of the package, by class name; files contain the names and arguments
            of such kernels, but not their code.

    Returns:
        the model, bit for bit equal to the saved one on the same machine.

    Raises:
        ModelFileError: a missing, truncated or edited file, another format version, or not a model file.
        InputError: ``nominal`` is missing, or passed for a robot; a class is missing in ``kernels``.
    """
    _check_classes(kernels)
    header, tensors = read(Path(path))
    try:
        return rebuild(header, tensors, nominal, kernels or {})
    except (ModelFileError, MissingArgumentError):
        raise
    except (*UNSOUND, DiffeoCalibError) as error:
        raise ModelFileError.of(
            f"{path} has contents that do not fit together ({error})", fix="save the model again"
        ) from error


def _check_classes(kernels: object) -> None:
    """Raise InputError unless these are classes of kernels by name, or None."""
    if kernels is None:
        return
    classes = list(kernels.values()) if isinstance(kernels, Mapping) else [kernels]
    if not isinstance(kernels, Mapping) or not all(isinstance(c, type) and issubclass(c, Kernel) for c in classes):
        fix = "pass the class itself, such as kernels={'MyKernel': MyKernel}"
        raise InputError.of(
            "`kernels`", expected="names -> subclasses of dc.Kernel", got=as_written(kernels)[:80], fix=fix
        )


def read(path: Path) -> tuple[Header, Tensors]:
    """Header and tensors of a file, after checking its format and checksum.

    Raises:
        ModelFileError: the file cannot be read, or has another format or a wrong checksum.
    """
    header, arrays = read_arrays(path)
    return header, {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}
