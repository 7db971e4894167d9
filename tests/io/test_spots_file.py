"""Spots files: what goes in comes out, other programs' tables are understood, every mistake is named at its place."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ctreg_cli.errors import SpotsFileError
from ctreg_cli.imaging.slice import SliceInfo
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.imaging.spots import RejectedSpot, Spots
from ctreg_cli.io.sinks import open_sinks
from ctreg_cli.io.spots_file import numbered, read_spots, spots_encoding
from ctreg_cli.io.spots_parsing import parse_spots
from ctreg_cli.scale import Scale

MIRROR = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
CONTRACT_COLUMNS = "slice,source,time_s,s_x_mm,s_y_mm,spot,u_px,v_px,sd_u_px,sd_v_px,area_px,contrast"


def some_spots(rng: np.random.Generator, count: int) -> Spots:
    root = rng.normal(size=(count, 2, 2)) + 2 * np.eye(2)
    covariance = root @ root.swapaxes(1, 2) * 0.01
    return Spots(
        uv_px=rng.uniform(-5, 2000, (count, 2)),
        covariance_px=(covariance + covariance.swapaxes(1, 2)) / 2,
        area_px=rng.uniform(1, 50, count),
        contrast=np.where(rng.random(count) < 0.3, np.nan, rng.uniform(100, 3000, count)),
        major_px=rng.uniform(2, 9, count),
        minor_px=rng.uniform(1, 2, count),
        angle_rad=rng.uniform(-1, 1, count),
        sd_assumed=bool(count and rng.random() < 0.5),
    )


def some_slices(seed: int) -> list[SpotSlice]:
    """Ordinary, bare, empty and unreadable slices, with gaps in their numbers."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.normal(size=3) * 100
    rich = SliceInfo(
        source="ser,ies/“a” 1.dcm#3",
        time_s=float(rng.uniform(0, 2e9)),
        scale=Scale(s_x=float(rng.uniform(0.1, 1)), s_y=float(rng.uniform(0.1, 1))),
        T_patient_slice=T,
        thickness_mm=float(rng.uniform(0.5, 10)),
        shape=(512, 400),
        series="1.2.840.99",
        uids={"series_instance": "1.2.840.99"},
    )
    bare = SliceInfo(source="b.png")
    return [
        SpotSlice(index=0, info=rich, spots=some_spots(rng, 6)),
        SpotSlice(index=2, info=bare, spots=some_spots(rng, 1)),
        SpotSlice(index=5, info=rich, spots=some_spots(rng, 0)),
        SpotSlice(
            index=6, info=bare, spots=some_spots(rng, 0), problem="PixelData: 12 bytes, but 2 × 512 × 512 needed"
        ),
    ]


def written(slices: list[SpotSlice], path: Path, *, with_uids: bool = False) -> str:
    with open_sinks([str(path)], spots_encoding(with_uids=with_uids), io.StringIO()) as sinks:
        for spot_slice in numbered(slices):
            sinks.write(spot_slice)
    return path.read_text(encoding="utf-8")


def assert_same(got: SpotSlice, wanted: SpotSlice, *, exact_covariance: bool) -> None:
    assert (got.index, got.problem) == (wanted.index, wanted.problem)
    assert (got.info.source, got.info.time_s, got.info.scale) == (
        wanted.info.source,
        wanted.info.time_s,
        wanted.info.scale,
    )
    for name in ("uv_px", "area_px", "contrast", "major_px", "minor_px", "angle_rad"):
        np.testing.assert_array_equal(getattr(got.spots, name), getattr(wanted.spots, name))
    np.testing.assert_allclose(
        got.spots.covariance_px, wanted.spots.covariance_px, rtol=0 if exact_covariance else 1e-15, atol=0
    )
    assert got.spots.sd_assumed == wanted.spots.sd_assumed


@pytest.mark.parametrize("seed", range(5))
def test_a_table_gives_back_what_went_in(tmp_path: Path, seed: int) -> None:
    slices = some_slices(seed)
    text = written(slices, tmp_path / "s.csv")
    back = read_spots(tmp_path / "s.csv")
    for got, wanted in zip(back, slices, strict=True):
        assert_same(got, wanted, exact_covariance=False)
        if len(wanted.spots):
            assert got.info.thickness_mm == wanted.info.thickness_mm
            assert got.info.shape == wanted.info.shape
            assert (got.info.T_patient_slice is None) == (wanted.info.T_patient_slice is None)
            if wanted.info.T_patient_slice is not None:
                np.testing.assert_allclose(got.info.T_patient_slice, wanted.info.T_patient_slice, rtol=0, atol=1e-14)
    # of a slice without spots a table says no place: it is that of the slice before
    assert [spot_slice.info.series for spot_slice in back] == ["0", "1", "1", "1"]
    assert written(back, tmp_path / "again.csv") == text


