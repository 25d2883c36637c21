"""Campaigns under faults: no row that was answered may be lost, and none may be taken in twice or by half.

    python benchmarks/robustness/campaign_faults.py [--count 200] [--seed 0] [--out campaign_faults.json]

Six rows are sent over standard input, or appended to the table by another program, while something fails:

* kill: SIGKILL ends the campaign; it is started again.
* full disk: files cannot grow beyond a random size (RLIMIT_FSIZE); then they can, and the campaign is started again.
* cut pipe: the input ends after a row was sent, or within it; the campaign is started again for every row.
* half a line: another program appends lines to the table in pieces of random lengths.
* two writers: a second campaign of the same table is started while a program sends rows.

A program sends rows again that were not answered. At the end the table must hold each row once, with the numbers that
were sent, and the journal one verdict for each. Fields of a record: `fault`, `count`, `faults` that struck (rows were
being sent), `answered` before, `lost`, `twice`, `torn`: rows; `failed`: campaigns that could not go on.
"""

from __future__ import annotations

import csv
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import harness
from kills import ended, start

from diffeo_calib.cli.commands import campaign as _loaded  # noqa: F401  # before the commands are forked
from diffeo_calib.robots.simulated_arm import SimulatedArm

ROWS = 6
SECONDS = 60.0
LOSSES = ("lost", "twice", "torn", "failed")
OPTIONS = ["--position", "x,y,z", "--length", "m", "--angle", "rad", "--base", "base_link", "--tip", "flange"]
ARM = SimulatedArm(1)

Row = dict[str, float]


def rows(seed: int) -> list[Row]:
    """What is measured."""
    q, y = ARM.measure(ROWS, seed=seed)
    names = [*ARM.nominal.joint_names, "x", "y", "z"]
    return [
        {"id": number, **dict(zip(names, [*a, *b], strict=True))}
        for number, (a, b) in enumerate(zip(q.tolist(), y[:, 0].tolist(), strict=True))
    ]


@dataclass
class Site:
    """A campaign in a folder.

    Args:
        answered: ids of rows that were answered.
    """

    folder: Path
    draw: random.Random
    wanted: list[Row]
    answered: set[int] = field(default_factory=set)
    process: int = 0
    failed: int = 0

    def run(self, limit: int | None = None) -> Client:
        """Start the campaign; files cannot grow beyond ``limit`` bytes."""
        words = ["campaign", str(self.folder / "run.csv"), "--robot", str(self.folder / "arm.urdf"), *OPTIONS]
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
        (stdin, rows), (answers, stdout) = os.pipe(), os.pipe()
        self.process = start([*words, "--stdin"], (stdin, stdout))
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        os.close(stdin)
        os.close(stdout)
        return Client(rows, answers)

    def send(self, client: Client, number: int) -> None:
        """Send a row and note its answer; ConnectionError without one."""
        answer = client.ask(self.wanted[number])
        if "line" in answer:
            self.answered.add(number)

    def killed(self) -> bool:
        """End the campaign by SIGKILL; whether it was still running."""
        os.kill(self.process, signal.SIGKILL)
        return ended(self.process) == -signal.SIGKILL

    def finish(self) -> None:
        """Start the campaign again and send what was not answered, as programs do."""
        with self.run() as client:
            try:
                for number in range(ROWS):
                    if number not in self.answered:
                        self.send(client, number)
            except ConnectionError:
                self.failed = 1
            client.rows.close()
            ended(self.process)

    def losses(self) -> dict[str, int]:
        """What became of the rows."""
        with (self.folder / "run.csv").open(newline="") as file:
            found = list(csv.DictReader(file))
        journal = [json.loads(line) for line in (self.folder / "run.csv.journal").read_text().splitlines()]
        judged = [one["line"] - 2 for one in journal if one.get("rows")]
        numbers = [float(one["id"] or -1) for one in found]
        whole = [row for row in found if None not in row.values() and _numbers(row) in self.wanted]
        missing = {number for number in self.answered if numbers.count(number) == 0}
        return {
            "lost": len(missing) + len(set(range(len(found))) - set(judged)),
            "twice": len(numbers) - len(set(numbers)) + len(judged) - len(set(judged)),
            "torn": len(found) - len(whole),
            "failed": self.failed or len(found) != ROWS,
        }


