"""The page in a real browser: Chromium without a window and without a network."""

import os
import re
import shutil

import pytest
from shown_designs import circuit_page

playwright = pytest.importorskip("playwright.sync_api", reason="the browser tests need `pip install playwright`")

CHROMIUM = os.environ.get("CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on this machine (apt-get install chromium)"),
]

FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking"]


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "rlc.html"
    path.write_text(circuit_page(), encoding="utf-8")
    return path.as_uri()


@pytest.fixture
def visit(browser, address):
    """Open the page; what it said and asked for is in `noise`."""
    opened = []

    def go(**options):
        tab = browser.new_page(**options)
        opened.append(tab)
        tab.noise = []
        tab.on("console", lambda message: tab.noise.append(message.text))
        tab.on("pageerror", lambda error: tab.noise.append(str(error)))
        tab.on("request", lambda request: request.url == address or tab.noise.append(request.url))
        tab.goto(address)
        tab.wait_for_function("window.charts && window.charts.length > 2")
        return tab

    yield go
    for tab in opened:
        tab.close()


def test_it_loads_without_errors_and_without_requests(visit):
    tab = visit(viewport={"width": 1280, "height": 900})
    tab.wait_for_timeout(200)
    # A font or icon inside the page is a request of the browser to itself.
    assert [line for line in tab.noise if not line.startswith("data:")] == []


def test_formulas_are_rendered(visit):
    tab = visit()
    sizes = tab.evaluate(
        "[...document.querySelectorAll('math')].map(m => m.getBoundingClientRect()).map(r => [r.width, r.height])"
    )
    assert len(sizes) > 30
    assert all(width > 2 and height > 5 for width, height in sizes)
    assert tab.evaluate("document.querySelectorAll('merror').length") == 0
    # A fraction is set above its bar, so it is taller than a line of text.
    assert (
        tab.evaluate("Math.max(...[...document.querySelectorAll('mfrac')].map(m => m.getBoundingClientRect().height))")
        > 25
    )
    assert tab.evaluate("document.fonts.check('16px \"pbcgen math\"')")


def test_a_curve_can_be_hidden_and_shown_again(visit):
    tab = visit()
    button = tab.locator("#plot-1 .legend button").nth(1)
    before = tab.evaluate("charts[0].ctx.canvas.toDataURL()")
    button.click()
    assert button.get_attribute("aria-pressed") == "false"
    assert tab.evaluate("charts[0].series[2].show") is False
    tab.wait_for_timeout(100)
    assert tab.evaluate("charts[0].ctx.canvas.toDataURL()") != before
    button.press("Enter")
    assert button.get_attribute("aria-pressed") == "true"


def test_the_keyboard_reads_values_and_magnifies(visit):
    tab = visit()
    tab.locator("#plot-1 .canvas").focus()
    for _ in range(3):
        tab.keyboard.press("ArrowRight")
    tab.wait_for_timeout(100)
    assert re.match(r"t = .* s: ", tab.locator("#plot-1 .readout").text_content())
    whole = tab.evaluate("charts[0].scales.x.max - charts[0].scales.x.min")
    tab.keyboard.press("+")
    tab.wait_for_timeout(100)
    assert tab.evaluate("charts[0].scales.x.max - charts[0].scales.x.min") < 0.6 * whole
    assert tab.evaluate("charts[1].scales.x.max - charts[1].scales.x.min") < 0.6 * whole, "panels share their window"
    tab.keyboard.press("0")
    tab.wait_for_timeout(100)
    assert tab.evaluate("charts[0].scales.x.max - charts[0].scales.x.min") == pytest.approx(whole)


CONTRAST = """() => {
  const parse = (c) => c.match(/[0-9.]+/g).map(Number);
  const linear = (v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * linear(r / 255) + 0.7152 * linear(g / 255) + 0.0722 * linear(b / 255);
  const paper = (e) => {
    for (; e; e = e.parentElement) {
      const c = parse(getComputedStyle(e).backgroundColor);
      if (c.length < 4 || c[3] > 0) { return c; }
    }
    return [255, 255, 255];
  };
  const says = (e) => [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim())
    && !["SCRIPT", "STYLE", "NOSCRIPT"].includes(e.tagName) && !e.closest("svg, noscript");
  const ratio = (e) => {
    const [a, b] = [light(parse(getComputedStyle(e).color)), light(paper(e))].sort((p, q) => q - p);
    return (a + 0.05) / (b + 0.05);
  };
  return [...document.querySelectorAll("body *")].filter(says).filter((e) => ratio(e) < 4.5)
    .map((e) => `${e.tagName}.${e.className}: ${ratio(e).toFixed(2)}`);
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_enough_contrast(visit, scheme):
    tab = visit(color_scheme=scheme)
    assert tab.evaluate(CONTRAST) == []
    dark = tab.evaluate("getComputedStyle(document.body).backgroundColor") != "rgb(255, 255, 255)"
    assert dark == (scheme == "dark")


def test_the_colours_can_be_switched(visit):
    tab = visit(color_scheme="light")
    tab.locator("#theme").click()
    assert tab.evaluate("getComputedStyle(document.body).backgroundColor") != "rgb(255, 255, 255)"
    assert tab.evaluate(CONTRAST) == []


@pytest.mark.parametrize("width", [360, 768, 1280])
def test_nothing_is_wider_than_the_screen(visit, width):
    tab = visit(viewport={"width": width, "height": 800})
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    rows = "[...document.querySelectorAll('.stacked tr')].map(r => r.getBoundingClientRect().height)"
    assert max(tab.evaluate(rows)) < 200, "a column so narrow that its words stand letter below letter"


def test_the_print_layout_is_a4_and_breaks_no_table(visit):
    tab = visit(viewport={"width": 688, "height": 1000}, color_scheme="dark")  # A4 without its margins, in CSS pixels
    tab.emulate_media(media="print", color_scheme="dark")
    tab.wait_for_timeout(200)
    assert tab.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    shown = "[...document.querySelectorAll('table, .canvas, .formula math')]"
    wide = f"{shown}.filter(e => e.getBoundingClientRect().right > 690).length"
    assert tab.evaluate(wide) == 0
    rows = "[...document.querySelectorAll('tr')].every(e => getComputedStyle(e).breakInside === 'avoid')"
    assert tab.evaluate(rows)
    assert tab.evaluate(
        "[...document.querySelectorAll('thead')].every(e => getComputedStyle(e).display === 'table-header-group')"
    )
    printed = tab.pdf(prefer_css_page_size=True, print_background=True)
    boxes = {tuple(map(float, box.split())) for box in re.findall(rb"/MediaBox \[([^\]]*)\]", printed)}
    assert boxes
    assert all(abs(b[2] - 595) < 2 and abs(b[3] - 842) < 2 for b in boxes)
