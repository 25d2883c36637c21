"""Queries about a tool centre point that need not have been measured, as methods of calibrated models."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor

from diffeo_calib.common.inference_mode import methods_outside_inference_mode
from diffeo_calib.fitting.fitted_map import FittedMap
from diffeo_calib.kinematics.nominal import GeometryMap
from diffeo_calib.kinematics.re_registration.registered_map import RegisteredMap
from diffeo_calib.kinematics.tool import ToolKinematics, tool_transform


@methods_outside_inference_mode
class ToolQueries(ABC):
    """What a calibrated model knows about its tool.

    Attributes:
        map: the fitted exact model.
        tool: (4, 4) tool centre point in the tip's frame, m. tool_tip: name of the tip that carries it, of several.
    """

    map: FittedMap
    tool: Tensor
    tool_tip: str | None

    @property
    @abstractmethod
    def nominal(self) -> GeometryMap:
        """k0 of the map."""

    @abstractmethod
    def _joints(self, q: object) -> Tensor:
        """Checked joint values (N, n)."""

    def tool_poses(self, q: object, tool: object = None, frame: str = "base", tip: str | None = None) -> Tensor:
        """Poses of a tool centre point, which need not have been measured.

        Any point of the flange moves as psi(k0(phi^-1(q))); three of them around the tool centre point give its pose.
        Models that were fitted to positions of one marker know the roll about the last axis from the prior alone.

        Args:
            q: (N, n) joint configurations, rad or m.
            tool: in the tip's frame, (4, 4) or position (3,) in m; the model's own by default.
            frame: "base" of the robot, as it was found, or "measuring".
            tip: name of the tip that carries the tool, for a robot with several; the model's own by default.

        Returns:
            (N, 4, 4) rigid transforms, m; detached, for derivatives see :meth:`tool_jacobian`.

        Raises:
            InputError: wrong shapes, values that are not finite, another frame or an unknown tip.
        """
        return self._tool(tool, frame, tip).poses(self._joints(q))

    def tool_jacobian(self, q: object, tool: object = None, frame: str = "base", tip: str | None = None) -> Tensor:
        """Exact derivative of :meth:`tool_poses`: (N, n) -> (N, 6, n), arguments as there.

        Linear velocity of the tool centre point [m/rad or m/m], then angular velocity, about the axes of the frame.
        """
        return self._tool(tool, frame, tip).jacobian(self._joints(q))

    def predict_tool_poses(
        self, q: object, tool: object = None, frame: str = "base", tip: str | None = None
    ) -> tuple[Tensor, Tensor]:
        """Poses of a tool centre point (N, 4, 4) in m and how well the model knows them; see :meth:`tool_poses`.

        The covariance (N, 6, 6) is that of shifts in m and small turns in rad about the axes of the frame. It is larger
        in the base frame than in the measuring frame: base and errors of the first joint can hardly be told apart.
        """
        return self._tool(tool, frame, tip).predict(self._joints(q).detach())

    def _tool(self, tool: object, frame: str, tip: str | None) -> ToolKinematics:
        own, tip = self.tool if tool is None else tool_transform(tool), tip or self.tool_tip
        if frame == "base" and isinstance(self.map, RegisteredMap):  # where the device stands does not matter there
            return ToolKinematics(self.map.fitted, self.nominal, own, frame, tip)
        return ToolKinematics(self.map, self.nominal, own, frame, tip)
