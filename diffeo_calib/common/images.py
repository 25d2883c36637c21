"""Figures as files."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

from diffeo_calib.common.files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

IMAGE_SUFFIXES = (".png", ".pdf", ".svg")
"""Suffixes of the files that figures can be written to."""


def write_figure(figure: Figure, path: str | os.PathLike[str], dpi: int) -> None:
    """Draw a figure into a file, whose suffix selects the format; InputError if it cannot be written."""
    image = io.BytesIO()
    figure.savefig(image, format=Path(path).suffix[1:].lower(), dpi=dpi)
    write_whole(path, image.getvalue())
