"""What a registration found, in lines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from diffeo_calib.kinematics.calibrated import CalibratedKinematics
from diffeo_calib.kinematics.re_registration.registered_map import Registration
from diffeo_calib.measurements.pose_frames import POINTS, middles
from diffeo_calib.measurements.poses import rotation_numbers


def registration_lines(model: CalibratedKinematics) -> Iterator[str]:
    """Where measuring frame and markers were found, how well, and from how many rows."""
    found = model.registration
    if found is None:
        return
    yield from motion_lines(found, model.on)
    rows = f"{found.rows} rows took part"
    yield (
        f"{rows}: RMS {1e3 * found.rms_after:.4f} mm on these rows, to which device and markers were fitted; "
        f"{1e3 * found.left_out_rms:.4f} mm with each row left out in turn"
    )


def motion_lines(found: Registration, tips: Sequence[str]) -> Iterator[str]:
    """Where measuring frame and markers are now, and how far from where they were."""
    if found.free != "marker":
        yield from frame_lines(found)
    if found.free != "base":
        yield from _marker_lines(found, tips)


def frame_lines(found: Registration) -> Iterator[str]:
    """Where the measuring frame is now."""
    turn = rotation_numbers(found.transform[None, :3, :3], "rotvec", angle="deg")[0]
    moved = f"{_triple(1e3 * found.transform[:3, 3])} mm, rotation vector {_triple(turn)} deg"
    yield f"the measuring frame of the model, seen from the new one: {moved}"
    deviations = found.frame_deviations
    shift, small = 1e3 * deviations[:3], torch.rad2deg(deviations[3:])
    yield f"  known to {_short(shift)} mm at the middle of the rows, and to {_short(small)} deg"


def _marker_lines(found: Registration, tips: Sequence[str]) -> Iterator[str]:
    rigid = found.lever is not None
    places, deviations = found.markers, found.marker_deviations
    tips = tips if len(tips) == len(places) else [tips[0]] * len(places)
    places, tips = (middles(places[None])[0], tips[::POINTS]) if rigid else (places, tips)
    for k, (place, deviation, tip) in enumerate(zip(places, deviations, tips, strict=False)):
        what = "measured frame" if rigid else "marker" + f" {k}" * (len(places) > 1)
        known = "" if rigid else f", known to {_short(1e3 * deviation)} mm"
        yield f"{what} in the frame of '{tip}': {_triple(1e3 * place)} mm{known}"
    if found.shift is not None:
        largest = 1e3 * float(found.shift.norm(dim=1).max())
        stayed = "" if found.same_place is None else f" (unmoved with probability {found.same_place:.2f})"
        yield f"  that is {largest:.3f} mm from where it was{stayed}"


def _triple(values: Tensor) -> str:
    return " ".join(f"{value:.3f}" for value in values.tolist())


def _short(values: Tensor) -> str:
    return " ".join(f"{value:.2g}" for value in values.tolist())
