"""Rows as JSON lines: how a program of the user's own feeds a campaign, over standard input.

Every line that is sent is one JSON object in UTF-8 that ends with a newline. Its keys are the columns of the table:
the joints, and whatever was measured there, in the units of the table; null where a marker was hidden. The first
object names all columns of a table that is not there yet. A line without its newline is never taken in. ::

    {"id": 7, "joint_1": -28.1, ..., "joint_6": 78.9, "x": -1982.31, "y": 1750.62, "z": 349.83}

Each line is answered by one, in order; one with an `id` says it again. A row that is answered is on the disk, with its
verdict. The campaign also prints lines of its own: its state when it goes on, `shown`, `removed`, rows of others. ::

    {"id": 7, "line": 8, "fits": true, "accepted": true, "error_mm": 0.03, "usual_mm": 0.04, "cause": "",
     "change": null, "text": "row 8 fits: ...", "revised": [], "expected_error_mm": 0.21, "error_limit_mm": 0.27,
     "more_rows": 14, "target_reached": false, "next": [{"joint_1": 12.9, ..., "joint_6": -40.2}], "rows": 7,
     "accepted_rows": 7}
    {"id": 7, "error": "the line was not taken in, and why"}

`line` is the row's line in the table, whose header is line 1; texts name rows by it. `fits` is null as long as there is
no model. `more_rows`, `target_reached` and `error_limit_mm`, which the error exceeds with 5 % probability and which
decides, belong to a target. `change`: what changed before the row (`line`, `cause`, `others`, `size`, `unit`, `fix`);
`revised`: earlier rows taken in or left out by this.

`id` is optional: a number or a word that is a column of the table and tells rows apart; 1 and "1" are the same. When a
campaign was started again, a program sends the rows again that were not answered: a row that the table has under its id
is answered and not taken in again. Other numbers under an id that the table has are an error.

Other objects: `{}` asks for the last seven of these alone; `{"do": "reject", "line": 5}` leaves a row out, "accept"
takes it in, "repeat" leaves it out and puts its pose first among the next. The last line, when the campaign ends, says
`"ended": true`, with what is `revised` since the last answer.
"""

from __future__ import annotations

import json
from functools import partial
from queue import Queue
from typing import IO, Any

from diffeo_calib.common.errors import DiffeoCalibError, InputError, as_written

DECISIONS = ("accept", "reject", "repeat")  # decisions of a user on a row: methods of a campaign
ID = "id"  # column that tells rows apart
LARGEST, LONGEST_WORD, LONGEST_LINE = 1e300, 200, 1 << 20  # number and characters of a cell, and bytes of a line

Entry = dict[str, Any]
Inbox = Queue[Entry | DiffeoCalibError | None]  # objects that were sent, or why a line is none; None at the end


def parsed(text: bytes) -> Entry:
    """The object of a line; InputError unless it is whole."""
    try:
        entry = json.loads(text) if text.endswith(b"\n") else None
    except (ValueError, RecursionError):
        entry = None
    if not isinstance(entry, dict):
        expected, got = "a JSON object that ends with a newline", repr(text[:60].decode(errors="replace"))
        raise InputError.of("a line of JSON", expected=expected, got=got)
    return entry


def check_cells(entry: Entry) -> None:
    """Raise InputError unless names and values fit into cells of a table, and an id is one."""
    for name, value in entry.items():
        word = isinstance(value, str) and len(value) <= LONGEST_WORD and value.isprintable()
        size = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST
        if not (word or size or value is None) or len(name) > LONGEST_WORD or not name.isprintable():
            expected = f"a finite number, a word of at most {LONGEST_WORD} characters, or null"
            raise InputError.of(f"'{name}' of a row", expected=expected, got=as_written(value))
    if not str(entry.get(ID, 0)).strip() or (ID in entry and entry[ID] is None):
        fix = "leave it out where rows have none"
        raise InputError.of(f"'{ID}' of a row", expected="a number or a word", got=json.dumps(entry[ID]), fix=fix)


def read_lines(stream: IO[bytes], inbox: Inbox) -> None:
    """Put what lines hold into an inbox."""
    for text in iter(partial(stream.readline, LONGEST_LINE), b""):
        try:
            inbox.put(parsed(text))
        except InputError as error:
            inbox.put(error)
    inbox.put(None)


def as_line(answer: Entry) -> bytes:
    """An answer as it is sent."""
    return (json.dumps(answer, allow_nan=False) + "\n").encode()
