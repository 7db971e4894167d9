"""Registration of unlabelled spots: right where it says ``ok``, honest where it cannot know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctreg_cli.geometry import pose as poses
from ctreg_cli.imaging.spots import Spots
from ctreg_cli.io.rod_file import load_rod_model
from ctreg_cli.registration.options import RegistrationOptions
from ctreg_cli.registration.register import register, undetermined
from ctreg_cli.scale import Scale
from tests.oracle import OracleFrame, OracleScene, bound, cross_rod, random_frame, twist_error
from tests.registration.frames import frame_of, model_of, registered, scale_of, some_scene, spots_of

CUBE = load_rod_model("rod-cube-30x30x40")


def error_of(T: np.ndarray, world: OracleScene) -> np.ndarray:
    return twist_error(T[:3, :3], T[:3, 3], world.R, world.t)


def labels_right(registration: object, world: OracleScene) -> bool:
    best = registration.best  # type: ignore[attr-defined]
    return all(world.rod_of_spot[s] == r for s, r in zip(best.spot_index, best.rod_index, strict=True))


@pytest.mark.parametrize("seed", range(12))
def test_sharp_spots_give_the_true_pose(seed: int) -> None:
    rng = np.random.default_rng([801, seed])
    frame = random_frame(rng, int(rng.integers(6, 10)))
    world = some_scene(rng, frame, sd_px=0.002, mm_per_px=(0.45, 0.6), least=6)
    result = registered(world, model_of(frame))
    assert result.status == "ok", (seed, result.reason)
    assert labels_right(result, world)
    error = error_of(result.candidates[0].T_slice_model, world)
    assert np.sqrt(error @ np.linalg.pinv(world.bound) @ error) < 6, seed


@pytest.mark.parametrize("seed", range(6))
def test_missing_rods_and_false_spots_are_found_out(seed: int) -> None:
    rng = np.random.default_rng([802, seed])
    world = some_scene(rng, frame_of(CUBE), sd_px=0.05, missing=1, false=5, least=6)
    result = registered(world, CUBE)
    assert result.status == "ok", (seed, result.reason)
    assert labels_right(result, world)
    seen = set(world.rod_of_spot.tolist()) - {-1}
    assert set(result.candidates[0].rod_index.tolist()) == seen


def test_the_order_of_spots_does_not_matter() -> None:
    rng = np.random.default_rng(803)
    world = some_scene(rng, frame_of(CUBE), sd_px=0.05, false=3, least=8)
    first = registered(world, CUBE).candidates[0]
    order = rng.permutation(len(world.uv_px))
    again = register(Spots.from_points(world.uv_px[order], 0.05), CUBE, scale=scale_of(world)).candidates[0]
    np.testing.assert_allclose(again.T_slice_model, first.T_slice_model, atol=1e-6)
    assert {(r, order[s]) for r, s in zip(again.rod_index, again.spot_index, strict=True)} == {
        (r, s) for r, s in zip(first.rod_index, first.spot_index, strict=True)
    }


def test_a_shifted_image_shifts_the_pose_and_nothing_else() -> None:
    rng = np.random.default_rng(804)
    world = some_scene(rng, frame_of(CUBE), sd_px=0.05, mm_per_px=(0.4, 0.55), least=8)
    shift = np.array([31.0, -12.5])
    first = registered(world, CUBE).candidates[0]
    moved = register(Spots.from_points(world.uv_px + shift, 0.05), CUBE, scale=scale_of(world)).candidates[0]
    expected = np.array(first.T_slice_model)
    expected[:2, 3] += shift * world.mm_per_px
    np.testing.assert_allclose(moved.T_slice_model, expected, atol=1e-6)
    np.testing.assert_allclose(moved.covariance, first.covariance, rtol=1e-4, atol=1e-12)


def test_errors_are_as_large_as_the_covariance_says_and_as_the_bound_allows() -> None:
    rng = np.random.default_rng(805)
    own, ideal = [], []
    for _ in range(50):
        world = some_scene(rng, frame_of(CUBE), sd_px=0.1, least=8)
        result = registered(world, CUBE)
        assert result.status == "ok"
        best = result.candidates[0]
        error = error_of(best.T_slice_model, world)
        own.append(error @ np.linalg.inv(best.covariance) @ error)
        ideal.append(error @ np.linalg.inv(world.bound) @ error)
    # χ² of 6 degrees: mean 6, sd of the mean √12/√50 = 0.49; three of them
    assert abs(np.mean(own) - 6) < 1.5, np.mean(own)
    assert abs(np.mean(ideal) - 6) < 1.5, np.mean(ideal)


@pytest.mark.parametrize("seed", range(12))
def test_pure_clutter_is_never_a_pose(seed: int) -> None:
    rng = np.random.default_rng([806, seed])
    uv = 250 + rng.uniform(-45, 45, (int(rng.integers(3, 25)), 2))
    result = register(Spots.from_points(uv, float(rng.choice([0.05, 0.3]))), CUBE, scale=Scale(s_x=0.5, s_y=0.5))
    assert result.status != "ok", seed


@pytest.mark.parametrize("seed", range(8))
def test_the_spots_of_another_frame_are_not_ours(seed: int) -> None:
    rng = np.random.default_rng([807, seed])
    world = some_scene(rng, random_frame(rng, 8), sd_px=0.05, least=8)
    assert registered(world, CUBE).status != "ok", seed


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_too_few_spots_are_said_to_be_too_few(n: int) -> None:
    uv = 100.0 + 20 * np.arange(2 * n).reshape(n, 2)
    result = register(Spots.from_points(uv), CUBE, scale=Scale(s_x=0.5, s_y=0.5))
    assert (result.status, result.reason, result.n_spots) == ("no_pose", "too_few_spots", n)


@pytest.mark.parametrize("name", ["leksell-g-2-panel", "z-frame-z001"])
def test_a_symmetric_frame_is_ambiguous_until_its_mount_is_obeyed(name: str) -> None:
    rng = np.random.default_rng(808)
    model = load_rod_model(name)
    assert model.mount is not None
    frame = frame_of(model)
    along = np.linalg.svd(model.directions)[2][0]
    for _ in range(3):
        R = poses.exp_rotation(rng.normal(size=3) * 0.08) @ np.asarray(model.mount.patient_from_model)
        # the slice a little off the middle, across the rods
        t = np.array([120.0, 130.0, 0.0]) - R @ (model.centre + 4.0 * along)
        spots = []
        for a, b in zip(frame.starts, frame.ends, strict=True):
            p, q = R @ a + t, R @ b + t
            if (p[2] > 0) != (q[2] > 0):
                spots.append((p + p[2] / (p[2] - q[2]) * (q - p))[:2] / 0.6)
        uv = np.array(spots) + rng.normal(size=(len(spots), 2)) * 0.05
        scale = Scale(s_x=0.6, s_y=0.6)
        free = register(Spots.from_points(uv, 0.05), model, scale=scale, options=RegistrationOptions(use_mount=False))
        assert free.status == "ambiguous", (name, free.reason)
        assert len(free.candidates) >= 2
        turn = poses.rotation_angle(
            free.candidates[0].T_slice_model[:3, :3] @ free.candidates[1].T_slice_model[:3, :3].T
        )
        assert turn > np.radians(60)
        settled = register(Spots.from_points(uv, 0.05), model, scale=scale)
        assert settled.status == "ok", (name, settled.reason)
        error = twist_error(
            settled.candidates[0].T_slice_model[:3, :3], settled.candidates[0].T_slice_model[:3, 3], R, t
        )
        assert np.linalg.norm(error[3:]) < np.radians(3)


@pytest.mark.parametrize("seed", range(6))
def test_one_spot_far_off_does_not_move_the_pose(seed: int) -> None:
    rng = np.random.default_rng([809, seed])
    world = some_scene(rng, frame_of(CUBE), sd_px=0.1, least=8)
    clean = registered(world, CUBE).candidates[0]
    uv = np.array(world.uv_px)
    angle = rng.uniform(0, 2 * np.pi)
    uv[int(rng.integers(len(uv)))] += 3 * np.array([np.cos(angle), np.sin(angle)])
    result = register(Spots.from_points(uv, 0.1), CUBE, scale=scale_of(world))
    assert result.status in ("ok", "ambiguous"), (seed, result.reason)
    if result.status == "ok":
        twist = poses.difference(result.candidates[0].T_slice_model, clean.T_slice_model)
        sd = np.sqrt(np.diag(result.candidates[0].covariance))
        assert (np.abs(twist) < 3 * sd).all(), seed


def test_spots_worse_than_they_say_are_not_believed() -> None:
    rng = np.random.default_rng(810)
    for _ in range(10):
        world = some_scene(rng, frame_of(CUBE), sd_px=0.5, least=8)
        result = register(Spots.from_points(world.uv_px, 0.05), CUBE, scale=scale_of(world))
        if result.status == "ok":  # then only with an sd that owns up to it
            best = result.candidates[0]
            error = error_of(best.T_slice_model, world)
            assert np.sqrt(error @ np.linalg.inv(best.covariance) @ error) < 6


def test_a_wrong_scale_is_not_a_small_sd() -> None:
    rng = np.random.default_rng(811)
    for _ in range(10):
        world = some_scene(rng, frame_of(CUBE), sd_px=0.05, least=8)
        s = scale_of(world)
        result = register(spots_of(world), CUBE, scale=Scale(s_x=s.s_x * 1.02, s_y=s.s_y * 1.02))
        if result.status == "ok":
            best = result.candidates[0]
            error = error_of(best.T_slice_model, world)
            error[:2] -= 0.02 * world.t[:2]  # where the origin is, moves with the scale
            assert np.sqrt(error @ np.linalg.inv(best.covariance) @ error) < 6


def test_a_frame_off_its_drawing_is_known_by_its_tolerance() -> None:
    rng = np.random.default_rng(812)
    drawn = random_frame(rng, 9, size=150, height=120)
    model = model_of(drawn, tolerance_mm=0.4)
    squares = []
    for _ in range(20):
        offset = rng.normal(size=drawn.starts.shape) * 0.4
        built = OracleFrame(drawn.starts + offset, drawn.ends + offset)
        world = some_scene(rng, built, sd_px=0.05, least=8, tilt_rad=0.1)
        result = registered(world, model)
        assert result.status in ("ok", "ambiguous"), result.reason
        if result.status == "ok":
            error = error_of(result.candidates[0].T_slice_model, world)
            squares.append(error @ np.linalg.inv(result.candidates[0].covariance) @ error)
    assert len(squares) > 15
    assert np.mean(squares) < 6 * 1.4, np.mean(squares)  # 3 sd of a mean of twenty
    assert np.max(squares) < 40


def test_mount_is_taken_in_patient_axes() -> None:
    rng = np.random.default_rng(813)
    model = load_rod_model("leksell-g-3-panel")
    assert model.mount is not None
    R_patient_slice = poses.exp_rotation(np.array([0.05, -0.1, 1.2]))  # a patient on the side
    R = R_patient_slice.T @ poses.exp_rotation(rng.normal(size=3) * 0.05) @ model.mount.patient_from_model
    normal = R[2]
    t = np.array([150.0, 140.0, 0.0]) - R @ (model.centre + 3 * normal)
    rods, uv = [], []
    for i, (a, b) in enumerate(zip(model.starts, model.ends, strict=True)):
        p, q = R @ a + t, R @ b + t
        if (p[2] > 0) != (q[2] > 0):
            rods.append(i)
            uv.append((p + p[2] / (p[2] - q[2]) * (q - p))[:2] / 0.6)
    assert len(rods) >= 5
    T_patient_slice = poses.make_pose(R_patient_slice, np.zeros(3))
    spots, scale = Spots.from_points(np.array(uv), 0.05), Scale(s_x=0.6, s_y=0.6)
    in_patient = register(spots, model, scale=scale, T_patient_slice=T_patient_slice)
    assert in_patient.status in ("ok", "ambiguous")
    # taken in slice axes instead, the same mount excludes the pose
    assert poses.rotation_angle(R @ np.asarray(model.mount.patient_from_model).T) > np.radians(45)
    without = register(spots, model, scale=scale)
    assert without.best is None or poses.rotation_angle(without.best.T_slice_model[:3, :3] @ R.T) > np.radians(10)


def test_a_rod_that_lies_in_the_slice_is_no_match() -> None:
    """It would be cut anywhere, with a little noise: here r2, 16 mm long, 500 mm beyond its end, and all was ``ok``."""
    rods = np.array(
        [
            [-1.42, 7.46, 13.11, 11.16, 5.18, -1.57],
            [0.16, -15.29, -4.61, -6.32, 10.09, 0.84],
            [11.26, 0.47, -5.09, 0.83, -10.59, -0.16],
            [-2.22, 10.42, 12.25, 19.13, 3.47, -15.01],
            [-3.15, 3.98, 13.65, 10.67, -12.38, -4.3],
            [-6.94, 13.47, 5.0, 18.49, -10.95, 9.88],
            [8.48, 0.3, 1.77, -25.65, -9.97, 2.56],
            [-0.68, -13.95, -2.34, 4.16, 6.66, 4.03],
        ]
    )
    spots_px = np.array(
        [
            [266.04, 240.32],
            [311.06, 263.1],
            [206.02, 255.79],
            [202.0, 249.74],
            [243.29, 297.63],
            [295.5, 257.63],
            [308.84, 264.79],
            [298.14, 263.32],
            [266.66, 230.7],
        ]
    )
    model = model_of(OracleFrame(rods[:, :3], rods[:, 3:]), tolerance_mm=0.09)
    result = register(Spots.from_points(spots_px, 0.2), model, scale=Scale(s_x=0.15227, s_y=0.15227))
    assert result.status == "no_pose"


@pytest.mark.parametrize("seed", [91, 126, 153])
def test_what_makes_a_slice_ambiguous_is_named(seed: int) -> None:
    """Also where the best pose's sd is widened until it reaches the rival."""
    rng = np.random.default_rng([891, seed])
    frame = random_frame(rng, int(rng.integers(5, 8)))
    world = some_scene(rng, frame, sd_px=float(rng.choice([0.3, 0.6, 1.0])), least=5)
    result = register(Spots.from_points(world.uv_px, world.sd_px), model_of(frame), scale=scale_of(world))
    assert (result.status, result.reason) == ("ambiguous", "rival_pose")
    assert len(result.candidates) > 1


