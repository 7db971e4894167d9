"""A DICOM registration refers to the image it was made from, whatever kind of image that is."""

from __future__ import annotations

import dataclasses
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pydicom
import pytest
from pydicom.uid import CTImageStorage

from ctreg_cli.errors import InputError
from ctreg_cli.interop.exports import write_export
from ctreg_cli.interop.selection import Content, select
from ctreg_cli.io.images import read_slices
from ctreg_cli.io.results import ResultsHeader
from ctreg_cli.io.results_document import document_of, record_of
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.pipeline import pose

from .senders import SAMPLES
from .sources import IMAGE_CLASSES, image_of_class


def posed(image: Path) -> Content:
    """Every slice of an image with its pose, in patient coordinates, as ``--with-uids`` keeps it."""
    model = load_rod_model(SAMPLES.parent / "frame.yaml")
    header = ResultsHeader(model=model)
    records = [record_of(result, header, with_uids=True) for result in pose(read_slices(image), model)]
    return select(document_of(header, records), space="patient", model=model)


@pytest.mark.parametrize("sop_class", list(IMAGE_CLASSES))
def test_the_class_is_that_of_the_image(sop_class: str, tmp_path: Path) -> None:
    image = image_of_class(sop_class, tmp_path)
    content, source = posed(image), pydicom.dcmread(image)
    n_frames = IMAGE_CLASSES[sop_class]
    assert len(content.usable) == n_frames
    paths = write_export(str(tmp_path / "r_{slice}.dcm"), content)
    for number, (path, record) in enumerate(zip(paths, content.usable, strict=True), start=1):
        ds = pydicom.dcmread(path)
        (image_item,) = ds.RegistrationSequence[0].ReferencedImageSequence
        (series_item,) = ds.ReferencedSeriesSequence[0].ReferencedInstanceSequence
        for reference in (image_item, series_item):
            assert reference.ReferencedSOPClassUID == source.SOPClassUID == sop_class
            assert reference.ReferencedSOPInstanceUID == source.SOPInstanceUID
            assert reference.get("ReferencedFrameNumber") == (number if n_frames > 1 else None)
        (matrix,) = ds.RegistrationSequence[1].MatrixRegistrationSequence[0].MatrixSequence
        read = np.array(matrix.FrameOfReferenceTransformationMatrix, dtype=float).reshape(4, 4)
        np.testing.assert_allclose(read, content.pose(record), atol=1e-9)
        if shutil.which("dciodvfy"):
            done = subprocess.run(["dciodvfy", str(path)], capture_output=True, text=True, timeout=30)
            assert "SpatialRegistration" in done.stderr + done.stdout
            assert not [line for line in (done.stderr + done.stdout).splitlines() if line.startswith("Error")]


@pytest.mark.parametrize(("name", "value"), [("sop_class", ""), ("sop_instance", "1.2.x"), ("study_instance", "1.02")])
def test_no_reference_is_made_up(name: str, value: str, tmp_path: Path) -> None:
    content = posed(image_of_class(CTImageStorage, tmp_path))
    (record,) = content.document.records
    changed = dataclasses.replace(record, uids={**record.uids, name: value})
    document = dataclasses.replace(content.document, records=(changed,))
    with pytest.raises(InputError, match=rf"no valid {name} UID.*--with-uids"):
        write_export(str(tmp_path / "r.dcm"), select(document))
    assert not (tmp_path / "r.dcm").exists()
