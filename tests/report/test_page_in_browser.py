"""The page as Chromium shows it: a report of six kinds of runs, opened from its file and without a network."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator

import pytest

from s2a_bench.experiments.boundary.config import BoundaryConfig
from s2a_bench.experiments.boundary.run import run_boundary
from s2a_bench.experiments.ccrb.config import CcrbComputed
from s2a_bench.experiments.ccrb.run import run_ccrb
from s2a_bench.experiments.timeline.config import TimelineComputed
from s2a_bench.experiments.timeline.run import run_timeline
from s2a_bench.plugins.chunks.chunks.config import ChunksVirtual
from s2a_bench.plugins.chunks.chunks.run import run_virtual
from s2a_bench.report.page import ReportConfig
from s2a_bench.report.page.chapters import read_chapters
from s2a_bench.report.page.files import make_report, write_report
from s2a_bench.testing import NullProgress
from tests.made_runs import PLAUSIBLE, made_run, spoken_run

pytest.importorskip("selenium", reason="selenium is not installed")
from selenium.webdriver import ActionChains, Chrome, ChromeOptions, Keys
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.actions.wheel_input import ScrollOrigin
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.wait import WebDriverWait

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (CHROMIUM and DRIVER), reason="no chromium, chromedriver: apt-get install chromium chromium-driver"
    ),
]
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
WIDTHS = (400, 1400)
EIGHT = PLAUSIBLE | dict.fromkeys(("iceoryx2", "zmq/gr00t", "websocket/openpi"), PLAUSIBLE["http/binary"])
LONG_POLICY = "stream-to-act?caution=1.5&detect=True"
WAIT_S = 10
STANDS_STILL = """
const done = arguments[0]; let last;
(function look() { if (scrollY === last) done(); else { last = scrollY; setTimeout(look, 100); } })()
"""
"""A wheel scrolls for some frames, and a click goes to where its target was."""
CUT = """
return [...document.querySelectorAll(arguments[0])]
  .filter((part) => part.scrollWidth > part.clientWidth || part.scrollHeight > part.clientHeight)
  .map((part) => part.textContent);
