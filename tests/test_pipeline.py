"""The pipeline's own promises: what becomes a row, what ends a run, and when."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ctreg_cli.errors import MissingScaleError
from ctreg_cli.imaging.segmentation import SegmentationOptions
from ctreg_cli.imaging.slice import Slice, UnreadableSlice
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.io.dicom_pixels import NativePixels
from ctreg_cli.io.images import open_images, read_slices
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.pipeline import FrameResult, pose, pose_joint, segment, track

SAMPLES = Path(__file__).parents[1] / "sample_data"
FRAME = load_rod_model(SAMPLES / "frame.yaml")
N = 4


@pytest.fixture(scope="module")
def seen() -> list[SpotSlice]:
    """Spots of the first slices of the sample series."""
    paths = [SAMPLES / "track" / f"track_{number:03d}.dcm" for number in range(N)]
    return list(segment(read_slices(*paths), SegmentationOptions()))


def without_scale(item: SpotSlice) -> SpotSlice:
    return replace(item, info=replace(item.info, scale=None))


Method = Callable[..., Iterator[FrameResult]]
METHODS = pytest.mark.parametrize("method", [pose, track], ids=["pose", "track"])


@METHODS
@pytest.mark.parametrize("lacking", [{0}, {0, 1}, {2}, {0, 1, 2}], ids=str)
def test_a_slice_without_scale_is_a_row_wherever_it_comes(
    method: Method, seen: list[SpotSlice], lacking: set[int]
) -> None:
    slices = [without_scale(item) if place in lacking else item for place, item in enumerate(seen)]
    for given in (slices, iter(slices)):
        results = list(method(given, FRAME))
        assert [result.index for result in results] == list(range(N))
        assert {result.index for result in results if result.reason == "no_scale"} == lacking
        assert {result.index for result in results if result.status == "ok"} == set(range(N)) - lacking
        assert [len(result.spots) for result in results] == [len(item.spots) for item in slices]


@METHODS
def test_no_scale_at_all_is_an_error_at_once_or_at_the_end_of_a_stream(method: Method, seen: list[SpotSlice]) -> None:
    slices = [without_scale(item) for item in seen]
    with pytest.raises(MissingScaleError, match="--scale"):
        next(method(slices, FRAME))
    rows = method(iter(slices), FRAME)
    assert [next(rows).reason for _ in slices] == N * ["no_scale"]
    with pytest.raises(MissingScaleError, match=slices[0].info.source):
        next(rows)


@METHODS
def test_slices_that_cannot_be_read_need_no_scale(method: Method, seen: list[SpotSlice]) -> None:
    broken = [replace(without_scale(item), problem="cut short") for item in seen]
    assert [result.reason for result in method(broken, FRAME)] == N * ["unreadable"]


def test_a_series_without_scale_does_not_end_the_other(seen: list[SpotSlice]) -> None:
    """Joint poses are of one series each."""
    other = [replace(without_scale(item), info=replace(item.info, scale=None, series="other")) for item in seen]
    rows = list(pose_joint([other[0], seen[0], other[1]], FRAME))
    assert [row.reason for row in rows][::2] == 2 * ["no_scale"]
    assert rows[1].best is not None
    with pytest.raises(MissingScaleError):
        list(pose_joint(other, FRAME))


def test_a_frame_that_is_followed_is_found_in_some_rows_of_an_image(monkeypatch: pytest.MonkeyPatch) -> None:
    paths = sorted((SAMPLES / "track").glob("*.dcm"))
    expected = list(track(read_slices(*paths), FRAME))
    read: list[str] = []
    whole = NativePixels.whole
    monkeypatch.setattr(NativePixels, "whole", lambda pixels: read.append(pixels.path) or whole(pixels))
    results = list(track(open_images(paths), FRAME))
    assert len(set(read)) < len(paths) / 2
    for result, other in zip(results, expected, strict=True):
        assert (result.status, result.method) == (other.status, other.method)
        np.testing.assert_allclose(result.spots.uv_px, other.spots.uv_px, rtol=0, atol=1e-9)
        assert result.best is not None
        assert other.best is not None
        np.testing.assert_allclose(result.best.T_slice_model, other.best.T_slice_model, rtol=0, atol=1e-9)
        np.testing.assert_allclose(result.best.covariance, other.best.covariance, rtol=1e-6)


@METHODS
@pytest.mark.parametrize("harm", ["cut short", "taken away"])
def test_a_file_harmed_after_it_was_opened_is_a_row(method: Method, harm: str, tmp_path: Path) -> None:
    """Its size was looked at when it was opened, its pixels are wanted a moment later."""
    for path in sorted((SAMPLES / "track").glob("*.dcm"))[:6]:
        (tmp_path / path.name).write_bytes(path.read_bytes())

    def opened() -> Iterator[Slice | UnreadableSlice]:
        for number, slice_ in enumerate(open_images([tmp_path])):
            if number == 3:
                path = tmp_path / slice_.info.source
                path.write_bytes(path.read_bytes()[:2000])
                if harm == "taken away":
                    path.unlink()
            yield slice_

    results = list(method(opened(), FRAME))
    assert [result.status for result in results] == [*3 * ["ok"], "no_pose", "ok", "ok"]
    assert results[3].reason == "unreadable"
