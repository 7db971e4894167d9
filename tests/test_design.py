"""The design check: degenerate frames, symmetries and predicted accuracy, against laws and independent simulation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from ctreg_cli.arrays import frozen
from ctreg_cli.cli.model import app
from ctreg_cli.design.check import DesignReport, check_design, settled_by_mount
from ctreg_cli.design.degeneracy import coincident_pairs, coplanar_triples, groups, parallel_triples
from ctreg_cli.design.prediction import DesignOptions, predict, sample_slices
from ctreg_cli.design.symmetry import symmetries
from ctreg_cli.io.rod_file import load_rod_model, save_rod_model, shipped_frames
from ctreg_cli.rods import Mount, Rod, RodModel, Target
from tests.geometry.sampling import crossing, random_pose

FEW = DesignOptions(samples=200)


def frame(*ends: tuple[tuple[float, ...], tuple[float, ...]], tolerance: float = 0.1) -> RodModel:
    rods = (
        Rod(id=f"r{i}", start=frozen(a, (3,)), end=frozen(b, (3,)), tolerance_mm=tolerance)
        for i, (a, b) in enumerate(ends)
    )
    return RodModel(name="made", rods=tuple(rods))


def moved(model: RodModel, T: np.ndarray) -> RodModel:
    """The same frame written in other axes."""

    def move(point: np.ndarray) -> np.ndarray:
        return frozen(T[:3, :3] @ point + T[:3, 3], (3,))

    mount = model.mount and Mount(
        patient_from_model=frozen(model.mount.patient_from_model @ T[:3, :3].T, (3, 3)),
        max_angle_deg=model.mount.max_angle_deg,
    )
    return RodModel(
        name=model.name,
        rods=tuple(Rod(id=r.id, start=move(r.start), end=move(r.end), tolerance_mm=r.tolerance_mm) for r in model.rods),
        mount=mount,
        targets=tuple(Target(id=t.id, point=move(t.point)) for t in model.targets),
    )


def uprights(n: int, radius: float = 50, height: float = 80) -> RodModel:
    angles = 2 * np.pi * np.arange(n) / n
    xy = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return frame(*(((x, y, -height / 2), (x, y, height / 2)) for x, y in xy.tolist()))


def random_frame(n: int, seed: int = 1) -> RodModel:
    """Rods roughly along z, so that slices cut most of them."""
    rng = np.random.default_rng(seed)
    feet, heads = rng.uniform(-40, 40, size=(2, n, 2))
    return frame(*(((*a, -50), (*b, 50)) for a, b in zip(feet.tolist(), heads.tolist(), strict=True)))


# --- degenerate sets -------------------------------------------------------------------------------------------------


def test_parallel_and_coplanar_sets_of_known_frames() -> None:
    box = load_rod_model("leksell-g-3-panel")
    named = [tuple(box.ids[i] for i in group) for group in groups(parallel_triples(box))]
    assert named == [("R1", "R3", "L1", "L3", "A1", "A3")]
    assert len(parallel_triples(box)) == 20
    panels = [tuple(box.ids[i] for i in group) for group in groups(coplanar_triples(box))]
    assert panels == [("R1", "R2", "R3"), ("L1", "L2", "L3"), ("A1", "A2", "A3")]


def test_degenerate_sets_do_not_depend_on_axes_or_the_sense_of_rods() -> None:
    model = load_rod_model("brw")
    other = moved(model, random_pose(np.random.default_rng(3)))
    turned = frame(
        *((tuple(r.end), tuple(r.start)) if i % 2 else (tuple(r.start), tuple(r.end)) for i, r in enumerate(model.rods))
    )
    for triples in (parallel_triples, coplanar_triples):
        np.testing.assert_array_equal(triples(other), triples(model))
        np.testing.assert_array_equal(triples(turned), triples(model))


def test_a_random_frame_has_no_degenerate_set() -> None:
    model = random_frame(8)
    assert len(parallel_triples(model)) == len(coplanar_triples(model)) == len(coincident_pairs(model)) == 0


def test_planes_that_share_one_rod_stay_two() -> None:
    model = load_rod_model("z-frame-z001")
    assert [len(group) for group in groups(coplanar_triples(model))] == [3, 3, 3]


def test_a_rod_written_twice_is_found() -> None:
    model = frame(
        ((0, 0, 0), (0, 0, 40)), ((0, 0, 60), (0, 0, 10)), ((20, 0, 0), (0, 20, 40)), ((0, 0, 60), (0, 0, 90))
    )
    assert coincident_pairs(model) == [(0, 1)]  # the last lies on the same line, but does not overlap
    assert any("r0 and r1" in remark for remark in check_design(model, FEW).remarks)


# --- symmetries ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "turns"),
    [
        ("z-frame-z001", [(180, (0, 1, 0))]),
        ("z-frame-z005", [(180, (0, 1, 0))]),
        ("z-frame-elongated", [(180, (0, 1, 0))]),
        ("leksell-g-2-panel", [(180, (1, 0, 0))]),
        ("leksell-g-3-panel", []),
        ("micromar-tm-03b", []),
        ("plus-fcal-2.0", []),
        ("rod-cube-30x30x40", []),
    ],
)
def test_symmetries_of_shipped_frames(name: str, turns: list[tuple[float, tuple[float, ...]]]) -> None:
    model = load_rod_model(name)
    report = check_design(model, FEW)
    assert len(report.symmetries) == len(turns)
    for found, (angle, axis) in zip(report.symmetries, turns, strict=True):
        assert found.angle_deg == pytest.approx(angle, abs=0.2)
        np.testing.assert_allclose(np.abs(found.axis), axis, atol=2e-3)
        assert settled_by_mount(model, found)
        assert found.deviation_mm < (0.15 if name == "z-frame-z005" else 1e-9)


def test_brw_is_nearly_threefold() -> None:
    found = symmetries(load_rod_model("brw"), within_mm=0.3)
    assert sorted(round(s.angle_deg) for s in found) == [120, 120, 180, 180, 180]
    assert sorted(s.deviation_mm < 1e-9 for s in found) == [False, False, False, False, True]
    assert len(symmetries(load_rod_model("brw"), within_mm=1e-4)) == 1


@pytest.mark.parametrize("n", [3, 4, 5, 6])
def test_regular_prisms_have_the_dihedral_group(n: int) -> None:
    assert len(symmetries(uprights(n), within_mm=0.01)) == 2 * n - 1


def test_mirror_symmetry_is_no_symmetry() -> None:
    """Micromar is its own mirror image in x; no rigid motion does that."""
    model = load_rod_model("micromar-tm-03b")
    mirrored = {frozenset((tuple(r.start * [-1, 1, 1]), tuple(r.end * [-1, 1, 1]))) for r in model.rods}
    # the front diagonal leans the other way: without it the mirror image is exact
    same = {frozenset((tuple(r.start), tuple(r.end))) for r in model.rods}
    assert len(mirrored & same) == 8
    without = model.subset([i for i, rod in enumerate(model.rods) if rod.id != "M5"])
    assert symmetries(without, within_mm=0.3) == ()


def test_symmetries_move_with_the_axes_and_make_a_group() -> None:
    model = uprights(4)
    T = random_pose(np.random.default_rng(4))
    found = symmetries(moved(model, T), within_mm=0.01)
    elements = [np.eye(4), *(s.transform for s in found)]
    for a in elements:
        for b in elements:
            assert min(np.abs(a @ b - c).max() for c in elements) < 1e-8
    original = [T @ s.transform @ np.linalg.inv(T) for s in symmetries(model, within_mm=0.01)]
    for transform in original:
        assert min(np.abs(transform - s.transform).max() for s in found) < 1e-8


@pytest.mark.parametrize("name", ["leksell-g-2-panel", "z-frame-z001", "brw"])
def test_the_twin_pose_leaves_the_same_spots(name: str) -> None:
    """What a symmetry is for: two poses, one picture. By the plain intersection written in the tests."""
    model = load_rod_model(name)
    rng = np.random.default_rng(6)
    R = Rotation.from_rotvec(0.3 * rng.normal(size=3)).as_matrix()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ (model.centre + 10 * rng.normal(size=3))
    for symmetry in symmetries(model, within_mm=0.3):
        twin = T @ symmetry.transform
        for i, image in enumerate(symmetry.image):
            spot_of_twin, _ = crossing(twin, model.starts[i], model.directions[i])
            spot, _ = crossing(T, model.starts[image], model.directions[image])
            np.testing.assert_allclose(spot_of_twin, spot, atol=3 * symmetry.deviation_mm + 1e-9)


def test_a_random_frame_has_no_symmetry_until_half_of_it_is_turned() -> None:
    half = random_frame(4)
    assert symmetries(half, within_mm=0.3) == ()
    turn = np.array([-1.0, 1, -1])  # half a turn about y
    both = [(tuple(r.start), tuple(r.end)) for r in half.rods]
    both += [(tuple(turn * r.start), tuple(turn * r.end)) for r in half.rods]
    (found,) = symmetries(frame(*both), within_mm=1e-6)
    assert found.angle_deg == pytest.approx(180)
    np.testing.assert_allclose(found.axis, [0, 1, 0], atol=1e-9)
    np.testing.assert_array_equal(found.image, [4, 5, 6, 7, 0, 1, 2, 3])


def test_a_symmetry_takes_each_rod_to_a_rod_of_its_own() -> None:
    """Two wires side by side on one side, one on the other: half a turn brings both to the same one."""
    ends = [((0, 30, -40), (0, 30, 40)), ((0, -30, -40), (0, -30, 40)), ((50, 0, -40), (50, 0, 40))]
    assert len(symmetries(frame(*ends, ((-50, 0, -40), (-50, 0, 40))), within_mm=0.3)) > 0
    pair = frame(*ends, ((-50, 0, -40), (-50, 0, 40)), ((-50.2, 0, -40), (-50.2, 0, 40)))
    assert not any(symmetry.image[2] in (3, 4) for symmetry in symmetries(pair, within_mm=0.3))


def test_a_mount_must_be_tight_enough_to_settle_a_symmetry() -> None:
    prism = uprights(6)
    sixth = next(s for s in symmetries(prism, within_mm=0.01) if round(s.angle_deg) == 60)
    assert not settled_by_mount(prism, sixth)
    for max_angle, settled in ((25.0, True), (45.0, False)):
        mount = Mount(patient_from_model=frozen(np.eye(3), (3, 3)), max_angle_deg=max_angle)
        assert settled_by_mount(RodModel(name="m", rods=prism.rods, mount=mount), sixth) is settled


# --- rank and verdict ------------------------------------------------------------------------------------------------


def by_rods_seen(report: DesignReport) -> dict[int, float]:
    return {row.rods_seen: row.linear_share for row in report.slices}


def test_generic_rods_have_the_ranks_of_the_method() -> None:
    """6, 8, 9 for 3, 4, 5 rods and more (method §2)."""
    for n, rank in ((3, 6), (4, 8), (5, 9), (8, 9)):
        report = check_design(random_frame(n), FEW)
        assert report.linear_rank == rank
        assert report.pose_rank == 6
        assert report.usable
    shares = by_rods_seen(check_design(random_frame(8), FEW))
    assert shares[8] == 1
    assert all(share == 0 for seen, share in shares.items() if seen < 5)


def test_two_panels_have_rank_8_at_every_pose() -> None:
    report = check_design(load_rod_model("leksell-g-2-panel"))
    assert report.linear_rank == 8
    assert report.pose_rank == 6
    assert set(by_rods_seen(report).values()) == {0.0}
    assert any("rank 8 of 9" in remark for remark in report.remarks)


def test_frames_that_can_never_give_a_pose() -> None:
    parallel = check_design(uprights(6), FEW)
    assert not parallel.usable
    assert "parallel" in parallel.problems[0]
    assert parallel.pose_rank < 6
    flat = frame(*(((x, 0.0, -40), (y, 0.0, 40)) for x, y in [(-30, -20), (0, 25), (30, -5), (45, 45)]))
    coplanar = check_design(flat, FEW)
    assert not coplanar.usable
    assert "one plane" in coplanar.problems[0]
    assert coplanar.pose_rank < 6
    apart = frame(((0, 0, 0), (1, 0, 10)), ((0, 0, 50), (0, 1, 60)), ((0, 0, 100), (1, 1, 110)))
    never = check_design(apart, DesignOptions(samples=200, max_tilt_deg=5))
    assert "no slice cuts 3 rods" in never.problems[0]


@pytest.mark.parametrize("name", sorted(shipped_frames()))
def test_every_shipped_frame_is_usable(name: str) -> None:
    report = check_design(load_rod_model(name), FEW)
    assert report.usable
    assert report.slices[0].pose_share == 1
    assert report.slices[0].rods_seen == report.n_rods
    assert report.targets[0] == "centre of rods"


def test_report_does_not_depend_on_where_the_model_origin_is() -> None:
    model = load_rod_model("leksell-g-3-panel")
    far = np.eye(4)
    far[:3, 3] = [500, -800, 300]
    for mine, theirs in zip(check_design(model, FEW).slices, check_design(moved(model, far), FEW).slices, strict=True):
        assert mine.rods_seen == theirs.rods_seen
        assert mine.condition == pytest.approx(theirs.condition, rel=1e-6)
        assert mine.spot_noise is not None
        assert theirs.spot_noise is not None
        assert mine.spot_noise.tre_mm == pytest.approx(theirs.spot_noise.tre_mm, rel=1e-6)


def test_a_frame_of_very_many_rods_is_still_judged() -> None:
    report = check_design(random_frame(60), FEW)
    assert report.usable
    assert any("60 rods: sets" in remark for remark in report.remarks)


def test_the_same_answer_every_time() -> None:
    model = load_rod_model("z-frame-z001")
    assert check_design(model, FEW).slices == check_design(model, FEW).slices
    other = DesignOptions(samples=200, seed=1)
    assert check_design(model, FEW).slices != check_design(model, other).slices


# --- predicted accuracy ----------------------------------------------------------------------------------------------


def test_prediction_grows_with_noise_and_pixels_and_tolerance() -> None:
    model = load_rod_model("rod-cube-30x30x40")
    slices = sample_slices(model, FEW)
    fixed = slices.seen.all(axis=1)
    rotation, tre = predict(model, slices, fixed, 0.0, DesignOptions(noise_px=0.1, mm_per_px=0.5))
    for options in (DesignOptions(noise_px=0.3, mm_per_px=0.5), DesignOptions(noise_px=0.1, mm_per_px=1.5)):
        worse_rotation, worse_tre = predict(model, slices, fixed, 0.0, options)
        np.testing.assert_allclose(worse_rotation, 3 * rotation, rtol=1e-9)
        np.testing.assert_allclose(worse_tre, 3 * tre, rtol=1e-9)
    box = load_rod_model("leksell-g-3-panel")
    row = check_design(box, FEW).slices[0]
    assert row.spot_noise is not None
    assert row.with_tolerance is not None
    assert row.with_tolerance.rotation_deg > 3 * row.spot_noise.rotation_deg


@pytest.mark.parametrize(("tolerance", "rods_seen"), [(0.0, 7), (0.2, 5)])
def test_prediction_is_what_a_simulated_experiment_shows(tolerance: float, rods_seen: int) -> None:
    """One slice, many times: rods off their places, spots with noise, a weighted fit by SciPy, all written here.

    200 trials know a standard deviation to 4 %.
    """
    options = DesignOptions(noise_px=0.1, mm_per_px=0.5, samples=200, seed=5)
    shape = load_rod_model("z-frame-z001")
    made = frame(*((tuple(r.start), tuple(r.end)) for r in shape.rods), tolerance=tolerance)
    tip = np.array([40.0, -20.0, 35.0])
    model = RodModel(name="made", rods=made.rods, targets=(Target(id="tip", point=frozen(tip, (3,))),))
    slices = sample_slices(model, options)
    index = int(np.flatnonzero(slices.seen.sum(axis=1) == rods_seen)[0])
    rotation, tre = predict(model, slices, np.arange(options.samples) == index, 1.0, options)

    T, seen = slices.T[index], slices.seen[index]
    rng = np.random.default_rng(7)
    starts, y = (model.starts - model.centre)[seen], model.directions[seen]
    d = y @ T[:3, :3].T
    k = d[:, :2] / d[:, 2:]
    C = 0.05**2 * np.eye(2) + tolerance**2 * (np.eye(2) + k[:, :, None] * k[:, None, :])
    whiten = np.linalg.inv(np.linalg.cholesky(C))

    def rotated(parameters: np.ndarray) -> np.ndarray:
        return Rotation.from_rotvec(parameters[3:]).as_matrix() @ T[:3, :3]

    def spots(parameters: np.ndarray, places: np.ndarray) -> np.ndarray:
        R = rotated(parameters)
        a, along = places @ R.T + T[:3, 3] + parameters[:3], y @ R.T
        return a[:, :2] - a[:, 2:] * along[:, :2] / along[:, 2:]

    errors = []
    for _ in range(200):
        shift = rng.normal(scale=tolerance or 1e-12, size=(rods_seen, 3))
        across = shift - np.einsum("ij,ij->i", shift, y)[:, None] * y
        measured = spots(np.zeros(6), starts + across) + rng.normal(scale=0.05, size=(rods_seen, 2))
        fit = least_squares(
            lambda p, m=measured: np.einsum("nij,nj->ni", whiten, spots(p, starts) - m).ravel(),
            np.zeros(6),
            x_scale=[1, 1, 1, 0.02, 0.02, 0.02],
            method="lm",
        )
        errors.append(fit.x)
    experiment = np.array(errors)
    tip_error = np.array([e[:3] + (rotated(e) - T[:3, :3]) @ (tip - model.centre) for e in experiment])
    assert rotation[0] == pytest.approx(np.degrees(np.sqrt((experiment[:, 3:] ** 2).sum(axis=1).mean())), rel=0.12)
    assert tre[0, 0] == pytest.approx(np.sqrt((experiment[:, :3] ** 2).sum(axis=1).mean()), rel=0.12)
    assert tre[0, 1] == pytest.approx(np.sqrt((tip_error**2).sum(axis=1).mean()), rel=0.12)


def test_the_cube_reaches_the_figures_of_the_method() -> None:
    """0.35 mm at 0.5 px and 0.488 mm/px for slices through the middle, 0.2 rad of tilt (method §6)."""
    model = load_rod_model("rod-cube-30x30x40")
    options = DesignOptions(noise_px=0.5, mm_per_px=0.488, max_tilt_deg=float(np.degrees(0.2)), samples=2000)
    slices = sample_slices(model, options)
    middle = slices.seen.all(axis=1) & (np.abs(slices.T[:, 2, 3]) < 3)
    rotation, tre = predict(model, slices, middle, 0.0, options)
    assert np.sqrt((tre**2).mean()) == pytest.approx(0.35, abs=0.02)
    assert np.sqrt((rotation**2).mean()) == pytest.approx(2.2, abs=0.2)


# --- the command -----------------------------------------------------------------------------------------------------


def test_check_command(tmp_path: Path) -> None:
    run = CliRunner().invoke
    good = run(app, ["check", "z-frame-z001"])
    assert good.exit_code == 0
    assert "180.0 deg about [0.00, 1.00, 0.00]" in good.stdout
    as_json = run(app, ["check", "leksell-g-2-panel", "--json", "--noise", "0.2"])
    assert as_json.exit_code == 0
    content = json.loads(as_json.stdout)
    assert content["usable"] is True
    assert content["linear_rank"] == 8
    assert content["options"]["noise_px"] == 0.2
    np.testing.assert_allclose(np.diag(content["symmetries"][0]["transform"])[:3], [1, -1, -1], atol=1e-9)
    save_rod_model(uprights(4), tmp_path / "prism.yaml")
    bad = run(app, ["check", str(tmp_path / "prism.yaml")])
    assert bad.exit_code == 1
    assert "can never give a pose" in bad.stdout
    assert run(app, ["check", str(tmp_path / "prism.yaml"), "--json"]).exit_code == 1


def test_check_names_what_is_wrong_with_a_file(tmp_path: Path) -> None:
    from ctreg_cli.cli.app import app as ctreg

    (tmp_path / "bad.yaml").write_text("schema: ctreg/frame/1\nname: x\nrods: [{id: a}]\n")
    result = CliRunner().invoke(ctreg, ["model", "check", str(tmp_path / "bad.yaml")])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert "bad.yaml:3:8: rods.0.start: is missing" in result.stderr
    assert "has 1 rods" in result.stderr
    assert "Traceback" not in result.stderr
