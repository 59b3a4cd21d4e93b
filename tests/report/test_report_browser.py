"""The page in a browser: no error, no request, clicks show the frame, nothing runs over the screen's edge."""

import shutil

import numpy as np
import pytest

from lanebev.app.config import RunConfig
from lanebev.app.fleet.manifest import Drive
from lanebev.app.fleet.mounts import DriveMount, stretches
from lanebev.app.fleet.page import CameraMounts, fleet_page
from lanebev.app.fleet.plan import Outcome
from lanebev.report.comparison import render_comparison
from lanebev.report.page import write_report
from lanebev.report.run_folder import RunFolder
from lanebev.report.verdict import Verdict
from tests.report.report_data import FRAMES, eventful_report

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason=f"no browser on this machine: none of {', '.join(BROWSERS)}"),
]
SCREENS = {
    "desktop": {"viewport": {"width": 1280, "height": 900}},
    "phone": {"viewport": {"width": 390, "height": 844}, "is_mobile": True, "has_touch": True},
}
HOSTILE = "</script><script>alert(1)</script>\"'<img src=x onerror=alert(2)>.mp4"


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield browser
        browser.close()


def _wait(page, condition, seconds=20):
    """Wait until a JavaScript condition holds; Playwright's own way is eval, which the page forbids."""
    for _ in range(20 * seconds):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(50)
    raise AssertionError(f"not within {seconds} s: {condition}")


def _open(browser, path, screen="desktop", address="", plots=3):
    """A page that is drawn, and the list that its errors, requests and dialogs go to."""
    page, seen = browser.new_context(**SCREENS[screen]).new_page(), []
    page.on("console", lambda message: message.type in ("error", "warning") and seen.append(message.text))
    page.on("pageerror", lambda error: seen.append(str(error)))
    page.on("request", lambda request: request.url.startswith(("file:", "data:")) or seen.append(request.url))
    page.on("dialog", lambda dialog: (seen.append(f"dialog {dialog.message}"), dialog.dismiss()))
    page.goto(f"file://{path}{address}")
    _wait(page, f"Bokeh.documents.length === {plots} && Bokeh.documents.every(each => each.is_idle)")
    return page, seen


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("browser") / "report.html"
    write_report(path, eventful_report())
    return path


@pytest.mark.parametrize("screen", list(SCREENS))
def test_the_page_is_drawn_without_errors_and_requests(browser, path, screen):
    page, seen = _open(browser, path, screen)
    assert page.locator("#verdict h2").inner_text().startswith("Calibrated for 79 % of the drive")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert page.locator("#picture-image").evaluate("img => img.complete && img.naturalWidth > 0")
    assert seen == []


def _shown(page):
    return page.locator("#moment-title").inner_text(), page.locator("#picture-image").get_attribute("src")


@pytest.mark.parametrize("screen", list(SCREENS))
def test_a_click_on_the_timeline_shows_that_frame(browser, path, screen):
    page, seen = _open(browser, path, screen)
    before = _shown(page)
    cover = page.locator("#cover")
    box = cover.bounding_box()
    cover.click(position={"x": box["width"] * 40.5 / FRAMES, "y": 5})
    after = _shown(page)
    assert after[0].startswith("frame 40, 2.0") or after[0].startswith("frame 41, 2.0")
    assert after[1] != before[1]
    assert page.locator("#moment-status").inner_text() == "TRACKING"
    assert page.locator("#moment-reasons").inner_text() == "one lane only"
    assert page.locator("#state-roll").inner_text() == "not determined"
    assert page.locator("#state-pitch").inner_text() == "measured"
    cover.click(position={"x": box["width"] * 150.5 / FRAMES, "y": 5})
    assert page.locator("#moment-status").inner_text() == "LOST"
    assert seen == []


def test_links_keys_and_slider_move_along_the_drive(browser, path):
    page, seen = _open(browser, path)
    page.locator("#verdict a", has_text="pose lost from").click()
    assert _shown(page)[0] == "frame 140, 7.00 s"
    first = _shown(page)
    page.keyboard.press("ArrowRight")
    assert _shown(page)[0] == "frame 160, 8.00 s"
    page.keyboard.press("ArrowLeft")
    assert _shown(page) == first
    page.locator("#on").click()
    assert _shown(page)[0] == "frame 160, 8.00 s"
    page.locator("#slider").fill("17")
    assert _shown(page)[0] == "frame 17, 0.85 s"
    assert "3 frames later" in page.locator("#caption").inner_text()
    page.locator("#worst a", has_text="largest jump: pitch").click()
    assert _shown(page)[0] == "frame 200, 10.00 s"
    assert seen == []


