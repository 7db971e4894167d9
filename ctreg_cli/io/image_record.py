"""One slice before its pixels are read: small, for there may be ten thousand; the same for DICOM and PNG."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ctreg_cli.errors import InputError
from ctreg_cli.imaging.slice import FileSlice, Slice, SliceInfo, StoredRows, UnreadableSlice


class Kind(Enum):
    """What an image is for."""

    SLICE = "slice"
    LOCALIZER = "localizer"
    #: secondary captures: screen shots, dose pages
    CAPTURE = "capture"


class SeriesKey(NamedTuple):
    """Images with the same key are one series."""

    #: SeriesInstanceUID, or the folder where there is none; None: the header broke off before it
    id: str | None
    kind: Kind
    #: a code of the standard (CT, MR, ...), ``PNG``, or empty
    modality: str


class Instant(NamedTuple):
    """A time of day; the day is None where the file gives a time without a date."""

    day: int | None
    second: float


class Pixels(Protocol):
    """Knows how to read one image."""

    def load(self) -> NDArray[Any] | StoredRows:
        """The (rows, columns) stored values, or, where they lie open in the file, what reads them in parts.

        Raises:
            UnreadableSliceError: they cannot be read or decoded; the text is the bare problem.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageRecord:
    """All that is known of one image without its pixels; ``pixels`` is None exactly where there is a ``problem``."""

    info: SliceInfo
    series: SeriesKey
    pixels: Pixels | None = None
    problem: str = ""
    slope: float = 1.0
    intercept: float = 0.0
    padding: tuple[float, float] | None = None
    #: what the file says of its time, the most telling first; None where it says nothing
    clock: tuple[Instant | None, ...] = ()
    instance: int | None = None
    #: from 1 in a multi-frame file, else 0
    frame: int = 0
    #: one short phrase each, the same for all files with the same oddity
    notes: tuple[str, ...] = ()

    def load(self) -> Slice | UnreadableSlice:
        """Read the pixels; a failure is a value."""
        return self._slice(whole=True)

    def open(self) -> Slice | UnreadableSlice:
        """The same, but pixels that lie open in the file are read when they are first looked at."""
        return self._slice(whole=False)

    def _slice(self, *, whole: bool) -> Slice | UnreadableSlice:
        if self.pixels is None:
            return UnreadableSlice(info=self.info, problem=self.problem)
        info, slope, intercept, padding = self.info, self.slope, self.intercept, self.padding
        try:
            found = self.pixels.load()
            if isinstance(found, np.ndarray) or whole:
                stored = found if isinstance(found, np.ndarray) else found.whole()
                return Slice(info=info, stored=stored, slope=slope, intercept=intercept, padding=padding)
            return FileSlice(info=info, stored=found, slope=slope, intercept=intercept, padding=padding)
        except InputError as error:
            return UnreadableSlice(info=info, problem=str(error))
