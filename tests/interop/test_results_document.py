"""What is read back is what was written; what ctreg never wrote is refused with its place."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ctreg_cli.errors import InputError
from ctreg_cli.io.results_document import read_document

from .documents import STATUSES, document_text, written


def test_json_and_json_lines_are_the_same(tmp_path: Path) -> None:
    data = json.loads(document_text())
    head = {key: value for key, value in data.items() if key != "results"}
    path = tmp_path / "r.jsonl"
    lines = "\n".join(json.dumps(item) for item in [head, *data["results"]])
    path.write_text(lines + '\n{"slice": 9, "sta', encoding="utf-8")  # still being written
    one, other = read_document(path), read_document(written(tmp_path))
    assert [record.index for record in one.records] == [record.index for record in other.records]
    for a, b in zip(one.records, other.records, strict=True):
        assert (a.status, a.matches, a.columns) == (b.status, b.matches, b.columns)


def test_only_ok_may_be_used(tmp_path: Path) -> None:
    document = read_document(written(tmp_path))
    assert [record.index for record in document.ok] == [i for i, s in enumerate(STATUSES) if s == "ok"]


def test_a_pose_beside_no_pose_is_not_believed(tmp_path: Path) -> None:
    data = json.loads(document_text())
    data["results"][3]["T_slice_model"] = np.eye(4).tolist()
    path = tmp_path / "r.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    assert read_document(path).records[3].T_slice_model is None


def _set(*place: object) -> Callable[[Any, object], None]:
    def change(data: Any, value: object) -> None:
        for key in place[:-1]:
            data = data[key]
        data[place[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "value", "message"),
    [
        (_set("schema"), "other/1", "ctreg/poses/1"),
        (_set("model"), None, "model"),
        (_set("results"), {}, "no list of results"),
        (_set("results", 2, "status"), "fine", r"results\.2\.status"),
        (_set("results", 0, "T_slice_model"), np.diag([1.0, 1, 2, 1]).tolist(), r"results\.0\.T_slice_model.*rigid"),
        (_set("results", 0, "T_patient_model"), np.diag([1.0, 1, -1, 1]).tolist(), r"T_patient_model.*rigid"),
        (_set("results", 0, "covariance"), (-np.eye(6)).tolist(), r"covariance"),
        (_set("results", 0, "matches", 0, "u_px"), "x", r"results\.0\.matches\.0\.u_px"),
        (_set("results", 0, "slice"), None, r"results\.0\.slice"),
    ],
)
def test_mistakes_are_named_with_their_place(
    tmp_path: Path, change: Callable[[Any, object], None], value: object, message: str
) -> None:
    data = json.loads(document_text())
    change(data, value)
    path = tmp_path / "r.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        read_document(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", "nonsense", "[" * 100_000])
@pytest.mark.parametrize("suffix", [".json", ".jsonl", ".csv"])
def test_what_is_no_document_is_one_message(tmp_path: Path, text: str, suffix: str) -> None:
    path = tmp_path / f"r{suffix}"
    path.write_text(text + "\n", encoding="utf-8")
    with pytest.raises(InputError):
        read_document(path)
