"""The page says what the results say, needs nothing from outside, and works in a browser."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from ctreg_cli.imaging.slice import Slice, SliceInfo
from ctreg_cli.io.results_document import ResultsDocument, read_document
from ctreg_cli.report.html import report_html, shown_view
from ctreg_cli.report.pictures import View, picture
from ctreg_cli.report.series import pose_series
from tests.interop.documents import STATUSES, document_text, frame

#: names of local programs that are a Chromium
BROWSER = shutil.which("chromium") or shutil.which("chromium-browser")
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


def test_hostile_names_stay_text(tmp_path: Path) -> None:
    evil = '</script><script>alert(1)</script><img src=x onerror=alert(1)>"&'
    data = json.loads(document_text())
    data["model"]["name"] = evil
    for row in data["results"]:
        row["source"] = evil
        row["reason"] = evil
        for match in row["matches"]:
            match["rod"] = evil
        for target in row["targets"]:
            target["id"] = evil
    data["options"] = {evil: evil}
    page = report_html(read(tmp_path, json.dumps(data)))
    assert "<script>alert" not in page
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
        assert "No slice has a pose" in report_html(read(tmp_path, json.dumps(data | {"results": results})))


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


def run_in_browser(page: str, script: str, tmp_path: Path, width: int) -> tuple[dict[str, object], str]:
    """Load the page, let ``script`` act on it and fill ``seen``; give that and what the browser logged."""
    acting = f"""<script>
      const seen = {{violations: []}};
      addEventListener("securitypolicyviolation", (e) => seen.violations.push(e.blockedURI));
      addEventListener("error", (e) => seen.violations.push(e.message));
      addEventListener("load", () => setTimeout(() => {{ {script}
        seen.resources = performance.getEntriesByType("resource").map((entry) => entry.name);
        document.body.setAttribute("data-seen", JSON.stringify(seen)); }}, 50));
    </script></head>"""
    path = tmp_path / "page.html"
    path.write_text(page.replace("</head>", acting, 1), encoding="utf-8")
    assert BROWSER is not None
    done = subprocess.run(
        [
            *(BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"),
            *("--disable-component-update", "--no-first-run", f"--user-data-dir={tmp_path / 'profile'}"),
            *("--enable-logging=stderr", f"--window-size={width},900", "--virtual-time-budget=2000", "--dump-dom"),
            path.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=90,
    )
    found = re.search(r'data-seen="([^"]*)"', done.stdout)
    assert found, done.stderr[-2000:]
    seen: dict[str, object] = json.loads(unescape(found[1]))
    return seen, "\n".join(line for line in done.stderr.splitlines() if "CONSOLE" in line)


@pytest.mark.skipif(BROWSER is None, reason="Debian package chromium is not installed")
@pytest.mark.parametrize("width", [1200, 500])
def test_browser_slider_and_scene(page: str, tmp_path: Path, width: int) -> None:
    script = """
      const slider = document.getElementById("slider"), canvas = document.getElementById("scene");
      const verdict = () => document.getElementById("verdict").textContent;
      const drawn = () => canvas.toDataURL();
      seen.max = slider.max; seen.first = verdict();
      const before = drawn();
      canvas.focus();
      canvas.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowLeft", bubbles: true}));
      seen.turned = drawn() !== before;
      document.getElementById("reset").click();
      seen.back = drawn() === before;
      document.querySelector("[data-zoom]").click();
      seen.zoomed = drawn() !== before;
      slider.value = 3; slider.dispatchEvent(new Event("input"));
      seen.lost = verdict(); seen.circles = document.querySelectorAll("#view circle").length;
      document.getElementById("back").click();
      seen.stepped = verdict(); seen.rings = document.querySelectorAll("#view circle").length;
      seen.wide = document.documentElement.scrollWidth <= innerWidth;
    """
    seen, console = run_in_browser(page, script, tmp_path, width)
    assert seen["violations"] == []
    assert seen["resources"] == []
    assert console == ""
    assert seen["max"] == str(len(STATUSES) - 1)
    assert str(seen["first"]).startswith("Slice 0, 0.dcm: ok")
    assert (seen["turned"], seen["back"], seen["zoomed"]) == (True, True, True)
    assert str(seen["lost"]).startswith("Slice 3, 3.dcm: no_pose (too_few_spots)")
    assert seen["circles"] == 0
    assert str(seen["stepped"]).startswith("Slice 2, 2.dcm: ok")
    assert seen["rings"] == 3
    assert seen["wide"], "the page scrolls sideways"


@pytest.mark.skipif(BROWSER is None, reason="Debian package chromium is not installed")
def test_a_browser_would_tell_of_a_request(page: str, tmp_path: Path) -> None:
    """The test above can fail: a picture from elsewhere is seen."""
    script = 'const i = new Image(); i.src = "https://localhost:9/x.png"; document.body.append(i);'
    late = "setTimeout(() => document.body.setAttribute('data-seen', JSON.stringify(seen)), 200);"
    seen, console = run_in_browser(page, script + late, tmp_path, 900)
    assert seen["violations"] or console
