"""Images of any kind the user names, as one ordered set of slices.

What is taken:

* Files named one by one are all taken, whatever series they are of. Of a folder (searched recursively), the one series
  that fits is: CT or MR slices with more than one readable image; failing that, with one; failing that, of another
  modality; failing that, localizers and secondary captures. If several fit, the user must say which (``--series N``).
* PNG files are one series. In a folder they stand back (with a warning) for a fitting DICOM series of more images.
* Files that are no images (text, reports, structure sets, DICOMDIR) are skipped and counted. A file that should be an
  image and cannot be read stays in its place as an :class:`UnreadableSlice`; one whose header is lost comes last.

The order within a series: by time if every slice has one, then by Instance Number if every slice has one, then by
natural file name and frame. Nothing but headers is read until a slice is asked for, and no pixel is kept.
"""

from __future__ import annotations

import os
import stat
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

from ctreg_cli.errors import InputError, UnreadableSliceError
from ctreg_cli.imaging.slice import Slice, SliceInfo, UnreadableSlice
from ctreg_cli.io.image_files import files_in, named, natural_key, shown
from ctreg_cli.io.image_record import ImageRecord, Kind, SeriesKey
from ctreg_cli.io.image_series import Series, SeriesInfo, order, remarks_on
from ctreg_cli.io.png import is_png, read_png

_MAX_SERIES_NAMED = 20

NOT_AN_IMAGE = "not an image"
NO_PIXELS = "DICOM without an image"
OTHER_SERIES = "image of another series"
PNG_BESIDE_DICOM = "PNG beside DICOM"
NOT_A_FILE = "not a regular file"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageSet:
    """Slices in order, read one at a time as they are asked for; may be gone through any number of times.

    Pixels that lie open in a file are read when they are first looked at, and then kept by the slice.
    """

    records: tuple[ImageRecord, ...]
    #: why files were left out → how many
    skipped: Mapping[str, int]
    #: one sentence each
    warnings: tuple[str, ...]
    #: all series found, also those not taken
    series: tuple[SeriesInfo, ...]

    def __len__(self) -> int:
        return len(self.records)

    def __iter__(self) -> Iterator[Slice | UnreadableSlice]:
        return (record.open() for record in self.records)


def open_images(paths: Sequence[Path], *, series: int | None = None) -> ImageSet:
    """Find the slices in files and folders; their headers are read now, their pixels when they are asked for.

    Args:
        paths: DICOM files, PNG files, folders of them.
        series: which series to take, as :func:`list_series` numbers them; needed only where several fit.

    Raises:
        InputError: a path does not exist, nothing in it is an image, there is no such series, or several fit.
        UnreadableSliceError: not one of the images can be read.
    """
    found = _find(paths)
    images = _image_set(found, _choose(found, paths, series))
    _refuse_if_none_is_readable(images.records)
    return images


def list_series(paths: Sequence[Path], *, series: int | None = None) -> ImageSet:
    """As :func:`open_images`, but no choice is forced: where several series fit, or none can be read, none is chosen.

    Raises:
        InputError: a path does not exist, nothing in it is an image, or there is no such series.
    """
    found = _find(paths)
    try:
        chosen = _choose(found, paths, series)
    except _SeveralFitError:
        chosen = []
    return _image_set(found, chosen)


def read_slices(*paths: str | os.PathLike[str], series: int | None = None) -> list[Slice]:
    """All slices of files and folders at once, in order.

    Raises:
        InputError: as :func:`open_images`.
        UnreadableSliceError: one of them cannot be read.
    """
    slices = []
    for record in open_images([Path(path) for path in paths], series=series).records:
        item = record.load()
        if isinstance(item, UnreadableSlice):
            raise UnreadableSliceError(f"{item.info.source}: {item.problem}")
        slices.append(item)
    return slices


class _SeveralFitError(InputError):
    """Several series fit; the text lists them and names the option that settles it."""


def _image_set(found: _Found, chosen: Sequence[Series]) -> ImageSet:
    skipped, warnings = Counter(found.skipped), []
    for group in found.groups:
        if group in chosen:
            warnings += remarks_on(group, len(found.groups) > 1)
        elif group.key.modality == "PNG" and chosen:
            skipped[PNG_BESIDE_DICOM] += len(group.records)
            warnings.append(f"{_count(len(group.records), 'PNG file')} beside a DICOM series left out")
        else:
            skipped[OTHER_SERIES] += len(group.records)
    records = [record for group in chosen for record in group.records] + found.lost
    if len(chosen) > 1:
        warnings.append(f"the slices come from {len(chosen)} series")
    if found.lost:
        first = found.lost[0]
        warnings.append(
            f"{_count(len(found.lost), 'file')} cannot be read at all; {first.info.source}: {first.problem}"
        )
    return ImageSet(
        records=tuple(records),
        skipped=dict(skipped),
        warnings=(*warnings, *_notes(records)),
        series=tuple(group.describe(group in chosen) for group in found.groups),
    )