def test_what_lies_where_in_a_table_is_written_as_dicom_has_it() -> None:
    head = "slice,u_px,v_px,image_position_mm,image_orientation\n"
    slices, _ = parse_spots((head + "0,1,2,-10\\20\\30.5,0.707\\0.707\\0\\0\\0\\-1\n").encode(), "t")
    T = slices[0].info.T_patient_slice
    assert T is not None
    r = np.sqrt(0.5)
    np.testing.assert_allclose(T, [[r, 0, -r, -10], [r, 0, r, 20], [0, -1, 0, 30.5], [0, 0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize("suffix", [".json", ".jsonl"])
@pytest.mark.parametrize("seed", range(3))
def test_a_document_gives_everything_back(tmp_path: Path, seed: int, suffix: str) -> None:
    slices = some_slices(seed)
    rejected = (RejectedSpot(u_px=1.0, v_px=2.5, reason="too_large"),)
    spots = slices[0].spots
    slices[0] = SpotSlice(
        index=0,
        info=slices[0].info,
        spots=Spots(uv_px=spots.uv_px, covariance_px=spots.covariance_px, rejected=rejected),
    )
    text = written(slices, tmp_path / f"s{suffix}", with_uids=True)
    back = read_spots(tmp_path / f"s{suffix}")
    for got, wanted in zip(back, slices, strict=True):
        assert_same(got, wanted, exact_covariance=True)
        assert (got.info.thickness_mm, got.info.shape) == (wanted.info.thickness_mm, wanted.info.shape)
        assert dict(got.info.uids) == dict(wanted.info.uids)
        if wanted.info.T_patient_slice is None:
            assert got.info.T_patient_slice is None
        else:
            np.testing.assert_array_equal(got.info.T_patient_slice, wanted.info.T_patient_slice)
    assert back[0].spots.rejected == rejected
    assert [spot_slice.info.series for spot_slice in back] == ["0", "1", "0", "1"]
    assert written(back, tmp_path / f"again{suffix}", with_uids=True) == text


def test_a_document_holds_no_uid_unasked(tmp_path: Path) -> None:
    assert "1.2.840" not in written(some_slices(1), tmp_path / "s.json")
    assert "1.2.840" not in written(some_slices(1), tmp_path / "s.csv")


def test_the_table_is_the_contracts(tmp_path: Path) -> None:
    head, *rows = written(some_slices(2), tmp_path / "s.csv").splitlines()
    assert head.startswith(CONTRACT_COLUMNS)
    empty = next(row for row in rows if row.startswith("5,"))
    assert empty.rsplit('"', 1)[1].split(",")[4:] == [""] * (head.count(",") - 4)


finite = st.floats(-1e6, 1e6, allow_nan=False)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 9), finite, finite), min_size=1, max_size=12), st.randoms())
def test_centres_are_all_a_table_needs(rows: list[tuple[int, float, float]], shuffler: object) -> None:
    text = "".join(f"{v!r},{index},{u!r}\n" for index, u, v in rows)
    slices, warnings = parse_spots(f"v_px,slice,u_px\n{text}".encode(), "t")
    assert warnings == ()
    assert [s.index for s in slices] == sorted({index for index, _, _ in rows})
    for spot_slice in slices:
        wanted = [(u, v) for index, u, v in rows if index == spot_slice.index]
        assert spot_slice.spots.uv_px.tolist() == [list(map(float, uv)) for uv in wanted]
        assert spot_slice.spots.sd_assumed
        np.testing.assert_array_equal(spot_slice.spots.sd_px, 0.25)
        assert spot_slice.info.scale is None


def one(text: str, **options: float) -> SpotSlice:
    (spot_slice,) = parse_spots(text.encode(), "t.csv", **options)[0]
    return spot_slice


