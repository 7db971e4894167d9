"""Pixel scale and patient geometry of a DICOM image, from the plain attributes or from functional groups."""

from __future__ import annotations

from ctreg_cli.arrays import FloatArray
from ctreg_cli.geometry.patient import patient_from_slice, slice_axes
from ctreg_cli.io.dicom_header import Elements, once_a_series, problem
from ctreg_cli.scale import Scale

#: no scanner's pixel is smaller or larger (mm): beyond, a digit or a decimal point was lost
PIXEL_SPACING_RANGE_MM = (1e-3, 100.0)


@once_a_series("PixelSpacing")
def read_scale(elements: Elements) -> Scale | None:
    """Pixel Spacing ``[row, column]`` = ``[s_y, s_x]``; None where the file has none.

    Raises:
        HeaderProblem: not two positive numbers of a size that pixels have.
    """
    spacing = elements.decimals("PixelSpacing", 2)
    if spacing is None:
        return None
    low, high = PIXEL_SPACING_RANGE_MM
    if not all(low <= value <= high for value in spacing):
        raise problem("PixelSpacing", f"is not between {low:g} and {high:g} mm")
    return Scale.from_pixel_spacing(*spacing)


@once_a_series("SliceThickness")
def read_thickness(elements: Elements) -> float | None:
    """Slice Thickness, mm; None where absent or 0, which some writers mean by "unknown".

    Raises:
        HeaderProblem: not a number, or negative.
    """
    thickness = elements.decimal("SliceThickness")
    if thickness is not None and thickness < 0:
        raise problem("SliceThickness", "is negative")
    return thickness or None


def read_patient_from_slice(position: Elements, orientation: Elements) -> FloatArray | None:
    """``T_patient_slice`` (4, 4) from Image Position and Image Orientation (Patient); None where either is absent.

    The first three cosines point along increasing u, the last three along increasing v; z = x × y (PS3.3 C.7.6.2.1.1).

    Raises:
        HeaderProblem: either is malformed, or the directions are not orthonormal.
    """
    origin = position.decimals("ImagePositionPatient", 3)
    cosines = orientation.decimals("ImageOrientationPatient", 6)
    if cosines is None:
        return None
    axes = slice_axes(cosines)
    if axes is None:
        raise problem("ImageOrientationPatient", "is not two orthogonal unit vectors")
    if origin is None:
        return None
    return patient_from_slice(axes, origin)
