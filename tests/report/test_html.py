"""The page says what the results say, needs nothing from outside, and works in a browser."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctreg_cli.imaging.slice import Slice, SliceInfo
from ctreg_cli.io.results_document import ResultsDocument, read_document
from ctreg_cli.report.html import report_html, shown_view
from ctreg_cli.report.pictures import View, picture
from ctreg_cli.report.series import pose_series
from tests.interop.documents import SCALE_MM, STATUSES, document_text, frame

from .browser import BROWSER, Browser, open_browser

VOID = {"meta", "link", "input", "br", "img"}


def read(tmp_path: Path, text: str) -> ResultsDocument:
    path = tmp_path / "results.json"
    path.write_text(text, encoding="utf-8")
    return read_document(path)


def noise_slice(seed: int = 0) -> Slice:
    stored = np.random.default_rng(seed).integers(-1000, 3000, (512, 512)).astype(np.int16)
    return Slice(info=SliceInfo(source="0.dcm"), stored=stored)


@pytest.fixture
def page(tmp_path: Path) -> str:
    document = read(tmp_path, document_text())
    view = shown_view(document)
    assert view is not None
    pictures = {0: picture(noise_slice(), view, 20_000)}
    return report_html(document, model=frame(), pictures=pictures)


class Balance(HTMLParser):
    """Elements that are closed in the order in which they were opened."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_page_is_whole_and_points_nowhere(page: str) -> None:
    parser = Balance()
    parser.feed(page)
    assert not parser.open
    assert all(address.startswith(("data:", "#")) for address in parser.addresses)
    assert set(re.findall(r"https?://[^\s\"'<>]+", page)) == {"http://www.w3.org/2000/svg"}
    assert "{{" not in page


def test_page_counts_and_tells_every_slice(page: str) -> None:
    for status in set(STATUSES):
        assert f"<b>{STATUSES.count(status)}</b> <span>{status}</span>" in page
    data = json.loads(re.search(r'id="data">(.*?)</script>', page, re.S)[1])  # type: ignore[index]
    assert [entry["status"] for entry in data["slices"]] == list(STATUSES)
    assert [entry["T"] is None for entry in data["slices"]] == [status == "no_pose" for status in STATUSES]
    assert "weak geometry: tilt about x is known to 9° only" in unescape(page)


EVIL = "</script><script>window.hit = 1</script><img src=x onerror=window.hit=1>\"'&"


def hostile_text() -> str:
    """A document with a script wherever it holds a word."""
    evil = EVIL
    data = json.loads(document_text())
    data["model"]["name"] = evil
    for row in data["results"]:
        row["source"] = evil
        row["reason"] = evil
        for match in row["matches"]:
            match["rod"] = evil
        for target in row["targets"]:
            target["id"] = evil
        row["missing_rods"] = [evil]
        row["warnings"] = [{"code": evil, "text": evil}]
    data["options"] = {evil: evil}
    return json.dumps(data)


def test_hostile_names_stay_text(tmp_path: Path) -> None:
    page = report_html(read(tmp_path, hostile_text()))
    assert "<script>window" not in page
    assert "<img" not in page
    parser = Balance()
    parser.feed(page)
    assert not parser.open


def test_uids_are_not_shown(page: str) -> None:
    assert "2.25." not in page


def test_curve_holds_no_pose_that_is_not_there(tmp_path: Path) -> None:
    document = read(tmp_path, document_text())
    series = pose_series(document.records)
    assert series.usable.tolist() == [status == "ok" for status in STATUSES]
    assert np.isnan(series.values[STATUSES.index("no_pose")]).all()
    T = [record.T_slice_model for record in document.records]
    for k in np.flatnonzero(series.usable):
        assert T[k] is not None
        np.testing.assert_allclose(series.values[k, :3], T[k][:3, 3])
        cosine = (np.trace(T[k][:3, :3] @ T[0][:3, :3].T) - 1) / 2  # type: ignore[index]
        np.testing.assert_allclose(np.cos(np.radians(np.linalg.norm(series.values[k, 3:]))), cosine, atol=1e-9)


