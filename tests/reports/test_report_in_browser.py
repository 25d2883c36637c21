"""The report in a real browser: nothing fails, nothing is loaded, everything is drawn, readable and reachable."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from product_bank import Case

import diffeo_calib as dc

pytestmark = pytest.mark.slow

CONTRAST = """() => {
  const luminance = (rgb) => {
    const [r, g, b] = rgb.map((v) => v / 255).map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const numbers = (text) => (text.match(/[\\d.]+/g) || []).map(Number);
  const behind = (node) => {
    for (; node; node = node.parentElement) {
      const found = numbers(getComputedStyle(node).backgroundColor);
      if (found.length === 3 || found[3] > 0) return found.slice(0, 3);
    }
    return [255, 255, 255];
  };
  const bad = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const parent = walker.currentNode.parentElement;
    if (!walker.currentNode.textContent.trim() || ["script", "style"].includes(parent.localName)) continue;
    const style = getComputedStyle(parent);
    const drawn = parent.namespaceURI.endsWith("svg") ? style.fill : style.color;
    const pair = [numbers(drawn).slice(0, 3), behind(parent)].map(luminance).sort((a, b) => b - a);
    const ratio = (pair[0] + 0.05) / (pair[1] + 0.05);
    if (ratio < 4.5) bad.push([walker.currentNode.textContent.trim().slice(0, 40), ratio]);
  }
  return bad;
}"""
DRAWN = """() => [...document.querySelectorAll("canvas")].map((canvas) => {
  const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  let count = 0;
  for (let k = 3; k < pixels.length; k += 4) count += pixels[k] > 0;
  return count;
})"""
TOO_WIDE = """() => [...document.querySelectorAll("main *")]
  .filter((node) => !node.closest(".scroll, pre, svg") && node.getBoundingClientRect().right > innerWidth + 1)
  .map((node) => node.className || node.tagName)"""
SVG_TEXT = """() => [...document.querySelectorAll("figure svg")].map((svg) => {
  const scale = svg.getBoundingClientRect().width / svg.viewBox.baseVal.width;
  const sizes = [...svg.querySelectorAll("text")].map((text) => parseFloat(getComputedStyle(text).fontSize));
  return scale * Math.min(...sizes);
})"""


@pytest.fixture(scope="module")
def report(arm: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    dc.write_report(arm.model, path, arm.test)
    return path


@pytest.fixture
def opened(browser: Any, report: Path, request: pytest.FixtureRequest) -> Iterator[Any]:
    """The page at the width and in the scheme that the test asks for; what it says and loads is checked at the end."""
    width, scheme = getattr(request, "param", (1400, "light"))
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    page = context.new_page()
    said: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda asked: said.append(asked.url))
    page.goto(report.as_uri())
    page.wait_for_timeout(200)
    yield page
    context.close()
    assert said == [report.as_uri()]


@pytest.mark.parametrize("opened", [(1400, "light"), (390, "dark")], indirect=True, ids=str)
def test_everything_is_drawn_and_readable(opened: Any) -> None:
    assert min(opened.evaluate(DRAWN)) > 2000
    assert opened.evaluate(TOO_WIDE) == []
    assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert opened.evaluate(CONTRAST) == []
    assert min(opened.evaluate(SVG_TEXT)) > 8.0


def test_the_scene_turns_every_control_is_reached_by_the_keyboard_and_it_prints(opened: Any, tmp_path: Path) -> None:
    def pixels() -> str:
        return opened.evaluate("document.querySelector('canvas').toDataURL()")

    first = pixels()
    opened.focus("canvas")
    opened.keyboard.press("ArrowLeft")
    turned = pixels()
    assert turned != first
    opened.keyboard.press("ArrowRight")
    assert pixels() == first
    opened.keyboard.press("+")
    assert pixels() != first
    assert opened.text_content(".scale").startswith("geometric")
    opened.focus("button[data-stage=calibrated]")
    opened.keyboard.press("Enter")
    assert opened.text_content(".scale").startswith("calibrated")
    assert opened.get_attribute("button[data-stage=calibrated]", "aria-pressed") == "true"
    before = pixels()
    canvas = opened.locator("canvas")
    canvas.drag_to(canvas, source_position={"x": 100, "y": 100}, target_position={"x": 180, "y": 120})
    opened.wait_for_function("before => document.querySelector('canvas').toDataURL() !== before", arg=before)
    opened.evaluate("document.activeElement.blur()")
    wanted = opened.evaluate("document.querySelectorAll('a[href], button, canvas, [tabindex=\"0\"]').length")
    reached = set()
    for _ in range(wanted + 2):
        opened.keyboard.press("Tab")
        controls = "[...document.querySelectorAll('a, button, [tabindex]')]"
        reached.add(opened.evaluate(f"{controls}.indexOf(document.activeElement)"))
    assert len(reached - {-1}) == wanted
    opened.pdf(path=tmp_path / "report.pdf", format="A4")
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")
    opened.emulate_media(media="print")
    assert not opened.is_visible("nav")
    assert min(opened.evaluate(DRAWN)) > 2000