def test_a_rod_model_of_parallel_rods_gives_no_pose() -> None:
    rng = np.random.default_rng(814)
    frame = random_frame(rng, 7)
    upright = OracleFrame(frame.starts, frame.starts + np.array([0, 0, 40.0]))
    uv = upright.starts[:, :2] / 0.5 + 200
    assert register(Spots.from_points(uv, 0.05), model_of(upright), scale=Scale(s_x=0.5, s_y=0.5)).status != "ok"


def test_bound_of_the_oracle_is_the_covariance_of_the_package() -> None:
    rng = np.random.default_rng(815)
    world = some_scene(rng, frame_of(CUBE), sd_px=0.001, least=8)
    best = registered(world, CUBE).candidates[0]
    expected = bound(frame_of(CUBE), sorted(best.rod_index.tolist()), world.R, world.t, world.mm_per_px, 0.001)
    np.testing.assert_allclose(best.covariance, expected, rtol=0.01, atol=1e-12)


def test_a_spot_beside_two_rods_is_tried_with_both() -> None:
    """An upright and a diagonal cross a few pixels apart, and only one of them is seen: the true one is found."""
    rng = np.random.default_rng(816)
    model = load_rod_model("leksell-g-3-panel")
    assert model.mount is not None
    wrong = checked = 0
    for _ in range(12):
        R = poses.exp_rotation(rng.normal(size=3) * 0.06) @ np.asarray(model.mount.patient_from_model)
        # near the panels' lower corners, where R2 runs into R3 and L2 into L3
        inside = model.centre + np.array([0, 0, rng.uniform(-52, -44)])
        t = np.array([150.0, 140.0, 0.0]) - R @ inside
        rods, uv = [], []
        for i, (a, b) in enumerate(zip(model.starts, model.ends, strict=True)):
            p, q = R @ a + t, R @ b + t
            if (p[2] > 0) != (q[2] > 0) and i not in (2, 4):
                rods.append(i)
                uv.append((p + p[2] / (p[2] - q[2]) * (q - p))[:2] / 0.6)
        result = register(
            Spots.from_points(np.array(uv) + rng.normal(size=(len(uv), 2)) * 0.05, 0.05),
            model,
            scale=Scale(s_x=0.6, s_y=0.6),
        )
        if result.status == "ok":
            checked += 1
            error = twist_error(
                result.candidates[0].T_slice_model[:3, :3], result.candidates[0].T_slice_model[:3, 3], R, t
            )
            wrong += bool(error @ np.linalg.inv(result.candidates[0].covariance) @ error > 36)
    assert wrong == 0
    assert checked >= 3