def test_empty_and_poseless_runs_are_pages_too(tmp_path: Path) -> None:
    data = json.loads(document_text())
    for results in ([], [row for row in data["results"] if row["status"] == "no_pose"]):
        page = report_html(read(tmp_path, json.dumps(data | {"results": results})))
        assert "No slice has a pose" in page
        assert page.count("No slice is ok") == 2  # not: there are no targets
        assert "targets (the frame" not in page


def test_picture_shows_its_part_of_the_slice() -> None:
    """A bright pixel stands in the picture where the page's overlay expects it: the view maps px to the picture."""
    import base64
    import io

    from PIL import Image

    stored = np.zeros((200, 300), dtype=np.int16)
    stored[60:63, 210:213] = 1000
    view = View(u0=180.0, v0=20.0, side_px=80.0)
    address = picture(Slice(info=SliceInfo(source=""), stored=stored), view, 10**6)
    image = np.array(Image.open(io.BytesIO(base64.b64decode(address.partition(",")[2]))), dtype=float)
    rows, columns = np.indices(image.shape)
    weight = np.where(image > 100, image, 0)
    side = image.shape[0]
    # picture pixel k covers [k, k + 1] of `side`; the view begins at u0
    u = view.u0 + ((weight * columns).sum() / weight.sum() + 0.5) / side * view.side_px
    v = view.v0 + ((weight * rows).sum() / weight.sum() + 0.5) / side * view.side_px
    np.testing.assert_allclose([u, v], [211, 61], atol=0.1)


