"""Model files: tensors in safetensors, everything else in its JSON header. Loading executes nothing.

numpy_model.py reads the file. The header holds the format version, units, robot, kernels, time stepping and a summary
of the fit.

Only some models have payloads, a registration or sessions. Readers that know nothing of them must refuse such a file:
controls of other payloads or sessions have other markers, and the markers of the fit are not those of a registered
model.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as safetensors
from torch import Tensor

from diffeo_calib.common.checks import as_tensor, check_covariance, check_number, positive
from diffeo_calib.common.device import HOST, outside_inference_mode
from diffeo_calib.common.errors import (
    DiffeoCalibError,
    InputError,
    ModelFileError,
    as_written,
    few,
    printable,
    warn_user,
)
from diffeo_calib.common.files import as_path, write_whole
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.flows import integrator_from_config
from diffeo_calib.interop.numpy_model import ENTRY, FORMAT, UNSOUND, Header, digest, read_arrays
from diffeo_calib.kernels.base import Kernel, SumKernel
from diffeo_calib.kernels.profiles import PROBED_R2, Profile, check_profile, probe
from diffeo_calib.kernels.radial import PROBE, RadialKernel
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.nominal import GeometryMap, PositionErrors, SessionMarkers
from diffeo_calib.kinematics.provenance import Provenance, Summary, entries_of, record_of
from diffeo_calib.kinematics.registered_map import RegisteredMap, Registration
from diffeo_calib.kinematics.tool import tool_transform
from diffeo_calib.maps.deformation import ModelSpec, Momenta
from diffeo_calib.maps.geodesic import GeodesicDeformation
from diffeo_calib.maps.noise import Noise
from diffeo_calib.maps.nominal import NominalMap, SmoothMap
from diffeo_calib.robots.geometry import Geometry
from diffeo_calib.robots.payload import NO_PAYLOAD, Payload
from diffeo_calib.robots.se3 import rigid
from diffeo_calib.robots.tree import robot_from_config
from diffeo_calib.sensors.kinds import stored_devices

UNITS = {"length": "m", "angle": "rad"}
LARGEST_PARAMETER = 1e6  # of a robot, m or rad: beyond it results have no correct digits
ENTRIES = {"format", "units", "nominal", "joint_kernel", "task_kernel", "task_dim", "integrator", "report", "lever"}
OPTIONAL = {"tool", "tool_tip", "urdf", "provenance", "registration", "ball", "placement"}
"""Entries of every header, and those that it may have or not."""
PROBE_CONFIGURATIONS = 8
"""Number of configurations at which a nominal function passed to `load` is compared with that of the fit."""
MOMENTA = ("x", "momenta_x", "momenta_y", "theta", "noise", "prior_variance", "new_noise")
GEOMETRY = ("base", "joint_errors", "tool")
MAP_TENSORS = {
    "data": "data",  # measured configurations of a coarse model; in others the control points x are these
    "workspace": "workspace",  # of a robot that no device has seen: where covariances leave rigid motions out
    "slopes": "slopes",  # linear functionals of the coordinates that were measured; without it, all coordinates were
    "measured": "y",  # what was measured; the first model files did not have it
    "unresolved": "unresolved",  # variances of errors that are too short for the fields, if there are any
}
"""Tensors that only some models have -> attributes of the map."""
ROBOT_TENSORS = ("rigid_errors", "scales")
"""Tensors of every robot's model: joint errors by geometry alone; scales of kernels, priors and noise."""
PAYLOADS = ("payloads", "task_controls", "unladen_theta")
"""Tensors of a model with payloads: mass of every control; then, for readers without the formulas of a payload, the
places of the controls' markers before the task-space flow, and theta of a robot for which the payload of the model is
a part of its own weight."""
SHARED = "shared_noise"
SESSIONS = (SHARED, "session", "session_tools")
"""Effects of shifts that rows share, number of each control's session, markers of each. The last two are missing where
one calibration had several sessions, whose markers are those of the model."""
PREFIX = "registration_"
ARRAYS = ("transform", "markers", "covariance", "centre", "q", "gain", "noise")
LEARNT = "learnt"  # entry of a registration that the map learnt from, no map around another one
PROBE_TOLERANCE = 1e-9
"""Largest relative difference between values of a profile passed to `load` and of that of the fit."""