@pytest.mark.parametrize("seed", [13, 33, 45, 49, 73, 75, *range(6)])
def test_an_exact_twin_is_never_overlooked(seed: int) -> None:
    """In the first six, noise took from the search every root that leads to the twin; the symmetry knows it."""
    rng = np.random.default_rng([811, seed])
    frame = frame_of(load_rod_model("z-frame-z001"))
    world = some_scene(rng, frame, sd_px=0.1, least=7, tilt_rad=0.15, height=(0.25, 0.75))
    result = registered(world, model_of(frame))
    assert result.status == "ambiguous", (seed, result.reason)
    error = [error_of(c.T_slice_model, world) for c in result.candidates]
    assert min(np.sqrt(e @ np.linalg.pinv(world.bound) @ e) for e in error) < 6, seed


@pytest.mark.parametrize("seed", [0, 1, 2, 9, 31, 50])
def test_a_frame_that_is_its_own_mirror_image_has_a_twin_seen_from_below(seed: int) -> None:
    """Three panels of a V each: no turn maps them onto themselves, but a slice has no handedness."""
    rng = np.random.default_rng([893, seed])
    ends = [(15, -13.5, 15, 0), (15, 0, 15, 13.5), (13.5, 15, 0, 15), (0, 15, -13.5, 15), (-15, 13.5, -15, 0)]
    ends += [(-15, 0, -15, -13.5)]
    up = np.array([1, -1, 1, -1, 1, -1]) * 16.5
    top, bottom = np.array(ends, dtype=float)[:, :2], np.array(ends, dtype=float)[:, 2:]
    frame = OracleFrame(np.column_stack([top, up]), np.column_stack([bottom, -up]))
    world = some_scene(rng, frame, sd_px=0.1, least=6)
    result = registered(world, model_of(frame))
    assert (result.status, result.reason) == ("ambiguous", "rival_pose")
    distances = [np.linalg.norm(error_of(c.T_slice_model, world)[3:]) for c in result.candidates]
    assert min(distances) < 0.1
    assert max(distances) > 1


