"""No text of a file gets out: not in slices, not in reasons, not in warnings, not in the list of series."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from pydicom import dcmread
from pydicom.datadict import DicomDictionary, keyword_for_tag
from pydicom.dataset import Dataset
from pydicom.tag import Tag
from typer.testing import CliRunner

from ctreg_cli.cli.app import app
from ctreg_cli.errors import InputError
from ctreg_cli.io.images import ImageSet, list_series, open_images
from tests.io.dicom_samples import CANARY, ct_slice, dicom_bytes, item, pixels, write_dicom

#: VRs that hold text a person may have typed, or that a writer may have put anything into
TEXT_VRS = {"AE", "AS", "CS", "DA", "DS", "DT", "IS", "LO", "LT", "PN", "SH", "ST", "TM", "UC", "UI", "UR", "UT"}
#: the text fields that are read at all
READ = (
    *("ImageType", "SOPClassUID", "SOPInstanceUID", "StudyInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID"),
    *("Modality", "InstanceNumber", "NumberOfFrames", "AcquisitionDateTime", "AcquisitionDate", "AcquisitionTime"),
    *("ContentDate", "ContentTime", "TriggerTime", "FrameTime", "FrameTimeVector", "GridFrameOffsetVector"),
    *("PixelSpacing", "SliceThickness", "ImagePositionPatient", "ImageOrientationPatient", "PhotometricInterpretation"),
    *("RescaleSlope", "RescaleIntercept", "LossyImageCompression"),
)


def everything_said(paths: list[Path]) -> str:
    """All text that reading these paths brings forth."""
    said = []
    for read in (open_images, list_series):
        try:
            images: ImageSet = read(paths)
        except InputError as error:
            said.append(str(error))
            continue
        said += [*images.warnings, *images.skipped, *map(str, images.series)]
        for one in images:
            fields = {field.name: getattr(one, field.name) for field in dataclasses.fields(one)}
            said.append(str({name: value for name, value in fields.items() if name != "stored"}))
    return "\n".join(said)


def canary_bytes(ds: Dataset, keyword: str) -> bytes:
    """The file with a canary in one field, whatever that field is for."""
    raw = dicom_bytes(ds)
    at = raw.index(Tag(keyword).group.to_bytes(2, "little") + Tag(keyword).element.to_bytes(2, "little"))
    length = int.from_bytes(raw[at + 6 : at + 8], "little")
    return raw[: at + 6] + (12).to_bytes(2, "little") + b"CANARYCANARY" + raw[at + 8 + length :]


@pytest.mark.parametrize("keyword", READ)
def test_a_canary_in_every_field_that_is_read(tmp_path: Path, keyword: str) -> None:
    filler: dict[str, Any] = {"NumberOfFrames": 1, "TriggerTime": 1, "FrameTime": 1, "LossyImageCompression": "00"}
    filler |= {"AcquisitionDateTime": "20240101", "FrameTimeVector": ["0"], "GridFrameOffsetVector": ["0"]}
    ds = ct_slice(**({keyword: filler[keyword]} if keyword in filler else {}))
    (tmp_path / "canary.dcm").write_bytes(canary_bytes(ds, keyword))
    assert CANARY in (tmp_path / "canary.dcm").read_bytes().decode("latin1")
    write_dicom(tmp_path / "good.dcm")
    for paths in ([tmp_path], [tmp_path / "canary.dcm"], [tmp_path / "canary.dcm", tmp_path / "good.dcm"]):
        assert CANARY not in everything_said(paths)


def test_canaries_in_all_other_text_fields(tmp_path: Path) -> None:
    ds = ct_slice()
    for tag, (vr, *_) in DicomDictionary.items():
        keyword = keyword_for_tag(tag)
        group = tag >> 16
        if vr in TEXT_VRS - {"DA", "DS", "DT", "IS", "TM", "UI"} and 0x0008 <= group < 0x7F00 and keyword not in READ:
            if keyword == "SpecificCharacterSet":
                continue
            ds.add_new(tag, vr, CANARY if vr != "AS" else "042Y")
    ds.RequestAttributesSequence = item(RequestedProcedureDescription=CANARY)
    ds.PatientBirthDate = "19660606"
    raw = dicom_bytes(ds)
    assert raw.count(CANARY.encode()) > 500
    (tmp_path / "a.dcm").write_bytes(raw)
    (tmp_path / "b.dcm").write_bytes(raw[:-7])
    said = everything_said([tmp_path])
    assert CANARY not in said
    assert "19660606" not in said
    assert "a.dcm" in said


def with_canaries(ds: Dataset, mark: str) -> Dataset:
    """The data set with ``mark`` in every text field that no image needs."""
    for tag, (vr, *_) in DicomDictionary.items():
        keyword = keyword_for_tag(tag)
        typed = vr in TEXT_VRS - {"AS", "DA", "DS", "DT", "IS", "TM", "UI"} and 0x0008 <= tag >> 16 < 0x7F00
        if typed and keyword not in {*READ, "SpecificCharacterSet"}:
            ds.add_new(tag, vr, mark)
    return ds


def test_no_output_of_any_command_depends_on_text_fields(tmp_path: Path) -> None:
    """Tables, documents and pictures are the same to the byte, whatever the text fields hold; none is quoted."""
    samples = Path(__file__).parents[2] / "sample_data"
    frame = samples / "frame.yaml"
    results = []
    for mark in (CANARY, "OTHER"):
        home = tmp_path / mark.lower()
        for number in range(2):
            ds = with_canaries(dcmread(samples / "track" / f"track_{number:03d}.dcm"), mark)
            (home / "in").mkdir(parents=True, exist_ok=True)
            ds.save_as(home / "in" / f"{number}.dcm")
        (home / "in" / "cut.dcm").write_bytes((home / "in" / "1.dcm").read_bytes()[:-9])
        said = []
        for command in ("info", "segment", "calibrate", "pose", "track"):
            arguments = [command, str(home / "in")]
            arguments += ["-m", str(frame)] if command in ("calibrate", "pose", "track") else []
            suffixes = {"info": [], "calibrate": ["yaml"]}.get(command, ["csv", "json", "jsonl"])
            for suffix in suffixes:
                arguments += ["-o", str(home / "out" / f"{command}.{suffix}")]
            arguments += ["--overlay", str(home / "out" / command)] if command in ("segment", "pose", "track") else []
            (home / "out").mkdir(exist_ok=True)
            said.append(run(*arguments, *(["-v"] if command != "info" else [])))
        said.append(run("segment", str(home / "in" / "cut.dcm")))
        written = {str(p.relative_to(home)): p.read_bytes() for p in sorted((home / "out").rglob("*")) if p.is_file()}
        assert len(written) == 3 * 3 + 1 + 3 * 2
        assert mark not in "".join(said)
        assert not [name for name, content in written.items() if mark.encode() in content]
        results.append(written)
    assert results[0] == results[1]


def test_no_text_of_a_png_gets_out(tmp_path: Path) -> None:
    note = PngInfo()
    note.add_text("Title", CANARY)
    note.add_text("Comment", CANARY, zip=True)
    Image.fromarray(pixels(64, 64, "<u2", 0)).save(tmp_path / "a.png", pnginfo=note)
    assert CANARY.encode() in (tmp_path / "a.png").read_bytes()
    said = run("segment", str(tmp_path / "a.png"), "-v", "--overlay", str(tmp_path / "out"), "-o", "-")
    said += everything_said([tmp_path / "a.png"])
    assert CANARY not in said
    picture = (tmp_path / "out" / "slice_0000.png").read_bytes()
    with Image.open(tmp_path / "out" / "slice_0000.png") as image:
        assert not image.info
    assert CANARY.encode() not in picture


def run(*arguments: str) -> str:
    """All that a command says; an exception that is no exit fails the test."""
    result = CliRunner().invoke(app, arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.output


def test_uids_are_in_their_one_place_only(tmp_path: Path) -> None:
    images = open_images([write_dicom(tmp_path / "a.dcm")])
    (slice_,) = images
    assert slice_.info.uids["series_instance"] == "1.2.3.4.1"
    instances = {"sop_instance", "series_instance", "study_instance", "frame_of_reference"}
    assert set(slice_.info.uids) == {"sop_class", *instances}
    rest = str(dataclasses.replace(slice_.info, uids={})) + str(images.series) + str(images.warnings)
    assert "1.2.3.4" not in rest


def test_dates_do_not_get_into_times(tmp_path: Path) -> None:
    (slice_,) = open_images([write_dicom(tmp_path / "a.dcm")])
    assert slice_.info.time_s == 10 * 3600 + 15 * 60 + 0.25