Tensors = dict[str, Tensor]
KernelClasses = Mapping[str, type[Kernel] | type[Profile] | Profile]


class MissingArgumentError(InputError):
    """Loading needs an argument for something that files cannot contain."""


def describe(model: CalibratedKinematics | FittedMap) -> tuple[Header, Tensors]:
    """The contents of a model's file: its header without checksum, and its tensors.

    Raises InputError: not a calibrated model, the Eulerian formulation, or a part that cannot be saved.
    """
    fitted = model.map if isinstance(model, CalibratedKinematics) else model
    if not isinstance(fitted, FittedMap):
        expected, fix = "a calibrated model", "pass `result.model` or `fit.model`"
        raise InputError.of("`model`", expected=expected, got=type(model).__name__, fix=fix)
    inner = fitted.unregistered
    if inner.formulation != "exact":
        got, fix = f"the {inner.formulation} formulation", 'fit with formulation="exact"'
        raise InputError.of("`model`", expected="an exact model", got=got, fix=fix)
    spec, deformation = inner.deformation.spec, inner.deformation
    nominal, tensors = _describe_nominal(spec.nominal, deformation.x)
    values = (deformation.x, *deformation.momenta.tensors, inner.noise.covariance, spec.prior_variance, inner.new_noise)
    tensors |= dict(zip(MOMENTA, values, strict=True)) | _tensors_of_rows(inner)
    tensors |= {name: getattr(inner, attribute) for name, attribute in MAP_TENSORS.items()}
    header: Header = {
        "report": {},
        "lever": None,
        "format": FORMAT,
        "units": UNITS,
        "nominal": nominal,
        "joint_kernel": _describe_kernel(spec.joint_kernel),
        "task_kernel": _describe_kernel(spec.task_kernel),
        "task_dim": spec.task_dim,
        "integrator": deformation.integrator.to_config(),
    }
    if isinstance(model, CalibratedKinematics):
        tensors |= {name: getattr(model, name) for name in ROBOT_TENSORS}
        made = model.provenance
        entries = {
            "tool": None if torch.equal(model.tool, tool_transform(None)) else model.tool.tolist(),
            "tool_tip": model.tool_tip,
            "urdf": model.robot.source,
            "provenance": None if made is None else entries_of(made, *["program_rows"] * (not made.program_rows)),
            "ball": True if model.ball and model.map.workspace is None else None,
            "placement": [device.stored() for device in model.placement] or None,
        }
        header |= {name: entry for name, entry in entries.items() if entry is not None}
        header |= {"report": model.report, "lever": model.lever}
    if (registration := model.registration) is not None:
        shift = None if registration.shift is None else registration.shift.tolist()
        learnt = {LEARNT: True} if fitted.registration is None else {}
        header["registration"] = entries_of(registration, *ARRAYS, "shift") | {"shift": shift} | learnt
        tensors |= {PREFIX + name: getattr(registration, name) for name in ARRAYS}
    return header, {name: t.detach().cpu().contiguous().clone() for name, t in tensors.items() if t is not None}


