"""``ctreg servo``: the article's simulation of the control law."""

from __future__ import annotations

import sys
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, cast

import typer

from ctreg_cli.cli.options import Gain, ModelName, Quiet, scale_pair

if TYPE_CHECKING:
    from ctreg_cli.tracking.experiment import Strategy

#: the desired pose is tilted from the centred one, so that nothing is symmetric, and the start displaced from it
TILT_DEG, SHIFT_MM, TURN_DEG = (7.0, -5.0, 17.0), (26.0, -20.0, 5.0), (-9.0, 7.0, 12.0)
MAX_RUNS, MAX_ITERATIONS = 10_000, 10_000


class Strategies(StrEnum):
    """Which Jacobian the control law uses."""

    updated = "updated"
    constant = "constant"
    both = "both"


def servo(
    model: ModelName,
    output: Annotated[
        list[str] | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Every iteration: .csv, .json or .jsonl by suffix, - for CSV on standard output.  [default: -]",
            show_default=False,
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="TX,TY,TZ,QX,QY,QZ,QW",
            help="First pose (model to slice, mm).  [default: spot paths of about 70 px]",
            show_default=False,
        ),
    ] = None,
    desired: Annotated[
        str | None,
        typer.Option(
            "--to",
            metavar="TX,TY,TZ,QX,QY,QZ,QW",
            help="Desired pose.  [default: the frame in the image's middle, tilted]",
            show_default=False,
        ),
    ] = None,
    noise: Annotated[
        float, typer.Option("--noise", metavar="PX", min=0.0, max=1e6, help="Sd of the noise on the spots.")
    ] = 0.0,
    gain: Gain = 0.1,
    jacobian: Annotated[Strategies, typer.Option(help="Renewed at every step, or kept; both side by side.")] = (
        Strategies.both
    ),
    scale: Annotated[
        tuple[float, float],
        typer.Option("--scale", metavar="SX SY", callback=scale_pair, help="Millimetres per pixel."),
    ] = (0.488, 0.488),
    runs: Annotated[int, typer.Option(min=1, max=MAX_RUNS, help="Runs, each with noise of its own.")] = 1,
    iterations: Annotated[int, typer.Option(min=1, max=MAX_ITERATIONS, help="Steps of a run.")] = 80,
    seed: Annotated[int, typer.Option(min=0, help="The same seed and options give the same bytes.")] = 0,
    figure: Annotated[
        list[str] | None,
        typer.Option(
            "--figure",
            metavar="FILE",
            help="Figure of the first run (.png or .svg; needs matplotlib); may be given several times.",
            show_default=False,
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Servo a frame from one pose to the spots of another, as in the article's simulation.

    Every iteration is a row: the pose, its error against the desired one, the stability margin and the spots.

    \b
    Examples:
      ctreg servo -m rod-cube-30x30x40 -o servo.csv --figure servo.png
      ctreg servo -m rod-cube-30x30x40 --noise 0.5 --runs 200 -o noisy.csv --figure noisy.svg
    """
    import numpy as np

    from ctreg_cli.cli.console import Talk
    from ctreg_cli.cli.servo_table import closing_words, servo_encoding
    from ctreg_cli.errors import InputError, SingularGeometryError
    from ctreg_cli.io.rod_file import load_rod_model
    from ctreg_cli.io.sinks import check_outputs, open_sinks
    from ctreg_cli.report.servo_figure import check_figure_path, servo_figure, write_figure
    from ctreg_cli.scale import Scale
    from ctreg_cli.simulation.defaults import suitable_settings
    from ctreg_cli.simulation.start import start_pose, tilted
    from ctreg_cli.tracking.experiment import ExperimentSettings, ServoRun, displaced_start, run_servo

    outputs = check_outputs(output)
    for path in figure or ():
        check_figure_path(path)
    rod_model = load_rod_model(model)
    mm_per_px = Scale(s_x=scale[0], s_y=scale[1])
    rng = np.random.default_rng(seed)
    settings = suitable_settings(rod_model, scale=mm_per_px)
    T_desired = start_pose(desired or "centred", rod_model, settings, np.eye(3), rng, option="--to")
    if desired is None:
        T_desired = tilted(T_desired, rod_model, TILT_DEG)
    if start is None:
        T_start = displaced_start(T_desired, rod_model, np.array(SHIFT_MM), np.radians(TURN_DEG))
    else:
        T_start = start_pose(start, rod_model, settings, np.eye(3), rng, option="--from")
    how = ExperimentSettings(gain=gain, noise_px=noise, iterations=iterations)
    strategies: list[Strategy] = ["updated", "constant"]
    if jacobian is not Strategies.both:
        strategies = [cast("Strategy", jacobian.value)]

    def servo_with(strategy: Strategy, run: int) -> ServoRun:
        noise_of_run = np.random.default_rng([seed, run])  # both strategies meet the same noise
        return run_servo(rod_model, T_start, T_desired, mm_per_px, strategy, how, noise_of_run)

    try:
        made = [[servo_with(strategy, run) for strategy in strategies] for run in range(runs)]
    except SingularGeometryError as error:
        raise InputError(
            f"{error}; give poses in which the slice cuts the same rods with --from and --to, and less --noise"
        ) from error
    with open_sinks(outputs, servo_encoding(rod_model, made[0][0], mm_per_px), sys.stdout) as sinks:
        for number, together in enumerate(made):
            for one in together:
                for iteration in range(len(one.T)):
                    sinks.write((number, one, iteration))
    for path in figure or ():
        write_figure(servo_figure(made[0]), path)
    Talk(quiet=quiet, outputs=outputs).table(closing_words(made))
