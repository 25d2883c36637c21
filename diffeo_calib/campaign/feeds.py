"""Rows as JSON lines: how a program of the user's own feeds a campaign, over standard input or a socket.

Every line that is sent is one JSON object in UTF-8 that ends with a newline. Its keys are the columns of the table:
the joints, and whatever was measured there, in the units of the table; null where a marker was hidden. The first
object names all columns of a table that is not there yet. A line without its newline is never taken in. ::

    {"id": 7, "joint_1": -28.1, ..., "joint_6": 78.9, "x": -1982.31, "y": 1750.62, "z": 349.83}

Each line is answered by one, in order. A row that is answered is on the disk, with its verdict. ::

    {"id": 7, "line": 8, "fits": true, "accepted": true, "error_mm": 0.03, "usual_mm": 0.04, "cause": "",
     "change": null, "text": "row 8 fits: ...", "revised": [], "expected_error_mm": 0.21, "error_limit_mm": 0.27,
     "more_rows": 14, "target_reached": false, "next": [{"joint_1": 12.9, ..., "joint_6": -40.2}], "rows": 7,
     "accepted_rows": 7}
    {"id": 7, "error": "the line was not taken in, and why"}

`line` is the row's line in the table, whose header is line 1; texts name rows by it. `fits` is null as long as there is
no model. `more_rows`, `target_reached` and `error_limit_mm`, which the error exceeds with 5 % probability and which
decides, belong to a target. `change`: what changed before the row (`line`, `cause`, `others`, `size`, `unit`, `fix`);
`revised`: earlier rows taken in or left out by this.

`id` is optional: a number or a word that is a column of the table and tells rows apart; 1 and "1" are the same. After a
cut connection, a program sends the rows again that were not answered: a row that the table has under its id is answered
and not taken in again. Other numbers under an id that the table has are an error.

Other objects: `{}` asks for the last seven of these alone; `{"do": "reject", "line": 5}` leaves a row out, "accept"
takes it in, "repeat" leaves it out and puts its pose first among the next. A socket answers `{}` by itself when a
connection begins, and says `"ended": true` when the campaign ends. Where it needs a token, `{"token": "..."}` is the
first line. A line that is no JSON object ends its connection: browsers, too, can send text to local ports.
"""

from __future__ import annotations

import json
import secrets
import socket
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from queue import Queue, SimpleQueue
from socketserver import StreamRequestHandler, ThreadingTCPServer
from threading import Event, Lock, Thread
from typing import Any, NamedTuple, TypeVar

from diffeo_calib.common.errors import DiffeoCalibError, InputError, as_written

MOST_BYTES = 1 << 20
"""Of a line."""
DECISIONS = ("accept", "reject", "repeat")
"""Decisions of a user on a row: methods of a campaign."""
ID = "id"
"""Column that tells rows apart."""
LARGEST, LONGEST_WORD = 1e300, 200
"""Number and characters of a cell."""
LOCAL = ("127.0.0.1", "localhost")
CLOSING_SECONDS = 2.0
"""For the last answers of a campaign."""

Entry = dict[str, Any]


class Sent(NamedTuple):
    """An object that was sent, or why a line is none; and what takes the answer."""

    entry: Entry | DiffeoCalibError
    answer: Callable[[Entry], object] = str


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


def read_lines(lines: Iterable[bytes], inbox: Queue[Sent | None]) -> None:
    """Put what lines hold into an inbox, and None at their end; what is no object with the reason."""
    for text in lines:
        try:
            inbox.put(Sent(parsed(text)))
        except InputError as error:
            inbox.put(Sent(error))
    inbox.put(None)


