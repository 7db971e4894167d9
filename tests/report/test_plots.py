"""Figures for papers: readable files, the same bytes for the same results, nothing of the time they were made."""

from __future__ import annotations

import io
import json
import xml.etree.ElementTree as ET
from itertools import islice
from pathlib import Path

import pytest

from ctreg_cli.errors import InputError
from ctreg_cli.io.results_document import read_document
from tests.interop.documents import document_text, written

pytest.importorskip("matplotlib")


def test_figures_are_png_and_svg(tmp_path: Path) -> None:
    from PIL import Image

    from ctreg_cli.report.plots import WIDTH_IN, plots

    document = read_document(written(tmp_path))
    found = dict(plots(document, png_dpi=60))
    assert sorted(found) == ["pose.png", "pose.svg", "residuals.png", "residuals.svg"]
    for name, content in found.items():
        if name.endswith(".svg"):
            root = ET.fromstring(content)
            assert root.tag.endswith("svg")
            assert "px" in "".join(root.itertext()) or "mm" in "".join(root.itertext())  # text stays text
        else:
            assert Image.open(io.BytesIO(content)).width == round(WIDTH_IN * 60)
    assert dict(islice(plots(document, png_dpi=60), 2))["pose.svg"] == found["pose.svg"]


def test_no_pose_no_figure(tmp_path: Path) -> None:
    from ctreg_cli.report.plots import plots

    data = json.loads(document_text())
    data["results"] = [row for row in data["results"] if row["status"] == "no_pose"]
    path = tmp_path / "r.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(InputError, match="no slice has a pose"):
        list(plots(read_document(path)))
