"""Pixel scale: the only place where s_x, s_y and DICOM's order meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctreg_cli.checks import demand, is_number
from ctreg_cli.errors import InputError, MissingScaleError


@dataclass(frozen=True, slots=True, kw_only=True)
class Scale:
    """Millimetres per pixel along u (columns, ``s_x``) and v (rows, ``s_y``).

    Raises:
        InputError: a scale that is not a positive finite number.
    """

    s_x: float
    s_y: float

    def __post_init__(self) -> None:
        for name, value in (("s_x", self.s_x), ("s_y", self.s_y)):
            if not (is_number(value) and value > 0):
                raise InputError(f"{name}: {value!r} mm/px is not a positive number")

    @classmethod
    def from_pixel_spacing(cls, row_spacing_mm: float, column_spacing_mm: float) -> Scale:
        """DICOM PixelSpacing is ``[row spacing, column spacing]`` = ``[s_y, s_x]``."""
        return cls(s_x=float(column_spacing_mm), s_y=float(row_spacing_mm))

    @property
    def mm_per_px(self) -> NDArray[np.float64]:
        """(2,) array ``[s_x, s_y]``: multiply (u, v) by it to get slice coordinates in mm."""
        return np.array([self.s_x, self.s_y])


def check_scale(scale: object) -> None:
    """Refuse what is given as a scale and is none; a bare pair does not say which of its numbers is s_x.

    Raises:
        MissingScaleError: it is None.
        InputError: it is no :class:`Scale`.
    """
    if scale is None:
        raise MissingScaleError("scale: there is none; give a ctreg_cli.Scale(s_x=..., s_y=...), mm per pixel")
    demand(isinstance(scale, Scale), "scale", scale, "a ctreg_cli.Scale(s_x=..., s_y=...), mm per pixel")
