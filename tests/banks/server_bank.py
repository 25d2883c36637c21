"""The command line in a process of its own for every command, forked from one that has loaded everything.

Starting Python and loading torch takes seconds; a copy of a process that has done so takes milliseconds.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType

from command_bank import Outcome, environment

SERVER = """
import gc, json, os, sys
import matplotlib.backends.backend_agg, matplotlib.figure, rich.progress, scipy.spatial.transform, torch, typer
import diffeo_calib.calibration.calibrate, diffeo_calib.interop, diffeo_calib.cli.main as program
from diffeo_calib.kinematics.compensation import compensate

gc.freeze()
answers = os.fdopen(os.dup(1), "w")
for line in sys.stdin:
    task = json.loads(line)
    child = os.fork()
    if child == 0:
        break
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), file=answers, flush=True)
else:
    sys.exit()

answers.close()
for number, place in enumerate(task["streams"]):  # what a shell does
    os.close(number)
    if place == "|":  # a pipe whose reader has gone
        read, write = os.pipe()
        os.dup2(write, number)
        os.close(read)
    elif place:
        opened = os.open(place, os.O_RDWR | os.O_CREAT, 0o600)
        if opened != number:
            os.dup2(opened, number)
            os.close(opened)
streams = {}
for number, name in enumerate(("stdin", "stdout", "stderr")):  # what Python does at its start
    try:
        os.fstat(number)
        streams[name] = open(number, "w" if number else "r", encoding="utf-8")
    except OSError:
        streams[name] = None
sys.stdin, sys.stdout, sys.stderr = streams.values()
sys.__stdin__, sys.__stdout__, sys.__stderr__ = streams.values()
if task["limit"] is not None:
    import resource
    sys.dont_write_bytecode = True  # Python would keep half of a module
    resource.setrlimit(resource.RLIMIT_FSIZE, (task["limit"], task["limit"]))
sys.argv = ["diffeo-calib", *task["arguments"]]
code = 0
try:
    program.main()
except SystemExit as end:
    code = end.code or 0
for stream in (sys.stdout, sys.stderr):  # what Python does at its end, without the seconds that unloading takes
    try:
        stream is None or stream.flush()
    except (OSError, ValueError):
        code = 120
os._exit(code)
"""


class Server:
    """Runs commands one after another, used as a context.

    Args:
        folder: for what the commands print.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __enter__(self) -> Server:
        command = [sys.executable, "-c", SERVER]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment()
        )
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        self._process.communicate("", timeout=60)

    def __call__(
        self, arguments: Sequence[object], streams: Mapping[int, str] | None = None, limit: int | None = None
    ) -> Outcome:
        """Run one command.

        Args:
            arguments: of the command.
            streams: number -> file, "" if it is closed, "|" for a pipe that nobody reads; 1 and 2 are kept otherwise.
            limit: largest size of a file in bytes, as on a disk that is full.
        """
        printed = [self.folder / "out", self.folder / "err"]
        for path in printed:
            path.write_bytes(b"")
        places = dict(enumerate(["/dev/null", *map(str, printed)])) | dict(streams or {})
        task = {"arguments": [str(a) for a in arguments], "streams": list(places.values()), "limit": limit}
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(task) + "\n")
        self._process.stdin.flush()
        code = int(self._process.stdout.readline())
        out, err = (path.read_text(encoding="utf-8", errors="replace") for path in printed)
        return Outcome(code, out, err)
