"""Seconds in which a series increases, from what scanners write."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctreg_cli.io.dicom_time import parse_date_time, parse_instant, timeline
from ctreg_cli.io.image_record import Instant

DAY = 738_000


@pytest.mark.parametrize(
    ("text", "second"),
    [
        ("101500.250000", 36900.25),
        ("101500", 36900),
        ("1015", 36900),
        ("10", 36000),
        ("10:15:00.5", 36900.5),
        ("235960", 86400),
    ],
)
def test_times_of_day(text: str, second: float) -> None:
    assert parse_instant("", text) == Instant(None, second)


@pytest.mark.parametrize("text", ["", "CANARY", "9", "2460", "101500,25", "250000", "-10000", "10 15", "１０"])
def test_what_is_no_time_is_none(text: str) -> None:
    assert parse_instant("20240229", text) is None


def test_dates() -> None:
    leap, next_day = parse_instant("20240229", "00"), parse_instant("2024.03.01", "00")
    assert leap is not None
    assert next_day is not None
    assert leap.day is not None
    assert next_day.day == leap.day + 1
    assert parse_instant("20230229", "00") == Instant(None, 0.0)


def test_date_times() -> None:
    assert parse_date_time("20240229101500.5+0100") == parse_instant("20240229", "101500.5")
    assert parse_date_time("20240229") is None


def clocks(*seconds: float | None, day: int | None = DAY) -> list[tuple[Instant | None, ...]]:
    return [(None if s is None else Instant(day, s),) for s in seconds]


def times(line_clocks: list[tuple[Instant | None, ...]]) -> list[float | None]:
    return timeline(line_clocks, [True] * len(line_clocks)).times_s


def test_midnight_without_and_with_a_new_date() -> None:
    before, after = 86399.5, 0.5
    assert times(clocks(before, after, day=None)) == [86399.5, 86400.5]
    assert times(clocks(before, after)) == [86399.5, 86400.5]
    assert times([(Instant(DAY, before),), (Instant(DAY + 1, after),)]) == [86399.5, 86400.5]


@given(st.lists(st.floats(0, 40_000), min_size=1, max_size=8), st.floats(0, 86_399))
def test_differences_survive_midnight(offsets: list[float], start: float) -> None:
    wrapped = [(Instant(None, (start + offset) % 86_400),) for offset in offsets]
    got = timeline(wrapped, [True] * len(wrapped)).times_s
    assert [t - got[0] for t in got if t is not None and got[0] is not None] == pytest.approx(
        [offset - offsets[0] for offset in offsets], abs=1e-6
    )


def test_the_first_clock_that_tells_slices_apart_is_taken() -> None:
    same, other = Instant(DAY, 100.0), (Instant(DAY, 7.0), Instant(DAY, 9.0))
    assert times([(same, other[0]), (same, other[1])]) == [7, 9]
    assert times([(other[0], same), (other[1], same)]) == [7, 9]
    assert times([(same, None), (same, other[1])]) == [100, 100]
    assert times([(None, other[0]), (same, other[1])]) == [7, 9]


def test_missing_times_do_not_order_a_series() -> None:
    line = timeline(clocks(5, None, 7), [True, True, True])
    assert (line.times_s, line.complete) == ([5, None, 7], False)
    assert timeline(clocks(5, None, 7), [True, False, True]).complete
    assert timeline([(), ()], [True, True]).times_s == [None, None]
    assert timeline([], []).times_s == []
