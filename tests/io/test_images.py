"""Files and folders as one ordered set of slices: what is taken, in which order, and what is said of the rest."""

from __future__ import annotations

import copy
import os
import pickle
import tracemalloc
from dataclasses import replace
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from PIL import Image
from pydicom.data import get_testdata_file
from typer.testing import CliRunner

from ctreg_cli.cli.info import info
from ctreg_cli.errors import InputError, UnreadableSliceError
from ctreg_cli.imaging.slice import FileSlice, Slice, UnreadableSlice
from ctreg_cli.io.image_files import natural_key
from ctreg_cli.io.images import ImageSet, list_series, open_images, read_slices
from tests.io.dicom_samples import ct_slice, dicom_bytes, pixels, write_dicom


def sources(images: ImageSet) -> list[str]:
    return [item.info.source for item in images]


def write_series(folder: Path, n: int = 4, *, name: str = "s{}.dcm", **attributes: Any) -> None:
    """n axial slices, 5 mm and 1 s apart."""
    for k in range(n):
        own = {
            "InstanceNumber": k + 1,
            "ImagePositionPatient": [0, 0, 5 * k],
            "AcquisitionTime": f"1000{k:02d}",
            "SOPInstanceUID": f"1.2.{k}.{int.from_bytes(folder.name.encode(), 'big') % 10**9}",
        }
        write_dicom(folder / name.format(k), ct_slice(**{**own, **attributes}))


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """As it comes from the archive: one CT series among all that goes with it."""
    folder = tmp_path / "study"
    write_series(folder / "A", name="IM{}")
    write_series(folder / "scout", 2, SeriesInstanceUID="1.2.2", ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"])
    write_series(folder / "shot", 1, SeriesInstanceUID="1.2.3", SOPClassUID="1.2.840.10008.5.1.4.1.1.7", Modality="CT")
    write_series(folder / "pet", 5, SeriesInstanceUID="1.2.5", Modality="PT")
    for name in ("rtstruct.dcm", "test-SR.dcm", "DICOMDIR"):
        (folder / name).write_bytes(Path(str(get_testdata_file(name, download=False))).read_bytes())
    (folder / "README").write_text("text")
    (folder / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    return folder


def test_the_series_that_fits_is_taken_and_the_rest_counted(study: Path) -> None:
    images = open_images([study])
    assert sources(images) == [f"A/IM{k}" for k in range(4)]
    assert images.skipped == {"DICOM without an image": 3, "not an image": 2, "image of another series": 8}
    assert images.warnings == ()
    assert [(s.index, s.modality, s.kind, s.n_slices, s.chosen) for s in images.series] == [
        (1, "CT", "slice", 4, True),
        (2, "PT", "slice", 5, False),
        (3, "CT", "localizer", 2, False),
        (4, "CT", "capture", 1, False),
    ]
    (chosen,) = [s for s in images.series if s.chosen]
    assert (chosen.shape, chosen.spacing_mm, chosen.thickness_mm) == ((24, 32), (0.5, 0.75), 2.5)
    assert (chosen.orientation, chosen.span_mm, chosen.duration_s) == ("axial", 15, 3)


def test_another_series_by_its_number(study: Path) -> None:
    images = open_images([study], series=3)
    assert sources(images) == ["scout/s0.dcm", "scout/s1.dcm"]
    assert "series 3: this is a localizer, not a series of slices" in images.warnings
    with pytest.raises(InputError, match="there is no series 9; series found: 1: CT axial, 4 slices 32 × 24;"):
        open_images([study], series=9)


def test_two_that_fit_ask_for_a_choice(study: Path) -> None:
    write_series(study / "B", 3, SeriesInstanceUID="1.2.6", Modality="MR")
    with pytest.raises(InputError, match=r"2 series fit; choose one with --series N; series found: .*CT.*MR") as caught:
        open_images([study])
    assert len(str(caught.value).splitlines()) == 1
    listed = list_series([study])
    assert len(listed) == 0
    assert len(listed.series) == 5
    assert not any(s.chosen for s in listed.series)
    number = next(s.index for s in listed.series if s.modality == "MR")
    assert sources(open_images([study], series=number)) == ["B/s0.dcm", "B/s1.dcm", "B/s2.dcm"]


def test_each_folder_has_its_own_choice_and_files_are_all_taken(tmp_path: Path) -> None:
    write_series(tmp_path / "a", 3)
    write_series(tmp_path / "b", 2, SeriesInstanceUID="1.2.6")
    images = open_images([tmp_path / "b", tmp_path / "a"])
    assert sources(images) == ["s0.dcm", "s1.dcm", "s0.dcm", "s1.dcm", "s2.dcm"]
    assert [item.info.series for item in images] == ["1", "1", "2", "2", "2"]
    assert any("2 series" in warning for warning in images.warnings)
    files = [tmp_path / "a" / "s2.dcm", tmp_path / "b" / "s0.dcm", tmp_path / "a" / "s1.dcm"]
    assert sources(open_images(files)) == ["s1.dcm", "s2.dcm", "s0.dcm"]


def test_one_bad_file_of_each_kind_does_not_end_the_run(tmp_path: Path) -> None:
    write_series(tmp_path, 3)
    good = (tmp_path / "s1.dcm").read_bytes()
    (tmp_path / "cut in the pixels.dcm").write_bytes(good[:-10])
    (tmp_path / "cut in the header.dcm").write_bytes(good[:300])
    (tmp_path / "notes.txt").write_text("text")
    Image.new("L", (8, 8)).save(tmp_path / "picture.png")
    images = open_images([tmp_path])
    assert sources(images) == ["s0.dcm", "cut in the pixels.dcm", "s1.dcm", "s2.dcm", "cut in the header.dcm"]
    assert [isinstance(item, UnreadableSlice) for item in images] == [False, True, False, False, True]
    assert images.skipped == {"not an image": 1, "PNG beside DICOM": 1}
    assert "series 1: 1 of 4 images cannot be read; cut in the pixels.dcm: Pixel Data (7FE0,0010)" in "".join(
        images.warnings
    )
    assert any("1 PNG file beside a DICOM series left out" in warning for warning in images.warnings)


def test_a_file_cut_within_its_series_uid_is_not_of_another_series(tmp_path: Path) -> None:
    write_series(tmp_path, 2)
    good = (tmp_path / "s1.dcm").read_bytes()
    at = good.index(b"\x20\x00\x0e\x00UI")
    for cut in range(at, at + 16):
        (tmp_path / "cut.dcm").write_bytes(good[:cut])
        assert sources(open_images([tmp_path])) == ["s0.dcm", "s1.dcm", "cut.dcm"]


def test_an_unreadable_slice_without_a_time_comes_last_of_its_series(tmp_path: Path) -> None:
    write_series(tmp_path, 3)
    broken = ct_slice(AcquisitionTime=None, ContentTime=None, InstanceNumber=None, PixelSpacing=[0, 0])
    write_dicom(tmp_path / "a.dcm", broken)
    images = open_images([tmp_path])
    assert sources(images) == ["s0.dcm", "s1.dcm", "s2.dcm", "a.dcm"]
    assert [item.info.time_s for item in images] == [36000, 36001, 36002, None]


def test_a_series_without_a_readable_image_fits_least(tmp_path: Path) -> None:
    write_series(tmp_path / "colour", 3, SeriesInstanceUID="1.2.6", PhotometricInterpretation="RGB")
    write_series(tmp_path / "scout", 1, SeriesInstanceUID="1.2.7", ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"])
    assert sources(open_images([tmp_path])) == ["scout/s0.dcm"]
    write_series(tmp_path / "slices", 1)
    assert sources(open_images([tmp_path])) == ["slices/s0.dcm"]


def test_as_many_png_as_dicom_ask_for_a_choice(tmp_path: Path) -> None:
    write_series(tmp_path, 2)
    for k in range(2):
        Image.new("L", (8, 8)).save(tmp_path / f"{k}.png")
    with pytest.raises(InputError, match="--series N"):
        open_images([tmp_path])


def test_png_beside_a_scout_are_the_slices(tmp_path: Path) -> None:
    write_series(tmp_path, 1, ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"])
    for k in range(2):
        Image.new("L", (8, 8)).save(tmp_path / f"{k}.png")
    assert sources(open_images([tmp_path])) == ["0.png", "1.png"]


def test_sized_lazy_and_repeatable(tmp_path: Path) -> None:
    write_series(tmp_path, 3)
    images = open_images([tmp_path])
    assert len(images) == 3
    first, second = list(images), list(images)
    for a, b in zip(first, second, strict=True):
        assert isinstance(a, Slice)
        assert isinstance(b, Slice)
        np.testing.assert_array_equal(a.stored, b.stored)
        assert a.stored is not b.stored
        with pytest.raises(ValueError, match="read-only"):
            a.stored[0, 0] = 1


# ------------------------------------------------------------------------------------------------------------- order


def test_time_goes_before_instance_number_and_name(tmp_path: Path) -> None:
    for name, time, instance in (("a", "100003", 1), ("b", "100001", 2), ("c", "100002", 3)):
        write_dicom(tmp_path / name, ct_slice(AcquisitionTime=time, InstanceNumber=instance))
    images = open_images([tmp_path])
    assert sources(images) == ["b", "c", "a"]
    assert [item.info.time_s for item in images] == [36001, 36002, 36003]


def test_instance_number_goes_before_name(tmp_path: Path) -> None:
    for name, instance in (("a", 10), ("b", 9), ("c", 2)):
        write_dicom(tmp_path / name, ct_slice(AcquisitionTime=None, ContentTime=None, InstanceNumber=instance))
    images = open_images([tmp_path])
    assert sources(images) == ["c", "b", "a"]
    assert [item.info.time_s for item in images] == [None] * 3


def test_natural_name_where_there_is_neither(tmp_path: Path) -> None:
    for name in ("s10", "s2", "S1"):
        write_dicom(tmp_path / name, ct_slice(AcquisitionTime=None, ContentTime=None, InstanceNumber=None))
    assert sources(open_images([tmp_path])) == ["S1", "s2", "s10"]


def test_one_missing_time_leaves_time_out_of_the_order_and_is_mentioned(tmp_path: Path) -> None:
    write_series(tmp_path, 3)
    write_dicom(tmp_path / "s1.dcm", ct_slice(InstanceNumber=2, AcquisitionTime=None, ContentTime=None))
    images = open_images([tmp_path])
    assert sources(images) == ["s0.dcm", "s1.dcm", "s2.dcm"]
    assert [item.info.time_s for item in images] == [36000, None, 36002]
    assert any("some slices have no time" in warning for warning in images.warnings)


def test_times_that_would_run_back_are_left_out(tmp_path: Path) -> None:
    for name, time, instance in (("a", "100003", 1), ("b", None, 2), ("c", "100002", 3)):
        write_dicom(tmp_path / name, ct_slice(AcquisitionTime=time, ContentTime=None, InstanceNumber=instance))
    images = open_images([tmp_path])
    assert sources(images) == ["a", "b", "c"]
    assert [item.info.time_s for item in images] == [None] * 3


def test_equal_instance_numbers(tmp_path: Path) -> None:
    for k in range(3):
        path = tmp_path / f"{k}"
        write_dicom(path, ct_slice(AcquisitionTime=None, ContentTime=None, ImagePositionPatient=[0, 0, k]))
    images = open_images([tmp_path])
    assert sources(images) == ["0", "1", "2"]
    assert any("the same Instance Number" in warning for warning in images.warnings)


def test_order_does_not_depend_on_the_order_of_the_arguments(tmp_path: Path) -> None:
    write_series(tmp_path, 5)
    files = sorted(tmp_path.iterdir())
    for seed in range(5):
        shuffled = [files[k] for k in np.random.default_rng(seed).permutation(5)]
        assert sources(open_images(shuffled)) == [path.name for path in files]


@pytest.mark.parametrize(
    "names",
    [["s2", "s10"], ["a/9", "a/10", "b/1"], ["1", "a"], ["x", "x1"], ["IM-0001-0002", "IM-0001-0010"]],
)
def test_natural_key(names: list[str]) -> None:
    backwards = list(reversed(names))
    assert sorted(backwards, key=natural_key) == names


# ---------------------------------------------------------------------------------------------------------- warnings


def test_doubled_files(tmp_path: Path) -> None:
    write_series(tmp_path, 2)
    (tmp_path / "copy.dcm").write_bytes((tmp_path / "s1.dcm").read_bytes())
    images = open_images([tmp_path])
    assert len(images) == 3
    assert any("twice" in warning for warning in images.warnings)


def test_the_same_place_at_the_same_time(tmp_path: Path) -> None:
    write_series(tmp_path, 3, ImagePositionPatient=[0, 0, 0], AcquisitionTime="10", ContentTime="10")
    assert any("the same place at the same time" in warning for warning in open_images([tmp_path]).warnings)


def test_the_same_place_at_other_times_is_no_defect(tmp_path: Path) -> None:
    write_series(tmp_path, 3, ImagePositionPatient=[0, 0, 0])
    assert open_images([tmp_path]).warnings == ()


def test_gaps(tmp_path: Path) -> None:
    write_series(tmp_path, 5)
    (tmp_path / "s2.dcm").unlink()
    assert any("gaps: neighbours are 5 to 10 mm apart" in warning for warning in open_images([tmp_path]).warnings)


def test_mixed_orientations_sizes_and_spacings(tmp_path: Path) -> None:
    write_series(tmp_path, 3)
    write_dicom(
        tmp_path / "s1.dcm",
        ct_slice(pixels(10, 10), InstanceNumber=2, ImageOrientationPatient=[1, 0, 0, 0, 0, -1], PixelSpacing=[1, 1]),
    )
    images = open_images([tmp_path])
    assert len(images) == 3
    text = "; ".join(images.warnings)
    assert "differ in orientation" in text
    assert "differ in size" in text
    assert "differ in Pixel Spacing" in text
    assert images.series[0].orientation == "mixed"
    assert images.series[0].shape is None


# ------------------------------------------------------------------------------------------------------------ errors


def test_no_such_path(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere: no such file or folder"):
        open_images([tmp_path / "nowhere"])


def test_nothing_usable(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("text")
    with pytest.raises(InputError, match="no DICOM or PNG image found \\(1 × not an image\\); give CT slices"):
        open_images([tmp_path])
    with pytest.raises(InputError, match="no input given"):
        open_images([])


def test_all_unreadable(tmp_path: Path) -> None:
    for k in range(3):
        (tmp_path / f"{k}.dcm").write_bytes(dicom_bytes(ct_slice())[:-9])
    with pytest.raises(UnreadableSliceError, match=r"none of the 3 images can be read; the first, 0\.dcm: Pixel Data"):
        open_images([tmp_path])
    assert list_series([tmp_path]).series[0].n_unreadable == 3


def test_all_unreadable_in_several_series(tmp_path: Path) -> None:
    for k in range(3):
        write_dicom(tmp_path / f"{k}.dcm", ct_slice(SeriesInstanceUID=f"1.2.{k}", PhotometricInterpretation="RGB"))
    with pytest.raises(UnreadableSliceError, match=r"none of the 3 images can be read; the first, 0\.dcm: Photometric"):
        open_images([tmp_path])


def test_read_slices_wants_them_all(tmp_path: Path) -> None:
    write_series(tmp_path, 2)
    assert [s.info.source for s in read_slices(str(tmp_path))] == ["s0.dcm", "s1.dcm"]
    (tmp_path / "s1.dcm").write_bytes(dicom_bytes(ct_slice())[:-9])
    with pytest.raises(UnreadableSliceError, match=r"^s1\.dcm: Pixel Data"):
        read_slices(tmp_path)


# ------------------------------------------------------------------------------------------------- the outside world


def test_pipes_and_links_do_not_hang(tmp_path: Path) -> None:
    write_series(tmp_path, 2)
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path)
    (tmp_path / "dangling.dcm").symlink_to(tmp_path / "gone")
    images = open_images([tmp_path])
    assert sources(images) == ["s0.dcm", "s1.dcm"]
    assert images.skipped == {"not a regular file": 2}


def test_files_and_folders_that_may_not_be_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As for a user without permission; root, who may run the tests, is refused nothing."""
    write_series(tmp_path, 2)
    write_dicom(tmp_path / "mine")
    (tmp_path / "closed").mkdir()
    listed = os.scandir

    def refuse_file(path: Path) -> FileIO:
        if path.name == "mine":
            raise PermissionError(13, "Permission denied", str(path))
        return FileIO(path)

    def refuse_folder(path: str) -> Any:
        if Path(path) in refused:
            raise PermissionError(13, "Permission denied", str(path))
        return listed(path)

    refused = {tmp_path / "closed"}
    monkeypatch.setattr("ctreg_cli.io.images.FileIO", refuse_file)
    monkeypatch.setattr(os, "scandir", refuse_folder)
    images = open_images([tmp_path])
    assert sources(images) == ["s0.dcm", "s1.dcm", "mine"]
    assert "Permission denied" in images.warnings[-1]
    assert images.skipped == {"folder that cannot be opened": 1}
    refused.add(tmp_path)
    with pytest.raises(InputError, match="the folder cannot be opened \\(Permission denied\\)"):
        open_images([tmp_path])


def test_names_of_any_bytes_can_be_written(tmp_path: Path) -> None:
    write_dicom(tmp_path / os.fsdecode(b"caf\xe9\n.dcm"))
    (source,) = sources(open_images([tmp_path]))
    assert source == "caf\N{REPLACEMENT CHARACTER}\N{REPLACEMENT CHARACTER}.dcm"
    assert source.encode("utf-8")


@pytest.mark.parametrize("other", [copy.copy, copy.deepcopy, lambda item: pickle.loads(pickle.dumps(item)), replace])
def test_a_slice_that_has_not_been_read_can_be_copied_and_sent(tmp_path: Path, other: Any) -> None:
    write_dicom(tmp_path / "a.dcm", ct_slice(RescaleIntercept=-7))
    (item,) = open_images([tmp_path])
    assert isinstance(item, FileSlice)
    twin = other(item)
    assert isinstance(twin, Slice)
    (tmp_path / "a.dcm").unlink()
    np.testing.assert_array_equal(twin.stored, pixels())
    assert (twin.info.source, twin.slope, twin.intercept) == ("a.dcm", item.slope, -7.0)


def test_memory_does_not_grow_with_the_pixels(tmp_path: Path) -> None:
    """A slice costs a few kilobytes until it is read, and nothing once it has been let go."""
    n, allowed_bytes = 100, 6000
    stored = np.zeros((64, 64), "<i2")  # 8 KiB of pixels
    raw = dicom_bytes(ct_slice(stored))
    for k in range(n):
        (tmp_path / f"{k}.dcm").write_bytes(raw)
    open_images([tmp_path / "0.dcm"])  # imports and caches
    tracemalloc.start()
    try:
        images = open_images([tmp_path])
        before = tracemalloc.get_traced_memory()[0]
        for item in images:
            assert isinstance(item, Slice)
            _ = item.stored
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert before < n * allowed_bytes
    assert held - before < 2 * stored.nbytes
    assert peak < n * allowed_bytes * 2


# --------------------------------------------------------------------------------------------------------- ctreg info


@pytest.fixture
def run_info() -> Any:
    app = typer.Typer()
    app.command()(info)
    return lambda *arguments: CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_info_lists_the_series(study: Path, run_info: Any) -> None:
    result = run_info(study)
    assert result.exit_code == 0
    lines = [line.split() for line in result.stdout.splitlines()]
    assert ["1*", "CT", "slice", "4", "32", "x", "24", "0.5", "x", "0.75", "2.5", "axial", "15", "3"] in lines
    assert [line[:3] for line in lines[-4:]] == [
        ["1*", "CT", "slice"],
        ["2", "PT", "slice"],
        ["3", "CT", "localizer"],
        ["4", "CT", "capture"],
    ]
    assert "skipped: " in result.stderr
    assert "CANARY" not in result.output


def test_info_of_one_series_and_of_an_ambiguous_study(study: Path, run_info: Any) -> None:
    write_series(study / "B", 3, SeriesInstanceUID="1.2.6")
    everything = run_info(study)
    assert "*" not in everything.stdout
    assert "choose one with --series N" in everything.stderr
    assert "2*" in run_info(study, "--series", 2).stdout
