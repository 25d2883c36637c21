"""Clean campaigns as people really make them: how many does `fit` refuse, and what does it say of them that is untrue?

    python benchmarks/robustness/false_alarms.py --count 300 --jobs 2 --out false_alarms.json

Nothing is wrong with the tables of `clean_campaigns.py`. Each is written to a file and fitted by the command line, in
this process; what it says is every warning, the error, and the lines about rows that look wrong. A sentence counts as
untrue unless the table `SENTENCES` finds it true by what is known of the campaign. `--seed S` begins at campaign
10000 S, `--only N ...` repeats single campaigns.

Fields of a record: `campaign` its number, `design`; `refused`; `untrue`, `true`: kinds of sentences; `texts` in full;
`true_mm` RMS error at 150 configurations within the joint ranges of the rows (at the rows where a camera must see a
board), after the best rigid motion; `expected_mm` what the model expects of it; `inside` share of these points in their
95 % regions without rigid motions; `seconds` of the processor.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the modules that all benchmarks share

import argparse
import json
import re
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from functools import partial
from multiprocessing import get_context
from typing import Any, NamedTuple

import harness
import torch
from clean_campaigns import Campaign, campaign, design
from commands import executed
from harness import Record
from held_out import covered, rms_mm
from rich.console import Console
from torch import Tensor

import diffeo_calib as dc
from diffeo_calib.measurements.poses import own_blocks
from diffeo_calib.robots.placement import rigid_fit
from diffeo_calib.robots.se3 import skew

TRUTH_ROWS = 150
CAMPAIGNS_PER_SEED = 10_000
COLUMNS = ("campaign", "design", "refused", "untrue", "true_mm", "expected_mm", "inside", "seconds")
SAID = re.compile(r"look wrong|probably wrong|gear line|stopped|not converge|no step lowers")
"""Lines of the output that judge rows or the fit."""


class Known(NamedTuple):
    """What is known of a campaign: how it was made, and the true error of the model by the one that it expects."""

    campaign: Campaign
    ratio: float
    inside: float


class Sentence(NamedTuple):
    """What `fit` may say: a pattern of its words, and whether that is true of a campaign."""

    pattern: str
    true: Callable[[Known], bool]


def always(_: Known) -> bool:
    """A fact, or advice that holds for every table of this kind."""
    return True


def never(_: Known) -> bool:
    """Not of a clean table."""
    return False


def ranges(known: Known) -> Tensor:
    """Ranges of the joints (n,) in the table, rad or m."""
    q = known.campaign.data.q
    return q.amax(0) - q.amin(0)


def open_places(known: Known) -> bool:
    """Whether a joint or the tool hardly turned, or the rows are few."""
    of = known.campaign.design
    styles = ("tool hardly turned", "one joint at a time", "small ranges")
    return of.style in styles or of.rows < 30 or bool((ranges(known) < 0.05).any())


def flatness(known: Known) -> bool:
    """Whether the true markers lie within 3 % of the reach from a plane or a line."""
    points = known.campaign.truth(known.campaign.data.q).mean(1)
    spread = torch.linalg.svdvals(points - points.mean(0)) / len(points) ** 0.5
    return float(spread[-1]) < 0.03 * known.campaign.design.reach_m


SENTENCES = {
    "a joint never moved": Sentence("never moved in", lambda known: bool((ranges(known) < 1e-3).any())),
    "a joint hardly moved": Sentence("hardly moved in", lambda known: bool((ranges(known) < 0.06).any())),
    "one joint at a time": Sentence("one at a time in", lambda known: "one joint" in known.campaign.design.style),
    "a place is open": Sentence(r"(is|are) known to [^;]* only: ", open_places),
    "a flat path": Sentence("positions lie near a", flatness),
    "no errors of the robot": Sentence(
        "show no errors of the robot", lambda known: known.campaign.design.off_mm <= known.campaign.design.noise_mm
    ),
    "few poses": Sentence("too few to select scales", lambda known: known.campaign.design.rows < 30),
    "scales contradicted": Sentence("contradict the selected", lambda known: known.ratio > 1.5 or known.inside < 0.85),
    "a length": Sentence("seems to differ by", lambda known: known.campaign.links_mm > 1.0),
    "rounded joints": Sentence("are rounded to", lambda known: known.campaign.design.joints.startswith("reported")),
    "no length known": Sentence("hold too little length", always),
    "no plane faces": Sentence("no plane faces", always),
    "a joint is not seen": Sentence("readings hardly change with", open_places),
    "the tool is hardly tilted": Sentence("hardly tilted|never tilted", open_places),
    "did not converge": Sentence("stopped|not converge|no step lowers", never),
    "rows look wrong": Sentence(r"rows? look wrong \(", never),
    "held-out rows are wrong": Sentence("few are far off", never),
    "outliers": Sentence("are outliers", never),
    "a block of wrong rows": Sentence("that follow one another", never),
    "something moved": Sentence("seems? to have (moved|changed)|seems to drift", never),
    "does not fit the robot": Sentence("do(es)? not fit", never),
    "joint offsets": Sentence("joint offsets are far", never),
    "beyond the limits": Sentence("far beyond the robot's limits", never),
    "nominal robot": Sentence("rows are those of the nominal robot", never),
    "a gear line": Sentence("gear line", never),
}
"""Kind of sentence -> its words, and when it is true. The first that matches counts."""


def kind_of(text: str) -> str:
    """The kind of a sentence, or its first words without digits."""
    found = (name for name, one in SENTENCES.items() if re.search(one.pattern, text))
    return next(found, re.sub(r"'[^']*'|\d[\d.e+-]*", "#", text.partition(": expected")[0])[:80])


def said(results: dict[str, Any], out: str) -> list[str]:
    """Everything that a fit says against a table or its model, the refusal last."""
    lines = [line for line in out.splitlines() if SAID.search(line)]
    return [*results["warnings"], *lines, *filter(None, [results["error"]])]


def truth(made: Campaign, model: dc.CalibratedKinematics) -> Record:
    """True and expected error within the joint ranges of the rows, and the share inside the regions."""
    low, high = made.data.q.amin(0), made.data.q.amax(0)
    draw = torch.rand(TRUTH_ROWS, len(low), dtype=low.dtype, generator=torch.Generator().manual_seed(3))
    q = made.data.q if made.design.kind.startswith("board") else low + (high - low) * draw
    points, true = model(q).detach().flatten(0, 1), made.truth(q).flatten(0, 1)
    T = rigid_fit(true, points)
    error = true @ T[:3, :3].mT + T[:3, 3] - points
    whole = model.map.conditional.covariance_between(model.map.geodesic.linearise(q))
    eye = torch.eye(3, dtype=q.dtype).expand(len(points), 3, 3)
    motions = torch.linalg.qr(torch.cat([eye, -skew(points - points.mean(0))], 2).flatten(0, 1)).Q
    left = whole - motions @ (motions.mT @ whole)
    covariance = own_blocks((left - (left @ motions) @ motions.mT)[None], len(points))[0]
    expected = 1e3 * float(covariance.diagonal(dim1=1, dim2=2).sum(1).mean().sqrt())
    return {"true_mm": rms_mm(error), "expected_mm": expected, "inside": covered(error, covariance)}


def judged(number: int) -> Record:
    """The record of a campaign."""
    of = design(number)
    with tempfile.TemporaryDirectory() as name:
        folder, begin = Path(name), time.process_time()
        made, model, results = campaign(of, folder), folder / "model.safetensors", folder / "results.json"
        _, out, err = executed([*made.written(folder), "-o", str(model), "--json", str(results)])
        if not results.exists():
            raise AssertionError(f"campaign {number} ({of.words}) ended without results: {err[-500:]}")
        found = json.loads(results.read_text(encoding="utf-8"))
        loaded: Any = dc.load(model) if model.exists() else None
        record: Record = {"campaign": number, "design": of.words, "refused": found["error"] is not None}
        record |= {} if loaded is None else truth(made, loaded)
    ratio = 0.0 if loaded is None else record["true_mm"] / record["expected_mm"]  # pyright: ignore
    known, texts = Known(made, ratio, float(record.get("inside") or 0.0)), said(found, out)
    kinds = dict.fromkeys((kind_of(text), found["error"] == text) for text in texts)
    true = [kind for kind, refusal in kinds if not refusal and kind in SENTENCES and SENTENCES[kind].true(known)]
    untrue = [f"refused: {kind}" * refusal or kind for kind, refusal in kinds if refusal or kind not in true]
    record |= {"untrue": "; ".join(untrue), "true": "; ".join(true), "texts": "\n".join(texts)}
    return record | {"seconds": time.process_time() - begin}


def measure(numbers: list[int], jobs: int) -> Iterator[Record]:
    """Records of campaigns, in their order."""
    pool = ProcessPoolExecutor(jobs, get_context("spawn")) if jobs > 1 else nullcontext()
    with pool as running:
        yield from map(judged, numbers) if running is None else running.map(judged, numbers)


def shares(records: list[Record]) -> list[Record]:
    """How often every kind of sentence was said, and how often untruly."""
    count, table = len(records), dict[str, list[int]]()
    for record in records:
        for place, field in enumerate(("untrue", "true")):
            for kind in filter(None, str(record[field]).split("; ")):
                table.setdefault(kind, [0, 0])[place] += 1
    rows = sorted(table.items(), key=lambda item: (-item[1][0], -item[1][1]))
    return [
        {"sentence": kind, "untrue": untrue, "untrue %": 100 * untrue / count, "true": true}
        for kind, (untrue, true) in rows
    ]


def errors(records: list[Record]) -> str:
    """True against expected errors, and coverage."""
    own = [record for record in records if record.get("true_mm") is not None]
    ratio = torch.tensor([record["true_mm"] / record["expected_mm"] for record in own])  # pyright: ignore
    inside = torch.tensor([record["inside"] for record in own])
    low, median, high = ratio.quantile(ratio.new_tensor([0.1, 0.5, 0.9])).tolist()
    return (
        f"true / expected error: median {median:.2f}, 80 % of the campaigns from {low:.2f} to {high:.2f}; inside the "
        f"95 % regions: {100 * float(inside.mean()):.1f} %, below 80 % in {int((inside < 0.8).sum())} of {len(own)}"
    )


def run(plan: argparse.Namespace) -> None:
    """Measure, and print the shares."""
    first = CAMPAIGNS_PER_SEED * plan.seed
    numbers = plan.only or list(range(first, first + (10 if plan.quick else plan.count)))
    records = harness.report(measure(numbers, plan.jobs), plan.out, COLUMNS)
    refused = sum(bool(record["refused"]) for record in records)
    console = Console(width=harness.WIDTH)
    console.print(harness.table(shares(records)))
    console.print(f"refused: {refused} of {len(records)}", errors(records), sep="\n")
    for record in records:
        if record["untrue"]:
            text = str(record["texts"]).replace("\n", "\n    ")
            console.print(f"{record['campaign']}: {record['design']}\n    {text}", markup=False, highlight=False)


def main() -> None:
    """Parse the arguments."""
    parser = harness.parser(__doc__)
    parser.add_argument("--seed", type=int, default=0, metavar="N")
    parser.add_argument("--count", type=harness.count, default=300, metavar="N")
    parser.add_argument("--jobs", type=harness.count, default=1, metavar="N", help="processes")
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="numbers of single campaigns")
    harness.guarded(partial(run, parser.parse_args()))


if __name__ == "__main__":
    main()