def test_a_link_to_a_frame_can_be_passed_on(browser, path):
    page, _ = _open(browser, path, address="#frame-140")
    assert _shown(page)[0] == "frame 140, 7.00 s"


def test_a_click_on_a_plot_shows_that_frame_and_a_drag_zooms(browser, path):
    page, seen = _open(browser, path)
    plot = page.locator("#plot-estimates")
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    before = _shown(page)
    page.mouse.click(box["x"] + 0.9 * box["width"], box["y"] + 60)
    _wait(page, f"document.getElementById('moment-title').textContent !== '{before[0]}'")
    assert int(_shown(page)[0].split()[1].rstrip(",")) > 0.8 * FRAMES
    width = "Bokeh.documents[0].roots()[0].select({type: 'Figure'})[0].x_range"
    span = page.evaluate(f"{width}.end - {width}.start")
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 90, steps=5)
    page.mouse.up()
    _wait(page, f"{width}.end - {width}.start < {0.5 * span}")
    assert seen == []


def test_hostile_names_run_nothing(browser, tmp_path):
    rows = [row._replace(image=HOSTILE) for row in eventful_report().rows]
    report = eventful_report(
        HOSTILE, rows=rows, facts={HOSTILE: HOSTILE}, problems=[HOSTILE], before_title=HOSTILE
    )
    write_report(tmp_path / "report.html", report)
    page, seen = _open(browser, tmp_path / "report.html")
    page.locator("#on").click()
    assert page.locator("#moment-title").inner_text() == HOSTILE
    assert seen == []


@pytest.mark.parametrize("screen", list(SCREENS))
def test_two_runs_side_by_side_are_drawn(browser, tmp_path, screen):
    report = eventful_report()
    first = RunFolder("a", report.rows)
    second = RunFolder("b", [row._replace(yaw_deg=row.yaw_deg + 0.1) for row in report.rows])
    (tmp_path / "compare.html").write_text(render_comparison(first, second), encoding="utf-8")
    page, seen = _open(browser, tmp_path / "compare.html", screen, plots=2)
    assert page.locator(".plot canvas").count() >= 2
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert seen == []


@pytest.mark.parametrize("screen", list(SCREENS))
def test_a_fleet_is_drawn(browser, tmp_path, screen):
    times = [f"2026-03-{day:02d}" for day in range(1, 9)]
    mounts = [
        DriveMount(
            f"{HOSTILE} {day}",
            time,
            np.array([0.02, -0.01, 0.001 * day + (0.05 if day > 4 else 0.0), 1.4]),
            np.array([0.002, 0.002, 0.003, 0.02]),
            np.array([False, False, day == 5, False]),
        )
        for day, time in enumerate(times)
    ]
    cameras = [CameraMounts(name, mounts, stretches(mounts)) for name in ("17", HOSTILE)]
    drives = [
        Drive(mount.name, "17", time, time, RunConfig("a.mp4", "c.yaml"))
        for mount, time in zip(mounts, times, strict=True)
    ]
    outcomes = {drive.name: Outcome(drive.name, frames=300, seconds=12.3) for drive in drives}
    outcomes[drives[3].name] = Outcome(drives[3].name, failure=f"video {HOSTILE}: expected a video")
    verdicts = {drive.name: Verdict("good", "Calibrated for 96 % of the drive.", "", ()) for drive in drives}
    path = tmp_path / "index.html"
    path.write_text(fleet_page("fleet", drives, outcomes, verdicts, cameras), encoding="utf-8")
    page, seen = _open(browser, path, screen, plots=2)
    assert page.locator("#failed li").count() == 1
    assert page.locator("#drives tbody tr").count() == 7
    assert page.locator("#cameras tbody tr").count() == 2 * 2  # the camera was moved once
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    assert not seen, seen
