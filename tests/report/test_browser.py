"""The page in a real Chromium: what is clicked and typed does what it says, and nothing is asked of a network."""

import re
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from izoo.report.__main__ import main
from tests.report.made_tables import SEVERAL, folder, table

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next((path for name in BROWSERS if (path := shutil.which(name))), None)
WIDE, PHONE, PAPER = (1280, 900), (420, 844), (718, 1000)
"""Width and height in pixels; A4 has the width of the last one between its margins."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason=f"no Chromium on PATH ({', '.join(BROWSERS)})"),
]


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A headless Chromium, driven by Playwright."""
    playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield browser
        browser.close()


def eventually(page: Any, condition: Callable[[], bool], patience_s: float = 60.0) -> None:
    """Wait for a condition; the page's own rules forbid to have it evaluated there."""
    end = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        page.wait_for_timeout(50)


class Visit:
    """An open page, with what it asked for and what it complained about."""

    def __init__(self, chromium: Any, path: Path, size: tuple[int, int], scheme: str = "light") -> None:
        self.page = chromium.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)
        self.page.set_default_timeout(90_000)
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())

    def close(self, path: Path) -> None:
        """Close the page; it must have been content, and have asked for nothing but itself."""
        self.page.close()
        assert self.complaints == []
        assert self.requests == [path.as_uri()]


def column(page: Any, number: int) -> list[str]:
    return [row.locator("th, td").nth(number).inner_text() for row in page.locator("#rows tbody tr").all()]


def pixels(page: Any, canvas: str) -> str:
    """The picture on a canvas."""
    return page.evaluate("id => document.getElementById(id).toDataURL()", canvas)


def test_table_sorts_and_filters(chromium, page: Path) -> None:
    visit = Visit(chromium, page, WIDE)
    sheet = visit.page
    sheet.wait_for_selector("#rows tbody tr")
    assert sheet.locator("#filter-count").inner_text() == "4 of 4 rows"
    head = sheet.get_by_role("button", name="CO2 per vehicle (g)", exact=True)
    head.click()
    heads = [text.strip() for text in sheet.locator("#rows th[scope=col]").all_inner_texts()]
    place = heads.index("CO2 per vehicle (g)")
    values = [float(text) for text in column(sheet, place)]
    assert values == sorted(values) and values[0] > 0.0
    assert sheet.locator("#rows th[aria-sort=ascending]").inner_text() == "CO2 per vehicle (g)"
    head.press("Enter")
    assert [float(text) for text in column(sheet, place)] == values[::-1]
    sheet.get_by_label("Filter").fill(f"no_column>9999 co2_g<{values[-1] + 1}")
    assert sheet.locator("#filter-count").inner_text() == "0 of 4 rows"  # "no_column>9999" names none: a word
    bound = 0.5 * (values[1] + values[2])
    sheet.get_by_label("Filter").fill(f"co2_g<{bound}")
    assert [float(text) for text in column(sheet, place)] == [value for value in values[::-1] if value < bound]
    sheet.get_by_label("Filter").fill("q600")
    assert len(column(sheet, 0)) == 2
    sheet.get_by_label("Filter").fill("")
    sheet.locator("#filter-policy").select_option("uncommanded")
    assert column(sheet, 1) == ["uncommanded"] * 2
    visit.close(page)


