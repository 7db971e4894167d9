"""What the user names on the command line, as slices: images, a spots file, or one on standard input."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

from ctreg_cli.errors import InputError
from ctreg_cli.imaging.spots import DEFAULT_SPOT_SD_PX
from ctreg_cli.pipeline import SliceLike

if TYPE_CHECKING:
    from ctreg_cli.imaging.spot_slice import SpotSlice
    from ctreg_cli.io.image_record import ImageRecord

STANDARD_INPUT = "-"
SPOTS_SUFFIXES = (".csv", ".json", ".jsonl")


class SizedSlices(Protocol):
    """Slices in order, their number known, read one at a time."""

    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[SliceLike]: ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Source:
    """Slices to work on, and what was noticed while finding them."""

    slices: SizedSlices
    kind: Literal["images", "spots"]
    #: reason → number of files in the folders that are no slices
    skipped: Mapping[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    #: where every readable slice is without a pixel scale: what to call them in a message; else empty
    without_scale: str = ""

    def __len__(self) -> int:
        return len(self.slices)

    def __iter__(self) -> Iterator[SliceLike]:
        return iter(self.slices)


def open_sources(inputs: Sequence[str], *, series: int | None = None, spot_sd_px: float = DEFAULT_SPOT_SD_PX) -> Source:
    """Slices of the inputs: DICOM or PNG files and folders of them, **or** one spots file, or ``-`` for standard input.

    Args:
        inputs: paths, or ``-``.
        series: number of the DICOM series to take when there are several.
        spot_sd_px: standard deviation (px) of spots that come without one.

    Raises:
        InputError: images and spots mixed, several spots files, a path that is not there, or nothing usable.
        SpotsFileError: mistakes in the spots file.
    """
    if not all(map(str.strip, inputs)):
        # pathlib takes no name for the current folder
        raise InputError(
            "an input has no name (is a variable of the shell empty?); name files, a folder, or . for this one"
        )
    tables = [name for name in inputs if _is_spots(name)]
    if not tables:
        # pydicom and Pillow are needed for images only
        from ctreg_cli.io.images import open_images

        images = open_images([Path(name) for name in inputs], series=series)
        return Source(
            slices=images,
            kind="images",
            skipped=images.skipped,
            warnings=tuple(images.warnings),
            without_scale=_without_scale(images.records),
        )
    if len(inputs) > 1:
        raise InputError(f"{' '.join(inputs)}: give either images or one spots file ({tables[0]} is a spots file)")
    (name,) = inputs
    if series is not None:
        raise InputError(f"--series {series}: a spots file holds one series; leave it out")
    from ctreg_cli.io.spots_file import read_bytes
    from ctreg_cli.io.spots_parsing import parse_spots

    content, shown = (_standard_input(), "standard input") if name == STANDARD_INPUT else (read_bytes(name), name)
    slices, warnings = parse_spots(content, shown, spot_sd_px=spot_sd_px)
    lacking = _without_scale(slices) and f"{shown}: columns s_x_mm, s_y_mm"
    return Source(slices=slices, kind="spots", warnings=warnings, without_scale=lacking)


def _without_scale(slices: Sequence[SpotSlice] | Sequence[ImageRecord]) -> str:
    """The first of slices that are all without a pixel scale; those that cannot be read have no say in it."""
    readable = [item.info for item in slices if not item.problem]
    if any(info.scale is not None for info in readable):
        return ""
    return next((info.name for info in readable), "")


def _is_spots(name: str) -> bool:
    return name == STANDARD_INPUT or (Path(name).suffix.lower() in SPOTS_SUFFIXES and not Path(name).is_dir())


def _standard_input() -> bytes:
    if sys.stdin.isatty():
        raise InputError("-: standard input is the keyboard; pipe spots into it: ctreg segment ... -o - | ctreg pose -")
    return sys.stdin.buffer.read()
