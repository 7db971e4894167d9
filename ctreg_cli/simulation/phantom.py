"""One slice of a rod frame, rendered with all that a scanner does to it, and the truth about it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctreg_cli.arrays import BoolArray, FloatArray, IntArray, frozen, frozen_index
from ctreg_cli.errors import InputError
from ctreg_cli.imaging.slice import Slice, SliceInfo
from ctreg_cli.rods import RodModel
from ctreg_cli.simulation.crossings import in_view, rod_crossings, rod_diameters, rod_ends
from ctreg_cli.simulation.cylinders import Cylinder, blend, cylinder_patch
from ctreg_cli.simulation.scene import (
    ACRYLIC_HU,
    add_noise,
    add_streaks,
    block_patch,
    body_hu,
    outside_view,
    room_mm,
)
from ctreg_cli.simulation.settings import ScannerSettings

#: ``HU = stored + INTERCEPT_HU``; scanners clip metal at 3071 HU, and some mark padding with a stored −2000
INTERCEPT_HU, MIN_HU, MAX_HU, PADDING_STORED = -1024.0, -1024.0, 3071.0, -2000

#: false spots: diameters (mm) and values (HU) of discs and needles, tilt of discs (rad), length of needles (mm)
DISC_DIAMETER_MM, DISC_HU, DISC_TILT_RAD = (0.8, 4.0), (1500.0, 9000.0), 0.3
NEEDLE_DIAMETER_MM, NEEDLE_LENGTH_MM, NEEDLE_SHARE = (0.7, 1.6), (8.0, 30.0), 0.3
#: a false spot stays this far from a rod's spot, and this share of the field of view's radius from its middle
FALSE_CLEARANCE_MM, FALSE_REACH, PLACING_TRIES = 3.0, 0.9, 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimulatedSlice:
    """A slice and the whole truth about it."""

    slice: Slice
    #: (4, 4)
    T_slice_model: FloatArray
    #: (k,) rods that pass through the slice inside the image; index in the model
    rod_index: IntArray
    #: (k, 2) where their axes cross the slab's middle, px, and (k,) how far from their start, mm
    uv_px: FloatArray
    lambda_mm: FloatArray
    #: (k,) the rod crosses the whole slab, so that the spot's centroid is the crossing
    through: BoolArray
    #: (r,) rods that would be seen, but were left out
    missing_rods: IntArray
    #: (f, 2) middles of the false spots, px
    false_px: FloatArray


def simulate_slice(
    model: RodModel,
    T_slice_model: FloatArray,
    settings: ScannerSettings,
    rng: np.random.Generator,
    info: SliceInfo | None = None,
) -> SimulatedSlice:
    """Render ``model`` at a pose (4, 4), mm, and say where its rods are.

    Args:
        info: source, time and patient geometry of the slice; scale, thickness and shape are those of ``settings``.

    Raises:
        InputError: a missing rod the model does not have, or no room for the false spots.
    """
    T_slice_model = frozen(T_slice_model, (4, 4))
    crossings = rod_crossings(model, T_slice_model, settings)
    absent = _absent_rods(model, crossings.visible, settings, rng)
    seen = np.flatnonzero(crossings.visible & ~absent)
    mm_per_px = settings.scale.mm_per_px
    clutter = _false_objects(crossings.uv_px[crossings.visible] * mm_per_px, settings, rng)

    image = body_hu(settings, room_mm(model, settings)).copy()
    if settings.block and (block := block_patch(model, T_slice_model, settings)) is not None:
        blend(image, block, ACRYLIC_HU)
    for cylinder in (*_rods(model, T_slice_model, np.flatnonzero(~absent), settings), *clutter):
        if (patch := cylinder_patch(cylinder, settings)) is not None:
            blend(image, patch, cylinder.hu)
    add_streaks(image, crossings.uv_px[seen] * mm_per_px, settings, rng)
    add_noise(image, settings, rng)

    return SimulatedSlice(
        slice=Slice(
            info=replace(
                info or SliceInfo(source="simulated"),
                scale=settings.scale,
                thickness_mm=settings.thickness_mm,
                shape=settings.shape,
            ),
            stored=digitise(image, settings),
            intercept=INTERCEPT_HU,
            padding=(PADDING_STORED, PADDING_STORED) if settings.padding else None,
        ),
        T_slice_model=T_slice_model,
        rod_index=frozen_index(seen),
        uv_px=frozen(crossings.uv_px[seen], (None, 2)),
        lambda_mm=frozen(crossings.lambda_mm[seen], (None,)),
        through=crossings.through[seen],
        missing_rods=frozen_index(np.flatnonzero(crossings.visible & absent)),
        false_px=frozen([(false.start + false.end)[:2] / 2 / mm_per_px for false in clutter], (None, 2)),
    )


def render_slice(
    model: RodModel, T_slice_model: FloatArray, settings: ScannerSettings, rng: np.random.Generator
) -> NDArray[np.int16]:
    """Only the stored pixels (rows, columns) of :func:`simulate_slice`; ``HU = stored + INTERCEPT_HU``."""
    stored: NDArray[np.int16] = simulate_slice(model, T_slice_model, settings, rng).slice.stored
    return stored


def digitise(image_hu: FloatArray, settings: ScannerSettings) -> NDArray[np.int16]:
    """Round, clip as a 12-bit scanner does, and mark what lies outside the field of view."""
    stored = np.rint(np.clip(image_hu, MIN_HU, MAX_HU) - INTERCEPT_HU).astype(np.int16)
    if settings.padding:
        stored[outside_view(settings)] = PADDING_STORED
    return stored


def _rods(model: RodModel, T_slice_model: FloatArray, indices: IntArray, settings: ScannerSettings) -> list[Cylinder]:
    starts, ends = rod_ends(model, T_slice_model)
    diameters = rod_diameters(model, settings)
    return [
        Cylinder(start=starts[i], end=ends[i], diameter_mm=float(diameters[i]), hu=settings.metal_hu) for i in indices
    ]


def _absent_rods(model: RodModel, visible: BoolArray, settings: ScannerSettings, rng: np.random.Generator) -> BoolArray:
    """(n,) rods that are not there: the named ones, and as many of those seen as were asked for."""
    unknown = sorted(set(settings.missing) - set(model.ids))
    if unknown:
        raise InputError(f"missing: {model.name} has no rod {', '.join(unknown)}; its rods are {', '.join(model.ids)}")
    absent = np.array([rod.id in settings.missing for rod in model.rods])
    if settings.missing_count:
        present = np.flatnonzero(visible & ~absent)
        count = min(settings.missing_count, len(present))
        absent[rng.choice(present, size=count, replace=False)] = True
    return absent


def _false_objects(rods_mm: FloatArray, settings: ScannerSettings, rng: np.random.Generator) -> list[Cylinder]:
    """Bright discs and needles, clear of the rods' spots (m, 2)."""
    return [_false_object(rods_mm, settings, rng) for _ in range(settings.false_count)]


