"""Model files: tensors in safetensors, everything else in its JSON header. Loading executes nothing.

The header says what the file is (format version, units, robot, kernels, time stepping, residuals of
the fit); a SHA-256 over header and tensors tells a damaged or edited file from a sound one.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, positive
from diffeo_calib.common.errors import DiffeoCalibError, InputError, ModelFileError, sentence
from diffeo_calib.flows.integrators import RK4, RK8, Integrator
from diffeo_calib.flows.torchdiffeq import TorchDiffEq
from diffeo_calib.kernels.profiles import CauchyProfile, ConstantProfile, GaussianProfile, MaternProfile, Profile
from diffeo_calib.kernels.radial import Kernel, RadialKernel, SumKernel
from diffeo_calib.kinematics.calibrated import CalibratedKinematics, CalibratedMap
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.maps.geodesic import GeodesicDeformation, ModelSpec, Momenta
from diffeo_calib.maps.noise import Noise
from diffeo_calib.maps.nominal import NominalMap, SmoothMap
from diffeo_calib.paper.eulerian_model import EulerianMap
from diffeo_calib.robots.chain import Chain, Joint
from diffeo_calib.robots.geometry import Geometry

FORMAT = 3
"""Version of the file layout; a reader refuses any other."""
ENTRY = "diffeo_calib"
UNITS = {"length": "m", "angle": "rad"}
PROFILES: dict[str, Callable[[], Profile]] = {
    "gaussian": GaussianProfile,
    "cauchy": CauchyProfile,
    "constant": ConstantProfile,
    "matern32": lambda: MaternProfile(1.5),
    "matern52": lambda: MaternProfile(2.5),
    "matern72": lambda: MaternProfile(3.5),
}
MOMENTA = ("x", "momenta_x", "momenta_y", "theta", "noise", "prior_variance", "new_noise")
PROBES = 8
"""Configurations at which a function given again is compared with the one of the fit."""
GEOMETRY = ("base", "joint_errors", "tool")
DATA = "data"
"""Measured configurations of a coarse model; of any other they are its control points x."""
INTEGRATORS: dict[str, type[RK4 | RK8 | TorchDiffEq]] = {"rk4": RK4, "rk8": RK8, "torchdiffeq": TorchDiffEq}

Header = dict[str, Any]
Tensors = dict[str, Tensor]


def save(model: CalibratedKinematics | CalibratedMap | EulerianMap, path: str | os.PathLike[str]) -> None:
    """Write a calibrated model to one file, replacing it in one step.

    Args:
        model: ``result.model`` of a calibration, or ``fit.model``. Of a plain function as nominal map
            only the deformation is stored: pass the function to :func:`load` again.
        path: where, usually ``*.safetensors``.

    Raises:
        InputError: not a calibrated model, one in the paper's Eulerian formulation (files hold the exact model), or the
            folder does not exist or cannot be written.
    """
    target = Path(path)
    if target.exists() and not target.is_file():
        raise InputError(
            sentence(f"the model cannot be written to {target}", expected="a file", fix="name another place")
        )
    header, tensors = _describe(model)
    header["digest"] = _digest(header, tensors)
    try:
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=target.name, suffix=".part")
        os.close(handle)
        try:
            save_file(tensors, name, metadata={ENTRY: json.dumps(header)})
            Path(name).chmod(0o666 & ~_umask())  # mkstemp's file is for its owner alone
            os.replace(name, target)
        finally:
            Path(name).unlink(missing_ok=True)
    except (OSError, SafetensorError) as error:
        raise InputError(
            sentence(
                f"the model cannot be written to {target} ({getattr(error, 'strerror', None) or error})",
                fix="check the folder",
            )
        ) from error


def load(
    path: str | os.PathLike[str], nominal: Callable[[Tensor], Tensor] | None = None
) -> CalibratedKinematics | CalibratedMap:
    """Read a model that :func:`save` wrote; nothing in the file is executed.

    Args:
        path: the file.
        nominal: the nominal map, for a model of a plain function; robots carry their own.

    Returns:
        the model, equal to the saved one to the last bit on the same machine.

    Raises:
        ModelFileError: missing, cut short, edited, of another format version, or not such a file.
        InputError: ``nominal`` is missing, or given for a robot.
    """
    header, tensors = _read(Path(path))
    try:
        return _rebuild(header, tensors, nominal)
    except ModelFileError:
        raise
    except (KeyError, TypeError, ValueError, DiffeoCalibError) as error:
        if isinstance(error, InputError) and "`nominal`" in str(error):
            raise
        raise ModelFileError(
            sentence(f"{path} has contents that do not fit together ({error})", fix="save the model again")
        ) from error


def _describe(model: CalibratedKinematics | CalibratedMap | EulerianMap) -> tuple[Header, Tensors]:
    inner = model.map if isinstance(model, CalibratedKinematics) else model
    if not isinstance(inner, CalibratedMap):
        expected, fix = "a calibrated model", "pass `result.model` or `fit.model`"
        if isinstance(inner, EulerianMap):
            expected, fix = "an exact model", 'fit with formulation="exact"'
        raise InputError(sentence("`model`", expected=expected, got=type(model).__name__, fix=fix))
    spec, deformation = inner.deformation.spec, inner.deformation
    nominal, geometry = _describe_nominal(spec.nominal, deformation.x)
    momenta = deformation.momenta
    values = (deformation.x, *momenta.tensors, inner.noise.covariance, spec.prior_variance, inner.new_noise)
    tensors = dict(zip(MOMENTA, values, strict=True)) | geometry
    if inner.x is not deformation.x:
        tensors[DATA] = inner.x
    header: Header = {
        "format": FORMAT,
        "units": UNITS,
        "nominal": nominal,
        "joint_kernel": _describe_kernel(spec.joint_kernel),
        "task_kernel": _describe_kernel(spec.task_kernel),
        "task_dim": spec.task_dim,
        "integrator": _describe_integrator(deformation.integrator),
        "report": model.report if isinstance(model, CalibratedKinematics) else {},
        "lever": model.lever if isinstance(model, CalibratedKinematics) else None,
    }
    return header, {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items()}


def _describe_integrator(integrator: Integrator) -> Header:
    for name, kind in INTEGRATORS.items():
        if type(integrator) is kind:
            return {"kind": name, **asdict(integrator)}
    raise InputError(sentence("the integrator cannot be saved", expected=", ".join(INTEGRATORS), got=repr(integrator)))


def _rebuild_integrator(description: Header) -> Integrator:
    if not isinstance(description, dict):
        raise InputError(sentence("the entry integrator", expected="a table", got=description))
    kind = description.get("kind")
    if not isinstance(kind, str) or kind not in INTEGRATORS:
        raise InputError(sentence("the kind of integrator", expected=", ".join(INTEGRATORS), got=repr(kind)))
    return INTEGRATORS[kind](**{name: value for name, value in description.items() if name != "kind"})


def _describe_nominal(nominal: NominalMap, x: Tensor) -> tuple[Header, Tensors]:
    if isinstance(nominal, SmoothMap):
        return {"kind": "function"}, {"probe": nominal.function(x[:PROBES])}
    if not isinstance(nominal, GeometryMap):
        raise InputError(
            sentence("the nominal map cannot be saved", expected="a robot or a function", got=type(nominal).__name__)
        )
    geometry, chain = nominal.geometry, nominal.geometry.chain
    joints = [
        {
            "name": j.name,
            "kind": j.kind,
            "origin": j.origin.tolist(),
            "axis": j.axis.tolist(),
            "lower": _number(j.lower),
            "upper": _number(j.upper),
            "mimic": j.mimic,
            "mimic_offset": j.mimic_offset,
        }
        for j in chain.joints
    ]
    robot = {"kind": "robot", "name": chain.name, "base": chain.base, "tip": chain.tip, "joints": joints}
    robot["elastic"] = nominal.elasticity is not None
    return robot, {name: getattr(geometry, name) for name in GEOMETRY}


def _describe_kernel(kernel: Kernel) -> list[Header]:
    terms = kernel.terms if isinstance(kernel, SumKernel) else (kernel,)
    return [_describe_term(term) for term in terms]


def _describe_term(term: Kernel) -> Header:
    names = [name for name, make in PROFILES.items() if isinstance(term, RadialKernel) and make() == term.profile]
    if not isinstance(term, RadialKernel) or not names:
        raise InputError(
            sentence("a kernel cannot be saved", expected=f"profiles {', '.join(PROFILES)}", got=repr(term))
        )
    return {
        "profile": names[0],
        "lengthscale": term.lengthscale.tolist(),
        "variance": term.variance.tolist(),
        "periodic": term.periodic,
        "columns": term.columns,
        "output": term.output,
    }


def _read(path: Path) -> tuple[Header, Tensors]:
    if not path.is_file():
        raise ModelFileError(sentence(f"there is no model file {path}", fix="check the path"))
    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(ENTRY)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # not a dict
        header = json.loads(text) if text is not None else None
    except (SafetensorError, OSError, ValueError, RecursionError) as error:
        raise ModelFileError(
            sentence(
                f"{path} cannot be read as a model file ({error})",
                fix="it is damaged or cut short: copy or save it again",
            )
        ) from error
    if not isinstance(header, dict):
        raise ModelFileError(
            sentence(f"{path} is not a diffeo_calib model", fix="pass a file written by `save` or `fit -o`")
        )
    if header.get("format") != FORMAT:
        raise ModelFileError(
            sentence(
                f"{path} has format version {header.get('format')!r}",
                expected=FORMAT,
                fix="read it with the version that wrote it",
            )
        )
    if header.pop("digest", None) != _digest(header, tensors):
        raise ModelFileError(
            sentence(f"{path} was damaged or edited: its checksum does not match", fix="save the model again")
        )
    return header, tensors


def _rebuild(
    header: Header, tensors: Tensors, nominal: Callable[[Tensor], Tensor] | None
) -> CalibratedKinematics | CalibratedMap:
    known = {"format", "units", "nominal", "joint_kernel", "task_kernel", "task_dim", "integrator", "report", "lever"}
    if set(header) != known or header["units"] != UNITS:
        raise ModelFileError(
            sentence("the header of the model file is not understood", expected=sorted(known), got=sorted(header))
        )
    x, b, p, theta, noise, prior, new_noise = (tensors[name] for name in MOMENTA)
    nominal_map = _rebuild_nominal(header["nominal"], tensors, nominal)
    _check_sizes(header, tensors, nominal_map)
    spec = ModelSpec(
        nominal_map,
        _rebuild_kernel(header["joint_kernel"]),
        _rebuild_kernel(header["task_kernel"]),
        prior,
        header["task_dim"],
    )
    spec.joint_kernel.check(x.shape[1], "joint_kernel")
    spec.task_kernel.check(spec.task_dim, "task_kernel")
    integrator = _rebuild_integrator(header["integrator"])
    map_ = CalibratedMap(
        GeodesicDeformation(spec, x, Momenta(b, p, theta), integrator), Noise(noise), tensors.get(DATA, x), new_noise
    )
    if isinstance(spec.nominal, GeometryMap):
        return CalibratedKinematics(spec.nominal.geometry.chain, map_, header["report"], lever=header["lever"])
    if header["lever"] is not None:
        raise InputError(sentence("the entry lever", expected="null for a plain function", got=header["lever"]))
    return map_


def _check_sizes(header: Header, tensors: Tensors, nominal: NominalMap) -> None:
    """Raise InputError unless all tensors are finite float64 and their shapes agree."""
    expected = {*MOMENTA, *(GEOMETRY if isinstance(nominal, GeometryMap) else ("probe",))}
    if set(tensors) - {DATA} != expected:
        raise InputError(sentence("the tensors of the file", expected=sorted(expected), got=sorted(tensors)))
    (n_rows, n), (_, m, _) = tensors["x"].shape, tensors["noise"].shape
    dim, size = header["task_dim"], nominal.parameters
    if type(dim) is not int or dim < 1 or m % dim or (isinstance(nominal, GeometryMap) and dim != 3):
        raise InputError(sentence("the entry task_dim", expected=f"a divisor of {m}, 3 for a robot", got=dim))
    if not isinstance(header["report"], dict):
        raise InputError(sentence("the entry report", expected="a table", got=type(header["report"]).__name__))
    if isinstance(nominal, GeometryMap) and n != nominal.geometry.chain.n:
        raise InputError(sentence("the tensor x", expected=f"{nominal.geometry.chain.n} active joints", got=n))
    data = len(tensors.get(DATA, tensors["x"]))
    shapes = {
        "x": (n_rows, n),
        "momenta_x": (n_rows, n),
        "momenta_y": (n_rows * m // dim, dim),
        "theta": (size,),
        "noise": (data, m, m),
        "prior_variance": (size,),
        "new_noise": (m, m),
    } | ({DATA: (data, n)} if DATA in tensors else {})
    for name, shape in shapes.items():
        if tensors[name].dtype != torch.float64:
            raise InputError(sentence(f"the tensor {name}", expected="float64", got=tensors[name].dtype))
        as_tensor(tensors[name], name, shape, empty=size == 0)
    if size:
        positive(tensors["prior_variance"], "prior_variance", (size,))
    new = tensors["new_noise"]
    skewed = bool(((new - new.mT).abs() > 1e-9 * new.abs().max()).any())
    if skewed or int(torch.linalg.cholesky_ex(new).info):
        raise InputError(sentence("the tensor new_noise", expected="a symmetric positive definite matrix in m^2"))


def _rebuild_nominal(description: Header, tensors: Tensors, nominal: Callable[[Tensor], Tensor] | None) -> NominalMap:
    if description["kind"] == "function":
        if nominal is None:
            raise InputError(
                sentence(
                    "`nominal` is missing: this model deforms a plain function", fix="pass the same function again"
                )
            )
        value = nominal(tensors["x"][:PROBES])
        if value.shape != tensors["probe"].shape or not torch.allclose(value, tensors["probe"], rtol=1e-9, atol=1e-12):
            raise InputError(
                sentence("`nominal` is not the map that the model was fitted to", fix="pass the same function")
            )
        return SmoothMap(nominal)
    if description["kind"] != "robot":
        raise ModelFileError(sentence("the kind of nominal map", expected="robot or function", got=description["kind"]))
    if nominal is not None:
        raise InputError(sentence("`nominal` was given, but the file holds its robot", fix="leave it out"))
    joints = [
        Joint(
            j["name"],
            j["kind"],
            torch.tensor(j["origin"], dtype=torch.float64),
            torch.tensor(j["axis"], dtype=torch.float64),
            _infinite(j["lower"], -torch.inf),
            _infinite(j["upper"], torch.inf),
            j["mimic"],
            j["mimic_offset"],
        )
        for j in description["joints"]
    ]
    chain = Chain(description["name"], description["base"], description["tip"], joints)
    geometry = Geometry(chain, *(tensors[name] for name in GEOMETRY))
    if not isinstance(description["elastic"], bool):
        raise InputError(sentence("the entry elastic", expected="true or false", got=description["elastic"]))
    return GeometryMap(geometry, elastic=description["elastic"])


def _rebuild_kernel(terms: list[Header]) -> Kernel:
    unknown = [t["profile"] for t in terms if t["profile"] not in PROFILES]
    if unknown:
        raise ModelFileError(
            sentence("the model uses a kernel that is not known", expected=", ".join(PROFILES), got=unknown[0])
        )
    kernels = [RadialKernel(PROFILES[t["profile"]](), **{k: v for k, v in t.items() if k != "profile"}) for t in terms]
    return kernels[0] if len(kernels) == 1 else SumKernel(kernels)


def _digest(header: Header, tensors: Tensors) -> str:
    sha = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        sha.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        sha.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return sha.hexdigest()


def _umask() -> int:
    mask = os.umask(0o022)  # reading it means setting it
    os.umask(mask)
    return mask


def _number(limit: float | None) -> float | None:
    """A joint limit for JSON, which knows no infinity."""
    return None if limit is None or abs(limit) == torch.inf else limit


def _infinite(limit: float | None, default: float) -> float:
    return default if limit is None else limit
