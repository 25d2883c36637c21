"""How far a robot sags under its payload, relative to the sag under the unknown masses of its links.

A coefficient of sag is compliance times mass times gravity. The compliances are the same under all loads, so that one
factor scales the prior deviations of all coefficients of the payload: the payload in terms of the masses of the links.
It is chosen by marginal likelihood, with all other scales as they are.
"""

from __future__ import annotations

from dataclasses import replace

from diffeo_calib.calibration.scales.hyperparameters import Hyperparameters
from diffeo_calib.calibration.scales.tangent_data import TangentData

FACTORS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
POSES, COORDINATES = 300, 1500
"""Most poses and coordinates on which the factor is chosen."""


def with_payload_factor(data: TangentData, scales: Hyperparameters, seed: int = 0) -> Hyperparameters:
    """The same scales with the likeliest factor; unchanged without payload.

    Args:
        data: the measurements. scales: all other scales. seed: draws the poses if there are many.
    """
    sag = data.nominal.elasticity
    if sag is None or not bool(sag.loaded.any()):  # no coefficient depends on it
        return scales
    _, some = data.sample(POSES, COORDINATES, seed)
    tried = [replace(scales, payload=factor) for factor in FACTORS]
    return max(tried, key=lambda one: float(some.factorised(one).log_marginal_likelihood(some.target)))
