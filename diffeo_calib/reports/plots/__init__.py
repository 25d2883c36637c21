"""Pictures of calibrations as matplotlib figures: ``dc.plots.transmissions(model).savefig("gears.pdf")``.

Every function returns a :class:`matplotlib.figure.Figure` and touches neither pyplot nor any window.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffeo_calib.common.lazy import lazy_names

if TYPE_CHECKING:
    from diffeo_calib.reports.plots.errors import learning_curve as learning_curve
    from diffeo_calib.reports.plots.errors import residuals as residuals
    from diffeo_calib.reports.plots.errors import stages as stages
    from diffeo_calib.reports.plots.errors import uncertainty as uncertainty
    from diffeo_calib.reports.plots.errors import workspace as workspace
    from diffeo_calib.reports.plots.joints import expected_error as expected_error
    from diffeo_calib.reports.plots.joints import explained as explained
    from diffeo_calib.reports.plots.joints import transmissions as transmissions

if not TYPE_CHECKING:  # type checkers see the imports above, and report unknown names
    __getattr__, __dir__, __all__ = lazy_names(__name__)
