"""Figures as files."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

from diffeo_calib.common.errors import InputError
from diffeo_calib.common.files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

IMAGE_SUFFIXES = (".png", ".pdf", ".svg")
"""Suffixes of the files that figures can be written to."""


def write_figure(figure: Figure, path: str | os.PathLike[str], dpi: int = 160) -> None:
    """Draw a figure into a file, whose suffix selects the format.

    Raises:
        InputError: an unknown format, a folder that does not exist, or a file that cannot be written.
    """
    if Path(path).suffix.lower() not in IMAGE_SUFFIXES or not Path(path).parent.is_dir():
        expected = f"a file ending in {', '.join(IMAGE_SUFFIXES)} in an existing folder"
        raise InputError.of(f"the figure cannot be written to {path}", expected=expected)
    image = io.BytesIO()
    figure.savefig(image, format=Path(path).suffix[1:].lower(), dpi=dpi)
    write_whole(path, image.getvalue())
