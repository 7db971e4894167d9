"""``ctreg export``: results as files of other programs."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from ctreg_cli.cli import options as opt


class Coordinates(StrEnum):
    """Where poses lead to."""

    slice = "slice"
    patient = "patient"


def export(
    results: Annotated[
        str,
        typer.Argument(metavar="RESULTS", help="What pose or track wrote: .json, .jsonl or .csv.", show_default=False),
    ],
    output: Annotated[
        list[str],
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Where to write; the suffix chooses the format; {slice} in it becomes the slice's number; may be "
            "given several times.",
            show_default=False,
        ),
    ],
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            "-m",
            metavar="FRAME",
            help="The frame the results were made with; needed for markups unless it is a shipped one.",
            show_default=False,
        ),
    ] = None,
    coordinates: Annotated[
        Coordinates | None,
        typer.Option(
            help="Of the slice or of the patient (LPS).  [default: patient if known; slice in .tum, .kitti]",
            show_default=False,
        ),
    ] = None,
    slice_number: Annotated[
        int | None,
        typer.Option("--slice", metavar="N", help="Only this slice, in formats of one slice.", show_default=False),
    ] = None,
    quiet: opt.Quiet = False,
) -> None:
    """Write results in the formats of other programs. Only poses of status ok leave; tables also say what failed.

    \b
    Formats:
      .tfm        ITK transform (SimpleITK, ANTs, 3D Slicer), one slice a file
      .mrk.json   3D Slicer markups: spots, rods, targets, one slice a file
      .seq.mha    3D Slicer transform sequence
      .tum        trajectory: time, position, quaternion (m)
      .kitti      trajectory: matrices (m)
      .tf.json    ROS tf2 transforms (m)
      .mat        MATLAB, Octave
      .parquet    column table (extra export)
      .dcm        DICOM Spatial Registration, one slice a file (needs --with-uids)

    \b
    Examples:
      ctreg export track.json -o track.seq.mha -o track.tum
      ctreg export poses.json --slice 3 -o pose.tfm
      ctreg export poses.json -m frame.yaml -o 'markups_{slice}.mrk.json'
    """
    from ctreg_cli.cli.console import Talk
    from ctreg_cli.interop.exports import check_export, write_export
    from ctreg_cli.interop.selection import select
    from ctreg_cli.io.frame_of_results import frame_of_results
    from ctreg_cli.io.results_document import read_document

    formats = [check_export(name) for name in output]
    talk = Talk(quiet=quiet)
    document = read_document(results)
    frame = frame_of_results(document, model)
    contents = [
        select(document, space=coordinates.value if coordinates else kind.space, model=frame) for kind in formats
    ]
    if any(kind.has_times for kind in formats):
        n_timeless = sum(record.time_s is None for record in document.ok)
        if not contents[0].has_times:
            talk.warn(f"{results}: the slices have no time; their numbers stand for seconds")
        elif n_timeless:
            talk.warn(
                f"{results}: {n_timeless} of {len(document.ok)} poses have no time, and are left out of the motion"
            )
    for name, content in zip(output, contents, strict=True):
        written = write_export(name, content, index=slice_number)
        what = str(written[0]) if len(written) == 1 else f"{len(written)} files {name}"
        talk.say(f"{what}: {content.space} coordinates")
    left_out = len(document.records) - len(document.ok)
    if left_out:
        talk.say(f"{left_out} of {len(document.records)} slices are not ok; their poses are not exported")
