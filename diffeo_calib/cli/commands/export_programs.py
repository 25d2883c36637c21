"""Programs of a model for `diffeo-calib export`: C source, torch, ONNX."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from diffeo_calib.interop.c_source import CFiles, c_files
from diffeo_calib.interop.torch_program import export_onnx, export_torch
from diffeo_calib.kinematics.calibrated import CalibratedKinematics

PROGRAMS = ("--c", "--torch", "--onnx")
MEGABYTE = 1e6


@dataclass(frozen=True)
class Tool:
    """Whose poses programs give.

    Args:
        transform: (4, 4) tool centre point in the tip's frame, m; None for the model's own.
        frame: "base" or "measuring"; None for the robot's base.
    """

    transform: Tensor | None
    frame: str | None

    @property
    def named(self) -> bool:
        """Whether the user asked for a tool or a frame."""
        return not (self.transform is None and self.frame is None)


class Programs:
    """The programs that are wanted; the C source is made at once, so that nothing is written if it cannot be.

    Args:
        model: a calibrated robot. wanted: option -> file. tool: whose poses they give.
        tip: that carries it in C, for a robot with several; None for the model's own.
    """

    def __init__(
        self, model: CalibratedKinematics, wanted: Mapping[str, Path], tool: Tool, tip: str | None = None
    ) -> None:
        self.model, self.tool, self.frame = model, tool, tool.frame or "base"
        self.wanted = {option: target for option, target in wanted.items() if option in PROGRAMS}
        self.c: CFiles | None = None
        if "--c" in self.wanted:
            self.c = c_files(model, self.wanted["--c"], tool.transform, self.frame, tip=tip)

    @property
    def texts(self) -> dict[Path, bytes]:
        """The C files."""
        return {} if self.c is None else self.c.contents

    def write(self) -> Iterator[str]:
        """Write the files that are no texts; yields a sentence about each file."""
        if self.c is not None:
            functions = ", ".join(self.c.functions)
            files = f"{self.c.source} ({self.c.size / MEGABYTE:.1f} MB), {self.c.header.name}"
            yield f"c: {files}: {functions}, in the frame {self.frame!r}"
        output = "tool_poses" if self.tool.named else "points"
        what = f"poses of the tool in the frame {self.frame!r}" if self.tool.named else "markers in the measuring frame"
        for option, export in (("--torch", export_torch), ("--onnx", export_onnx)):
            if option in self.wanted:
                target = self.wanted[option]
                export(self.model, target, output, tool=self.tool.transform, frame=self.frame)
                yield f"{option[2:]}: {target} ({target.stat().st_size / MEGABYTE:.1f} MB): {what}"
