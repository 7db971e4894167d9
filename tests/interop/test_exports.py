"""Every export says what the results say, according to a reader that shares nothing with the writer."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from ctreg_cli.errors import InputError
from ctreg_cli.interop.exports import FORMATS, check_export, write_export
from ctreg_cli.interop.selection import Content, Space, select
from ctreg_cli.io.results_document import read_document

from .documents import SCALE_MM, STATUSES, document_text, frame, patient_from_slice, written

OK = [index for index, status in enumerate(STATUSES) if status == "ok"]


@pytest.fixture
def content(tmp_path: Path) -> Content:
    return select(read_document(written(tmp_path)), model=frame())


def in_slice(tmp_path: Path) -> Content:
    return select(read_document(written(tmp_path)), model=frame(), space="slice")


def poses(content: Content) -> np.ndarray:
    return np.array([content.pose(record) for record in content.usable])


@pytest.mark.parametrize("space", ["slice", "patient"])
def test_itk_maps_points_back_to_the_model(tmp_path: Path, space: Space) -> None:
    sitk = pytest.importorskip("SimpleITK")
    content = select(read_document(written(tmp_path)), space=space)
    paths = write_export(str(tmp_path / "p_{slice}.tfm"), content)
    assert [path.name for path in paths] == [f"p_{index:04d}.tfm" for index in OK]
    points = np.random.default_rng(1).uniform(-50, 50, (5, 3))
    for path, T in zip(paths, poses(content), strict=True):
        assert "to model coordinates" in path.read_text(encoding="ascii")
        transform = sitk.ReadTransform(str(path))
        for point in points:
            seen = T[:3, :3] @ point + T[:3, 3]
            np.testing.assert_allclose(transform.TransformPoint(seen.tolist()), point, atol=1e-9)


def test_markups_hold_spots_on_rods_in_the_patient(content: Content, tmp_path: Path) -> None:
    """A spot stands where the pixel is in the patient; a rod's ends where the pose puts them; all in LPS."""
    path = tmp_path / "m.mrk.json"
    write_export(str(path), content, index=OK[1])
    document = json.loads(path.read_text(encoding="utf-8"))
    nodes = {node["name"]: node for node in document["markups"]}
    record = content.document.records[OK[1]]
    spots = nodes[f"spots of slice {record.index}"]["controlPoints"]
    to_slice = np.linalg.inv(patient_from_slice())
    for match, spot in zip(record.matches, spots, strict=True):
        place = to_slice @ [*spot["position"], 1]
        np.testing.assert_allclose(place[:3], [match.u_px * SCALE_MM[0], match.v_px * SCALE_MM[1], 0], atol=1e-9)
        assert spot["label"] == match.rod
    to_model = np.linalg.inv(content.pose(record))
    for rod in frame().rods:
        start, end = ((to_model @ [*point["position"], 1])[:3] for point in nodes[rod.id]["controlPoints"])
        np.testing.assert_allclose([start, end], [rod.start, rod.end], atol=1e-9)
    (target,) = nodes[f"targets of slice {record.index}"]["controlPoints"]
    np.testing.assert_allclose((to_slice @ [*target["position"], 1])[:3], [1, 2, 3], atol=1e-9)
    assert {node["coordinateSystem"] for node in nodes.values()} == {"LPS"}


#: the part of 3D Slicer's markups-schema-v1.0.3.json that these files touch
MARKUPS_SCHEMA = {
    "type": "object",
    "required": ["@schema", "markups"],
    "properties": {
        "@schema": {"type": "string", "pattern": "markups-schema-v1.0.3.json#$"},
        "markups": {
            "type": "array",
            "minItems": 1,
            "items": {
                "type": "object",
                "required": ["type"],
                "properties": {
                    "type": {"enum": ["Fiducial", "Line", "Angle", "Curve", "ClosedCurve", "Plane", "ROI"]},
                    "name": {"type": "string"},
                    "coordinateSystem": {"enum": ["LPS", "RAS"]},
                    "coordinateUnits": {"enum": ["mm", "um"]},
                    "locked": {"type": "boolean"},
                    "controlPoints": {
                        "type": "array",
                        "items": {
                            "type": "object",
                            "properties": {
                                "id": {"type": "string"},
                                "label": {"type": "string"},
                                "description": {"type": "string"},
                                "position": {
                                    "type": "array",
                                    "items": {"type": "number"},
                                    "minItems": 3,
                                    "maxItems": 3,
                                },
                                "positionStatus": {"const": "defined"},
                                "locked": {"type": "boolean"},
                            },
                            "required": ["position", "positionStatus"],
                            "additionalProperties": False,
                        },
                    },
                },
                "additionalProperties": False,
            },
        },
    },
}


def test_markups_keep_to_the_schema(content: Content, tmp_path: Path) -> None:
    from jsonschema import validate

    for path in write_export(str(tmp_path / "m{slice}.mrk.json"), content):
        validate(json.loads(path.read_text(encoding="utf-8")), MARKUPS_SCHEMA)


