"""Pictures of calibrations as matplotlib figures: ``dc.plots.transmissions(model).savefig("gears.pdf")``.

Every function returns a :class:`matplotlib.figure.Figure` and touches neither pyplot nor any window.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diffeo_calib.reports.plots.errors import stages, workspace
    from diffeo_calib.reports.plots.joints import comparison, expected_error, explained, transmissions
    from diffeo_calib.reports.plots.trust import learning_curve, residuals, uncertainty

__all__ = [
    "comparison",
    "expected_error",
    "explained",
    "learning_curve",
    "residuals",
    "stages",
    "transmissions",
    "uncertainty",
    "workspace",
]

_MODULE_OF = {
    "comparison": "joints",
    "expected_error": "joints",
    "explained": "joints",
    "learning_curve": "trust",
    "residuals": "trust",
    "stages": "errors",
    "transmissions": "joints",
    "uncertainty": "trust",
    "workspace": "errors",
}

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        """Load a plot when it is first used."""
        if name not in _MODULE_OF:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)

    def __dir__() -> list[str]:
        """The plots, so that consoles complete their names."""
        return list(__all__)