def test_replay_plays_and_scrubs(chromium, page: Path) -> None:
    visit = Visit(chromium, page, WIDE)
    sheet = visit.page
    sheet.wait_for_selector("#replay-app[data-scene='0']")
    assert sheet.locator("h2").first.inner_text() == "Replay: the best and the worst context"
    before = pixels(sheet, "policy-map"), pixels(sheet, "baseline-timespace")
    scrub = sheet.get_by_label("Time of the episode")
    scrub.fill("150")
    assert sheet.locator("#clock").inner_text() == "75 s"
    assert pixels(sheet, "policy-map") != before[0]
    assert pixels(sheet, "baseline-timespace") != before[1]
    scrub.press("ArrowRight")
    assert scrub.input_value() == "151"
    sheet.get_by_role("button", name="Play").click()
    eventually(sheet, lambda: int(scrub.input_value()) > 155)
    sheet.get_by_role("button", name="Pause").click()
    stopped = scrub.input_value()
    sheet.wait_for_timeout(200)
    assert scrub.input_value() == stopped
    sheet.locator("#rate").select_option("30")
    sheet.get_by_role("button", name="Play").click()
    eventually(sheet, lambda: sheet.locator("#play").inner_text() == "Play")  # it stops at the end
    assert scrub.input_value() == scrub.get_attribute("max")
    picture = pixels(sheet, "policy-map")
    sheet.locator("#paint").select_option("kind")
    painted = pixels(sheet, "policy-map")
    sheet.get_by_role("button", name="Zoom in").click()
    assert len({picture, painted, pixels(sheet, "policy-map")}) == 3
    diagram = sheet.locator("#policy-timespace")
    diagram.click(position={"x": 200, "y": 60})
    assert 0 < int(scrub.input_value()) < int(scrub.get_attribute("max"))
    sheet.locator("#scenes button").nth(1).click()
    sheet.wait_for_selector("#replay-app[data-scene='1']")
    assert "CO2 over uncommanded" in sheet.locator("#scene-text").inner_text()
    visit.close(page)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with every kind of chart, of made results."""
    path = tmp_path_factory.mktemp("drawn") / "results"
    made = folder(path, table(SEVERAL).assign(task="salt_lake_city_paper"), "salt_lake_city_paper")
    run = made / "train" / "ppo" / "seed0"
    run.mkdir(parents=True)
    (run / "metrics.csv").write_text("frames,return\n1000,-3\n2000,-2\n")
    (run / "validation.csv").write_text("frames,co2_saved,co2_saved_low,co2_saved_high\n1000,1,0.5,2\n")
    assert main([str(made), "replay=false"]) == 0
    return made / "report.html"


def without_marks(page: Any) -> list[str]:
    """Names of charts that have no mark, or none with a size."""
    empty = """() => [...document.querySelectorAll('.plot')].filter(plot => {
        const boxes = [...plot.querySelectorAll('svg use, svg path, svg circle')].map(e => e.getBoundingClientRect());
        return boxes.filter(box => box.width + box.height > 0).length < 3;
    }).map(plot => plot.getAttribute('aria-label'))"""
    return page.evaluate(empty)


def lightness(page: Any, selector: str, style: str) -> int:
    """Sum of red, green and blue of a colour."""
    script = "([selector, style]) => getComputedStyle(document.querySelector(selector))[style]"
    return sum(int(part) for part in re.findall(r"\d+", page.evaluate(script, [selector, style]))[:3])


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [WIDE, PHONE])
def test_figures_are_drawn_and_nothing_overflows(chromium, drawn: Path, size, scheme) -> None:
    visit = Visit(chromium, drawn, size, scheme)
    sheet = visit.page
    sheet.wait_for_selector("#rows tbody tr")
    assert sheet.evaluate("document.documentElement.scrollWidth") <= size[0]
    assert sheet.locator(".plot svg").count() >= 10
    assert without_marks(sheet) == []
    for link in sheet.locator("nav a").all():
        box = link.bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= size[0] and box["height"] > 0
    if size == WIDE:
        tables = "[...document.querySelectorAll('.wide')].filter(e => e.scrollWidth > e.clientWidth)"
        assert sheet.evaluate(f"{tables}.map(e => e.getAttribute('aria-label'))") in ([], ["Movements"])
        assert [head.is_visible() for head in sheet.locator("#rows th[scope=col]").all()].count(True) == 6
        sheet.get_by_role("checkbox", name="every figure").check()
        assert [head.is_visible() for head in sheet.locator("#rows th[scope=col]").all()].count(True) > 15
    unnamed = "[...document.querySelectorAll('canvas, .plot')].filter(e => !e.getAttribute('aria-label')).length"
    assert sheet.evaluate(unnamed) == 0
    contrast = abs(lightness(sheet, ".plot text", "fill") - lightness(sheet, ".chart", "backgroundColor"))
    assert contrast > 380
    ground = lightness(sheet, "body", "backgroundColor")
    sheet.get_by_label("Switch between light and dark").click()
    assert lightness(sheet, "body", "backgroundColor") != ground
    visit.close(drawn)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_paper_is_light_and_whole(chromium, drawn: Path, scheme: str) -> None:
    visit = Visit(chromium, drawn, PAPER, scheme)
    sheet = visit.page
    sheet.wait_for_selector("#rows tbody tr")
    folded, ground = sheet.locator("details:not([open])").count(), lightness(sheet, "body", "backgroundColor")
    sheet.emulate_media(media="print")
    sheet.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert lightness(sheet, "body", "backgroundColor") == 3 * 255
    assert lightness(sheet, ".plot text", "fill") < 200
    assert folded > 0 and sheet.locator("details:not([open])").count() == 0
    assert without_marks(sheet) == []
    assert sheet.evaluate("document.documentElement.scrollWidth") <= PAPER[0]
    assert not sheet.locator("nav").is_visible() and not sheet.get_by_label("Filter").is_visible()
    sheet.evaluate("dispatchEvent(new Event('afterprint'))")
    assert sheet.locator("details:not([open])").count() == folded
    assert lightness(sheet, "body", "backgroundColor") == ground
    assert sheet.pdf(format="A4").count(b"/Type /Page\n") + 1 > 3
    visit.close(drawn)
