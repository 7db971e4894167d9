"""The picture shows what was found, where it was found, and lets every spot be seen."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from PIL import Image

from ctreg_cli.imaging.slice import Slice, SliceInfo
from ctreg_cli.imaging.spots import RejectedSpot, Spots
from ctreg_cli.report.overlay import LINE, MARGIN, MATCHED, MISSING, PANEL, REJECTED, UNMATCHED, draw_overlay

SIZE = 200


def spots_at(uv: np.ndarray) -> Spots:
    k = len(uv)
    shape = {"major_px": np.full(k, 5.0), "minor_px": np.full(k, 4.0), "angle_rad": np.zeros(k)}
    rejected = (RejectedSpot(u_px=150.0, v_px=180.0, reason="too_large"),)
    return Spots(uv_px=uv, covariance_px=np.tile(np.eye(2) * 0.01, (k, 1, 1)), rejected=rejected, **shape)


def slice_of(values: np.ndarray) -> Slice:
    return Slice(info=SliceInfo(source="drawn"), stored=values)


@pytest.fixture
def slice_() -> Slice:
    return slice_of(np.random.default_rng(0).integers(-1000, 200, (SIZE, SIZE)).astype(np.int16))


def count(picture: Image.Image, colour: tuple[int, int, int]) -> int:
    return int((np.asarray(picture) == colour).all(axis=2).sum())


def test_rings_crosses_and_marks_have_their_colours(slice_: Slice) -> None:
    spots = spots_at(np.array([[80.0, 90.0], [120.0, 100.0]]))
    plain = draw_overlay(slice_, spots)
    assert plain.mode == "RGB"
    assert count(plain, UNMATCHED)
    assert not count(plain, MATCHED) + count(plain, MISSING) + count(plain, REJECTED)
    full = draw_overlay(
        slice_,
        spots,
        labels={0: "r1"},
        predicted_px=np.array([[100.0, 60.0]]),
        predicted_names=["r2"],
        title="slice",
        show_rejected=True,
    )
    assert all(count(full, colour) for colour in (MATCHED, UNMATCHED, MISSING, REJECTED))


def test_a_spot_is_drawn_where_it_is(slice_: Slice) -> None:
    """Integer coordinates are pixel centres: in the left panel pixel (u, v) covers a square of PANEL / SIZE."""
    uv = np.array([37.0, 141.0])
    picture = np.asarray(draw_overlay(slice_, spots_at(uv[None]), labels={0: ""}))
    left = picture[LINE + MARGIN : LINE + MARGIN + PANEL, MARGIN : MARGIN + PANEL]
    rows, columns = np.nonzero((left == MATCHED).all(axis=2))
    middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
    np.testing.assert_allclose(middle, (uv + 0.5) * PANEL / SIZE, atol=1.0)


@pytest.mark.parametrize("at", [(102.0, 97.0), (180.0, 20.0)])
def test_a_reason_is_written_where_its_candidate_is_seen_closest(slice_: Slice, at: tuple[float, float]) -> None:
    """Three spots in the middle have a close-up beside the whole slice; a candidate far away is seen in this only."""
    spots = spots_at(np.array([[95.0, 95.0], [105.0, 95.0], [100.0, 105.0]]))
    with_reason, without = (
        np.asarray(
            draw_overlay(
                slice_,
                dataclasses.replace(spots, rejected=(RejectedSpot(u_px=at[0], v_px=at[1], reason=reason),)),
                labels=dict.fromkeys(range(3), ""),
                show_rejected=True,
            )
        )
        for reason in ("too_large", "")
    )
    panel = MARGIN + PANEL
    assert with_reason.shape[1] > 2 * panel
    changed = (with_reason != without).any(axis=(0, 2))
    close = at[0] < 150
    assert changed[:panel].any() != close
    assert changed[panel:].any() == close


def test_no_label_covers_a_spot(slice_: Slice) -> None:
    """Twelve rods side by side: with and without their names, the inside of every ring is the same picture."""
    angle = np.linspace(0, 2 * np.pi, 13)[:-1]
    uv = 100 + 30 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    spots = spots_at(uv)
    named = np.asarray(draw_overlay(slice_, spots, labels={i: f"rod{i}" for i in range(12)}))
    bare = np.asarray(draw_overlay(slice_, spots, labels=dict.fromkeys(range(12), "")))
    assert named.shape == bare.shape
    height = LINE + MARGIN + PANEL
    changed = (named[:height] != bare[:height]).any(axis=2)
    assert changed.any()
    ring = (bare[:height] == MATCHED).all(axis=2)
    right = slice(2 * MARGIN + PANEL, None)
    rows, columns = np.nonzero(ring[:, right])
    side = 60 + 2 * 12.0  # the frame's extent with the border about it
    zoom, corner = PANEL / side, 100 - side / 2
    for u, v in uv:
        x, y = ((u - corner) * zoom, (v - corner) * zoom + LINE + MARGIN)
        inside = np.hypot(columns - x, rows - y) < 3 * zoom
        assert inside.any()
        patch = changed[round(y) - 12 : round(y) + 13, right][:, round(x) - 12 : round(x) + 13]
        assert not patch.any()


def test_a_small_frame_is_magnified_and_a_large_one_is_not(slice_: Slice) -> None:
    small = draw_overlay(slice_, spots_at(np.array([[90.0, 90.0], [110.0, 110.0]])))
    large = draw_overlay(slice_, spots_at(np.array([[10.0, 10.0], [190.0, 190.0]])))
    assert small.width > 1.9 * large.width - 2 * MARGIN
    assert small.height == large.height


@pytest.mark.parametrize(
    "values",
    [
        np.zeros((64, 48), dtype=np.int16),
        np.full((30, 90), np.nan),
        np.arange(3, dtype=np.uint8).reshape(1, 3),
    ],
)
def test_any_slice_can_be_drawn_and_stays_as_it_was(values: np.ndarray) -> None:
    before = values.copy()
    slice_ = slice_of(values)
    nothing = spots_at(np.empty((0, 2)))
    picture = draw_overlay(slice_, nothing, title="nothing here", show_rejected=True)
    assert picture.size[0] > PANEL
    np.testing.assert_array_equal(values, before)
    again = draw_overlay(slice_, nothing, title="nothing here", show_rejected=True)
    assert picture.tobytes() == again.tobytes()


def test_spots_without_a_shape_are_drawn_too(slice_: Slice) -> None:
    spots = Spots.from_points(np.array([[50.0, 60.0]]))
    assert count(draw_overlay(slice_, spots, predicted_px=np.array([[np.nan, 1.0]])), UNMATCHED)
