"""Pictures of calibrations as matplotlib figures: ``dc.plots.transmissions(model).savefig("gears.pdf")``.

Every function returns a :class:`matplotlib.figure.Figure` and touches neither pyplot nor any window.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffeo_calib.common.lazy import lazy_names

if TYPE_CHECKING:
    from diffeo_calib.reports.plots.errors import stages, workspace
    from diffeo_calib.reports.plots.joints import expected_error, explained, transmissions
    from diffeo_calib.reports.plots.trust import learning_curve, residuals, uncertainty

__all__ = [
    "expected_error",
    "explained",
    "learning_curve",
    "residuals",
    "stages",
    "transmissions",
    "uncertainty",
    "workspace",
]

if not TYPE_CHECKING:
    modules = {
        "errors": "stages workspace",
        "joints": "expected_error explained transmissions",
        "trust": "learning_curve residuals uncertainty",
    }
    __getattr__, _ = lazy_names(__name__, modules)

    def __dir__() -> list[str]:
        """The plots, so that consoles complete their names."""
        return list(__all__)
