"""Settings that suit a frame: a field of view that holds it, and a body that goes with it."""

from __future__ import annotations

import math
from typing import Any

from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale
from ctreg_cli.simulation.scene import frame_radius_mm, is_large
from ctreg_cli.simulation.settings import ScannerSettings

#: smallest field of view, room about the frame, and the round numbers consoles offer
MIN_FIELD_MM, FIELD_PER_DIAMETER, FIELD_STEP_MM = 250.0, 1.1, 10.0


def suitable_settings(model: RodModel, shape: tuple[int, int] = (512, 512), **chosen: Any) -> ScannerSettings:
    """Defaults for ``model``, with the fields ``chosen`` instead.

    A frame as large as a head holds one; a smaller one lies on an abdomen.

    Raises:
        InputError: a chosen value outside what a scanner does.
    """
    diameter = 2 * frame_radius_mm(model)
    field = max(MIN_FIELD_MM, FIELD_STEP_MM * math.ceil(FIELD_PER_DIAMETER * diameter / FIELD_STEP_MM))
    side = field / max(min(shape), 1)
    suited = {"scale": Scale(s_x=side, s_y=side), "body": "head" if is_large(model) else "abdomen"}
    return ScannerSettings(shape=shape, **(suited | chosen))