def test_transform_sequence_is_in_ras_and_lost_frames_have_no_matrix(content: Content, tmp_path: Path) -> None:
    path = tmp_path / "t.seq.mha"
    write_export(str(path), content)
    fields = dict(line.split(" = ", 1) for line in path.read_text(encoding="ascii").splitlines())
    flip = np.diag([-1.0, -1, 1, 1])
    for index, status in enumerate(STATUSES):
        name = f"Seq_Frame{index:04d}_ModelToPatientTransform"
        assert float(fields[f"Seq_Frame{index:04d}_Timestamp"]) == 36000 + 0.25 * index
        assert fields[f"{name}Status"] == ("OK" if status == "ok" else "INVALID")
        assert (name in fields) == (status == "ok")
        if status == "ok":
            M = np.array(fields[name].split(), dtype=float).reshape(4, 4)
            np.testing.assert_allclose(flip @ M @ flip, content.pose(content.document.records[index]), atol=1e-9)
    assert fields["DimSize"] == f"0 0 {len(STATUSES)}"


def test_times_and_numbers_never_mix(tmp_path: Path) -> None:
    """A slice without a time leaves the sequence. Only where no pose has one do all slices go by their number."""

    def stamps(*timeless: int) -> list[float]:
        data = json.loads(document_text())
        for index in timeless:
            data["results"][index]["time_s"] = None
        (tmp_path / "r.json").write_text(json.dumps(data), encoding="utf-8")
        content = select(read_document(tmp_path / "r.json"))
        write_export(str(tmp_path / "t.seq.mha"), content)
        write_export(str(tmp_path / "t.tum"), content)
        lines = (tmp_path / "t.seq.mha").read_text(encoding="ascii").splitlines()
        found = [float(line.split(" = ")[1]) for line in lines if "_Timestamp" in line]
        assert f"DimSize = 0 0 {len(found)}" in lines
        assert set(np.loadtxt(tmp_path / "t.tum")[:, 0]) <= set(found)
        return found

    seconds = [36000 + 0.25 * index for index in range(len(STATUSES))]
    lost = STATUSES.index("no_pose")
    for gone in (lost, OK[0]):
        assert stamps(gone) == [time_s for index, time_s in enumerate(seconds) if index != gone]
    assert stamps(*OK) == list(range(len(STATUSES)))


