"""Multi-frame files: a slice a frame, with its own geometry and time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian, RLELossless

from ctreg_cli.imaging.slice import UnreadableSlice
from ctreg_cli.io.images import open_images, read_slices
from tests.io.dicom_samples import ct_slice, enhanced_ct, item, pixels, write_dicom

N = 4
FRAMES = np.stack([pixels(10, 12, low=200 * k) for k in range(N)])
SHARED = {
    "PixelMeasuresSequence": item(PixelSpacing=[0.75, 0.5], SliceThickness=1.25),
    "PlaneOrientationSequence": item(ImageOrientationPatient=[1, 0, 0, 0, 0, -1]),
    "PixelValueTransformationSequence": item(RescaleSlope=2, RescaleIntercept=-100, RescaleType="HU"),
}


def frame_items(order: list[int] | range = range(N)) -> list[dict[str, object]]:
    """Frame k lies at y = 10 k and was taken k seconds after 23:59:58, in the given order of frames."""
    times = ["20231231235958", "20231231235959", "20240101000000", "20240101000001.0"]
    return [
        {
            "PlanePositionSequence": item(ImagePositionPatient=[1, 10 * k, 3]),
            "FrameContentSequence": item(FrameAcquisitionDateTime=times[k]),
        }
        for k in order
    ]


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian])
def test_enhanced_ct(tmp_path: Path, syntax: str) -> None:
    path = write_dicom(tmp_path / "a.dcm", enhanced_ct(FRAMES, frame_items(), **SHARED), syntax)
    slices = read_slices(path)
    assert [s.info.source for s in slices] == [f"a.dcm#{k}" for k in range(1, N + 1)]
    times = [s.info.time_s for s in slices]
    np.testing.assert_allclose(np.diff(np.array(times, dtype=float)), 1)
    for k, slice_ in enumerate(slices):
        np.testing.assert_array_equal(slice_.stored, FRAMES[k])
        assert slice_.info.scale is not None
        assert (slice_.info.scale.s_x, slice_.info.scale.s_y) == (0.5, 0.75)
        assert slice_.info.thickness_mm == 1.25
        assert (slice_.slope, slice_.intercept) == (2, -100)
        assert slice_.info.T_patient_slice is not None
        np.testing.assert_allclose(slice_.info.T_patient_slice[:3, 3], [1, 10 * k, 3])
        np.testing.assert_allclose(slice_.info.T_patient_slice[:3, :3], np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))


def test_frames_come_in_the_order_of_their_times(tmp_path: Path) -> None:
    order = [2, 0, 3, 1]
    slices = read_slices(write_dicom(tmp_path / "a.dcm", enhanced_ct(FRAMES, frame_items(order), **SHARED)))
    assert [s.info.source for s in slices] == ["a.dcm#2", "a.dcm#4", "a.dcm#1", "a.dcm#3"]
    for k, slice_ in enumerate(slices):
        assert slice_.info.T_patient_slice is not None
        assert slice_.info.T_patient_slice[1, 3] == 10 * k
        np.testing.assert_array_equal(slice_.stored, FRAMES[order.index(k)])


def test_a_frames_own_macro_goes_before_the_shared_one(tmp_path: Path) -> None:
    items = frame_items()
    items[1]["PixelMeasuresSequence"] = item(PixelSpacing=[2, 3], SliceThickness=5)
    slices = read_slices(write_dicom(tmp_path / "a.dcm", enhanced_ct(FRAMES, items, **SHARED)))
    assert [s.info.thickness_mm for s in slices] == [1.25, 5, 1.25, 1.25]


def test_one_bad_frame_is_one_unreadable_slice(tmp_path: Path) -> None:
    items = frame_items()
    items[2]["PixelMeasuresSequence"] = item(PixelSpacing=[0.5, -1], SliceThickness=5)
    slices = list(open_images([write_dicom(tmp_path / "a.dcm", enhanced_ct(FRAMES, items, **SHARED))]))
    bad = [s for s in slices if isinstance(s, UnreadableSlice)]
    assert [s.info.source for s in bad] == ["a.dcm#3"]
    assert bad[0].problem.startswith("Pixel Spacing (0028,0030)")
    assert len(slices) == N


def test_groups_for_fewer_frames_than_there_are(tmp_path: Path) -> None:
    write_dicom(tmp_path / "good.dcm")
    write_dicom(tmp_path / "bad.dcm", enhanced_ct(FRAMES, frame_items(range(3)), **SHARED))
    (problem,) = [s.problem for s in open_images([tmp_path]) if isinstance(s, UnreadableSlice)]
    assert "Per-Frame Functional Groups Sequence (5200,9230)" in problem


@pytest.mark.parametrize("compressed", [False, True])
def test_classic_multi_frame_in_time(tmp_path: Path, compressed: bool) -> None:
    ds = ct_slice(FRAMES, NumberOfFrames=N, FrameTime="250")
    if compressed:
        write_dicom(tmp_path / "plain.dcm", ds)  # gives the data set the file meta that compress() asks for
        (tmp_path / "plain.dcm").unlink()
        ds.compress(RLELossless)
    slices = read_slices(write_dicom(tmp_path / "a.dcm", ds, RLELossless if compressed else ExplicitVRLittleEndian))
    assert len(slices) == N
    times = np.array([s.info.time_s for s in slices], dtype=float)
    np.testing.assert_allclose(times - times[0], [0, 0.25, 0.5, 0.75])
    for slice_, frame in zip(slices, FRAMES, strict=True):
        np.testing.assert_array_equal(slice_.stored, frame)
        assert slice_.info.T_patient_slice is not None
        np.testing.assert_allclose(slice_.info.T_patient_slice[:3, 3], [-10, -20.5, 30.25])


def test_frame_time_vector(tmp_path: Path) -> None:
    ds = ct_slice(FRAMES, NumberOfFrames=N, FrameTimeVector=["0", "100", "300", "100"])
    times = np.array([s.info.time_s for s in read_slices(write_dicom(tmp_path / "a.dcm", ds))], dtype=float)
    np.testing.assert_allclose(times - times[0], [0, 0.1, 0.4, 0.5])


def test_frames_of_unknown_place_do_not_all_sit_where_the_first_does(tmp_path: Path) -> None:
    slices = read_slices(write_dicom(tmp_path / "a.dcm", ct_slice(FRAMES, NumberOfFrames=N)))
    assert [s.info.T_patient_slice for s in slices] == [None] * N
    assert all(s.info.scale is not None for s in slices)


def test_grid_frame_offsets_move_along_the_normal(tmp_path: Path) -> None:
    ds = ct_slice(FRAMES, NumberOfFrames=N, GridFrameOffsetVector=[0, 3, 6, 9])
    for k, slice_ in enumerate(read_slices(write_dicom(tmp_path / "a.dcm", ds))):
        assert slice_.info.T_patient_slice is not None
        np.testing.assert_allclose(slice_.info.T_patient_slice[:3, 3], [-10, -20.5, 30.25 + 3 * k])
