"""Is it the arm or the camera? Simulated arms whose camera slips on its mount, focuses anew, or sees a bent print.

    python benchmarks/robustness/arm_or_camera.py --out arm_or_camera.json

60 images of a board with noise of 0.1 px, half of them after a slip where there is one. `case`: `none`; `arm`, whose
errors are three times as large; `slip` of the camera on the tool, mm; `focus`, focal lengths that differ from image to
image, %; `print`, a board that is bent by 0.5 mm at its edge.

Fields of a record: `case`, `size`, `seed`; `said`: what warnings name; `right`: whether that is the cause, and nothing
else (no warning for `none` and `print`, none or one of a link for `arm`); `true_mm` and `expected_mm`: error of the
model at 300 other poses, as it is and as the model says (a slip: of the camera's place with most images).
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parents[1] / room) for room in ("", "real_robots")]  # for modules that are shared

import warnings
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace

import harness
import torch
from harness import Record
from simulated_camera import BOARD_PRIOR, HEIGHT, LENS, WIDTH, CameraArm, camera_arm
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.common.device import seeded
from diffeo_calib.robots.se3 import twist_transform

IMAGES, JUDGED, NOISE_PX, BENT_M, WORSE = 60, 300, 0.1, 5e-4, 3.0
NAMED = {"the camera on the tool": "slip", "the focal length": "focus", "the link before": "arm"}
CASES = (("none", 0.0), ("arm", WORSE), ("slip", 0.5), ("slip", 1.5), ("focus", 0.2), ("focus", 0.4), ("print", 0.5))
COLUMNS = ("case", "size", "seed", "said", "right", "true_mm", "expected_mm")


def slipped(boards: Tensor, size: float, seed: int) -> Tensor:
    """Poses of the board in the camera, which shifts by some mm after half of them and turns by 5 mrad for each mm."""
    twist = torch.randn(2, 3, dtype=boards.dtype, generator=seeded(seed))
    twist = twist / twist.norm(dim=1, keepdim=True) * twist.new_tensor([[1e-3 * size], [5e-3 * size]])
    moved = boards.clone()
    moved[len(boards) // 2 :] = twist_transform(twist.view(1, 6)) @ moved[len(boards) // 2 :]
    return moved


def focused(corners: Tensor, share: float, seed: int) -> Tensor:
    """Corners (N, K, 5) in images with focal lengths of their own."""
    own = 1.0 + share * torch.randn(len(corners), 1, 1, dtype=corners.dtype, generator=seeded(seed))
    middle = corners.new_tensor(LENS[2:4])
    pixels = middle + own * (corners[..., 3:] - middle)
    outside = (pixels < 0).any(2) | (pixels > pixels.new_tensor([WIDTH - 1, HEIGHT - 1])).any(2)
    return torch.cat([corners[..., :3], pixels], 2).masked_fill(outside[..., None], torch.nan)


def images(arm: CameraArm, case: str, size: float, seed: int) -> dc.Measurements:
    """What the arm's camera shows in a case."""
    seen = replace(arm, q=arm.q[JUDGED:], boards=arm.boards[JUDGED:])
    if case == "slip":
        seen = replace(seen, boards=slipped(seen.boards, size, seed))
    if case == "print":
        unknowns = seen.camera.unknowns.clone()
        unknowns[-3] = 1e-3 * size / seen.camera.half_size
        seen = replace(seen, camera=replace(seen.camera, unknowns=unknowns))
    q, corners = seen.shown(NOISE_PX, seed)
    corners = focused(corners, 1e-2 * size if case == "focus" else 0.0, seed)
    return dc.Measurements.from_images(q, corners, (WIDTH, HEIGHT), arm.arm.nominal.joint_names, board=BOARD_PRIOR)


def measure(plan: Namespace) -> Iterator[Record]:
    """A record for every case and seed."""
    for seed in range(1, plan.seeds + 1):
        arm = camera_arm(JUDGED + IMAGES, seed)
        for case, size in [one for one in CASES if not plan.only or one[0] in plan.only]:
            own = camera_arm(JUDGED + IMAGES, seed, worse=size) if case == "arm" else arm
            data = images(own, case, size, seed)
            with warnings.catch_warnings(record=True) as found:
                warnings.simplefilter("always")
                result = dc.calibrate(own.arm.nominal, data)
            said = [str(one.message) for one in found]
            names = {next((cause for words, cause in NAMED.items() if words in text), "other") for text in said}
            right = names == ({case} & {"slip", "focus"}) or (case == "arm" and names == {"arm"})
            record: Record = {
                "case": case,
                "size": size,
                "seed": seed,
                "said": ", ".join(sorted(names)),
                "right": right,
            }
            true = own.error(result.model, own.q[:JUDGED])
            yield record | {"true_mm": 1e3 * true, "expected_mm": 1e3 * result.expected.measured}


if __name__ == "__main__":
    only = {"nargs": "+", "metavar": "CASE"}
    harness.run(__doc__, measure, COLUMNS, quick={"seeds": 1}, seeds=harness.number(20), only=only)
