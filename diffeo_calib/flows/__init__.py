"""Flows of kernel vector fields: landmark geodesics, their integration, and what they carry along."""

from collections.abc import Mapping
from typing import Any

from diffeo_calib.common.errors import InputError, sentence
from diffeo_calib.flows.integrators import RK4, RK8, Integrator
from diffeo_calib.flows.torchdiffeq import TorchDiffEq

INTEGRATORS: dict[str, type[Integrator]] = {kind.kind: kind for kind in (RK4, RK8, TorchDiffEq)}
"""All integrators by the names that model files use."""


def integrator_from_config(config: object) -> Integrator:
    """The integrator that :meth:`Integrator.to_config` describes.

    Raises:
        InputError: not such a description, or an unknown kind.
    """
    if not isinstance(config, Mapping):
        raise InputError(sentence("the entry integrator", expected="a table", got=config))
    arguments: dict[str, Any] = dict(config)
    kind = arguments.pop("kind", None)
    if not isinstance(kind, str) or kind not in INTEGRATORS:
        raise InputError(sentence("the kind of integrator", expected=", ".join(INTEGRATORS), got=repr(kind)))
    return INTEGRATORS[kind](**arguments)
