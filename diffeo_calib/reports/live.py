"""A page that shows a campaign while it runs, served to this machine alone.

The page is one file without outside resources (html/live.html). It asks twice a second for what it shows, which holds
everything, so that a page that was reloaded or slept misses nothing. Decisions about rows come back by POST.

Other machines connect only to an address that was asked for, with a token. Without one the Host header must name this
machine, so that no page of another origin reaches the server under a name of its own; and a POST needs a header that
browsers send across origins only after asking.
"""

from __future__ import annotations

import json
import re
import secrets
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from threading import Event, Thread
from typing import Any
from urllib.parse import parse_qs

from diffeo_calib.campaign.campaign import Campaign, Next
from diffeo_calib.campaign.feeds import DECISIONS, Inbox
from diffeo_calib.common.errors import InputError, shown

LOCAL = ("127.0.0.1", "localhost")
PATHS = tuple(f"/{name}" for name in DECISIONS)
SHOWN_ROWS, SHOWN_POSES = 8, 500  # the last rows, and poses
LAST_SECONDS = 0.6  # time for a page, which asks twice a second, to see the last state


class Page(ThreadingHTTPServer):
    """A running server: ``url`` is the page, with its token; ``decisions`` take what the buttons decide."""

    def __init__(self, place: tuple[str, int], decisions: Inbox) -> None:
        super().__init__(place, _Handler)
        host, port = str(self.server_address[0]), self.server_address[1]
        self.token = "" if place[0] in LOCAL else secrets.token_urlsafe()
        self.url = f"http://{host}:{port}/" + (f"?token={self.token}" if self.token else "")
        self.decisions = decisions
        self.state, self.seen = "{}", Event()

    def publish(self, state: dict[str, Any]) -> None:
        """Show something new on all pages."""
        self.state = json.dumps(state)
        self.seen.clear()

    def handle_error(self, *given: Any) -> None:
        """A cut connection is no event."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(*given)


@contextmanager
def served(address: str, decisions: Inbox) -> Iterator[Page]:
    """Serve a page at ``PORT`` or ``HOST:PORT``, 0 for any free port; InputError if there is none, or it is taken."""
    host, _, port = address.rpartition(":")
    try:
        page = Page((host or LOCAL[0], int(port)), decisions)
    except (OSError, ValueError, OverflowError) as error:
        expected = "a free port, or HOST:PORT"
        raise InputError.of(f"the page at {shown(address)}", expected=expected, got=shown(str(error))) from error
    thread = Thread(target=page.serve_forever, daemon=True)
    thread.start()
    try:
        yield page
    finally:
        if page.state != "{}":
            page.seen.wait(LAST_SECONDS)
        page.shutdown()
        page.server_close()
        thread.join()


def state_of(campaign: Campaign, words: tuple[str, str], proposal: Next | None) -> dict[str, Any]:
    """Data of the page: lengths in mm, places in m in the robot's base.

    Args:
        words: the expected error, and the next poses. proposal: these.
    """
    robot, count, error = campaign.robot, len(campaign), campaign.expected_error
    said = [(row.row + 1, 1e3 * row.expected_error) for row in campaign.verdicts if row.expected_error is not None]
    next_q, expected = (campaign.candidates[:0], ()) if proposal is None else (proposal.q[:1], proposal.expected)
    verdicts = [
        {"line": row.line, "text": str(row), "accepted": row.accepted, "fits": row.fits}
        for row in campaign.verdicts[: -SHOWN_ROWS - 1 : -1]
    ]
    done_q = next_q[:0] if campaign.table is None else campaign.table.q[-SHOWN_POSES:]
    next_tips, done = (robot.tip_poses(q)[:, 0, :3, 3].tolist() for q in (next_q, done_q))
    return {
        "error": None if error is None else 1e3 * error,
        "state": f"{len(campaign.accepted)} of {count} rows accepted; {words[0]}",
        "pose": words[1],
        "goal": None if campaign.goal is None else 1e3 * campaign.goal,
        "curve": said[:: max(1, len(said) // SHOWN_POSES)],
        "forecast": [(count + step, 1e3 * value) for step, value in enumerate(expected)],
        "verdicts": verdicts,
        "done": done,
        "next": next_tips,
        "links": robot.joint_frames(next_q)[:, :, :3, 3].flatten(0, 1).tolist() + next_tips,
    }


class _Handler(BaseHTTPRequestHandler):
    """Answers the page's requests."""

    server: Page

    @property
    def _query(self) -> dict[str, list[str]]:
        return parse_qs(self.path.partition("?")[2])

    def do_GET(self) -> None:
        """The page, or what it shows."""
        path = self.path.partition("?")[0]
        if not self._allowed():
            self.send_error(403)
        elif path == "/":
            self._begin("text/html; charset=utf-8")
            self.wfile.write(files("diffeo_calib.reports.html").joinpath("live.html").read_bytes())
        elif path == "/state":
            self._begin("application/json")
            self.server.seen.set()
            self.wfile.write(self.server.state.encode())
        else:
            self.send_error(404)

    def do_POST(self) -> None:
        """A decision about a row, such as /reject?line=N."""
        path, line = self.path.partition("?")[0], self._query.get("line", [""])[0]
        if not self._allowed() or self.headers.get("X-Campaign") is None:
            self.send_error(403)
        elif path not in PATHS:
            self.send_error(404)
        elif not re.fullmatch("[0-9]{1,9}", line):
            self.send_error(400)
        else:
            self.server.decisions.put({"do": path[1:], "line": int(line)})
            self._begin("text/plain")

    def log_message(self, *_: object) -> None:
        """Nothing is printed."""

    def _begin(self, kind: str) -> None:
        self.send_response(200)
        headers = {"Content-Type": kind, "Cache-Control": "no-store", "Referrer-Policy": "no-referrer"}
        headers["Content-Security-Policy"] = "default-src 'self' 'unsafe-inline'; frame-ancestors 'none'"
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()

    def _allowed(self) -> bool:
        if self.server.token:
            given = self._query.get("token", [""])[0]
            return secrets.compare_digest(given.encode(), self.server.token.encode())
        return self.headers.get("Host", "").rpartition(":")[0] in LOCAL
