"""The page: its structure, what it says, that it escapes every name, loads nothing, and stays small."""

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from lanebev import Camera
from lanebev.report.lens_table import lens_table
from lanebev.report.page import Report, write_report
from lanebev.report.pictures import PictureSampler, jpeg
from lanebev.report.plots import plot_estimates, plot_widths, width_deviation, width_limits
from lanebev.report.timeline import places_on_axis, shown_frames, strips
from lanebev.report.worst import jumps, scores, worst_moments
from tests.report.report_data import CAMERA, FRAMES, KNOCK, eventful_report, eventful_rows, picture

SECTIONS = ["verdict", "timeline", "worst", "pose", "widths", "mount", "problems", "settings", "conventions",
            "glossary"]  # fmt: skip
QUIET = eventful_rows()[20]
HOSTILE = "</script><script>alert(1)</script>\"'<img src=x onerror=alert(2)>.mp4"


class _Reader(HTMLParser):
    """Tags, attributes, ids of sections, and the text of each script and style."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.sections, self.scripts, self.text = [], [], [], []
        self._inside = None
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag == "section":
            self.sections.append(dict(attributes).get("id"))
        if tag in ("script", "style"):
            self._inside = dict(attributes)
            self.scripts.append((dict(attributes), ""))

    def handle_endtag(self, tag):
        if tag in ("script", "style"):
            self._inside = None

    def handle_data(self, data):
        if self._inside is not None:
            attributes, text = self.scripts[-1]
            self.scripts[-1] = (attributes, text + data)
        else:
            self.text.append(data)

    def data(self, name):
        return json.loads(next(text for attributes, text in self.scripts if attributes.get("id") == name))


def _page(tmp_path, report):
    write_report(tmp_path / "report.html", report)
    return (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return _page(tmp_path_factory.mktemp("page"), eventful_report())


def test_the_verdict_comes_first(page):
    read = _Reader(page)
    assert read.sections == SECTIONS
    words = re.sub(r"\s+", " ", " ".join(read.text))
    assert "Calibrated for 79 % of the drive, all four axes determined for 54 %." in words
    assert "roll not determined from 2.0 to 5.0 s: one lane only" in words
    assert "pose lost from 7.0 to 8.0 s: no lane boundaries seen" in words
    assert "190 of 240 frames TRACKING" in words
    assert "needs 20 s of straight driving with two lanes in view" in words
    assert "frame 130: cannot be decoded" in words


def test_links_lead_to_frames_that_are_shown(page):
    read = _Reader(page)
    links = [attributes["href"] for tag, attributes in read.tags if tag == "a"]
    frames = {int(link.removeprefix("#frame-")) for link in links if link.startswith("#frame-")}
    assert {40, 120, 140, KNOCK} <= frames
    assert frames <= set(read.data("data")["frame"])


def test_the_script_is_given_every_number(page):
    data = _Reader(page).data("data")
    assert data["frame"] == list(range(FRAMES))
    assert data["value"][KNOCK][0] == pytest.approx(eventful_rows()[KNOCK].pitch_deg, abs=1e-4)
    assert data["states"][data["state"][60][2]] == "not determined"
    assert data["reasons"][data["reason"][60]] == "one lane only"
    assert data["after"][0] == [None, 3.7, 3.7, 3.7, None]
    assert set(data["pictures"]) == {str(i) for i in range(0, FRAMES, 20)}


def test_every_name_is_escaped(tmp_path):
    rows = [row._replace(image=HOSTILE) for row in eventful_rows()]
    hostile = eventful_report(
        HOSTILE, rows=rows, facts={HOSTILE: HOSTILE}, problems=[HOSTILE], before_title=HOSTILE, is_stills=True
    )
    read, plain = _Reader(_page(tmp_path, hostile)), _Reader(_page(tmp_path, eventful_report(is_stills=True)))
    assert sum(tag == "script" for tag, _ in read.tags) == sum(tag == "script" for tag, _ in plain.tags)
    assert sum(tag == "img" for tag, _ in read.tags) == 3
    assert not any("onerror" in attributes for _, attributes in read.tags)
    assert read.data("data")["image"][0] == HOSTILE
    assert HOSTILE in "".join(read.text)


def test_the_page_loads_nothing(page):
    read = _Reader(page)
    policy = next(a["content"] for tag, a in read.tags if a.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy
    loaded = [
        attributes.get(name) for _, attributes in read.tags for name in ("src", "href", "srcset", "action")
    ]
    assert all(address.startswith(("#", "data:image/")) for address in loaded if address)
    outside = r"(src|href|action)[\"']?\s*[=:]\s*[\"'`]?(https?:)?//|url\([\"']?(https?:)?//|[\"'`]https?://(?!www\.w3\.org/)"
    assert not re.findall(outside, page)
    own = "".join(text for _, text in read.scripts if "Bokeh Contributors" not in text)
    assert len(own) < 600_000  # Bokeh alone has 1.2 MB
    assert not re.findall(r"fetch\(|XMLHttpRequest|@import|WebSocket|sendBeacon|import\(", own)


@pytest.mark.slow
def test_the_page_stays_small(tmp_path):
    """Ten hours of video at 30 frames a second make a page that a mail takes."""
    first = eventful_rows()
    many = [first[i % FRAMES]._replace(frame=i, time_s=i / 30) for i in range(30_000)]
    sampler = PictureSampler(most_bytes=200_000)
    noise = np.random.default_rng(0).integers(0, 255, (90, 160, 3), dtype=np.uint8)
    for i in range(0, 30_000, 50):
        sampler.add(i, {"image": noise}, {})
    widths = np.full((30_000, 5), 3.7)
    report = eventful_report(rows=many, before=widths, after=widths, pictures=sampler.pictures)
    assert len(_page(tmp_path, report).encode()) < 1_300_000 + 270_000 + 1_600_000  # Bokeh, pictures, numbers


def test_a_page_of_one_image_and_of_nothing(tmp_path):
    nothing = np.full((1, 5), np.nan)
    row = eventful_rows()[0]
    page = _page(tmp_path, Report("x", [row], nothing, nothing, 3.7, {}))
    assert "No frame was calibrated" in page
    assert len(page) < 60_000  # without Bokeh
    page = _page(tmp_path, Report("x", [], nothing[:0], nothing[:0], 3.7, {}))
    assert "there was no frame" in page


def test_a_sigma_that_is_no_number_is_told(tmp_path):
    rows = [row._replace(yaw_std_deg=math.nan, height_m=math.inf) for row in eventful_rows()]
    data = _Reader(_page(tmp_path, eventful_report(rows=rows))).data("data")
    assert data["std"][0][1] is None
    assert data["value"][0][3] is None


def test_worst_moments_are_found():
    found = {moment.place: moment.what for moment in worst_moments(eventful_rows())}
    assert found[KNOCK].startswith("started in this frame; largest jump: pitch +3.")
    assert found[139] == "least certain while predicted: σ of pitch 1.00°"
    assert found[159] == "least certain while lost: σ of pitch 2.00°"
    assert found[99].startswith("largest σ while tracking: roll 1.08")


def test_a_quiet_drive_has_no_jumps():
    rows = [QUIET._replace(frame=i, time_s=i / 20) for i in range(100)]
    assert not any("jump" in moment.what for moment in worst_moments(rows))


def test_sampler_covers_the_drive_and_keeps_the_best():
    sampler = PictureSampler(most_bytes=40 * len(jpeg(picture(0))))
    for i in range(1000):
        sampler.add(
            i, {"image": picture(i)}, {"jump": float(i == 501), "late": 0.0 if i < 700 else 1000.0 - i}
        )
    kept = list(sampler.pictures)
    assert {501, 700} <= set(kept)
    even = [i for i in kept if i not in (501, 700)]
    assert 15 < len(even) <= 40
    assert set(np.diff(even)) == {sampler.every}
    assert kept[-1] > 1000 - 2 * sampler.every


def test_sampler_gives_up_no_best_picture_for_room():
    sampler = PictureSampler(most_bytes=1)
    sampler.add(3, {"image": picture(3)}, {"jump": 2.0})
    sampler.add(5, {"image": picture(5)}, {"jump": 1.0})
    assert list(sampler.pictures) == [3]


def test_pictures_are_scaled_down():
    assert len(jpeg(np.zeros((2000, 3000, 3), np.uint8))) < 20_000


def test_timeline_has_stretches_without_gaps():
    status, *axes = strips(eventful_rows())
    assert [stretch.kind for stretch in status.stretches] == [
        "uninitialised", "tracking", "coasting", "lost", "tracking",
    ]  # fmt: skip
    assert [strip.name for strip in axes] == ["pitch", "yaw", "roll", "height"]
    roll = axes[2].stretches
    assert [stretch.kind for stretch in roll] == [
        "unknown",
        "measured",
        "undetermined",
        "measured",
        "undetermined",
        "lost",
        "measured",
    ]
    assert roll[2].words == "roll not determined, 2.0 to 5.0: one lane only"
    assert sum(stretch.width for stretch in roll) == pytest.approx(100)
    np.testing.assert_allclose([s.start for s in roll[1:]], np.cumsum([s.width for s in roll])[:-1])


@pytest.mark.slow
def test_timeline_of_a_long_drive_keeps_the_worst():
    rows = [QUIET._replace(frame=i, time_s=i / 20) for i in range(100_000)]
    rows[50_000] = rows[50_000]._replace(status="LOST")
    status = strips(rows)[0]
    assert [stretch.kind for stretch in status.stretches] == ["tracking", "lost", "tracking"]
    flicker = [row._replace(status="LOST") if i % 2 else row for i, row in enumerate(rows)]
    assert len(strips(flicker)[0].stretches) <= 600


def test_shown_frames_are_bounded_and_hold_what_must_be_there():
    rows = [QUIET._replace(frame=i) for i in range(100_000)]
    rows[777] = rows[777]._replace(status="LOST")
    places = shown_frames(rows, [5, 99_999])
    assert {5, 777, 778, 99_999} <= set(places)
    assert len(places) < 2100


def test_times_that_do_not_advance_have_a_place():
    rows = [eventful_rows()[0]._replace(time_s=time) for time in (0.0, 0.1, 0.05, 0.2)]
    assert np.all(np.diff(places_on_axis(rows, stills=False)) >= 0)
    assert len(strips(rows)) == 5
    assert len(strips([row._replace(time_s=0.0) for row in rows])) == 5


@pytest.mark.parametrize("stills", [False, True])
def test_plots_hold_estimates_and_grey_what_is_not_determined(stills):
    rows = eventful_rows()
    text = json.dumps(plot_estimates(np.arange(float(FRAMES)), rows, stills, rows))
    assert "not determined" in text
    assert "truth" in text
    quiet = json.dumps(plot_estimates(np.arange(30.0), rows[20:35] * 2, stills))
    assert "not determined" not in quiet


def test_width_plots():
    widths = np.full((30, 5), 3.7)
    widths[:, 0] = np.nan
    low, high = width_limits(widths, widths * np.nan, 3.5)
    assert low < 3.5
    assert high > 3.7
    text = json.dumps(plot_widths(np.arange(30.0), widths, 3.7, (low, high), "time (s)"))
    assert r"lane 1\u20132" in text
    assert r"lane 0\u20131" not in text
    assert width_deviation(widths) == pytest.approx(0, abs=1e-9)
    assert math.isnan(width_deviation(widths * np.nan))


def test_lens_table_holds_every_coefficient():
    table = lens_table(CAMERA)
    assert table["focal lengths fx, fy"] == "1000.00, 1010.00 px"
    assert [table[f"distortion {name}"] for name in ("k1", "k2", "p1", "p2", "k3")] == [
        "-0.31", "0.12", "0.001", "-0.0007", "0.031",
    ]  # fmt: skip
    fisheye = Camera.from_parameters(300, 300, 319.5, 179.5, 640, 360, [0.01, -0.002, 0.0, 0.0], "fisheye")
    assert lens_table(fisheye)["distortion k2"] == "-0.002"
    assert "field of view, without distortion" not in lens_table(fisheye)
    assert lens_table(Camera.from_parameters(300, 300, 319.5, 179.5, 640, 360))["distortion"] == "none"


def test_the_sketch_is_that_of_the_docs():
    root = Path(__file__).parents[2]
    drawn = [
        [
            line.strip()
            for line in path.read_text(encoding="utf-8").splitlines()
            if re.search(r"<(line|path|text|circle)", line)
        ]
        for path in (root / "docs/assets/axes.svg", root / "lanebev/report/templates/axes.svg")
    ]
    assert drawn[0] == drawn[1]
    assert len(drawn[0]) > 20


def test_a_jump_is_a_departure_from_going_on():
    rows = [QUIET._replace(time_s=t, pitch_deg=3.0 * t, yaw_deg=0.1) for t in (0.0, 0.1, 0.3)]
    assert jumps(rows[2], rows[0], rows[1]) == pytest.approx([0, 0, 0, 0], abs=1e-12)
    knocked = rows[2]._replace(yaw_deg=1.1)
    assert jumps(knocked, rows[0], rows[1])[1] == pytest.approx(1.0)
    found = scores(knocked, rows[:2])
    assert found["jump yaw"] == pytest.approx(1.0 / 0.08)
    assert "jump pitch" not in found
    assert "jump yaw" not in scores(knocked, rows[:2], settled=False)
    assert "jump yaw" not in scores(knocked, [rows[0]._replace(status="UNINITIALISED"), rows[1]])
