"""What the files hold that commands write for programs (--json), as types of Python: the JSON schema is made of them.

``python -m diffeo_calib.reports.results`` prints the schema. Entries may be added within a version of the format; none
is removed or changes its meaning.
"""

from __future__ import annotations

import json
import sys
from types import NoneType
from typing import Any, get_args

VERSION, FORMAT = 3, "diffeo_calib result"
SIMPLE = {bool: "boolean", int: "integer", float: "number", str: "string", NoneType: "null"}


def schema(kind: Any, text: str = "", **more: Any) -> dict[str, Any]:
    """The JSON schema of values of a kind, with their meaning and further keywords.

    Args:
        kind: a simple type or a union of some, ``[kind]`` for lists, ``{str: kind}`` for values by name, a tuple of the
            texts that are allowed, or a schema.
    """
    more |= {"description": text} if text else {}
    if isinstance(kind, dict):
        named = {"type": "object", "additionalProperties": schema(kind[str])} if str in kind else kind
        return named | more
    if isinstance(kind, list):
        return {"type": "array", "items": schema(kind[0])} | more
    if isinstance(kind, tuple):
        return {"enum": list(kind)} | more
    each = get_args(kind) or (kind,)
    return {"type": SIMPLE[each[0]] if len(each) == 1 else [SIMPLE[word] for word in each]} | more


def entries(fields: dict[str, Any], text: str = "", *may_lack: str, **more: Any) -> dict[str, Any]:
    """An object with these entries, by name, and no others."""
    head = {"type": "object", "required": [name for name in fields if name not in may_lack]}
    body = {"additionalProperties": False, "properties": {name: schema(kind) for name, kind in fields.items()}}
    return schema(head | body | more, text)


def tree(kind: Any, depth: int) -> dict[str, Any]:
    """Values by name, or values by name in these, up to a depth."""
    return {str: {"anyOf": [schema(kind), schema(tree(kind, depth - 1))]} if depth > 1 else kind}  # pyright: ignore