@pytest.mark.parametrize("axis", ["x", "z"])
def test_a_mount_is_not_obeyed_against_the_spots(axis: str) -> None:
    """A frame put on the other way round: what the mount leaves explains fewer spots, and is not ``ok``."""
    model = load_rod_model("z-frame-z001")
    assert model.mount is not None
    half_turn = Rotation.from_euler(axis, 180, degrees=True).as_matrix()
    against = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        tilt = poses.exp_rotation(rng.normal(size=3) * 0.1)
        R = half_turn @ tilt @ np.asarray(model.mount.patient_from_model)
        t = np.array([160.0, 160.0, rng.normal() * 0.2 * model.size_mm]) - R @ model.centre
        hits = [cross_rod(a, b, R, t) for a, b in zip(model.starts, model.ends, strict=True)]
        uv = np.array([hit[0] for hit in hits if hit is not None]) / 0.7
        spots = Spots.from_points(uv + rng.normal(size=uv.shape) * 0.1, 0.1)
        scale = Scale(s_x=0.7, s_y=0.7)
        obeyed = register(spots, model, scale=scale)
        if obeyed.status == "ok":
            # a second pose of this frame, to which every spot agrees as well: nothing speaks against the mount
            assert obeyed.best is not None
            assert len(obeyed.best.rod_index) == len(uv), (seed, obeyed.best.rod_index)
        elif obeyed.reason == "rival_pose":
            turned = [
                np.linalg.norm(twist_error(c.T_slice_model[:3, :3], c.T_slice_model[:3, 3], R, t)[3:])
                for c in obeyed.candidates
            ]
            against += min(turned) < 0.1
    assert against >= 4


@pytest.mark.parametrize("seed", range(4))
def test_a_place_known_to_a_quarter_of_the_frame_is_none_wherever_the_frame_file_has_its_origin(seed: int) -> None:
    """What counts is the frame's centre: far from it, a rotation known well enough makes a place known badly."""
    rng = np.random.default_rng(seed)
    far = rng.normal(size=3) * 500.0
    moved = replace(CUBE, rods=tuple(replace(rod, start=rod.start + far, end=rod.end + far) for rod in CUBE.rods))
    T = poses.make_pose(Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3) * 50.0)
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    for share, is_unknown in ((0.2, False), (0.3, True)):
        at_centre = 1e-4 * np.eye(6)
        at_centre[:3, :3] += (share * CUBE.size_mm) ** 2 * np.outer(direction, direction)
        for model in (CUBE, moved):
            arm = T[:3, :3] @ model.centre
            to_origin = np.eye(6)  # V at the origin is V at the centre less Ω × arm
            to_origin[:3, 3:] = np.array([[0, -arm[2], arm[1]], [arm[2], 0, -arm[0]], [-arm[1], arm[0], 0]])
            assert undetermined(model, T, to_origin @ at_centre @ to_origin.T) == is_unknown
