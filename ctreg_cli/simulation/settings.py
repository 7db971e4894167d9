"""What the simulated scanner does: every choice with its unit, validated once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from ctreg_cli.errors import InputError
from ctreg_cli.scale import Scale

Body = Literal["abdomen", "head", "none"]
NoiseTexture = Literal["fbp", "white"]

#: 512 px over 250 mm
DEFAULT_SCALE = Scale(s_x=0.48828125, s_y=0.48828125)
#: sides a simulated image may have, px
MIN_SIDE_PX, MAX_SIDE_PX = 16, 4096
#: least and greatest value of the numbers in :class:`ScannerSettings`, generous for any scanner
LIMITS: Mapping[str, tuple[float, float]] = {
    "thickness_mm": (0.05, 100),
    "psf_fwhm_mm": (0, 20),
    "noise_hu": (0, 10_000),
    "metal_hu": (1, 1_000_000),
    "rod_diameter_mm": (0.05, 50),
    "streak_hu": (0, 10_000),
    "missing_count": (0, 1000),
    "false_count": (0, 1000),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ScannerSettings:
    """One scanner protocol and the scene in front of it.

    Raises:
        InputError: a value outside what a scanner does; the sentence names the field.
    """

    scale: Scale = DEFAULT_SCALE
    #: (rows, columns)
    shape: tuple[int, int] = (512, 512)
    #: thickness of the slab that is averaged into the slice
    thickness_mm: float = 2.5
    #: full width at half maximum of the in-plane Gaussian point-spread function; 0: none
    psf_fwhm_mm: float = 1.0
    #: standard deviation of the noise in soft tissue
    noise_hu: float = 15.0
    #: ``fbp``: correlated as filtered back-projection leaves it; ``white``: every pixel on its own
    noise_texture: NoiseTexture = "fbp"
    #: steel fills a voxel with about this before the scanner clips it
    metal_hu: float = 16000.0
    #: diameter of rods whose frame file gives none
    rod_diameter_mm: float = 1.0
    #: depth of the dark bands between rods, about; 0: no streaks
    streak_hu: float = 0.0
    body: Body = "abdomen"
    #: acrylic that holds the rods
    block: bool = True
    #: mark pixels outside the circular field of view as padding
    padding: bool = True
    #: ids of rods that are not there
    missing: tuple[str, ...] = ()
    #: further rods left out, drawn anew for every slice among those that would be seen (all of them at most)
    missing_count: int = 0
    #: bright discs and needles that are no rods, drawn anew for every slice
    false_count: int = 0

    def __post_init__(self) -> None:
        for name, (least, most) in LIMITS.items():
            value = getattr(self, name)
            # written so that NaN is refused
            if not least <= value <= most:
                raise InputError(f"{name}: {value!r} is not allowed; it must be a number from {least:g} to {most:g}")
        if not all(MIN_SIDE_PX <= side <= MAX_SIDE_PX for side in self.shape):
            raise InputError(f"shape: {self.shape} (rows, columns) is outside {MIN_SIDE_PX} to {MAX_SIDE_PX} px")

    @property
    def extent_mm(self) -> tuple[float, float]:
        """(width, height) of the image from pixel edge to pixel edge, mm."""
        rows, columns = self.shape
        return columns * self.scale.s_x, rows * self.scale.s_y

    @property
    def centre_mm(self) -> tuple[float, float]:
        """(x, y) of the image's middle in slice coordinates, mm."""
        rows, columns = self.shape
        return (columns - 1) / 2 * self.scale.s_x, (rows - 1) / 2 * self.scale.s_y

    @property
    def field_of_view_mm(self) -> float:
        """Diameter of the circle inscribed in the image, mm."""
        return min(self.extent_mm)
