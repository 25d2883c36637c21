"""Panels of pictures of calibrations; as figures: ``dc.plots.pictures(model)["parts"].savefig("parts.pdf")``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffeo_calib.common.lazy import lazy_names

if TYPE_CHECKING:
    from diffeo_calib.reports.report import pictures as pictures

if not TYPE_CHECKING:  # type checkers see the import above, and report unknown names
    __getattr__, __dir__, __all__ = lazy_names(__name__)