def test_tum_and_kitti_are_metres(content: Content, tmp_path: Path) -> None:
    write_export(str(tmp_path / "t.tum"), content)
    write_export(str(tmp_path / "t.kitti"), content)
    tum, kitti = np.loadtxt(tmp_path / "t.tum"), np.loadtxt(tmp_path / "t.kitti")
    np.testing.assert_allclose(tum[:, 0], [36000 + 0.25 * index for index in OK])
    np.testing.assert_allclose(1000 * tum[:, 1:4], poses(content)[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(Rotation.from_quat(tum[:, 4:]).as_matrix(), poses(content)[:, :3, :3], atol=1e-12)
    read = kitti.reshape(-1, 3, 4) * [1, 1, 1, 1000]
    np.testing.assert_allclose(read, poses(content)[:, :3], atol=1e-9)


def test_evo_takes_the_trajectory(content: Content, tmp_path: Path) -> None:
    evo = shutil.which("evo_traj") or shutil.which("evo_traj", path=str(Path(sys.executable).parent))
    if evo is None:
        pytest.skip("the program evo_traj is not installed")
    write_export(str(tmp_path / "t.tum"), content)
    home = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(  # a program of its own, for its licence
        [evo, "tum", str(tmp_path / "t.tum"), "--full_check"], capture_output=True, text=True, env=home, timeout=60
    )
    assert "SE(3) conform\tyes" in done.stdout, done.stdout + done.stderr


def test_tf_json_maps_the_child_to_the_parent(content: Content, tmp_path: Path) -> None:
    path = tmp_path / "t.tf.json"
    write_export(str(path), content)
    for T, entry in zip(poses(content), json.loads(path.read_text(encoding="utf-8"))["transforms"], strict=True):
        translation, rotation = entry["transform"]["translation"], entry["transform"]["rotation"]
        np.testing.assert_allclose(1000 * np.array([translation[a] for a in "xyz"]), T[:3, 3], atol=1e-9)
        R = Rotation.from_quat([rotation[a] for a in "xyzw"]).as_matrix()
        np.testing.assert_allclose(R, T[:3, :3], atol=1e-12)
        assert entry["header"]["frame_id"] == "ctreg_patient"
        assert 0 <= entry["header"]["stamp"]["nanosec"] < 10**9


def test_mat_has_every_slice_with_its_status(content: Content, tmp_path: Path) -> None:
    path = tmp_path / "t.mat"
    write_export(str(path), content)
    read = loadmat(path)
    assert [str(cell[0][0]) for cell in read["status"]] == list(STATUSES)
    for index, record in enumerate(content.document.records):
        T = read["T_slice_model"][:, :, index]
        if record.T_slice_model is None:
            assert np.isnan(T).all()
            assert np.isnan(read["tx_mm"][index])
        else:
            np.testing.assert_array_equal(T, record.T_slice_model)
    assert read["covariance"].shape == (6, 6, len(STATUSES))


def test_parquet_has_types_and_nulls(content: Content, tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "t.parquet"
    write_export(str(path), content)
    table = pq.read_table(path)
    assert table["status"].to_pylist() == list(STATUSES)
    assert [value is None for value in table["tx_mm"].to_pylist()] == [s == "no_pose" for s in STATUSES]
    assert str(table.schema.field("n_spots").type) == "int64"
    assert str(table.schema.field("inflation").type) == "double"


def test_registration_is_sound_dicom(content: Content, tmp_path: Path) -> None:
    """pydicom finds the pose in it, in the slices' frame of reference; dciodvfy finds no error."""
    import pydicom

    paths = write_export(str(tmp_path / "r_{slice}.dcm"), content)
    for path, record in zip(paths, content.usable, strict=True):
        ds = pydicom.dcmread(path)
        assert ds.FrameOfReferenceUID == "2.25.12"
        slice_item, model_item = ds.RegistrationSequence
        (image,) = slice_item.ReferencedImageSequence
        assert image.ReferencedSOPInstanceUID == record.uids["sop_instance"]
        (matrix,) = model_item.MatrixRegistrationSequence[0].MatrixSequence
        read = np.array(matrix.FrameOfReferenceTransformationMatrix, dtype=float).reshape(4, 4)
        np.testing.assert_allclose(read, content.pose(record), atol=1e-9)
        assert model_item.FrameOfReferenceUID != ds.FrameOfReferenceUID
        assert not ds.PatientName
        assert not ds.PatientID
    assert len({str(pydicom.dcmread(path).SOPInstanceUID) for path in paths}) == len(paths)


@pytest.mark.skipif(shutil.which("dciodvfy") is None, reason="Debian package dicom3tools is not installed")
def test_dciodvfy_finds_no_error(content: Content, tmp_path: Path) -> None:
    (path,) = write_export(str(tmp_path / "r.dcm"), content, index=OK[0])
    done = subprocess.run(["dciodvfy", str(path)], capture_output=True, text=True, timeout=30)
    assert "SpatialRegistration" in done.stderr + done.stdout
    assert not [line for line in (done.stderr + done.stdout).splitlines() if line.startswith("Error")]


@pytest.mark.parametrize("suffix", list(FORMATS))
def test_poses_not_ok_never_leave_without_their_status(content: Content, tmp_path: Path, suffix: str) -> None:
    """In every format without a status column there are as many poses as ok slices."""
    kind = FORMATS[suffix]
    if kind.one_slice is None:
        return
    assert len(write_export(str(tmp_path / f"x{{slice}}{suffix}"), content)) == len(OK)
    with pytest.raises(InputError, match="ambiguous, and only ok"):
        write_export(str(tmp_path / f"x{suffix}"), content, index=1)
    with pytest.raises(InputError, match="no such slice"):
        write_export(str(tmp_path / f"x{suffix}"), content, index=77)


@pytest.mark.parametrize("suffix", [suffix for suffix, kind in FORMATS.items() if kind.one_slice])
def test_several_poses_want_several_names(content: Content, tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match=r"3 slices have a pose.*x_\{slice\}"):
        write_export(str(tmp_path / f"x{suffix}"), content)
    assert not list(tmp_path.glob(f"x*{suffix}"))


def test_patient_coordinates_must_be_known(tmp_path: Path) -> None:
    document = read_document(written(tmp_path, patient=False))
    assert select(document).space == "slice"
    with pytest.raises(InputError, match="--coordinates slice"):
        select(document, space="patient")


def test_registration_needs_uids(tmp_path: Path) -> None:
    content = select(read_document(written(tmp_path, with_uids=False)))
    with pytest.raises(InputError, match="--with-uids"):
        write_export(str(tmp_path / "r.dcm"), content, index=0)


def test_markups_need_the_frame(tmp_path: Path) -> None:
    content = select(read_document(written(tmp_path)))
    with pytest.raises(InputError, match="-m FRAME"):
        write_export(str(tmp_path / "m.mrk.json"), content, index=0)


def test_unknown_suffix_lists_those_there_are() -> None:
    with pytest.raises(InputError, match=r"\.tfm.*\.parquet"):
        check_export("x.xyz")


def test_a_full_disk_is_named_and_leaves_nothing(content: Content, tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    _, most = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    place = tmp_path / "t.parquet"
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, most))
    try:
        with pytest.raises(InputError, match=r"t\.parquet: cannot be written"):
            write_export(str(place), content)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]
