"""Gear lines of a calibrated model by name: which joint, at which frequency, how large."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, hypot

from torch import Tensor

from diffeo_calib.kinematics.calibrated import CalibratedKinematics

SAME_RATIO = 0.5
"""Difference of two frequencies, rad per rad, up to which one counts as a multiple of the other."""
MULTIPLES = (2, 3, 4)
"""Waves per turn of the motor that are named."""


@dataclass(frozen=True)
class NamedGearLine:
    """amplitude cos(frequency q - phase) of one joint.

    Args:
        joint: its name.
        frequency: rad per rad of the joint: periods per turn; the ratio of a gear or a multiple of it.
        amplitude: rad. phase: rad.
        multiple: how often the frequency contains that of another line of the robot; 1 if there is none.
        displacement: RMS displacement of the markers by it over the model's configurations, m.
    """

    joint: str
    frequency: float
    amplitude: float
    phase: float
    multiple: int
    displacement: float

    @property
    def sentence(self) -> str:
        """Such as "joint_3: gear line 200.3 per rad = 2 x 100.15, 0.070 mrad"."""
        ratio = f" = {self.multiple} x {self.frequency / self.multiple:.2f}" if self.multiple > 1 else ""
        return f"{self.joint}: gear line {self.frequency:.1f} per rad{ratio}, {1e3 * self.amplitude:.3f} mrad"


def gear_lines(model: CalibratedKinematics) -> tuple[NamedGearLine, ...]:
    """The gear lines of a model, the largest displacement first; empty where no line was found."""
    nominal, theta = model.nominal, model.map.deformation.momenta.theta
    waves, coefficients = nominal.waves, nominal.wave_coefficients(theta).view(-1, 2)
    if not waves.size:
        return ()
    moved = _displacements(model, theta)
    found = []
    for k, (joint, frequency) in enumerate(zip(waves.joints, waves.frequencies, strict=True)):
        C, S = coefficients[k].tolist()
        name, multiple = model.robot.joint_names[joint], _multiple(frequency, waves.frequencies)
        found.append(NamedGearLine(name, frequency, hypot(C, S), atan2(S, C), multiple, moved[k]))
    return tuple(sorted(found, key=lambda line: -line.displacement))


def _displacements(model: CalibratedKinematics, theta: Tensor) -> list[float]:
    """RMS displacement of the markers by every line, m."""
    nominal = model.nominal
    sensitivities = nominal.sensitivities(model.configurations, theta)[..., nominal.sag.stop :]
    effects = (sensitivities * nominal.wave_coefficients(theta)).unflatten(-1, (-1, 2)).sum(-1)  # (N, 3 P, K)
    return effects.unflatten(1, (-1, 3)).square().sum(2).mean((0, 1)).sqrt().tolist()


def _multiple(frequency: float, others: tuple[float, ...]) -> int:
    near = (k for k in MULTIPLES if any(abs(frequency / k - other) <= SAME_RATIO for other in others))
    return next(near, 1)