class Client:
    """A program that sends rows, through two pipes."""

    def __init__(self, rows: int, answers: int) -> None:
        self.rows, self.answers = os.fdopen(rows, "wb", buffering=0), os.fdopen(answers, "rb")

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.rows.close()
        self.answers.close()

    def read(self) -> dict[str, object]:
        """The answer to a row; what a campaign says by itself is skipped."""
        while line := self.answers.readline():
            answer = json.loads(line)
            if answer.keys() & {"id", "error"}:
                return answer
        raise ConnectionError

    def write(self, content: bytes) -> None:
        """Send bytes."""
        try:
            self.rows.write(content)
        except OSError as error:
            raise ConnectionError from error

    def ask(self, row: Row) -> dict[str, object]:
        """Send a row."""
        self.write(as_line(row))
        return self.read()


def _numbers(row: dict[str, str]) -> Row:
    return {name: float(value) for name, value in row.items()}


def as_line(row: Row) -> bytes:
    """A row as it is sent."""
    return (json.dumps(row) + "\n").encode()


def kill(site: Site) -> bool:
    """SIGKILL while a row is on its way."""
    at = site.draw.randrange(ROWS)
    with site.run() as client:
        for number in range(at):
            site.send(client, number)
        client.write(as_line(site.wanted[at]))
        time.sleep(site.draw.uniform(0.0, 0.02))
        killed = site.killed()
        with suppress(ConnectionError):
            if "line" in client.read():
                site.answered.add(at)
    return killed


def full_disk(site: Site) -> bool:
    """Files that cannot grow."""
    with site.run(site.draw.randrange(1500)) as client:
        with suppress(ConnectionError):
            for number in range(ROWS):
                site.send(client, number)
        client.rows.close()
        ended(site.process)
    return len(site.answered) < ROWS


def cut_pipe(site: Site) -> bool:
    """Every row is cut once, at a random byte, or sent without waiting for its answer."""
    for number in range(ROWS):
        content = as_line(site.wanted[number])
        with site.run() as client:
            client.write(content[: site.draw.randrange(1, len(content) + 1)])
            client.rows.close()
            ended(site.process)
        with site.run() as client:
            site.send(client, number)
            client.rows.close()
            ended(site.process)
    return True


def half_a_line(site: Site) -> bool:
    """Another program that appends to the table in pieces, while the campaign follows it."""
    header = ",".join(site.wanted[0])
    content = "".join(f"{line}\n" for line in [header, *(",".join(map(repr, row.values())) for row in site.wanted)])
    with site.run() as client:
        with (site.folder / "run.csv").open("a") as file:
            while content:
                size = site.draw.randrange(1, 200)
                file.write(content[:size])
                file.flush()
                content = content[size:]
                time.sleep(site.draw.uniform(0.0, 0.05))
        for number in range(ROWS):
            site.send(client, number)
        client.rows.close()
        ended(site.process)
    return True


def two_writers(site: Site) -> bool:
    """A second campaign, which must be refused."""
    with site.run() as client:
        first = site.process
        site.send(client, 0)  # the table is its own before the second starts
        with site.run():
            for number in range(1, ROWS):
                site.send(client, number)
            refused = ended(site.process) == 1
        client.rows.close()
        ended(first)
    return refused


FAULTS: dict[str, Callable[[Site], bool]] = {
    "kill": kill,
    "full disk": full_disk,
    "cut pipe": cut_pipe,
    "half a line": half_a_line,
    "two writers": two_writers,
}


def struck(name: str, count: int, seed: int) -> harness.Record:
    """Let one fault strike again and again."""
    found: dict[str, int] = dict.fromkeys(("faults", "answered", *LOSSES), 0)
    for k in range(count):
        with tempfile.TemporaryDirectory() as place:
            ARM.write_urdf(Path(place) / "arm.urdf")
            site = Site(Path(place), random.Random(f"{seed} {name} {k}"), rows(seed + k))
            try:
                found["faults"] += FAULTS[name](site)
            except ConnectionError:
                site.failed = 1
                with suppress(ProcessLookupError, ChildProcessError):
                    site.killed()
            found["answered"] += len(site.answered)
            site.finish()
            for loss, number in site.losses().items():
                found[loss] += number
    return {"fault": name, "count": count, **found}


def measure(count: int, seed: int, names: list[str]) -> Iterator[harness.Record]:
    """One record for every fault."""
    yield from (struck(name, count, seed) for name in names)


def program() -> None:
    """Parse the arguments, measure, report; exit code 1 if a row was lost, torn or taken twice."""
    parser = harness.parser(__doc__)
    parser.add_argument("--count", type=harness.count, default=200, help="times that each fault strikes")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--fault", choices=FAULTS, action="append", help="only this one; may be repeated")
    given = parser.parse_args()
    names = given.fault or list(FAULTS)
    records = harness.report(measure(2 if given.quick else given.count, given.seed, names), given.out)
    if any(record[name] for record in records for name in LOSSES):
        sys.exit("error: rows were lost, torn or taken twice.")


if __name__ == "__main__":
    harness.guarded(program)