"""
REFERENCES = """
return [...document.querySelectorAll('[href], [src]')].map((part) => part.getAttribute('href') ?? part.src);
"""
WIDTHS_OF_IMAGES = """
return Promise.all([...document.querySelectorAll('img, image')].map(async (image) => {
  const copy = new Image();
  copy.src = image.getAttribute('href') ?? image.src;
  await copy.decode();
  return copy.naturalWidth;
}));
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Write a report of a run of each kind, most of them computed, and return its address."""
    folder = tmp_path_factory.mktemp("page")
    done = NullProgress()
    timeline = TimelineComputed(profiles=("jetson-agx-orin",), tokens_per_skill=(6, 4), policies=("naive", LONG_POLICY))
    chunks = ChunksVirtual(modes="sync,replace?execute=8", latency="60,100", cycles=100, shown_ticks=60)
    warning = {"code": "load", "message": "busy-" * 60, "advice": "wait"}
    paths = [
        made_run(folder, EIGHT, manifest={"warnings": [warning], "environment": {"cpu": "c" * 300}}).path,
        spoken_run(folder, 34.2, host="h" * 60).path,
        run_timeline(timeline, folder, done),
        run_virtual(chunks, folder, done),
        run_boundary(BoundaryConfig(), folder, done),
        run_ccrb(CcrbComputed(), folder, done),
    ]
    output = folder / "page.html"
    report = make_report(read_chapters(paths, against="paper"), against="paper")
    write_report(report, ReportConfig(runs=paths, output=output))
    return output.as_uri()


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chrome]:
    options = ChromeOptions()
    options.binary_location = str(CHROMIUM)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(flag)
    with Chrome(options, Service(str(DRIVER))) as browser:
        browser.execute_cdp_cmd("Network.enable", {})
        offline = {"offline": True, "latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        browser.execute_cdp_cmd("Network.emulateNetworkConditions", offline)
        yield browser


@pytest.fixture
def opened(chromium: Chrome, page: str) -> Iterator[Callable[..., Chrome]]:
    """Open the page at a width and in a colour scheme; afterwards nothing is fetched, and the console is empty."""

    def shown(width: int = 1400, scheme: str = "light", *, unfold: bool = False) -> Chrome:
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        chromium.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        chromium.get("about:blank")
        chromium.get(page)
        if unfold:
            chromium.execute_script("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
        return chromium

    yield shown
    assert chromium.execute_script("return performance.getEntriesByType('resource').map((each) => each.name)") == []
    assert chromium.get_log("browser") == []


def found(browser: Chrome | WebElement, selector: str) -> list[WebElement]:
    return browser.find_elements(By.CSS_SELECTOR, selector)


def tip_of(browser: Chrome) -> str:
    return found(browser, "#tip")[0].text


def span_of(view: WebElement) -> tuple[float, float]:
    """Return from when and for how long a view shows its lanes, in s."""
    start, _, width, _ = str(found(view, "svg")[0].get_dom_attribute("viewBox")).split()
    return float(start), float(width)


def test_every_figure_is_drawn_and_every_reference_is_the_pages_own(opened: Callable[..., Chrome]) -> None:
    browser = opened(unfold=True)
    chapters = found(browser, "section[id^=run-]")
    assert len(chapters) == 6
    assert all(found(chapter, ".plot") for chapter in chapters)
    for plot in found(browser, ".plot"):
        (svg,) = (each for each in found(plot, "svg") if each.is_displayed())
        assert min(svg.size.values()) > 100
    assert all(width > 0 for width in browser.execute_script(WIDTHS_OF_IMAGES))
    ids = browser.execute_script("return [...document.querySelectorAll('[id]')].map((part) => part.id)")
    assert len(ids) == len(set(ids))
    references = browser.execute_script(REFERENCES)
    assert references
    assert all(each.startswith("data:image/png;base64,") or each.removeprefix("#") in ids for each in references)


def test_pointing_at_a_bar_says_what_it_is(opened: Callable[..., Chrome]) -> None:
    browser = opened()
    naive, _ = found(browser, ".panel")[0].find_elements(By.CSS_SELECTOR, ".lane:not(.tokens)")
    pointer = ActionChains(browser, duration=0)
    pointer.move_to_element(found(naive, ".stall")[0]).perform()
    assert tip_of(browser) == "naive: stall of 0.25 s before skill 2, 2.75 to 3.00 s"
    pointer.move_to_element(found(naive, ".skill")[7]).perform()
    assert tip_of(browser).startswith("naive: skill 8 arrives at 10.50 s, runs 10.50 to 11.50 s")
    pointer.move_to_element(found(browser, "h1")[0]).perform()
    assert not found(browser, "#tip")[0].is_displayed()


def test_lanes_are_zoomed_and_moved_by_buttons_wheel_and_pointer(opened: Callable[..., Chrome]) -> None:
    browser = opened()
    panel = found(browser, ".panel")[0]
    view, (closer, farther, whole) = found(panel, ".view")[0], found(panel, "button")
    _, end = span_of(view)
    for button, span in ((closer, end / 2), (closer, end / 4), (farther, end / 2), (whole, end), (farther, end)):
        button.click()
        assert span_of(view)[1] == pytest.approx(span)
    wait, scrolled = WebDriverWait(browser, WAIT_S, poll_frequency=0.02), "return scrollY"
    middle = ScrollOrigin.from_element(found(view, "svg")[0])
    pointer = ActionChains(browser, duration=0)
    here = browser.execute_script(scrolled)
    pointer.scroll_from_origin(middle, 0, -100).perform()  # a wheel that only passes scrolls the page
    wait.until(lambda _: browser.execute_script(scrolled) != here)
    browser.execute_async_script(STANDS_STILL)
    assert span_of(view) == (0, end)
    pointer.move_to_element(view).click().perform()
    pointer.scroll_from_origin(middle, 0, -100).perform()
    wait.until(lambda _: span_of(view) != (0, end))
    start, span = span_of(view)
    assert (start, span) == (pytest.approx(0.1 * end, rel=0.02), pytest.approx(0.8 * end))
    share = 100 / found(view, "svg")[0].size["width"]
    pointer.move_to_element(view).click_and_hold().move_by_offset(-20, 0).release().perform()
    assert span_of(view) == (pytest.approx(start + share * span / 5, rel=0.01), pytest.approx(span))
    assert [mark.text for mark in found(view, ".axis span")] == ["2", "4", "6", "8", "10"]


def test_keys_go_from_bar_to_bar(opened: Callable[..., Chrome]) -> None:
    browser = opened()
    view = found(browser, ".view")[0]
    _, end = span_of(view)
    for keys, start in (
        (Keys.ARROW_RIGHT, "naive: skill 1 "),
        (Keys.ARROW_RIGHT, "naive: stall of 0.25 s before skill 2"),
        (Keys.ARROW_DOWN, f"{LONG_POLICY}: skill 1 "),
        (Keys.ARROW_UP, "naive: skill 2 "),
    ):
        view.send_keys(keys)
        assert tip_of(browser).startswith(start)
    view.send_keys(Keys.ESCAPE)
    assert not found(browser, "#tip")[0].is_displayed()
    view.send_keys("++", Keys.SHIFT, Keys.ARROW_RIGHT)
    assert span_of(view) == (pytest.approx((0.375 + 0.25 / 4) * end), pytest.approx(end / 4))


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_wider_than_the_window(opened: Callable[..., Chrome], width: int) -> None:
    browser = opened(width, unfold=True)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    assert browser.execute_script(CUT, ".names span, .lanes, pre, .claim, .facts dd") == []
    if width == WIDTHS[-1]:
        assert browser.execute_script(CUT, ".scroll, .plot, .plot > div") == []  # a table of eight cells, too
