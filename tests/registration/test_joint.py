"""One pose for a scan: at its bound, honest about the frame's tolerance, and no slice carried along blindly."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from ctreg_cli.errors import InputError, MissingScaleError
from ctreg_cli.geometry.pose import inverse
from ctreg_cli.imaging.spot_slice import SpotSlice
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.registration.joint import register_joint
from tests import oracle
from tests.registration.frames import frame_of, model_of
from tests.registration.scans import MM_PER_PX, Scan, make_scan


def frame_and_scan(rng: np.random.Generator, **options: object) -> tuple[oracle.OracleFrame, Scan]:
    frame = oracle.random_frame(rng, 8, size=60.0, height=80.0)
    return frame, make_scan(rng, frame, **options)  # type: ignore[arg-type]


def joint_bound(scan: Scan, frame: oracle.OracleFrame, sd_px: float) -> np.ndarray:
    """Cramér–Rao bound of the common pose, rods exact: informations of the slices, turned into patient axes, added."""
    information = np.zeros((6, 6))
    for item in scan.slices:
        T = np.linalg.inv(item.info.T_patient_slice) @ scan.T_patient_model
        seen = [
            i
            for i in range(len(frame))
            if oracle.cross_rod(scan.frame.starts[i], scan.frame.ends[i], T[:3, :3], T[:3, 3]) is not None
        ]
        J = oracle.numeric_jacobian(scan.frame, seen, T[:3, :3], T[:3, 3], np.array(MM_PER_PX))
        turn = np.kron(np.eye(2), item.info.T_patient_slice[:3, :3].T)
        information += turn.T @ J.T @ J @ turn / sd_px**2
    return np.linalg.inv(information)


def test_exact_rods_give_the_joint_bound() -> None:
    rng = np.random.default_rng(1)
    against_bound, against_own = [], []
    for _ in range(8):
        frame, scan = frame_and_scan(rng, sd_px=0.2, n_slices=3)
        joint = register_joint(scan.slices, model_of(frame))
        assert joint.status == "ok"
        assert len(joint.used) == 3
        error = scan.error(joint.T_patient_model)
        against_bound.append(error @ np.linalg.solve(joint_bound(scan, frame, 0.2), error) / 6)
        against_own.append(error @ np.linalg.solve(joint.covariance, error) / 6)
    allowed = 3 * np.sqrt(2 / 48)
    assert abs(np.mean(against_bound) - 1) < allowed
    assert abs(np.mean(against_own) - 1) < allowed


def test_a_frames_tolerance_does_not_average_out() -> None:
    """Error as large as the covariance says, and hardly smaller with three times the slices."""
    rng = np.random.default_rng(2)
    sds, normalised = [], []
    for n_slices in (2, 4):
        for _ in range(2):
            frame, scan = frame_and_scan(rng, tolerance_mm=0.3, n_slices=n_slices, sd_px=0.1)
            joint = register_joint(scan.slices, model_of(frame, tolerance_mm=0.3))
            error = scan.error(joint.T_patient_model)
            normalised.append(error @ np.linalg.solve(joint.covariance, error) / 6)
            sds.append(np.sqrt(np.trace(joint.covariance[:3, :3])))
    assert 0.5 < np.mean(normalised) < 1 + 3 * np.sqrt(2 / 24)
    assert np.median(sds[2:]) > 0.7 * np.median(sds[:2])


def test_every_row_is_the_joint_pose_in_its_own_axes() -> None:
    frame, scan = frame_and_scan(np.random.default_rng(3), tolerance_mm=0.1)
    joint = register_joint(scan.slices, model_of(frame, tolerance_mm=0.1))
    for item, row in zip(scan.slices, joint.slices, strict=True):
        assert row.status == "ok"
        best = row.candidates[0]
        np.testing.assert_allclose(item.info.T_patient_slice @ best.T_slice_model, joint.T_patient_model, atol=1e-9)
        turn = np.kron(np.eye(2), item.info.T_patient_slice[:3, :3])
        np.testing.assert_allclose(turn @ best.covariance @ turn.T, joint.covariance, atol=1e-12)
        T = inverse(item.info.T_patient_slice) @ scan.T_patient_model
        truth = np.array(
            [oracle.cross_line(frame.starts[i], frame.ends[i], T[:3, :3], T[:3, 3]) for i in best.rod_index]
        )
        assert np.abs(item.spots.uv_px[best.spot_index] - truth / MM_PER_PX).max() < 3  # rods are 20 px apart


def test_a_slice_that_denies_the_pose_is_named_and_left_out() -> None:
    """The patient moved before the last slice: 3 mm aside."""
    frame, scan = frame_and_scan(np.random.default_rng(4), n_slices=5)
    last = scan.slices[-1]
    moved = replace(last, spots=replace(last.spots, uv_px=last.spots.uv_px + np.array([6.0, 0.0])))
    joint = register_joint([*scan.slices[:-1], moved], model_of(frame))
    assert joint.status == "ok"
    assert joint.left_out == {4: "inconsistent"}
    assert joint.slices[4].status == "no_pose"
    assert joint.used == (0, 1, 2, 3)
    assert np.abs(scan.error(joint.T_patient_model) * [1, 1, 1, 60, 60, 60]).max() < 0.5


def test_a_slice_without_its_rods_denies_the_pose_and_one_beyond_the_rods_does_not() -> None:
    frame, scan = frame_and_scan(np.random.default_rng(5), n_slices=4)
    empty = Spots(uv_px=np.empty((0, 2)), covariance_px=np.empty((0, 2, 2)))
    bare = replace(scan.slices[1], spots=empty)
    beyond_place = np.array(scan.slices[3].info.T_patient_slice)
    beyond_place[:3, 3] += 100 * beyond_place[:3, 2]
    beyond = SpotSlice(info=replace(scan.slices[3].info, T_patient_slice=beyond_place), spots=empty)
    joint = register_joint([scan.slices[0], bare, scan.slices[2], beyond], model_of(frame))
    assert [row.status for row in joint.slices] == ["ok", "no_pose", "ok", "ok"]
    assert joint.slices[1].reason == "inconsistent"
    assert dict(joint.slices[3].warnings).keys() >= {"carried"}
    assert [math.isnan(joint.slices[place].candidates[0].rms_px) for place in (0, 2, 3)] == [False, False, True]


def test_slices_too_poor_to_register_alone_still_count() -> None:
    """Three rods left in a slice fix no pose alone; beside others they are matched where the pose says."""
    frame, scan = frame_and_scan(np.random.default_rng(6), n_slices=4)
    poor = replace(scan.slices[2], spots=scan.slices[2].spots.take(np.arange(3)))
    joint = register_joint([*scan.slices[:2], poor, scan.slices[3]], model_of(frame))
    assert joint.used == (0, 1, 2, 3)
    assert len(joint.slices[2].candidates[0].rod_index) == 3


def test_one_false_spot_does_not_move_the_pose() -> None:
    frame, scan = frame_and_scan(np.random.default_rng(7), n_slices=4, false=2)
    model = model_of(frame)
    clean = register_joint(scan.slices, model)
    uv = np.array(scan.slices[1].spots.uv_px)
    victim = int(clean.slices[1].candidates[0].spot_index[0])
    uv[victim] += [3.0, 0.0]
    spoiled = replace(scan.slices[1], spots=replace(scan.slices[1].spots, uv_px=uv))
    joint = register_joint([scan.slices[0], spoiled, *scan.slices[2:]], model)
    change = scan.error(joint.T_patient_model) - scan.error(clean.T_patient_model)
    assert (np.abs(change) < np.sqrt(np.diag(clean.covariance))).all()


def test_a_symmetric_frame_is_ambiguous_until_its_mount_settles_it() -> None:
    rng = np.random.default_rng(8)
    model = load_rod_model("leksell-g-2-panel")
    frame = frame_of(model)
    upright = oracle.OracleFrame(frame.starts - model.centre, frame.ends - model.centre)
    plain = replace(model_of(upright), mount=None)
    scan = make_scan(rng, upright, n_slices=3)
    joint = register_joint(scan.slices, plain)
    assert joint.status == "ambiguous"
    assert {row.status for row in joint.slices} == {"ambiguous"}
    errors = [
        np.abs(scan.error(scan.slices[0].info.T_patient_slice @ c.T_slice_model)).max()
        for c in joint.slices[0].candidates
    ]
    assert min(errors) < 0.5 < max(errors)


def test_what_is_missing_is_said() -> None:
    frame, scan = frame_and_scan(np.random.default_rng(9), n_slices=3)
    model = model_of(frame)
    nowhere = [replace(item, info=replace(item.info, T_patient_slice=None)) for item in scan.slices]
    with pytest.raises(InputError, match="place in the patient"):
        register_joint(nowhere, model)
    with pytest.raises(MissingScaleError):
        register_joint([replace(item, info=replace(item.info, scale=None)) for item in scan.slices], model)
    mixed = register_joint([nowhere[0], *scan.slices[1:], replace(scan.slices[0], problem="cut short")], model)
    assert [row.reason for row in mixed.slices] == ["no_position", "", "", "unreadable"]
    stranger = model_of(oracle.random_frame(np.random.default_rng(99), 7, size=90.0))
    assert register_joint(scan.slices, stranger).status == "no_pose"
