"""Which poses leave the house, and in which coordinates: the same choice for every kind of file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

from ctreg_cli.arrays import FloatArray
from ctreg_cli.errors import InputError
from ctreg_cli.io.results_document import ResultsDocument, SliceRecord
from ctreg_cli.rods import RodModel

#: coordinates in which poses are written: of the slice, or of the patient (DICOM, LPS)
Space = Literal["slice", "patient"]

MM_PER_M = 1000.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Content:
    """What an export is made of."""

    document: ResultsDocument
    space: Space
    #: the frame's rods; None where nobody gave them
    model: RodModel | None = None

    @property
    def usable(self) -> tuple[SliceRecord, ...]:
        """The slices whose pose may be used: those that are ``ok``."""
        return self.document.ok

    @property
    def has_times(self) -> bool:
        """Whether any usable slice has a time; else the numbers of the slices stand for seconds."""
        return any(record.time_s is not None for record in self.usable)

    def timed(self, records: Iterable[SliceRecord]) -> Iterator[tuple[SliceRecord, float]]:
        """Slices with their seconds; where any usable one has a time, those without are left out."""
        has_times = self.has_times
        for record in records:
            time_s = record.time_s if has_times else float(record.index)
            if time_s is not None:
                yield record, time_s

    @property
    def model_name(self) -> str:
        """What to call the frame."""
        return self.document.model_name or (self.model.name if self.model else "") or "model"

    def pose(self, record: SliceRecord) -> FloatArray:
        """(4, 4) model → slice or patient, mm, of a usable record."""
        T = record.T_slice_model if self.space == "slice" else record.T_patient_model
        if T is None:
            raise InputError(
                f"{self.document.name}: slice {record.index} has no patient geometry; "
                "export in slice coordinates: --coordinates slice"
            )
        return T


def select(document: ResultsDocument, *, space: Space | None = None, model: RodModel | None = None) -> Content:
    """Choose the coordinates: the patient's where every usable pose has them, else the slice's, unless told.

    Raises:
        InputError: no pose may be used, or the patient's coordinates are asked for and not known.
    """
    usable = document.ok
    if not usable:
        raise InputError(f"{document.name}: not one slice has a pose of status ok; there is nothing to export")
    if space is None:
        space = "patient" if all(record.T_patient_model is not None for record in usable) else "slice"
    content = Content(document=document, space=space, model=model)
    for record in usable:
        content.pose(record)
    return content
