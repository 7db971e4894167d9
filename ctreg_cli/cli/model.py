"""``ctreg model``: the frames there are, what one holds, how good it is, and the schema of a frame file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from ctreg_cli.cli import model_refine

if TYPE_CHECKING:
    from ctreg_cli.design.prediction import DesignOptions

app = typer.Typer(no_args_is_help=True, help="List, show, check and refine frames (rod models).", rich_markup_mode=None)

Frame = Annotated[
    str,
    typer.Argument(
        metavar="FRAME", help="Frame file, or name of a shipped frame (ctreg model list).", show_default=False
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="JSON instead of a table.")]
Noise = Annotated[
    float, typer.Option("--noise", metavar="PX", min=1e-3, max=100, help="Standard deviation of a spot's u and v.")
]
PixelSize = Annotated[
    float, typer.Option("--mm-per-px", metavar="MM", min=1e-3, max=100, help="Pixel size of the slices imagined.")
]
MaxTilt = Annotated[
    float, typer.Option("--max-tilt", metavar="DEG", min=0, max=80, help="Slices are tilted up to this.")
]
SchemaFile = Annotated[
    str, typer.Option("--output", "-o", metavar="FILE", help="Where to write; - is standard output.")
]

EXIT_UNUSABLE = 1


@app.command("list")
def list_frames(as_json: AsJson = False) -> None:
    """List the frames that come with ctreg; each name can follow -m.

    \b
    Example:
      ctreg model list
    """
    from ctreg_cli.cli import model_tables
    from ctreg_cli.io.rod_file import load_rod_model, shipped_frames

    models = [load_rod_model(name) for name in shipped_frames()]
    if as_json:
        typer.echo(model_tables.as_json([model_tables.summary(model) for model in models]))
    else:
        model_tables.show(model_tables.frame_list(models))


@app.command()
def show(frame: Frame, as_json: AsJson = False) -> None:
    """Show a frame's rods, mount and targets, in mm.

    \b
    Examples:
      ctreg model show leksell-g-3-panel
      ctreg model show my-frame.yaml --json
    """
    from ctreg_cli.cli import model_tables
    from ctreg_cli.io.rod_file import load_rod_model

    model = load_rod_model(frame)
    if as_json:
        typer.echo(model_tables.as_json(model_tables.details(model)))
    else:
        model_tables.show(*model_tables.frame_page(model))


@app.command()
def check(
    frame: Frame, noise: Noise = 0.1, mm_per_px: PixelSize = 0.5, max_tilt: MaxTilt = 30.0, as_json: AsJson = False
) -> None:
    """Check a frame file and the frame's design: degenerate rods, symmetries, and the accuracy to expect.

    Exit code 0 when the frame can give poses, 1 when it never can, 2 when the file is wrong.

    \b
    Examples:
      ctreg model check my-frame.yaml
      ctreg model check brw --noise 0.3 --mm-per-px 0.7 --json
    """
    from ctreg_cli.cli import model_tables
    from ctreg_cli.design.check import check_design
    from ctreg_cli.io.rod_file import load_rod_model

    report = check_design(load_rod_model(frame), _options(noise, mm_per_px, max_tilt))
    if as_json:
        typer.echo(model_tables.as_json({**model_tables.plain(report), "usable": report.usable}))
    else:
        model_tables.show(*model_tables.design_page(report))
    if not report.usable:
        raise typer.Exit(EXIT_UNUSABLE)


@app.command()
def schema(output: SchemaFile = "-") -> None:
    """Write the JSON Schema of frame files, for editors that check while one types.

    \b
    Example:
      ctreg model schema -o frame.schema.json
    """
    from ctreg_cli.cli import model_tables
    from ctreg_cli.io.atomic import write_text
    from ctreg_cli.io.rod_file import frame_schema

    text = model_tables.as_json(frame_schema())
    if output == "-":
        typer.echo(text)
    else:
        write_text(output, text + "\n")


app.command("refine")(model_refine.refine)


def _options(noise: float, mm_per_px: float, max_tilt: float) -> DesignOptions:
    from ctreg_cli.design.prediction import DesignOptions

    return DesignOptions(noise_px=noise, mm_per_px=mm_per_px, max_tilt_deg=max_tilt)
