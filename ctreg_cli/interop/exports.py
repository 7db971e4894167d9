"""Files other programs open, chosen by suffix: rendered first, written whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from ctreg_cli.errors import InputError
from ctreg_cli.interop import itk, slicer, spatial_registration, tables, trajectories
from ctreg_cli.interop.selection import Content
from ctreg_cli.io.atomic import check_folder, write_bytes
from ctreg_cli.io.results_document import SliceRecord

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


#: suffix → format; the longest suffix that fits counts
FORMATS: Mapping[str, Format] = {
    ".tfm": Format(meaning="ITK transform, one slice a file", one_slice=itk.tfm),
    ".mrk.json": Format(
        meaning="3D Slicer markups: spots, rods, targets, one slice a file",
        one_slice=slicer.markups,
        needs_model=True,
    ),
    ".seq.mha": Format(meaning="3D Slicer transform sequence", all_slices=slicer.transform_sequence, has_times=True),
    ".tum": Format(meaning="trajectory, time and quaternion (m)", all_slices=trajectories.tum, has_times=True),
    ".kitti": Format(meaning="trajectory, matrices (m)", all_slices=trajectories.kitti),
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
