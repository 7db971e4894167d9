"""A CT slice: stored pixels, and what is known of where and when they were taken.

Pixels stay as the scanner stored them; they become Hounsfield units only in the windows that are looked at
(:meth:`Slice.values`). A 512 × 512 slice is thresholded ten times faster than it is rescaled. Those of a file are read
when they are first looked at (:class:`FileSlice`): a frame that is followed crosses a third of an image's rows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ctreg_cli.arrays import BoolArray, FloatArray
from ctreg_cli.checks import demand, is_number
from ctreg_cli.errors import InputError
from ctreg_cli.scale import Scale


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SliceInfo:
    """All that is known of a slice beside its pixels; never a patient field, never free text."""

    #: file relative to the input the user gave (never an absolute path), plus ``#frame`` in a multi-frame file
    source: str
    #: seconds, increasing within a series; only differences mean anything; None when the input has no time
    time_s: float | None = None
    #: mm per pixel; None when the input has none (PNG, bare spots file)
    scale: Scale | None = None
    #: (4, 4) maps slice coordinates (mm) to DICOM patient coordinates (LPS, mm); None without patient geometry
    T_patient_slice: FloatArray | None = None
    #: slab thickness, mm
    thickness_mm: float | None = None
    #: (rows, columns)
    shape: tuple[int, int] | None = None
    #: opaque key: slices of one series share it; tracking never runs across a change
    series: str = ""
    #: UIDs (``sop_class``, ``sop_instance``, ``series_instance``, ``study_instance``, ``frame_of_reference``), for
    #: ``--with-uids`` only
    uids: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """What a message calls the slice: spots without a file have no source."""
        return self.source or "spots"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Slice:
    """One image: ``value = slope * stored + intercept`` (HU in CT).

    Raises:
        InputError: no rows and columns of numbers, or a slope that makes all pixels alike.
    """

    info: SliceInfo
    #: (rows, columns) as stored, any real dtype; not copied, treat as read-only
    stored: NDArray[Any]
    slope: float = 1.0
    intercept: float = 0.0
    #: inclusive range of stored values that mean "outside the image"; never metal, never air
    padding: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        stored = self.stored
        if not (isinstance(stored, np.ndarray) and stored.ndim == 2 and stored.size and stored.dtype.kind in "biuf"):
            what = f"{stored.dtype} {stored.shape}" if isinstance(stored, np.ndarray) else type(stored).__name__
            raise InputError(f"stored: {what} is no image; give a (rows, columns) array of real numbers")
        _check_rescale(self.slope, self.intercept)

    def rows(self, first: int, end: int) -> NDArray[Any]:
        """Stored values of the rows from ``first`` to before ``end``; of a file, no more than these are read."""
        return self.stored[first:end]

    def values(self, rows: slice = slice(None), columns: slice = slice(None)) -> FloatArray:
        """Rescaled values (float64) of a window; padded pixels are NaN."""
        window = self.stored[rows, columns]
        values = window.astype(np.float64) * self.slope + self.intercept
        if self.padding is not None:
            values[self.is_padding(window)] = np.nan
        return values

    def is_padding(self, stored: NDArray[Any]) -> BoolArray:
        """Which of these stored values mean "outside the image"."""
        if self.padding is None:
            return np.zeros(stored.shape, dtype=bool)
        low, high = self.padding
        result: BoolArray = (stored >= low) & (stored <= high)
        return result


class StoredRows(Protocol):
    """Knows how to read an image of a file, or some of its rows."""

    def whole(self) -> NDArray[Any]:
        """The (rows, columns) stored values."""
        ...

    def rows(self, first: int, end: int) -> NDArray[Any]:
        """Those of the rows from ``first`` to before ``end``."""
        ...


class FileSlice(Slice):
    """A slice whose pixels are still in a file; the whole image is read, and kept, when it is first asked for.

    Raises:
        InputError: a slope that makes all pixels alike. Looking at pixels raises UnreadableSliceError where the file
            has been taken away or cut short in the meantime.
    """

    __slots__ = ("_pixels",)
    #: what reads them, and once they have been read, they themselves
    _pixels: StoredRows | NDArray[Any]

    def __init__(
        self,
        *,
        info: SliceInfo,
        stored: StoredRows | NDArray[Any],
        slope: float = 1.0,
        intercept: float = 0.0,
        padding: tuple[float, float] | None = None,
    ) -> None:
        """See :class:`Slice`; ``stored`` reads integers, or has been read."""
        _check_rescale(slope, intercept)
        keep = object.__setattr__  # the class is frozen
        keep(self, "info", info)
        keep(self, "slope", slope)
        keep(self, "intercept", intercept)
        keep(self, "padding", padding)
        keep(self, "_pixels", stored)

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process gets the pixels, not the file."""
        return _slice, (self.info, self.stored, self.slope, self.intercept, self.padding)

    @property
    def stored(self) -> NDArray[Any]:
        """(rows, columns) as stored; treat as read-only."""
        pixels = self._pixels
        if not isinstance(pixels, np.ndarray):
            pixels = pixels.whole()
            object.__setattr__(self, "_pixels", pixels)
        return pixels

    def rows(self, first: int, end: int) -> NDArray[Any]:
        """See :meth:`Slice.rows`."""
        pixels = self._pixels
        return pixels[first:end] if isinstance(pixels, np.ndarray) else pixels.rows(first, end)


def _slice(
    info: SliceInfo, stored: NDArray[Any], slope: float, intercept: float, padding: tuple[float, float] | None
) -> Slice:
    return Slice(info=info, stored=stored, slope=slope, intercept=intercept, padding=padding)


def _check_rescale(slope: float, intercept: float) -> None:
    demand(is_number(slope) and slope != 0, "slope", slope, "a finite number that is not 0")
    demand(is_number(intercept), "intercept", intercept, "a finite number")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UnreadableSlice:
    """A file that should have been a slice and is not; a value, so that a folder with one bad file still runs."""

    info: SliceInfo
    #: one sentence naming the tag or place and what is wrong with it; no text taken from the file
    problem: str