def test_the_assumed_sd_is_the_users_choice_and_is_admitted() -> None:
    half = one("slice,u_px,v_px,sd_u_px,sd_v_px\n0,1,2,,\n0,3,4,0.1,0.2\n", spot_sd_px=0.5)
    np.testing.assert_array_equal(half.spots.sd_px, [[0.5, 0.5], [0.1, 0.2]])
    assert half.spots.sd_assumed
    assert not one("slice,u_px,v_px,sd_u_px,sd_v_px\n0,3,4,0.1,0.2\n").spots.sd_assumed


@pytest.mark.parametrize(
    "text",
    [
        "\ufeffslice,u_px,v_px\n7,1,2\n",
        "slice,u_px,v_px\r\n7,1,2\r\n",
        "slice , u_px, v_px\n 7 , 1 , 2 \n\n,,\n",
        "slice,u_px,v_px\n7.0,1e0,2.\n",
        "slice,u_px,v_px,area_px,sd_u_px,sd_v_px,time_s\n7,1,2,nan,NaN,nan,\n",
        'slice,note,u_px,v_px\n7,"a, b""c",1,2',
    ],
    ids=["byte order mark", "CRLF", "spaces and blank rows", "spreadsheet numbers", "nan for unknown", "extra column"],
)
def test_tables_as_other_programs_write_them(text: str) -> None:
    spot_slice = one(text)
    assert spot_slice.index == 7
    assert spot_slice.spots.uv_px.tolist() == [[1.0, 2.0]]
    assert np.isnan(spot_slice.spots.area_px[0])


PLACED = "slice,u_px,v_px,image_position_mm,image_orientation\n"


def test_spots_left_out_are_numbered_anew_and_it_is_said() -> None:
    slices, warnings = parse_spots(b"slice,spot,u_px,v_px\n0,4,40,4\n0,2,20,2\n1,0,1,1\n", "t.csv")
    assert slices[0].spots.uv_px[:, 0].tolist() == [20, 40]
    assert len(warnings) == 1
    assert "slice 0" in warnings[0]


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", r"t: is empty"),
        ("slice,u_px,v_px\n", r"t: holds no slice"),
        ("slice;u_px;v_px\n0;1,5;2\n", r"t:1: .*';'"),
        ("slice\tu_px\tv_px\n0\t1\t2\n", r"t:1: .*tabs"),
        ("slice,x,y\n0,1,2\n", r"t:1: no column u_px, v_px"),
        ("slice,u_px,v_px,u_px\n0,1,2,3\n", r"t:1: column u_px is given twice"),
        ("slice,u_px,v_px\n0,1\n", r"t:2: 2 cells under 3 columns"),
        ("slice,u_px,v_px\n0,1,5,2,5\n", r"t:2: 5 cells under 3 columns.*decimal point"),
        ('slice,u_px,v_px\n0,"1,5",2\n', r"t:2: u_px: .*number.*decimal point"),
        ("slice,u_px,v_px\n0,1,nan\n", r"t:2: v_px: .*finite"),
        ("slice,u_px,v_px\n0,1,inf\n", r"t:2: v_px: .*finite"),
        ("slice,u_px,v_px\n0,1,1e300\n", r"t:2: v_px: .*less than or equal to"),
        ("slice,u_px,v_px\n0,1,2\n0,1,\n", r"t:3: v_px: .*required"),
        ("slice,u_px,v_px\n-1,1,2\n", r"t:2: slice: .*greater than or equal to 0"),
        ("slice,u_px,v_px\n1.5,1,2\n", r"t:2: slice: .*integer"),
        ("slice,u_px,v_px\n,1,2\n", r"t:2: slice: .*integer"),
        ("slice,u_px,v_px,sd_u_px,sd_v_px\n0,1,2,0,1\n", r"t:2: sd_u_px: .*greater"),
        ("slice,u_px,v_px,sd_u_px,sd_v_px\n0,1,2,1,\n", r"t:2: sd_u_px, sd_v_px: give both or neither"),
        ("slice,u_px,v_px,sd_u_px,sd_v_px,cov_uv_px2\n0,1,2,1,1,2\n", r"t:2: covariance: .*positive definite"),
        (f"{PLACED}0,1,2,1\\2,1\\0\\0\\0\\1\\0\n", r"t:2: image_position_mm: .*required"),
        (f"{PLACED}0,1,2,1\\x\\3,1\\0\\0\\0\\1\\0\n", r"t:2: image_position_mm: .*number.*'x'"),
        (f"{PLACED}0,1,2,1\\2\\3,1\\0\\0\\1\\1\\0\n", r"t:2: image_orientation: .*orthogonal"),
        ("slice,u_px,v_px,s_x_mm\n0,1,2,0.5\n", r"t:2: .*s_x_mm, s_y_mm"),
        ("slice,u_px,v_px,s_x_mm,s_y_mm\n0,1,2,-1,1\n", r"t:2: s_x_mm: .*greater than or equal to 0.000001"),
        ("slice,u_px,v_px,s_x_mm,s_y_mm\n0,1,2,1,1e300\n", r"t:2: s_y_mm: .*less than or equal to 1000"),
        ("slice,u_px,v_px,source\n0,1,2,a\n0,1,2,b\n", r"t:3: source: differs from line 2"),
        ("slice,spot,u_px,v_px\n0,1,1,2\n0,1,3,4\n", r"t:2: spot: .*twice"),
        ('slice,u_px,v_px\n0,"1,2\n', r"t:2: .*quote"),
        ('{"schema": "ctreg/poses/1", "results": []}', r"t: schema: .*ctreg/spots/1"),
        ('{"schema": "ctreg/spots/1", "slices": [{"slice": 0}, {"slice": 0}]}', r"t: slice 0 is given 2 times"),
        ('{"schema": "ctreg/spots/1", "slices": [{"slice": 0, "spots": [{"u_px": 1}]}]}', r"slices\.0\.spots\.0\.v_px"),
        ('{"schema": "ctreg/spots/1", "slices": [{"slice": 0,', r"t: .*JSON.*EOF"),
        ('{"schema": "ctreg/spots/1"}\n{"slice": 0}\n{"slice": 1,', r"t: .*line 3"),
        ('{"schema": "ctreg/spots/1"}\n{"slice": 0}\n{"slice": -1}', r"t:3: slice: .*greater than or equal to 0"),
        ("[" * 100_000, r"t: .*recursion"),
        (
            '{"schema": "ctreg/spots/1", "slices": [{"slice": 0, "T_patient_slice": ' + f"{MIRROR}}}]}}",
            r"slices\.0: T_patient_slice: must be a rigid",
        ),
    ],
)
def test_a_mistake_is_named_at_its_place(text: str, wanted: str) -> None:
    with pytest.raises(SpotsFileError, match=wanted):
        parse_spots(text.encode(), "t")