def _describe_nominal(nominal: NominalMap, x: Tensor) -> tuple[Header, Tensors]:
    if isinstance(nominal, SmoothMap):
        return {"kind": "function"}, {"probe": nominal.function(x[:PROBE_CONFIGURATIONS])}
    if not isinstance(nominal, GeometryMap):
        got = type(nominal).__name__
        raise InputError.of("the nominal map cannot be saved", expected="a robot or a function", got=got)
    geometry, chain = nominal.geometry, nominal.geometry.chain
    robot: Header = {"kind": "robot", **chain.to_config(), "elastic": nominal.elasticity is not None}
    if len(set(geometry.on)) > 1 or geometry.on[0] != chain.tips[0]:
        robot["on"] = list(geometry.on)
    robot |= {name: list(map(list, given)) for name, given in nominal.own._asdict().items() if given}
    if carried := nominal.load:
        robot["payload"] = {"link": carried.link, "mass": float(carried.masses), "unit": carried.unit}
    return robot, {name: getattr(geometry, name) for name in GEOMETRY}


def _describe_kernel(kernel: Kernel) -> list[Header]:
    """The terms of a kernel: those of the package by profile, users' kernels by the name of their class."""
    return [
        term.to_config()
        if isinstance(term, RadialKernel)
        else {"kernel": type(term).__name__, "arguments": term.to_config()}
        for term in kernel.terms
    ]


def _tensors_of_rows(fitted: FittedMap) -> Tensors:
    """The tensors of sessions and payloads; none where all rows are of one session, and nothing is carried."""
    spec, theta, tensors = fitted.geodesic.spec, fitted.geodesic.momenta.theta, Tensors()
    nominal, by_row, shared = spec.nominal, spec.nominal_of_controls, fitted.noise.shared
    if isinstance(spec.at_controls, SessionMarkers):
        sessions = spec.at_controls
        tensors |= zip(SESSIONS, (shared, sessions.session.to(torch.float64), sessions.tools), strict=True)
    elif shared.shape[2]:
        tensors[SHARED] = shared
    if isinstance(nominal, GeometryMap) and nominal.elasticity is not None and nominal.load:
        rows = by_row.load if isinstance(by_row, GeometryMap | SessionMarkers) else NO_PAYLOAD
        if not rows.by_row:
            raise InputError.of("the model cannot be saved: the payloads of its rows are not known")
        tensors |= zip(PAYLOADS, (rows.masses, fitted.geodesic.task_controls, nominal.folded(theta)), strict=True)
    return tensors


def rebuild(
    header: Header, tensors: Tensors, nominal: Callable[[Tensor], Tensor] | None, kernels: KernelClasses
) -> CalibratedKinematics | FittedMap:
    """The model that a header and tensors describe.

    Args:
        header, tensors: the output of :func:`describe`. nominal: the nominal map, for a model of a plain function.
        kernels: kernel classes and profiles that are not part of the package, by name of the class or profile.

    Raises MissingArgumentError: ``nominal`` or an entry of ``kernels`` is missing, or is another one than that of the
    fit. ModelFileError, InputError, KeyError, TypeError, ValueError: contents that do not fit together.
    """
    if set(header) - OPTIONAL != ENTRIES or header["units"] != UNITS:
        what = "the header of the model file is not understood"
        raise ModelFileError.of(what, expected=sorted(ENTRIES), got=sorted(header))
    x, b, p, theta, noise, prior, new_noise = (tensors[name] for name in MOMENTA)
    k0 = _rebuild_nominal(header["nominal"], tensors, nominal, header.get("urdf"))
    _check(header, tensors, k0)
    joint, task = (_rebuild_kernel(header[name], kernels) for name in ("joint_kernel", "task_kernel"))
    spec = ModelSpec(k0, joint, task, prior, header["task_dim"])
    joint.check(x.shape[1], "joint_kernel")
    task.check(spec.task_dim, "task_kernel")
    spec = replace(spec, at_controls=_rebuild_rows(k0, tensors))
    deformation = GeodesicDeformation(spec, x, Momenta(b, p, theta), integrator_from_config(header["integrator"]))
    of_map = {attribute: tensors.get(name) for name, attribute in MAP_TENSORS.items()}
    fitted = FittedMap(deformation, Noise(noise, tensors.get(SHARED)), new_noise=new_noise, **of_map)
    learnt = None
    if "registration" in header:
        placed = rebuild_registration(header["registration"], tensors, x.shape[1])
        learnt = placed if LEARNT in header["registration"] else None
        fitted = fitted if learnt else RegisteredMap(fitted, placed)
    if not isinstance(k0, GeometryMap):
        return fitted
    summary = Summary.from_dict(header["report"], positions=fitted.workspace is None) if header["report"] else None
    given: dict[str, Any] = {name: header.get(name) for name in ("lever", "tool", "tool_tip")}
    given |= {name: tensors.get(name) for name in ROBOT_TENSORS} | {"learnt": learnt}
    given["ball"] = header.get("ball", False) is True
    given["placement"] = tuple(stored_devices(entry, len(fitted.x)) for entry in header.get("placement", ()))
    made = header.get("provenance")
    given["provenance"] = None if made is None else record_of(Provenance, made)
    return CalibratedKinematics(k0.geometry.chain, fitted, summary, **given)