def _refuse_if_none_is_readable(records: Sequence[ImageRecord]) -> None:
    # of an image asked for alone the pixels are read too: what only decoding shows is an error at once
    first = records[0].load() if len(records) == 1 or all(record.problem for record in records) else None
    if isinstance(first, UnreadableSlice):
        several = "" if len(records) == 1 else f"none of the {len(records)} images can be read; the first, "
        raise UnreadableSliceError(f"{several}{first.info.source}: {first.problem}")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Found:
    groups: list[Series]
    #: images whose header broke off before it said which series they are of
    lost: list[ImageRecord]
    skipped: dict[str, int]


def _find(paths: Sequence[Path]) -> _Found:
    """Read the header of every file there is, and sort them into series."""
    if not paths:
        raise InputError("no input given; give CT slices or a folder of them")
    by_key: dict[SeriesKey, Series] = {}
    lost: list[ImageRecord] = []
    skipped: Counter[str] = Counter()
    for number, path in enumerate(paths):
        named_by = number if path.is_dir() else -1
        for file, source in files_in(path, skipped):
            records = read_image_file(file, source)
            if isinstance(records, str):
                skipped[records] += 1
                continue
            for record in records:
                if record.series.id is None:
                    lost.append(record)
                    continue
                group = by_key.setdefault(
                    record.series, Series(index=len(by_key) + 1, key=record.series, records=[], inputs=set())
                )
                group.records.append(record)
                group.inputs.add(named_by)
    for group in by_key.values():
        order(group)
    if not by_key and not lost:
        seen = ", ".join(f"{count} × {reason}" for reason, count in skipped.items()) or "no files"
        raise InputError(f"{named(paths)}: no DICOM or PNG image found ({seen}); give CT slices or a folder of them")
    lost.sort(key=lambda record: natural_key(record.info.source))
    return _Found(groups=list(by_key.values()), lost=lost, skipped=dict(skipped))


def read_image_file(path: Path, source: str) -> list[ImageRecord] | str:
    """The records of one file, or why it is skipped."""
    from ctreg_cli.io.dicom import NotAnImage, is_dicom, read_dicom
    from ctreg_cli.io.dicom_plain import HEAD_BYTES

    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):  # a pipe or a device would be waited for
            return NOT_A_FILE
        with FileIO(path) as file:
            head = file.read(HEAD_BYTES)
    except FileNotFoundError:  # a link to nowhere
        return NOT_A_FILE
    except OSError as error:
        info = SliceInfo(source=source)
        unknown = SeriesKey(None, Kind.SLICE, "")
        return [ImageRecord(info=info, series=unknown, problem=f"the file cannot be read ({error.strerror})")]
    if is_png(path, head):
        return [read_png(path, source)]
    if not is_dicom(path, head):
        return NOT_AN_IMAGE
    records = read_dicom(path, source, head, status.st_size)
    return NO_PIXELS if isinstance(records, NotAnImage) else records


def _choose(found: _Found, paths: Sequence[Path], series: int | None) -> list[Series]:
    groups = found.groups
    if series is not None:
        chosen = [group for group in groups if group.index == series]
        if not chosen:
            raise InputError(f"{named(paths)}: there is no series {series}; {_listing(groups)}")
        return chosen
    chosen = [group for group in groups if -1 in group.inputs]
    for number, path in enumerate(paths):
        if path.is_dir():
            fitting = _fitting([group for group in groups if number in group.inputs])
            if len(fitting) > 1 and fitting[0].n_readable:
                raise _SeveralFitError(
                    f"{shown(path)}: {len(fitting)} series fit; choose one with --series N; {_listing(groups)}"
                )
            chosen += [group for group in fitting if group not in chosen]
    return chosen


def _fitting(groups: list[Series]) -> list[Series]:
    """The series of the best rank that has any."""
    if not groups:
        return []
    best = min(map(_rank, groups))
    fitting = [group for group in groups if _rank(group) == best]
    dicom = [group.n_readable for group in fitting if group.key.modality != "PNG"]
    return [group for group in fitting if not dicom or group.key.modality != "PNG" or group.n_readable >= max(dicom)]


def _rank(group: Series) -> int:
    """How well a series fits, 0 best."""
    if group.n_readable == 0:
        return 4
    if group.key.kind is not Kind.SLICE:
        return 3
    if group.key.modality not in ("CT", "MR", "PNG", ""):
        return 2
    return 0 if group.n_readable > 1 else 1


def _listing(groups: Sequence[Series]) -> str:
    lines = []
    for group in groups[:_MAX_SERIES_NAMED]:
        info = group.describe(False)
        size = f"{info.shape[1]} × {info.shape[0]}" if info.shape else "of different sizes"
        what = f"{info.modality or 'unknown modality'} {info.orientation or info.kind}".strip()
        lines.append(f"{group.index}: {what}, {info.n_slices} slices {size}")
    more = [f"and {len(groups) - len(lines)} more"] if len(groups) > len(lines) else []
    return "series found: " + "; ".join(lines + more) if lines else "no series was found"


def _notes(records: Sequence[ImageRecord]) -> list[str]:
    """One sentence a kind of oddity, however many files have it."""
    first: dict[str, str] = {}
    count: Counter[str] = Counter()
    for record in records:
        for note in record.notes:
            first.setdefault(note, record.info.source)
            count[note] += 1
    return [
        f"{source}: {note}" if count[note] == 1 else f"{count[note]} images, first {source}: {note}"
        for note, source in first.items()
    ]


def _count(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"