def test_all_mistakes_at_once_but_not_a_flood() -> None:
    with pytest.raises(SpotsFileError) as caught:
        parse_spots(b"slice,u_px,v_px\n" + b"0,x,y\n" * 50, "t")
    lines = str(caught.value).splitlines()
    assert lines[0].startswith("t:2: u_px")
    assert lines[1].startswith("t:2: v_px")
    assert lines[-1] == "... and 80 more"
    assert len(lines) == 21


def test_a_binary_or_absent_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "b.csv").write_bytes(b"\x93NUMPY\x01\x00")
    with pytest.raises(SpotsFileError, match=r"b\.csv: is no UTF-8 text"):
        read_spots(tmp_path / "b.csv")
    with pytest.raises(SpotsFileError, match=r"absent\.csv: cannot be read"):
        read_spots(tmp_path / "absent.csv")


def test_bytes_of_any_kind_end_in_slices_or_in_our_own_error() -> None:
    rng = np.random.default_rng(11)
    bases = [
        b"slice,source,u_px,v_px,sd_u_px,sd_v_px\n0,a,1.5,2,0.1,0.2\n1,b,,,,\n",
        json.dumps({"schema": "ctreg/spots/1", "slices": [{"slice": 0, "spots": [{"u_px": 1, "v_px": 2}]}]}).encode(),
    ]
    for _ in range(1500):
        content = bytearray(bases[int(rng.integers(2))])
        for _ in range(int(rng.integers(1, 6))):
            content[int(rng.integers(len(content)))] = int(rng.integers(256))
        try:
            slices, _ = parse_spots(bytes(content[: int(rng.integers(1, len(content) + 1))]), "t")
        except SpotsFileError:
            continue
        assert all(np.isfinite(spot_slice.spots.uv_px).all() for spot_slice in slices)
