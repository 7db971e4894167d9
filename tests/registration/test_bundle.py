"""The rods' true lines: found as sure as is said, refused when the slices do not show them."""

from __future__ import annotations

import numpy as np
import pytest

from ctreg_cli.errors import InputError, SingularGeometryError
from ctreg_cli.registration.bundle import RodRefinement, refine_rods
from ctreg_cli.registration.joint import register_joint
from ctreg_cli.rods import RodModel
from tests import oracle
from tests.registration.frames import model_of
from tests.registration.scans import Scan, make_scan

TOLERANCE_MM = 0.3


def drawn_and_scanned(rng: np.random.Generator, **options: object) -> tuple[RodModel, Scan]:
    frame = oracle.random_frame(rng, 8, size=60.0, height=80.0)
    scan = make_scan(rng, frame, tolerance_mm=TOLERANCE_MM, **options)  # type: ignore[arg-type]
    return model_of(frame, tolerance_mm=TOLERANCE_MM), scan


def without_rigid_motion(model: RodModel, shift: np.ndarray) -> np.ndarray:
    """Shifts (n, 2, 3) less the rigid motion that explains most of them across the rods; plain loops."""
    ends = np.stack([model.starts, model.ends], axis=1)
    rows, values = [], []
    for i, d in enumerate(model.directions):
        P = np.eye(3) - np.outer(d, d)
        for e in range(2):
            x, y, z = ends[i, e] - model.centre
            turn = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
            rows.append(P @ np.hstack([np.eye(3), turn]))
            values.append(P @ shift[i, e])
    G, v = np.concatenate(rows), np.concatenate(values)
    return (v - G @ np.linalg.lstsq(G, v, rcond=None)[0]).reshape(shift.shape)


def normalised_errors(model: RodModel, scan: Scan, found: RodRefinement) -> np.ndarray:
    """(n, 2) squared error of each end over its variance; two directions across."""
    error = found.shift_mm - without_rigid_motion(model, scan.shift)
    result: np.ndarray = (error**2).sum(axis=-1) / (2 * found.sd_mm**2)
    return result


def test_shifts_are_found_as_sure_as_is_said() -> None:
    rng = np.random.default_rng(1)
    found_all, ratio = [], []
    for _ in range(3):
        model, scan = drawn_and_scanned(rng, n_slices=6)
        found = refine_rods(scan.slices, model)
        assert found.one_pose
        assert found.determined.all()
        found_all.append(normalised_errors(model, scan, found).mean())
        ratio.append(np.sqrt((found.sd_mm**2).mean()) / TOLERANCE_MM)
    # spots carry noise for a bow the oracle's rods have not: sds are a little too wide, never too narrow
    assert 0.25 < np.mean(found_all) < 1.4
    assert max(ratio) < 0.5


def test_the_mean_rigid_motion_of_the_shifts_is_zero() -> None:
    model, scan = drawn_and_scanned(np.random.default_rng(2), n_slices=5)
    found = refine_rods(scan.slices, model)
    np.testing.assert_allclose(without_rigid_motion(model, found.shift_mm), found.shift_mm, atol=1e-9)


def test_the_refined_frame_fits_slices_it_has_not_seen() -> None:
    model, scan = drawn_and_scanned(np.random.default_rng(3), n_slices=10)
    refined = refine_rods(scan.slices[::2], model).model
    assert refined.tolerances.max() < 0.6 * TOLERANCE_MM
    before, after = (register_joint(scan.slices[1::2], frame) for frame in (model, refined))
    rms = [np.sqrt(np.mean([row.candidates[0].rms_px ** 2 for row in joint.slices])) for joint in (before, after)]
    assert rms[1] < rms[0] / 1.5


def test_without_places_every_slice_has_a_pose_of_its_own() -> None:
    model, scan = drawn_and_scanned(np.random.default_rng(4), n_slices=12, places=False, sd_px=0.05)
    found = refine_rods(scan.slices, model)
    assert not found.one_pose
    assert normalised_errors(model, scan, found).mean() < 2.0


def test_scales_are_found_along() -> None:
    model, scan = drawn_and_scanned(np.random.default_rng(5), n_slices=8, scale_error=1.004)
    found = refine_rods(scan.slices, model, free_scales=True)
    assert found.scale_factor is not None
    assert found.scale_factor_sd is not None
    assert (np.abs(found.scale_factor - 1.004) < 3.5 * found.scale_factor_sd).all()


@pytest.mark.parametrize(
    ("options", "words"),
    [({"n_slices": 1}, "1 usable"), ({"n_slices": 3, "height": (0.0, 0.02)}, "spread over the height")],
)
def test_slices_that_do_not_show_the_rods_are_refused(options: dict[str, object], words: str) -> None:
    model, scan = drawn_and_scanned(np.random.default_rng(6), **options)
    with pytest.raises(SingularGeometryError, match=words):
        refine_rods(scan.slices, model)


def test_rods_said_to_be_exact_need_a_tolerance() -> None:
    model, scan = drawn_and_scanned(np.random.default_rng(7), n_slices=5)
    exact = model_of(oracle.OracleFrame(np.array(model.starts), np.array(model.ends)))
    with pytest.raises(InputError, match="tolerance 0"):
        refine_rods(scan.slices, exact)
    assert refine_rods(scan.slices, exact, tolerance_mm=TOLERANCE_MM).rms_after_px < 0.2


def test_a_stranger_is_refused() -> None:
    _, scan = drawn_and_scanned(np.random.default_rng(8), n_slices=2)
    stranger = model_of(oracle.random_frame(np.random.default_rng(99), 7, size=90.0), tolerance_mm=0.3)
    with pytest.raises(SingularGeometryError, match="no common pose"):
        refine_rods(scan.slices, stranger)