def _check(header: Header, tensors: Tensors, nominal: NominalMap) -> None:
    """Raise InputError unless all tensors are known, finite float64 of shapes that agree."""
    robot = nominal if isinstance(nominal, GeometryMap) else None
    names = {*MOMENTA, *MAP_TENSORS, *PAYLOADS, *SESSIONS, *(PREFIX + name for name in ARRAYS)}
    names |= {"probe"} if robot is None else {*GEOMETRY, *ROBOT_TENSORS}
    if unknown := set(tensors) - names:
        raise InputError.of("the tensors of the file", expected=sorted(names), got=sorted(unknown))
    if other := {name: tensor.dtype for name, tensor in tensors.items() if tensor.dtype != torch.float64}:
        raise InputError.of(f"the tensors {', '.join(other)}", expected="float64", got=next(iter(other.values())))
    (n_rows, n), (_, width, _) = tensors["x"].shape, tensors["noise"].shape
    m = tensors["new_noise"].shape[0] if "slopes" in tensors else width
    dim, size, data = header["task_dim"], nominal.parameters, len(tensors.get("data", tensors["x"]))
    if type(dim) is not int or dim < 1 or m % dim or (robot is not None and dim != 3):
        raise InputError.of("the entry task_dim", expected=f"a divisor of {m}, 3 for a robot", got=dim)
    shapes = {
        **{"x": (n_rows, n), "momenta_x": (n_rows, n), "momenta_y": (n_rows * m // dim, dim)},
        **{"theta": (size,), "prior_variance": (size,), "noise": (data, width, width), "new_noise": (m, m)},
        **{"data": (data, n), "workspace": ("M", n), "slopes": (data, width, m), "measured": (data, width)},
        **{"unresolved": (n,), "session": (n_rows,), "payloads": (n_rows,), SHARED: (data, width, "c")},
    }
    if robot is not None:
        shapes["scales"] = (5 * n + 2 * robot.geometry.chain.moving + 9,)
        shapes["session_tools"] = ("S", robot.geometry.markers, 3)
    for name, shape in shapes.items():
        if name in tensors:
            as_tensor(tensors[name], name, shape, empty=size == 0)
    if size:
        positive(tensors["prior_variance"], "prior_variance", (size,))
    if robot is not None and size and (largest := float(tensors["theta"].abs().max())) > LARGEST_PARAMETER:
        raise InputError.of("the tensor theta", expected=f"at most {LARGEST_PARAMETER:g}", got=f"{largest:.3g}")
    if "scales" in tensors and bool((tensors["scales"] < 0).any()):
        raise InputError.of("the tensor scales", expected="no negative number", got=float(tensors["scales"].min()))
    check_covariance(tensors["new_noise"], "the tensor new_noise")


def _rebuild_nominal(
    description: Header, tensors: Tensors, nominal: Callable[[Tensor], Tensor] | None, source: object
) -> NominalMap:
    if description["kind"] == "function":
        if nominal is None:
            what = "`nominal` is missing: this model deforms a plain function"
            raise MissingArgumentError.of(what, fix="pass the same function again")
        value = nominal(tensors["x"][:PROBE_CONFIGURATIONS])
        if value.shape != tensors["probe"].shape or not torch.allclose(value, tensors["probe"], rtol=1e-9, atol=1e-12):
            what = "`nominal` is not the map that the model was fitted to"
            raise MissingArgumentError.of(what, fix="pass the same function")
        return SmoothMap(nominal)
    if description["kind"] != "robot":
        raise ModelFileError.of("the kind of nominal map", expected="robot or function", got=description["kind"])
    if nominal is not None:
        raise MissingArgumentError.of("`nominal` was given, but the file holds its robot", fix="leave it out")
    if not isinstance(source, str | None):
        raise InputError.of("the entry urdf", expected="the text of a file", got=type(source).__name__)
    robot, on = robot_from_config(description, source), tuple(description.get("on", ()))
    geometry = Geometry(robot, **{name: tensors[name] for name in GEOMETRY}, on=on)
    if not isinstance(description["elastic"], bool):
        raise InputError.of("the entry elastic", expected="true or false", got=description["elastic"])
    payload = NO_PAYLOAD
    if carried := description.get("payload"):
        for name, least in (("mass", -1e-300), ("unit", 0.0)):
            check_number(carried[name], f"the {name} of the payload", above=least)
        mass = torch.tensor(carried["mass"], dtype=torch.float64, device=HOST)
        payload = Payload(carried["link"], mass, float(carried["unit"]))
    waves = tuple((int(joint), float(frequency)) for joint, frequency in description.get("waves", ()))
    axes = tuple((int(axis), float(low), float(high), int(K)) for axis, low, high, K in description.get("axes", ()))
    return GeometryMap(geometry, elastic=description["elastic"], own=PositionErrors(waves, axes), payload=payload)


def _rebuild_kernel(terms: list[Header], classes: KernelClasses) -> Kernel:
    kernels: list[Kernel] = []
    for term in terms:
        if "kernel" not in term:
            profile_of = partial(_own_profile, values=term.get(PROBE), classes=classes)
            kernels.append(RadialKernel.from_config(term, profile_of))
            continue
        name = term["kernel"]
        given = classes.get(name)
        if not (isinstance(given, type) and issubclass(given, Kernel)):
            raise _missing(f"kernel {name!r}", f"its class: load(path, kernels={{{name!r}: ...}})", classes)
        kernels.append(given.from_config(term["arguments"]))
    return kernels[0] if len(kernels) == 1 else SumKernel(kernels)


def _missing(what: str, fix: str, classes: KernelClasses) -> MissingArgumentError:
    what = f"the model uses the {what}, which is not part of diffeo_calib"
    got = f"`kernels` with {few(list(classes)) or 'no entry'}"
    return MissingArgumentError.of(what, got=got, fix=f"pass {fix}")


def _own_profile(name: str, values: list[float] | None, classes: KernelClasses) -> Profile:
    """The profile that a user passes, if it is that of the fit by its values; files of old versions have none."""
    profile = classes.get(name)
    if not isinstance(profile, Profile):
        fix = f"it, with the parameters of the fit: load(path, kernels={{{name!r}: YourProfile(...)}})"
        raise _missing(f"profile {name!r}", fix, classes)
    if values is None:
        text = "the model file is of an old version: whether the profile"
        warn_user(f"{text} {name!r} is that of its fit is not checked")
        return profile
    values_of_both = torch.tensor([probe(profile), values], dtype=torch.float64, device=HOST)
    if not torch.allclose(values_of_both[0], values_of_both[1], rtol=PROBE_TOLERANCE, atol=0.0):
        got, wanted = (", ".join(f"{kappa:.6g}" for kappa in row) for row in values_of_both.tolist())
        what = f"the profile {name!r} passed in `kernels` is not that of the model"
        expected = f"kappa = {wanted} at r2 = {', '.join(map(str, PROBED_R2))}"
        fix = "pass the profile of the fit, with the same parameters"
        raise MissingArgumentError.of(what, expected=expected, got=got, fix=fix)
    return profile


def _rebuild_rows(nominal: NominalMap, tensors: Tensors) -> GeometryMap | SessionMarkers | None:
    """k0 at the controls, each with its own payload and of its own session; None where these are the same for all."""
    if SHARED in tensors and not isinstance(nominal, GeometryMap):
        raise InputError.of("sessions of rows", expected="a robot", got="a plain function")
    if not isinstance(nominal, GeometryMap):
        return None
    by_row = nominal.with_payload(nominal.load.weighing(tensors[PAYLOADS[0]])) if nominal.load else None
    if SESSIONS[1] not in tensors:
        return by_row
    given, count = tensors["session"], len(tensors["session_tools"])
    whole = given.round().to(torch.int64)
    if bool(((whole != given) | (whole < 0) | (whole >= count)).any()):
        raise InputError.of("the tensor session", expected=f"whole numbers below {count}", got=given[:5].tolist())
    return SessionMarkers(by_row or nominal, whole, tensors["session_tools"])


def rebuild_registration(entry: Any, tensors: Tensors, n: int) -> Registration:
    """A registration of a robot with n joints."""
    arrays = {name: tensors[PREFIX + name] for name in ARRAYS}
    m, rows = 3 * len(arrays["markers"]), len(arrays["q"])
    shapes = {"markers": (m // 3, 3), "centre": (3,), "q": (rows, n), "gain": (m + 6, m * rows)}
    for name, shape in (shapes | {"noise": (m, m), "covariance": (m + 6, m + 6)}).items():
        as_tensor(arrays[name], PREFIX + name, shape)
    rigid(arrays["transform"], PREFIX + "transform")
    plain = dict(entry)
    plain.pop(LEARNT, None)
    moved = plain.pop("shift", None)
    shift = None if moved is None else as_tensor(moved, "shift", (m // 3, 3))
    return record_of(Registration, plain, **arrays, shift=shift)


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
    classes, (header, tensors) = _checked(kernels), read(as_path(path))
    try:
        return rebuild(header, tensors, nominal, classes)
    except (ModelFileError, MissingArgumentError):
        raise
    except (*UNSOUND, DiffeoCalibError) as error:
        what = f"{path} has contents that do not fit together ({error})"
        raise ModelFileError.of(what, fix="save the model again") from error


def _checked(kernels: object) -> KernelClasses:
    """Classes of kernels, and profiles whose derivatives are right, of classes without arguments, by their names."""
    given: dict[str, Any] = {} if kernels is None else dict(kernels) if isinstance(kernels, Mapping) else {"": None}
    for name, kernel in given.items():
        if isinstance(kernel, type) and issubclass(kernel, Kernel):
            continue
        if not (isinstance(kernel, Profile) or (isinstance(kernel, type) and issubclass(kernel, Profile))):
            fix = "pass the class itself, such as kernels={'MyKernel': MyKernel}, or {'my_profile': MyProfile(2.5)}"
            expected = "names -> subclasses of dc.Kernel, or profiles"
            raise InputError.of("`kernels`", expected=expected, got=as_written(kernels)[:80], fix=fix)
        try:
            given[name] = kernel() if isinstance(kernel, type) else kernel
        except TypeError as error:
            fix = "pass the profile with the parameters of the fit, such as kernels={'my_profile': MyProfile(2.5)}"
            raise InputError.of(f"`kernels`: {as_written(kernel)} needs arguments ({error})", fix=fix) from error
        check_profile(given[name])
    return given


def read(path: Path) -> tuple[Header, Tensors]:
    """Header and tensors of a file, after checking its format and checksum; ModelFileError as :func:`read_arrays`."""
    header, arrays = read_arrays(path)
    return header, {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}