def _false_object(rods_mm: FloatArray, settings: ScannerSettings, rng: np.random.Generator) -> Cylinder:
    needle = rng.random() < NEEDLE_SHARE
    turn = rng.uniform(0, 2 * math.pi)
    if needle:
        diameter, hu = rng.uniform(*NEEDLE_DIAMETER_MM), settings.metal_hu
        length, rise = rng.uniform(*NEEDLE_LENGTH_MM), 0.0
    else:
        diameter, hu = rng.uniform(*DISC_DIAMETER_MM), rng.uniform(*DISC_HU)
        # long enough to leave the slab on both sides at any tilt allowed
        length, rise = 2 * settings.thickness_mm + 4 * diameter, math.pi / 2 - rng.uniform(0, DISC_TILT_RAD)
    axis = length * np.array([math.cos(rise) * math.cos(turn), math.cos(rise) * math.sin(turn), math.sin(rise)])
    clearance = FALSE_CLEARANCE_MM + diameter / 2 + (length / 2 if needle else 0.0)
    for _ in range(PLACING_TRIES):
        radius = FALSE_REACH * settings.field_of_view_mm / 2 * math.sqrt(rng.random())
        angle = rng.uniform(0, 2 * math.pi)
        middle = np.array([*settings.centre_mm, 0.0]) + radius * np.array([math.cos(angle), math.sin(angle), 0.0])
        far = len(rods_mm) == 0 or np.linalg.norm(rods_mm - middle[:2], axis=1).min() > clearance
        if far and in_view(middle[None, :2] / settings.scale.mm_per_px, settings)[0]:
            return Cylinder(start=middle - axis / 2, end=middle + axis / 2, diameter_mm=diameter, hu=hu)
    raise InputError(
        f"false: no room for {settings.false_count} false spots clear of the rods in a field of view of "
        f"{settings.field_of_view_mm:.0f} mm; ask for fewer, or for a larger image"
    )