class Server(ThreadingTCPServer):
    """A server whose connections have threads of their own."""

    daemon_threads = True
    allow_reuse_address = True

    def end(self) -> None:
        """Let the connections go."""

    def handle_error(self, *given: Any) -> None:
        """A cut connection is no event: its rows are sent again."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(*given)


SomeServer = TypeVar("SomeServer", bound=Server)


@contextmanager
def running(server: Callable[[tuple[str, int]], SomeServer], address: str, what: str) -> Iterator[SomeServer]:
    """Run a server at ``PORT`` or ``HOST:PORT``, 0 for any free port; InputError where that is none, or taken."""
    host, _, port = address.rpartition(":")
    try:
        made = server((host or LOCAL[0], int(port)))
    except (OSError, ValueError, OverflowError) as error:
        expected = "a free port, or HOST:PORT"
        raise InputError.of(f"the {what} at {address}", expected=expected, got=str(error)) from error
    thread = Thread(target=made.serve_forever, daemon=True)
    thread.start()
    try:
        yield made
    finally:
        made.shutdown()
        made.end()
        made.server_close()
        thread.join()


@contextmanager
def listening(address: str, token: str, inbox: Queue[Sent | None]) -> Iterator[Listener]:
    """Put what comes over a socket at ``HOST:PORT`` into an inbox; PORT 0 is any free one.

    Args:
        token: that connections must begin with; empty for none, at addresses of this machine alone.

    Raises:
        InputError: another machine's address without a token, no such address, or one that is taken.
    """
    host, _, port = address.rpartition(":")
    if host not in ("", *LOCAL) and not token:
        fix = f"add a token, or listen at {LOCAL[0]}:{port}"
        raise InputError.of(f"other machines could send rows to {address}", expected="a token", got="none", fix=fix)
    with running(lambda place: Listener(place, token, inbox), address, "socket") as server:
        yield server


class Listener(Server):
    """A socket that rows come from.

    Attributes:
        address: HOST:PORT. last: what every connection is told at the end.
    """

    def __init__(self, place: tuple[str, int], token: str, inbox: Queue[Sent | None]) -> None:
        super().__init__(place, _Connection)
        self.address = f"{self.server_address[0]}:{self.server_address[1]}"
        self.token, self.inbox, self.last = token, inbox, {"ended": True}
        self._open, self._lock, self._none = set[socket.socket](), Lock(), Event()
        self._none.set()

    def note(self, connection: socket.socket, *, opened: bool) -> None:
        """Remember the connections that are open."""
        with self._lock:
            (self._open.add if opened else self._open.discard)(connection)
            (self._none.clear if self._open else self._none.set)()

    def end(self) -> None:
        """Read no more, answer what was sent since, and wait until the last answers are written."""
        with self._lock:
            for connection in self._open:
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RD)
        while not self.inbox.empty():
            sent = self.inbox.get()
            if sent is not None:
                sent.answer(self.last | {"error": "the campaign has ended; the row was not taken in"})
        self._none.wait(CLOSING_SECONDS)


class _Connection(StreamRequestHandler):
    """Sends what comes over one connection, line by line, and answers it."""

    server: Listener

    def handle(self) -> None:
        self.server.note(self.connection, opened=True)
        try:
            if self.server.token:
                given = str(parsed(self.rfile.readline(MOST_BYTES)).get("token")).encode(errors="replace")
                if not secrets.compare_digest(given, self.server.token.encode()):
                    raise InputError.of("the first line", expected='{"token": "..."} with the token of the campaign')
            self._ask({})
            while text := self.rfile.readline(MOST_BYTES):
                self._ask(parsed(text))
            self._write(self.server.last)
        except InputError as error:
            self._write({"error": str(error)})
        finally:
            self.server.note(self.connection, opened=False)

    def _ask(self, entry: Entry) -> None:
        answers: SimpleQueue[Entry] = SimpleQueue()
        self.server.inbox.put(Sent(entry, answers.put))
        self._write(answers.get())

    def _write(self, answer: Entry) -> None:
        self.wfile.write(as_line(answer))


def as_line(answer: Entry) -> bytes:
    """An answer as it is sent."""
    return (json.dumps(answer, allow_nan=False) + "\n").encode()
