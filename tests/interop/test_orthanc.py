"""A real Orthanc: it sends slices to ``ctreg listen`` (C-MOVE), and keeps and returns a registration."""

from __future__ import annotations

import csv
import io
import json
import shutil
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pydicom
import pytest
from pydicom.uid import EnhancedCTImageStorage, MRImageStorage

from ctreg_cli.interop.exports import write_export

from .senders import LIMIT_S, SAMPLES, SLICES, free_port
from .sources import image_of_class
from .test_registration_object import posed

ORTHANC = shutil.which("Orthanc")
pytestmark = pytest.mark.skipif(ORTHANC is None, reason="Debian package orthanc is not installed")
N = 5


class Orthanc:
    """Its REST interface."""

    def __init__(self, port: int, dicom_port: int) -> None:
        self.address, self.dicom_port = f"http://127.0.0.1:{port}", dicom_port

    def call(self, path: str, data: bytes | None = None, method: str | None = None) -> Any:
        request = urllib.request.Request(self.address + path, data=data, method=method)
        with urllib.request.urlopen(request, timeout=LIMIT_S) as answer:
            body = answer.read()
        return json.loads(body) if answer.headers["Content-Type"].startswith("application/json") else body


@pytest.fixture(scope="module")
def orthanc(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Orthanc]:
    folder = tmp_path_factory.mktemp("orthanc")
    server = Orthanc(free_port(), free_port())
    settings = {
        "StorageDirectory": str(folder / "storage"),
        "IndexDirectory": str(folder / "storage"),
        "HttpPort": int(server.address.rpartition(":")[2]),
        "DicomPort": server.dicom_port,
        "RemoteAccessAllowed": False,
        "AuthenticationEnabled": False,
        "DicomCheckCalledAet": False,
        "DicomCheckModalityHost": False,
        "Plugins": [],
    }
    path = folder / "orthanc.json"
    path.write_text(json.dumps(settings), encoding="utf-8")
    assert ORTHANC is not None
    with (folder / "log").open("w") as log:
        process = subprocess.Popen([ORTHANC, str(path)], stdout=log, stderr=subprocess.STDOUT)
        try:
            end = time.monotonic() + LIMIT_S
            while True:
                try:
                    server.call("/system")
                    break
                except (urllib.error.URLError, ConnectionError):
                    assert time.monotonic() < end, (folder / "log").read_text()
                    time.sleep(0.1)
            yield server
        finally:
            process.terminate()
            process.wait(LIMIT_S)


@pytest.mark.parametrize("sop_class", [MRImageStorage, EnhancedCTImageStorage])
def test_registration_is_kept_and_returned(orthanc: Orthanc, tmp_path: Path, sop_class: str) -> None:
    """It is of the image's study, and refers to the image; the patient's fields stay empty."""
    image = image_of_class(sop_class, tmp_path)
    (path, *_) = write_export(str(tmp_path / "r_{slice}.dcm"), posed(image))
    kept = [orthanc.call("/instances", file.read_bytes()) for file in (image, path)]
    assert {answer["Status"] for answer in kept} <= {"Success", "AlreadyStored"}
    back = pydicom.dcmread(io.BytesIO(orthanc.call(f"/instances/{kept[1]['ID']}/file")))
    assert back == pydicom.dcmread(path)
    (reference,) = back.RegistrationSequence[0].ReferencedImageSequence
    source = pydicom.dcmread(io.BytesIO(orthanc.call(f"/instances/{kept[0]['ID']}/file")))
    assert (back.StudyInstanceUID, back.PatientID) == (source.StudyInstanceUID, "")
    assert (reference.ReferencedSOPClassUID, reference.ReferencedSOPInstanceUID) == (sop_class, source.SOPInstanceUID)
    assert orthanc.call(f"/instances/{kept[1]['ID']}/simplified-tags")["Modality"] == "REG"
    for answer in kept:
        orthanc.call(f"/instances/{answer['ID']}", method="DELETE")


@pytest.mark.skipif(shutil.which("movescu") is None, reason="Debian package dcmtk is not installed")
def test_orthanc_sends_to_the_listener(orthanc: Orthanc, tmp_path: Path) -> None:
    """The whole command, fed by a C-MOVE of another program; the poses are those of the files."""
    for path in SLICES[:N]:
        orthanc.call("/instances", path.read_bytes())
    port, table = free_port(), tmp_path / "poses.csv"
    frame_file = SAMPLES.parent / "frame.yaml"
    command = [
        "listen",
        "-m",
        frame_file,
        "--port",
        port,
        "--queue",
        "all",
        "--count",
        N,
        "--idle",
        LIMIT_S,
        "-o",
        table,
    ]
    listener = subprocess.Popen(
        [sys.executable, "-m", "ctreg_cli", *map(str, command)], stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    try:
        assert listener.stderr is not None
        assert listener.stderr.readline().startswith("listening as CTREG")
        modality = {"AET": "CTREG", "Host": "127.0.0.1", "Port": port}
        orthanc.call("/modalities/ctreg", json.dumps(modality).encode(), "PUT")
        series = [orthanc.call(f"/series/{name}") for name in orthanc.call("/series")]
        (ct,) = (entry for entry in series if entry["MainDicomTags"]["Modality"] == "CT")
        uid = ct["MainDicomTags"]["SeriesInstanceUID"]
        study = orthanc.call(f"/studies/{ct['ParentStudy']}")["MainDicomTags"]["StudyInstanceUID"]
        moved = subprocess.run(
            [
                *("movescu", "-S", "-aec", "ORTHANC", "-aet", "CTREG", "-aem", "CTREG"),
                *(
                    "-k",
                    "QueryRetrieveLevel=SERIES",
                    "-k",
                    f"StudyInstanceUID={study}",
                    "-k",
                    f"SeriesInstanceUID={uid}",
                ),
                *("127.0.0.1", str(orthanc.dicom_port)),
            ],
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
        )
        assert moved.returncode == 0, moved.stderr
        _, said = listener.communicate(timeout=2 * LIMIT_S)
    finally:
        listener.kill()
    assert listener.returncode == 0, said
    with table.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["ok"] * N
    # Orthanc sends in an order of its own: compare by the time of each slice
    truth = {float(f"{36000 + 0.25 * number}"): number for number in range(N)}
    assert {float(row["time_s"]) for row in rows} == set(truth)
    poses = json.loads((SAMPLES / "truth.json").read_text(encoding="utf-8"))
    for row in rows:
        T = poses[truth[float(row["time_s"])]]["T_slice_model"]
        for axis, name in enumerate(("tx_mm", "ty_mm", "tz_mm")):
            assert float(row[name]) == pytest.approx(T[axis][3], abs=0.3)
