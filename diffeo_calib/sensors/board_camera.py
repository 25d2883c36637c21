"""The camera that saw a printed board, as a model keeps it: lens, print, and what they explain at the tool."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from diffeo_calib.cameras.images import UNKNOWNS, Camera, View
from diffeo_calib.common.device import HOST
from diffeo_calib.sensors.devices import Extrinsics

SIZE = len(UNKNOWNS)


@dataclass(frozen=True)
class Explained:
    """RMS distances of the points of measured poses, m, apart from the places of the robot and of what is on the tool.

    Args:
        nominal: of the nominal robot from the images.
        lens, board: how the fit with the robot changed what the images alone say.
        lens_std, board_std: what is still not known of them.
        corners: noise of one image.
    """

    nominal: float
    lens: float
    board: float
    lens_std: float
    board_std: float
    corners: float

    @property
    def arm(self) -> float:
        """Part that the arm's own errors explain."""
        return max(self.nominal**2 - self.lens**2 - self.board**2 - self.corners**2, 0.0) ** 0.5

    def sentence(self) -> str:
        """In mm."""
        sizes = {name: f"{1e3 * value:.3f}" for name, value in (vars(self) | {"arm": self.arm}).items()}
        return (
            f"arm or camera? the nominal arm misses the images by {sizes['nominal']} mm RMS at the tool: "
            f"arm {sizes['arm']}, lens {sizes['lens']} (still unknown {sizes['lens_std']}), board {sizes['board']} "
            f"(still unknown {sizes['board_std']}), corners of one image {sizes['corners']}"
        )


EXPLAINED = len(fields(Explained))


@dataclass(frozen=True, eq=False)
class BoardCamera:
    """A camera, whether it is on the tool (else the board is), and what it explains."""

    camera: Camera
    on_tool: bool
    explained: Explained

    @property
    def numbers(self) -> Tensor:
        """The constants of a device."""
        camera, unknowns = self.camera, self.camera.unknowns
        head = [float(self.on_tool), camera.width, camera.height, camera.half_size, camera.noise]
        head += [*astuple(self.explained), *([] if camera.view is None else camera.view.numbers)]
        root = unknowns.new_zeros(SIZE, SIZE)
        factor = camera.root if camera.root.shape[1] <= SIZE else torch.linalg.qr(camera.root.mT).R.mT
        root[:, : factor.shape[1]] = factor
        return torch.cat([unknowns.new_tensor(head), root.flatten(), unknowns])

    @classmethod
    def of(cls, numbers: Tensor) -> BoardCamera | None:
        """The inverse of :attr:`numbers`; None for models of earlier versions, which keep lens and board alone.

        Models of other earlier versions do not know what the images showed.
        """
        if len(numbers) <= SIZE:
            return None
        rest, root, unknowns = numbers.split([len(numbers) - SIZE * (SIZE + 1), SIZE * SIZE, SIZE])
        head, view = rest[: 5 + EXPLAINED], rest[5 + EXPLAINED :]
        on_tool, width, height, half_size, noise, *explained = head.tolist()
        shown = View(view[4:].view(-1, 3), int(view[0]), *view[1:4].tolist()) if len(view) else None
        camera = Camera(int(width), int(height), half_size, unknowns, root.view(SIZE, SIZE), noise, shown)
        return cls(camera, bool(on_tool), Explained(*explained))


@dataclass(frozen=True, eq=False)
class BoardCameras(Extrinsics):
    """Cameras that saw a board, by their :attr:`BoardCamera.numbers`."""

    kind = "camera"

    @classmethod
    def of_rows(cls, rows: Tensor, device: Tensor) -> BoardCameras:
        """Without names, which a model does not keep."""
        none = torch.zeros(0, 1, dtype=torch.float64, device=HOST)
        return cls((), none, none, rows, device)

    def with_cameras(self, cameras: Mapping[str, BoardCamera]) -> BoardCameras:
        """Return the rows of cameras by their names."""
        numbers = torch.stack([device.numbers for device in cameras.values()])
        deviations = torch.stack([device.camera.deviations for device in cameras.values()])
        return replace(self, names=tuple(cameras), constants=numbers, deviations=deviations)

    @property
    def cameras(self) -> dict[str, BoardCamera]:
        each = zip(self.names, map(BoardCamera.of, self.constants), strict=True)
        return {name: camera for name, camera in each if camera is not None}

    def aligned(self, data: Any) -> Any:
        """Images with what these know of lens and board: a model is compared with what its own cameras see."""
        return data.seen_with({name: device.camera for name, device in self.cameras.items()})

    def sentences(self) -> list[str]:
        """Lens of each camera, of several with its name, the board that all of them saw, and what explains what."""
        each = {f"{name}: " * (len(self.cameras) > 1): device for name, device in self.cameras.items()}
        lenses = [f"{name}{line}" for name, device in each.items() for line in device.camera.sentences()]
        board = [device.camera.board_sentence() for device in [*each.values()][:1]]
        return [*lenses, *board, *(f"{name}{device.explained.sentence()}" for name, device in each.items())]
