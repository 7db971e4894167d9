"""DICOM files of simulated slices: valid, lossless, consistent in the patient, and the same every time."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pydicom
import pytest

from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import InputError
from ctreg_cli.imaging.slice import Slice, SliceInfo
from ctreg_cli.io.dicom_writer import SeriesIdentity, ct_dataset, write_ct_slice
from ctreg_cli.scale import Scale
from ctreg_cli.simulation.motion import MotionSettings, advance, move, slice_times
from ctreg_cli.simulation.phantom import SimulatedSlice
from ctreg_cli.simulation.series import simulate_series
from ctreg_cli.simulation.start import parse_orientation
from tests.simulation.scenes import bare, pose_near_middle, small_frame

IDENTITY = SeriesIdentity(entropy="a test")


def series(orientation: str, n: int = 2, **changes: object) -> list[SimulatedSlice]:
    settings, rng = bare(noise_hu=5.0, **changes), np.random.default_rng(1)
    start = pose_near_middle(settings, rng, 0.3)
    trajectory = advance(move(start, small_frame().centre, slice_times(n, 0.3), MotionSettings(), rng), 1.5)
    return list(simulate_series(small_frame(), trajectory, settings, parse_orientation(orientation), rng))


def written(simulated: SimulatedSlice, path: Path, number: int = 1) -> pydicom.Dataset:
    write_ct_slice(path, simulated.slice, instance_number=number, identity=IDENTITY)
    return pydicom.dcmread(path)


def patient_point(ds: pydicom.Dataset, uv: FloatArray) -> FloatArray:
    """PS3.3 C.7.6.2.1.1: the patient coordinates of a pixel, from the tags alone."""
    x, y = (np.array(ds.ImageOrientationPatient[k : k + 3], float) for k in (0, 3))
    row_spacing, column_spacing = (float(v) for v in ds.PixelSpacing)
    origin = np.array(ds.ImagePositionPatient, float)
    point: FloatArray = origin + x * column_spacing * uv[0] + y * row_spacing * uv[1]
    return point


@pytest.mark.parametrize("orientation", ["axial", "coronal", "21,-13,44"])
def test_a_rod_is_in_the_patient_where_its_pose_puts_it(orientation: str, tmp_path: Path) -> None:
    model = small_frame()
    for i, simulated in enumerate(series(orientation)):
        ds = written(simulated, tmp_path / f"{i}.dcm")
        T_patient_slice = simulated.slice.info.T_patient_slice
        assert T_patient_slice is not None
        T_patient_model = T_patient_slice @ simulated.T_slice_model
        assert len(simulated.rod_index) >= 5
        for rod, uv, lambda_mm in zip(simulated.rod_index, simulated.uv_px, simulated.lambda_mm, strict=True):
            on_rod = model.starts[rod] + lambda_mm * model.directions[rod]
            expected = T_patient_model[:3, :3] @ on_rod + T_patient_model[:3, 3]
            assert np.allclose(patient_point(ds, uv), expected, atol=1e-8)


def test_pixels_scale_padding_and_time_come_back(tmp_path: Path) -> None:
    for i, simulated in enumerate(series("axial", padding=True, metal_hu=16000.0)):
        ds = written(simulated, tmp_path / f"{i}.dcm", i + 1)
        assert np.array_equal(ds.pixel_array, simulated.slice.stored)
        assert [float(v) for v in ds.PixelSpacing] == [0.53, 0.41]
        assert ds["PixelPaddingValue"].VR == "SS"
        assert ds.PixelPaddingValue == simulated.slice.stored[0, 0]
        hu = ds.pixel_array * float(ds.RescaleSlope) + float(ds.RescaleIntercept)
        assert hu.max() == 3071
        seconds = float(str(ds.AcquisitionTime)[4:])
        assert seconds == pytest.approx(0.3 * i)
        assert ds.ContentTime == ds.AcquisitionTime


def test_only_the_constant_patient_is_written(tmp_path: Path) -> None:
    ds = written(series("axial", n=1)[0], tmp_path / "a.dcm")
    assert (str(ds.PatientName), ds.PatientID) == ("SIMULATED", "SIMULATED")
    assert not any((ds.PatientBirthDate, ds.AccessionNumber, ds.ReferringPhysicianName))


def test_the_same_slice_has_the_same_bytes_and_identity_follows_the_entropy(tmp_path: Path) -> None:
    simulated = series("axial", n=1)[0]
    first, again = (written(simulated, tmp_path / name) for name in ("a.dcm", "b.dcm"))
    assert (tmp_path / "a.dcm").read_bytes() == (tmp_path / "b.dcm").read_bytes()
    next_one = ct_dataset(simulated.slice, instance_number=2, identity=IDENTITY)
    other = ct_dataset(simulated.slice, instance_number=1, identity=SeriesIdentity(entropy="another"))
    assert first.SeriesInstanceUID == again.SeriesInstanceUID == next_one.SeriesInstanceUID
    uids = {str(first.SOPInstanceUID), str(next_one.SOPInstanceUID), str(other.SOPInstanceUID)}
    uids |= {str(ds[name].value) for ds in (first, other) for name in ("StudyInstanceUID", "SeriesInstanceUID")}
    assert len(uids) == 7


def test_a_time_past_midnight_goes_on_in_the_next_day() -> None:
    simulated = series("axial", n=1)[0]
    info = SliceInfo(
        source="late.dcm",
        time_s=24 * 3600 + 1.25,
        scale=simulated.slice.info.scale,
        T_patient_slice=simulated.slice.info.T_patient_slice,
    )
    ds = ct_dataset(Slice(info=info, stored=simulated.slice.stored), instance_number=1, identity=IDENTITY)
    assert (ds.AcquisitionDate, ds.AcquisitionTime) == ("20000102", "000001.250000")


@pytest.mark.parametrize("lack", ["scale", "place", "type"])
def test_a_slice_that_is_no_ct_image_is_refused(lack: str) -> None:
    info = SliceInfo(
        source="x.png",
        scale=None if lack == "scale" else Scale(s_x=1, s_y=1),
        T_patient_slice=None if lack == "place" else np.eye(4),
    )
    stored = np.zeros((16, 16), np.uint8 if lack == "type" else np.int16)
    with pytest.raises(InputError, match=r"x\.png"):
        ct_dataset(Slice(info=info, stored=stored), instance_number=1, identity=IDENTITY)


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        write_ct_slice(
            tmp_path / "nowhere" / "a.dcm", series("axial", n=1)[0].slice, instance_number=1, identity=IDENTITY
        )


@pytest.mark.skipif(shutil.which("dciodvfy") is None, reason="dciodvfy (Debian package dicom3tools) is not installed")
@pytest.mark.parametrize("orientation", ["axial", "sagittal", "21,-13,44"])
@pytest.mark.parametrize("padding", [True, False])
def test_an_independent_verifier_finds_no_error(orientation: str, padding: bool, tmp_path: Path) -> None:
    for i, simulated in enumerate(series(orientation, padding=padding, thickness_mm=1 / 3)):
        path = tmp_path / f"{i}.dcm"
        written(simulated, path, i + 1)
        run = subprocess.run(["dciodvfy", str(path)], capture_output=True, text=True, check=False)
        report = run.stdout + run.stderr
        assert "CTImage" in report
        assert "Error" not in report
