"""What is known of the places of devices, bases and markers before any row is seen: one table of Gaussian priors.

A shift and a turn that have one number are known to as many metres as radians.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PlacePriors:
    """Standard deviations.

    Args:
        marker_m: of a marker from the tip: no tool is larger.
        open_base_m, open_base_rad: of a base about which the rows say nothing, around any place: a turn may be half of
            one.
        sought_base_m_rad: of a base or a measuring frame around the start of a search: no constraint.
        found_m_rad: of a base, a marker, a device or a socket around the place where it was found: wide.
        session_m_rad: of what remains between the frames of sessions after these were found.
        remounted_m: of a marker between sessions, or since the fit: a tool that was mounted again.
        same_m: of a marker that nobody touched since the fit. other_m: of another one, around where it was found.
        same_registered_m, other_registered_m: the same two in a registration, around where the fit had the marker.
    """

    marker_m: float = 0.3
    open_base_m: float = 5.0
    open_base_rad: float = 2.0
    sought_base_m_rad: float = 1.0
    found_m_rad: float = 0.1
    session_m_rad: float = 0.01
    remounted_m: float = 1e-3
    same_m: float = 5e-5
    other_m: float = 0.1
    same_registered_m: float = 1e-5
    other_registered_m: float = 0.3


PLACES = PlacePriors()
