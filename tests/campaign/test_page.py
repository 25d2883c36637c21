"""The page of a campaign: who may see it, what comes when, and in a real browser what is drawn and what buttons do."""

import http.client
import json
import socket
from collections.abc import Iterator
from queue import Queue
from threading import Timer
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import pytest

import diffeo_calib as dc
from diffeo_calib.common.errors import InputError
from diffeo_calib.reports.live import Page, served, state_of
from diffeo_calib.robots import SimulatedArm

ARM = SimulatedArm(3)


def answer(page: Page, method: str, path: str, **headers: str) -> int:
    parts = urlsplit(page.url)
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port, timeout=10)
    connection.request(method, path, headers=headers)
    status = connection.getresponse().status
    connection.close()
    return status


def decided(page: Page) -> list[tuple[str, int]]:
    both = page.decisions.get(timeout=5), page.decisions.get(timeout=5)
    return [(one["do"], one["line"]) for one in both if isinstance(one, dict)]


@pytest.fixture
def page() -> Iterator[Page]:
    with served("0", Queue()) as running:
        yield running


def test_only_who_may_sees_the_page_and_the_last_state(page: Page) -> None:
    assert page.url.startswith("http://127.0.0.1:")
    assert answer(page, "GET", "/") == 200
    assert answer(page, "GET", "/", Host="evil.example:80") == answer(page, "GET", "/state", Host="evil.example") == 403
    page.publish({"row": 1})
    with urlopen(f"{page.url}state") as state:
        assert json.load(state) == {"row": 1}
    assert answer(page, "GET", "/../journal") == 404
    mine = {"X-Campaign": "1"}
    assert answer(page, "POST", "/reject?line=3") == 403
    assert answer(page, "POST", "/reject?line=3", Host="evil.example", **mine) == 403
    assert answer(page, "POST", "/remove?line=3", **mine) == 404
    for line in ("x", "", "-1", "1.5", 5000 * "9", "%D9%A3"):
        assert answer(page, "POST", f"/reject?line={line}", **mine) == 400
    with socket.create_connection(page.server_address[:2], timeout=10) as raw:
        raw.sendall(b"GET http://[/ HTTP/1.0\r\n\r\n")
        assert b" 403 " in raw.makefile("rb").readline()
    assert page.decisions.empty()
    assert answer(page, "POST", "/reject?line=3", **mine) == 200
    assert answer(page, "POST", "/accept?line=4", **mine) == 200
    assert decided(page) == [("reject", 3), ("accept", 4)]
    for address in ("x", "70000", f"{urlsplit(page.url).port}", "no-such-host.invalid:0"):
        with pytest.raises(InputError), served(address, Queue()):
            pass
    seen = list[Any]()
    with served("0.0.0.0:0", Queue()) as other:
        assert answer(other, "GET", "/") == answer(other, "GET", "/?token=wrong") == 403
        assert answer(other, "GET", "/state?token=") == 403
        assert answer(other, "GET", f"/?token={other.token}") == 200
        other.publish({"state": "reached"})
        late = Timer(0.3, lambda: seen.append(json.load(urlopen(f"{other.url.replace('/?', '/state?')}"))))
        late.start()
    late.join()
    assert seen == [{"state": "reached"}]


@pytest.fixture(scope="module")
def campaign() -> dc.Campaign:
    found = dc.Campaign(ARM.nominal, candidates=ARM.sample(20), target=ARM.sample(10, seed=1))
    q, y = ARM.measure(16, seed=2)
    y[14] += 0.02
    found.add(q, y)
    return found


def test_the_state_is_short_and_finite(campaign: dc.Campaign) -> None:
    found = state_of(campaign, ("0.5 mm expected", "next: 1, 2"), campaign.next(1))
    state = json.loads(json.dumps(found, allow_nan=False))
    assert state["state"] == "15 of 16 rows accepted; 0.5 mm expected"
    assert [one["line"] for one in state["verdicts"]] == list(range(15, 7, -1))
    assert len(state["done"]) == 16
    assert len(state["links"]) == 7


@pytest.mark.slow
@pytest.mark.parametrize(("width", "scheme"), [(1400, "light"), (390, "dark")])
def test_the_page_in_a_browser(page: Page, campaign: dc.Campaign, browser: Any, width: int, scheme: Any) -> None:
    state = state_of(campaign, ("0.5 mm expected", "next: 1, 2"), campaign.next(1))
    seen = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    said: list[str] = []
    seen.on("pageerror", lambda error: said.append(str(error)))
    seen.on("request", lambda asked: said.append(asked.url))
    seen.goto(page.url)
    page.publish(state)
    seen.wait_for_selector("li")
    assert seen.text_content("#error") == f"{state['error']:.2g} mm"
    assert seen.locator("li .bad").count() == 1
    drawn = "() => [...document.querySelectorAll('canvas')].map((c) => c.toDataURL())"
    before = seen.evaluate(drawn)
    seen.focus("#robot")
    seen.keyboard.press("ArrowLeft")
    after = seen.evaluate(drawn)
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, False]
    assert seen.evaluate("document.documentElement.scrollWidth <= innerWidth")
    with seen.expect_response("**/reject?**"):
        seen.get_by_label("reject row 15", exact=True).focus()
        seen.keyboard.press("Enter")
    with seen.expect_response("**/accept?**"):
        seen.get_by_label("accept row 14", exact=True).focus()
        seen.keyboard.press("Enter")
    assert decided(page) == [("reject", 15), ("accept", 14)]
    for row in (9, 15):
        with seen.expect_response("**/repeat?**"):
            seen.get_by_label(f"repeat row {row}", exact=True).click()
    assert decided(page) == [("repeat", 9), ("repeat", 15)]
    seen.reload()
    seen.wait_for_selector("li")
    page.publish(state | {"error": 0.123})
    seen.wait_for_function("() => document.title === '0.12 mm'")
    seen.close()
    assert {urlsplit(url).netloc for url in said} == {urlsplit(page.url).netloc}