MAYBE = float | None  # null where there is none, or where it is not finite
TRANSFORM = schema([schema([float], minItems=4, maxItems=4)], minItems=4, maxItems=4)
SIZES = ("rms", "median", "p95", "max")
ANGLES = {"rows": int} | {f"angle_{size}_deg": MAYBE for size in SIZES}
ERRORS = entries(ANGLES | {f"{size}_m": MAYBE for size in SIZES})
KIND = entries(ANGLES | {"what": ("errors", "spread", "readings"), "unit": str} | dict.fromkeys(SIZES, MAYBE))
POSE = entries({"pose_m": [[float]], "position_std_m": [float], "rotation_std_rad": [float]})
PLACES = dict.fromkeys(("camera_in_tip", "board_in_base", "board_in_tip", "camera_in_base"), POSE)
HAND_EYE = entries(
    {**PLACES},
    "A camera and its board, one in the frame of the tip, the other in the robot's base, with standard deviations "
    "along the axes of these frames.",
    *PLACES,
    minProperties=2,
)
CAMERA = entries(
    {"width": int, "height": int, "noise_px": float, "explained_m": {str: float}},
    "The camera that saw a board: image size, noise of corners, lens and board as value and standard deviation "
    "(pixels, ratios), and what explains the errors of the nominal arm at the tool, RMS.",
    additionalProperties=entries({"value": float, "std": float}),
)
OFFSET = {"joint": str, "size_rad_or_m": MAYBE}
RESULTS: dict[str, tuple[Any, str]] = {
    "errors": (
        tree(ERRORS, 3),
        "Errors of measured positions alone, in m: by rows (evaluate: all, used_in_the_fit, not_used_in_the_fit, "
        "in_sessions; after; compare: found, expected; recalibrate: before, after, left_out), by stage (report), or by "
        "rows and then stage (fit). Empty where no position was measured.",
    ),
    "kinds": (
        {str: tree(KIND, 2)},
        "Every kind of rows in its own unit, by kind and then as under errors; what: errors of measured positions, "
        "spread within sockets, or errors of readings.",
    ),
    "expected_error_by_stage_m": ({str: float}, "Absolute errors that a model expects of every stage of its fit."),
    "expected_error": (
        entries(
            {
                **{"expected_error_m": float, "with_open_places_m": float, "at_rows_of_fit_m": float},
                **{"open_places": [str], "size_deviation": MAYBE, "length_in_doubt_m": MAYBE},
            }
        ),
        "What the model expects of its own errors over the joint ranges of its rows: RMS apart from places of base and "
        "markers that the rows leave open, RMS with these, RMS at the rows of the fit, the relative standard deviation "
        "of the robot's size, and the part of the first two by a length in doubt.",
    ),
    "leave_one_out_rms_m": (MAYBE, "Of measured positions; null without any."),
    "leave_one_out": ({str: KIND}, "Each row of the fit predicted by all others, by kind."),
    "parts": ([entries({"name": str, "displacement_m": float, "angle_rad_or_m": MAYBE})], ""),
    "outliers": (
        [entries({"row": int, "marker": int | None, "distance": MAYBE, "unit": str, "reason": str})],
        "Lines of the file that look wrong.",
    ),
    "base": (TRANSFORM, "Robot base in the measuring frame."),
    "markers_m": ([[float]], "Markers in the frame of the tip; three points for measured poses."),
    "transform": (TRANSFORM, "From the old measuring frame to the new one."),
    "markers": (("same", "moved", "other"), ""),
    "converged": (bool, ""),
    "status": (str, ""),
    "files": ({str: str}, "Files that the command wrote."),
    "accepted": ({"type": ["boolean", "integer"]}, "Whether --tolerance is kept; how many rows a campaign accepted."),
    "rows": (int, ""),
    "refused": ({str: str}, "Images without a board, and why."),
    "clock_offset_s": (float, "Added to the times of what was seen."),
    "expected_error_m": (MAYBE, "At the end of a campaign."),
    "session_transforms": ({str: TRANSFORM}, "From the measuring frame of the model to each session evaluated."),
    "sessions": ({str: TRANSFORM}, "From the measuring frame of the model to that of each session of a fit."),
    "mountings": ({str: [[float]]}, "Shifts of the markers of each session from those of the model, in their tips, m."),
    "drift": ({str: float}, "m and rad over the range of every column."),
    "statuses": ({str: int}, "Rows of a corrected program by status."),
    "misses": (
        {str: entries({"miss_m": [MAYBE], "angle_miss_deg": schema([MAYBE], type=["array", "null"])})},
        "By tip, how far its tool is from the target of every row of a corrected program on the model; null without a "
        "target, or without a command that is allowed.",
    ),
    "expected_rms_m": ([MAYBE], "Expected RMS error with 0, 1, 2, ... planned poses."),
    "noise_rms_m": (MAYBE, ""),
    "assumed": (bool, "Whether the scales are those of usual robots."),
    "possible_offsets": (
        [entries(OFFSET | {"deviation_rad_or_m": MAYBE})],
        "Joint offsets that explain a new place of device or markers as well: the rows do not tell which.",
    ),
    "smallest_offsets": (
        [entries(OFFSET)],
        "Smallest change of each joint's offset that the new rows would show in nine cases of ten, rad or m; null "
        "where places of device and markers hide it.",
    ),
    "changes": (
        [entries({"part": str, "size_rad_or_m": MAYBE, "probability": MAYBE, "sentence": str})],
        "Empty without a change, or where `rows_can_tell` is false. An offset is added to what the joint reads.",
    ),
    "rows_can_tell": (bool, "Whether changes were tested, and a model is certain enough at the new rows to tell them."),
    "left_out": (bool, "Whether rows of the fit are shown, each predicted by all others."),
    "coverage_95": (MAYBE, ""),
    "verdict": (str, ""),
    "advice": ([str], ""),
    "lengths": ({str: [float]}, "That contradict the robot's description, by cause: value and standard deviation."),
    "devices": (
        entries({"constants": {str: [float]}, "deviations": {str: [float]}}, "", "deviations"),
        "Devices of readings after a fit, in the robot's base: point and zero, normal and distance, or transform and "
        "depth.",
    ),
    "sockets": (
        entries({"positions_m": {str: [float]}}),
        "Sockets after a fit, in the measuring frame (the robot's base if no position was measured).",
    ),
    "camera": (CAMERA, ""),
    "cameras": ({str: CAMERA}, "The same of each of several cameras, by its name."),
    "hand_eye": (HAND_EYE, ""),
    "hand_eyes": ({str: HAND_EYE}, "The same of each of several cameras, by the name of its session."),
    "found_from_rows": (
        entries({"numbers": int, "sentences": [str]}),
        "How many numbers were found from the rows that are judged, such as places of devices, and what they say.",
    ),
}
SCHEMA = entries(
    {
        **{"format": (FORMAT,), "format_version": (VERSION,), "diffeo_calib": schema(str, "Version of the package.")},
        "arguments": schema([str], "The command and its options."),
        "exit_code": schema(int, "0 success, 1 unusable input, 3 not converged, 4 above --tolerance, 130 Ctrl-C."),
        "error": schema(str | None, "The sentence that ended the command."),
        "warnings": [str],
        "results": entries(
            {name: schema(*own) for name, own in RESULTS.items()},
            "",
            *RESULTS,
            patternProperties={"^(rms|limit)_": schema(MAYBE, "evaluate --tolerance: what is compared, in this unit.")},
        ),
    },
    "Units are in the names (m, rad, deg), or beside the numbers as unit. Numbers that are not finite are null. "
    "Entries may be added within a version.",
    **{"$schema": "https://json-schema.org/draft/2020-12/schema"},
    title=f"Results of a diffeo-calib command (--json), format version {VERSION}",
)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(SCHEMA, indent=2) + "\n")
