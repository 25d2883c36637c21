"""The absolute errors that a calibrated model expects of every stage of its calibration, where no device shows them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import Tensor

from diffeo_calib.calibration.sockets import workspace_deviation, workspace_of
from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.robots.placement import rigid_fit


def expected_errors(model: CalibratedKinematics, stages: Mapping[str, Callable[[Tensor], Tensor]]) -> dict[str, float]:
    """Root mean square distances, m, of the ball from its true places over the joint ranges of the rows, by stage.

    sqrt(d^2 + s^2) with d the distance between the places of a stage and those of the model, and s the one that the
    model expects of its own; without a measuring device after the best rigid motion.

    Args:
        model: of rows in sockets or of readings.
        stages: name -> kinematics, (N, n) -> (N, P, 3) in m, the ball last.
    """
    fitted, own = model.map, workspace_deviation(model.map)
    q = workspace_of(fitted)
    places = model(q).detach()[:, -1]

    def expected(points: Tensor) -> float:
        if fitted.workspace is not None:
            T = rigid_fit(points, places)
            points = points @ T[:3, :3].mT + T[:3, 3]
        return float(((points - places).square().sum(1).mean() + own**2).sqrt())

    return {name: expected(kinematics(q).detach()[:, -1]) for name, kinematics in stages.items()}