def test_two_hundred_slices_fit_in_six_megabytes(tmp_path: Path) -> None:
    from ctreg_cli.cli.report import PICTURE_BYTES, PICTURES_BYTES

    budget = min(PICTURE_BYTES, PICTURES_BYTES // 200)
    view = View(u0=100.0, v0=100.0, side_px=200.0)
    pictures = [picture(noise_slice(seed), view, budget) for seed in range(3)]  # noise is what shrinks worst
    data = json.loads(document_text())
    rows = [data["results"][k % 5] | {"slice": k, "time_s": float(k)} for k in range(200)]
    document = read(tmp_path, json.dumps(data | {"results": rows}))
    page = report_html(document, model=frame(), pictures={k: pictures[k % 3] for k in range(200)})
    assert len(page.encode()) <= 6_000_000


needs_browser = pytest.mark.skipif(BROWSER is None, reason="Debian package chromium is not installed")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with open_browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


def shown(browser: Browser, page: str, tmp_path: Path, **screen: Any) -> None:
    path = tmp_path / "page.html"
    path.write_text(page, encoding="utf-8")
    browser.show(path, **screen)


def verdict(browser: Browser) -> str:
    return str(browser.evaluate("document.getElementById('verdict').textContent"))


def drawn(browser: Browser) -> str:
    return str(browser.evaluate("document.getElementById('scene').toDataURL()"))


def count(browser: Browser, selector: str) -> int:
    return int(browser.evaluate(f"document.querySelectorAll({selector!r}).length"))


SCREENS = [{"width": 1280}, {"width": 390, "phone": True}, {"width": 390, "phone": True, "dark": True}]


@needs_browser
@pytest.mark.parametrize("screen", SCREENS, ids=["desk", "phone", "dark phone"])
def test_slider_and_scene_respond(browser: Browser, page: str, tmp_path: Path, screen: dict[str, Any]) -> None:
    shown(browser, page, tmp_path, **screen)
    assert browser.evaluate("innerWidth") == screen["width"]
    assert browser.evaluate("document.documentElement.scrollWidth") <= screen["width"], "the page scrolls sideways"
    assert browser.evaluate("document.getElementById('slider').max") == str(len(STATUSES) - 1)
    assert verdict(browser).startswith("Slice 0, 0.dcm: ok")
    # the keyboard alone: along the slices, then into the scene
    browser.evaluate("document.getElementById('slider').focus()")
    for _ in range(3):
        browser.press("ArrowRight", 39)
    assert verdict(browser).startswith("Slice 3, 3.dcm: no_pose (too_few_spots)")
    assert (count(browser, "#view circle:not(.free)"), count(browser, "#view circle.free")) == (0, 2)
    browser.press("Tab", 9)
    browser.press("Tab", 9)
    assert browser.evaluate("document.activeElement.id") == "scene"
    browser.evaluate("document.getElementById('back').click()")
    assert verdict(browser).startswith("Slice 2, 2.dcm: ok")
    assert count(browser, "#view circle:not(.free)") == 3
    before = drawn(browser)
    browser.press("ArrowLeft", 37)
    assert drawn(browser) != before
    browser.press("0", 48, "0")
    assert drawn(browser) == before
    browser.press("+", 187, "+")
    assert drawn(browser) != before
    assert browser.console == []
    assert [address for address in browser.requests if not address.startswith(("data:", "file:"))] == []


@needs_browser
def test_spots_of_no_rod_and_rods_of_no_spot_stand_where_they_are(browser: Browser, tmp_path: Path) -> None:
    data = json.loads(document_text())
    row, rods = data["results"][0], frame().rods
    T = np.eye(4)
    T[:3, 3] = [40.0, 45.0, 1.0]
    row |= {"T_slice_model": T.tolist(), "missing_rods": [rod.id for rod in rods[3:5]]}
    shown(browser, report_html(read(tmp_path, json.dumps(data)), model=frame()), tmp_path, width=1280)
    rings = browser.evaluate(
        "[...document.querySelectorAll('#view circle.free')].map(c => ['cx', 'cy'].map(k => +c.getAttribute(k)))"
    )
    np.testing.assert_allclose(rings, row["unmatched_px"], atol=1e-3)
    crosses = browser.evaluate("[...document.querySelectorAll('#view path.unseen')].map(p => p.getAttribute('d'))")
    assert len(crosses) == 2
    for rod, cross in zip(rods[3:5], crosses, strict=True):
        # where the rod meets the plane z = 0 of the slice
        p, q = rod.start + T[:3, 3], rod.end + T[:3, 3]
        expected = (p + p[2] / (p[2] - q[2]) * (q - p))[:2] / SCALE_MM
        numbers = np.array(re.findall(r"-?[\d.]+(?:e-?\d+)?", cross), dtype=float).reshape(4, 2)
        np.testing.assert_allclose(numbers.mean(axis=0), expected, atol=1e-3)


@needs_browser
def test_a_browser_would_tell_of_a_request(browser: Browser, page: str, tmp_path: Path) -> None:
    """The test above can fail: a picture from elsewhere is seen."""
    script = 'const i = new Image(); i.src = "https://localhost:9/x.png"; document.body.append(i);'
    shown(browser, page.replace("</body>", f"<script>{script}</script></body>"), tmp_path, width=900)
    assert any("localhost:9" in said for said in browser.console + browser.requests)


@needs_browser
def test_on_paper_all_is_open_and_dark_on_light(browser: Browser, page: str, tmp_path: Path) -> None:
    shown(browser, page, tmp_path, width=1280, dark=True)
    on_screen = drawn(browser)
    browser.evaluate("dispatchEvent(new Event('beforeprint'))")
    on_paper = drawn(browser)
    browser.evaluate("dispatchEvent(new Event('afterprint'))")
    assert count(browser, "details:not([open])") == 0
    assert drawn(browser) == on_screen != on_paper
    shown(browser, page, tmp_path, width=1280)
    assert drawn(browser) == on_paper
    assert browser.pdf().startswith(b"%PDF")


@needs_browser
def test_hostile_names_run_nothing(browser: Browser, tmp_path: Path) -> None:
    shown(browser, report_html(read(tmp_path, hostile_text()), model=frame()), tmp_path, width=1280)
    for _ in STATUSES:
        browser.evaluate("document.getElementById('on').click()")
    assert browser.evaluate("document.title.includes('<script>')")
    assert browser.evaluate("window.hit === undefined")
    assert count(browser, "img") == 0
    assert browser.console == []
