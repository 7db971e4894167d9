"""Files other programs open, chosen by suffix: rendered first, written whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ctreg_cli.errors import InputError
from ctreg_cli.interop import itk, slicer, spatial_registration, tables, trajectories
from ctreg_cli.interop.selection import Content, Space, select
from ctreg_cli.io import sinks
from ctreg_cli.io.atomic import check_folder, write_bytes
from ctreg_cli.io.results import ResultsHeader
from ctreg_cli.io.results_document import SliceRecord, document_of, record_of
from ctreg_cli.pipeline import FrameResult

#: stands in a file name for the number of the slice
SLICE = "{slice}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """A kind of file: of all slices, or one of each."""

    meaning: str
    all_slices: Callable[[Content], bytes] | None = None
    one_slice: Callable[[Content, SliceRecord], bytes] | None = None
    needs_uids: bool = False
    needs_model: bool = False
    #: seconds are written; the slice's number stands for them where there are none
    has_times: bool = False
    #: without a word from the user: the coordinates of the pose table, or the patient's where they are known
    space: Space | None = None


#: suffix → format; the longest suffix that fits counts
FORMATS: Mapping[str, Format] = {
    ".tfm": Format(meaning="ITK transform, one slice a file", one_slice=itk.tfm),
    ".mrk.json": Format(
        meaning="3D Slicer markups: spots, rods, targets, one slice a file",
        one_slice=slicer.markups,
        needs_model=True,
    ),
    ".seq.mha": Format(meaning="3D Slicer transform sequence", all_slices=slicer.transform_sequence, has_times=True),
    ".tum": Format(
        meaning="trajectory, time and quaternion (m)", all_slices=trajectories.tum, has_times=True, space="slice"
    ),
    ".kitti": Format(meaning="trajectory, matrices (m)", all_slices=trajectories.kitti, space="slice"),
    ".tf.json": Format(meaning="ROS tf2 transforms (m)", all_slices=trajectories.tf_json, has_times=True),
    ".mat": Format(meaning="MATLAB", all_slices=tables.mat),
    ".parquet": Format(meaning="column table", all_slices=tables.parquet),
    ".dcm": Format(
        meaning="DICOM Spatial Registration, one slice a file",
        one_slice=spatial_registration.spatial_registration,
        needs_uids=True,
    ),
}


def format_of(output: str) -> Format | None:
    """The format a file name asks for; None when it is none of :data:`FORMATS`."""
    name = Path(output).name.lower()
    suffixes = [suffix for suffix in FORMATS if name.endswith(suffix)]
    return FORMATS[max(suffixes, key=len)] if suffixes else None


def check_export(output: str) -> Format:
    """The format of an output, before any work is done.

    Raises:
        InputError: an unknown suffix, or a folder that does not exist.
    """
    kind = format_of(output)
    if kind is None:
        raise InputError(f"-o {output}: the suffix chooses the format, and must be one of {', '.join(FORMATS)}")
    if SLICE in output and kind.one_slice is None:
        raise InputError(f"-o {output}: this format holds all slices in one file; leave out {SLICE}")
    check_folder(Path(output))
    return kind


def render(output: str, content: Content, *, index: int | None = None) -> Iterator[tuple[Path, bytes]]:
    """The files of one ``-o``: their paths and contents.

    Args:
        output: path whose suffix chooses the format; ``{slice}`` in its name becomes the number of the slice.
        content: what to write.
        index: only this slice; in formats of one slice a file.

    Raises:
        InputError: an unknown suffix, several poses for one file, or what the format needs is missing.
    """
    kind = check_export(output)
    if kind.all_slices is not None:
        if index is not None:
            raise InputError(f"--slice {index}: {output} holds all slices; leave it out")
        yield Path(output), kind.all_slices(content)
        return
    assert kind.one_slice is not None
    records = [record for record in content.usable if index in (None, record.index)]
    if not records:
        statuses = [record.status for record in content.document.records if record.index == index]
        why = f"its status is {statuses[0]}, and only ok is exported" if statuses else "there is no such slice"
        raise InputError(f"--slice {index}: {why}")
    if len(records) > 1 and SLICE not in output:
        suffix = next(suffix for suffix in FORMATS if FORMATS[suffix] is kind)
        stem = output[: -len(suffix)]
        raise InputError(
            f"-o {output}: {len(records)} slices have a pose and such a file holds one; choose with --slice N, "
            f"or write one file each: -o '{stem}_{SLICE}{suffix}'"
        )
    for record in records:
        yield Path(output.replace(SLICE, f"{record.index:04d}")), kind.one_slice(content, record)


def write_export(output: str, content: Content, *, index: int | None = None) -> list[Path]:
    """Render and write; the paths written.

    Raises:
        InputError: as :func:`render`, or a place that cannot be written.
    """
    written = []
    for path, data in render(output, content, index=index):
        write_bytes(path, data)
        written.append(path)
    return written


class ExportSink:
    """One ``-o`` of another program's format, as an output of results (see :class:`ctreg_cli.io.sinks.Sink`).

    The file is made from all results when they are done; when none may be used there is none, and ``tell`` hears of it.

    Raises:
        InputError: as :func:`check_export`, or the format wants one file a slice and the name does not.
    """

    def __init__(self, output: str, header: ResultsHeader, *, one_slice: bool, tell: Callable[[str], None]) -> None:
        self._output, self._header, self._tell = output, header, tell
        self._kind = check_export(output)
        if self._kind.one_slice is not None and not one_slice and SLICE not in output:
            raise InputError(
                f"-o {output}: such a file holds one slice; put {SLICE} in its name to write one file each"
            )
        self._records: list[SliceRecord] = []

    def write(self, result: FrameResult) -> None:
        """Keep what the file will say of a slice."""
        self._records.append(record_of(result, self._header, with_uids=self._kind.needs_uids))

    def finish(self) -> None:
        """Write the file or files."""
        document = document_of(self._header, self._records)
        if not document.ok:
            self._tell(f"-o {self._output}: not one pose of status ok, so nothing is written")
            return
        write_export(self._output, select(document, space=self._kind.space, model=self._header.model))

    def abandon(self) -> None:
        """Nothing has been written."""
        self._records.clear()


def split_outputs(outputs: Sequence[str] | None) -> tuple[list[str], list[str]]:
    """The values of ``-o``: those that :mod:`ctreg_cli.io.sinks` writes, and those that are written here."""
    exports = [
        output
        for output in outputs or ()
        if (kind := format_of(output)) is not None and not any(FORMATS.get(s) is kind for s in sinks.FORMATS)
    ]
    return [output for output in outputs or () if output not in exports], exports
