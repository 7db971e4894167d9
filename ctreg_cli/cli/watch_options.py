"""Options of commands that work beside a scanner."""

from __future__ import annotations

from typing import Annotated

import typer

OptionalInputs = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="INPUT",
        help="DICOM or PNG files, folders of them, or one spots file (.csv, .json, .jsonl; - is standard input).",
        show_default=False,
    ),
]
WatchFolder = Annotated[
    str | None,
    typer.Option(
        "--watch", metavar="DIR", help="Follow a folder that is being filled, instead of INPUT.", show_default=False
    ),
]
Idle = Annotated[
    float | None,
    typer.Option(
        "--idle",
        metavar="SECONDS",
        min=0.1,
        help="End when nothing has come for so long.  [default: at Ctrl-C]",
        show_default=False,
    ),
]
Count = Annotated[
    int | None, typer.Option("--count", metavar="N", min=1, help="End after N slices.", show_default=False)
]
Igtl = Annotated[
    str | None,
    typer.Option(
        "--igtl",
        metavar="[HOST:]PORT",
        help="Send poses to OpenIGTLink clients that connect here; 18944 is usual.",
        show_default=False,
    ),
]
