"""Flows of kernel vector fields: landmark geodesics, their integration, and the transport of passive points."""

from collections.abc import Mapping
from typing import Any

from diffeo_calib.common.errors import InputError, as_written
from diffeo_calib.flows.integrators import RK4, RK8, Integrator
from diffeo_calib.flows.torchdiffeq import TorchDiffEq

INTEGRATORS: dict[str, type[Integrator]] = {kind.kind: kind for kind in (RK4, RK8, TorchDiffEq)}
"""All integrators by their names in model files."""


def integrator_from_config(config: object) -> Integrator:
    """Rebuild an integrator from the output of :meth:`Integrator.to_config`.

    Raises:
        InputError: not a mapping, or an unknown kind.
    """
    if not isinstance(config, Mapping):
        raise InputError.of("the entry integrator", expected="a table", got=config)
    arguments: dict[str, Any] = dict(config)
    kind = arguments.pop("kind", None)
    if not isinstance(kind, str) or kind not in INTEGRATORS:
        raise InputError.of("the kind of integrator", expected=", ".join(INTEGRATORS), got=as_written(kind))
    return INTEGRATORS[kind](**arguments)
