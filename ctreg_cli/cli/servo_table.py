"""What ``ctreg servo`` writes: a row for every iteration, and a closing table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ctreg_cli._version import __version__
from ctreg_cli.geometry.pose import quaternion
from ctreg_cli.io.sinks import Encoding, rounded
from ctreg_cli.rods import RodModel
from ctreg_cli.scale import Scale
from ctreg_cli.tracking.experiment import ServoRun

#: number of a run, the run, and an iteration of it
Step = tuple[int, ServoRun, int]

SCHEMA = "ctreg/servo/1"
_COLUMNS = (
    *("run", "jacobian", "iteration", "rms_px", "margin", "angle_sum_deg", "position_mm"),
    *("error_tx_mm", "error_ty_mm", "error_tz_mm", "error_rx_deg", "error_ry_deg", "error_rz_deg"),
    *("tx_mm", "ty_mm", "tz_mm", "qx", "qy", "qz", "qw"),
)
_DIGITS = 9


def servo_encoding(model: RodModel, first: ServoRun, scale: Scale) -> Encoding[Step]:
    """Columns as above, then ``u_ROD_px`` and ``v_ROD_px`` for every rod in play."""
    names = [f"{axis}_{model.ids[rod]}_px" for rod in first.rods for axis in "uv"]
    columns = [*_COLUMNS, *names]

    def record(step: Step) -> Mapping[str, object]:
        return dict(zip(columns, _values(step), strict=True))

    def head(_first: Step | None) -> Mapping[str, object]:
        return {
            "schema": SCHEMA,
            "ctreg": __version__,
            "model": {"name": model.name, "sha256": model.sha256},
            "scale": {"s_x_mm": scale.s_x, "s_y_mm": scale.s_y},
        }

    return Encoding(
        columns=columns, rows=lambda step: [_values(step)], record=record, header=head, records_key="iterations"
    )


def _values(step: Step) -> list[object]:
    number, run, i = step
    rms = float(np.sqrt(np.mean((run.desired_px - run.spots_px[i]) ** 2)))
    numbers = [rms, run.margin[i], run.angle_sum_deg[i], run.position_mm[i]]
    numbers += [*run.error[i, :3], *np.degrees(run.error[i, 3:])]
    numbers += [*run.T[i, :3, 3], *quaternion(run.T[i])]
    numbers += [*run.spots_px[i].reshape(-1)]
    return [number, run.strategy, i, *(rounded(float(value), _DIGITS) for value in numbers)]


def closing_words(runs: Sequence[Sequence[ServoRun]]) -> list[tuple[str, str]]:
    """Where the runs ended, a line a strategy."""
    rows = [("rods", f"{len(runs[0][0].rods)}, paths of {runs[0][0].path_px.mean():.0f} px on average")]
    for together in zip(*runs, strict=True):
        angle = float(np.mean([run.angle_sum_deg[-1] for run in together]))
        distance = float(np.mean([run.position_mm[-1] for run in together]))
        margin = min(float(run.margin.min()) for run in together)
        bend = max(float(run.bend_px.max()) for run in together)
        end = f"ends {angle:.3g}° (sum of three angles) and {distance:.3g} mm off, on average of {len(together)}"
        way = f"paths bend by at most {bend:.2g} px; stability margin at least {margin:.2g}"
        rows.append((together[0].strategy, f"{end}; {way}"))
    return rows
