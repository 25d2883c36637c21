"""Model files: tensors in safetensors, everything else in its JSON header. Loading executes nothing.

numpy_model.py reads the file, model_header.py defines its contents.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as safetensors
from torch import Tensor

from diffeo_calib.common.device import outside_inference_mode
from diffeo_calib.common.errors import DiffeoCalibError, InputError, ModelFileError, as_written, printable
from diffeo_calib.common.files import write_whole
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.interop.model_header import KernelClasses, MissingArgumentError, Tensors, describe, rebuild
from diffeo_calib.interop.numpy_model import ENTRY, UNSOUND, Header, digest, read_arrays
from diffeo_calib.kernels.base import Kernel
from diffeo_calib.kernels.profiles import Profile, check_profile
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
        kernels: what is not part of the package, since files contain no code: kernel classes by class name, whose
            arguments are in the file, and profiles by their ``name`` with the parameters of the fit, such as
            ``{"rq": RationalQuadratic(2.5)}``; a class of profiles is called without arguments.

    Returns:
        the model, bit for bit equal to the saved one on the same machine.

    Raises:
        ModelFileError: a missing, truncated or edited file, another format version, or not a model file.
        InputError: ``nominal`` is missing, or passed for a robot; a class or profile is missing in ``kernels``, or the
            profile has other values than that of the fit.

    Warns:
        DiffeoCalibWarning: devices of a kind that nobody registered here, whose readings are not predicted; a profile
            in a file of an old version, which cannot be compared with the one passed.
    """
    known, (header, tensors) = _checked(kernels), read(Path(path))
    try:
        return rebuild(header, tensors, nominal, known)
    except (ModelFileError, MissingArgumentError):
        raise
    except (*UNSOUND, DiffeoCalibError) as error:
        what = f"{path} has contents that do not fit together ({error})"
        raise ModelFileError.of(what, fix="save the model again") from error


def _checked(kernels: object) -> KernelClasses:
    """Classes of kernels, and profiles whose derivatives are right, of classes without arguments, by their names."""
    given: dict[str, Any] = {} if kernels is None else dict(kernels) if isinstance(kernels, Mapping) else {"": None}
    for name, one in given.items():
        if isinstance(one, type) and issubclass(one, Kernel):
            continue
        if not (isinstance(one, Profile) or (isinstance(one, type) and issubclass(one, Profile))):
            fix = "pass the class itself, such as kernels={'MyKernel': MyKernel}, or {'my_profile': MyProfile(2.5)}"
            expected = "names -> subclasses of dc.Kernel, or profiles"
            raise InputError.of("`kernels`", expected=expected, got=as_written(kernels)[:80], fix=fix)
        try:
            given[name] = one() if isinstance(one, type) else one
        except TypeError as error:
            fix = "pass the profile with the parameters of the fit, such as kernels={'my_profile': MyProfile(2.5)}"
            raise InputError.of(f"`kernels`: {as_written(one)} needs arguments ({error})", fix=fix) from error
        check_profile(given[name])
    return given


def read(path: Path) -> tuple[Header, Tensors]:
    """Header and tensors of a file, after checking its format and checksum; ModelFileError as :func:`read_arrays`."""
    header, arrays = read_arrays(path)
    return header, {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}
