"""A simulated series on disk: DICOM slices, the true poses, and the true spots."""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from ctreg_cli._version import __version__
from ctreg_cli.arrays import FloatArray
from ctreg_cli.io.dicom_writer import SeriesIdentity, write_ct_slice
from ctreg_cli.io.new_folder import new_folder
from ctreg_cli.io.results import ResultsHeader, results_encoding
from ctreg_cli.io.sinks import Encoding, open_sinks
from ctreg_cli.rods import RodModel
from ctreg_cli.simulation.motion import Trajectory
from ctreg_cli.simulation.phantom import SimulatedSlice
from ctreg_cli.simulation.series import NAME, truth

#: names a simulated series consists of: a folder of these, and of nothing else, may be replaced
OWN_FILES = re.compile(rf"{NAME}_\d{{4,}}\.dcm|truth\.(csv|json)|truth_spots\.csv")

#: a spots file that also says which rod each spot is of (empty: a false spot), and whether it crosses the whole slab
SPOT_COLUMNS = (
    *("slice", "source", "time_s", "s_x_mm", "s_y_mm", "spot", "u_px", "v_px"),
    *("rod", "lambda_mm", "through"),
)


def write_series(
    slices: Iterable[SimulatedSlice],
    folder: Path,
    header: ResultsHeader,
    *,
    entropy: str,
    overwrite: bool,
) -> list[int]:
    """Write ``NAME_0000.dcm …``, ``truth.csv``, ``truth.json`` and ``truth_spots.csv``; all of them or nothing.

    Args:
        entropy: what the pixels depend on; the UIDs are made of it.

    Returns:
        How many rods each slice shows.

    Raises:
        InputError: ``folder`` holds something already, or cannot be written.
    """
    identity = SeriesIdentity(entropy=entropy)
    rods_seen: list[int] = []
    with new_folder(folder, overwrite=overwrite, own=OWN_FILES) as unfinished:
        poses = [str(unfinished / name) for name in ("truth.csv", "truth.json")]
        spots = [str(unfinished / "truth_spots.csv")]
        with (
            open_sinks(poses, results_encoding(header), io.StringIO()) as pose_sinks,
            open_sinks(spots, _spots_encoding(header.model), io.StringIO()) as spot_sinks,
        ):
            for index, simulated in enumerate(slices):
                path = unfinished / simulated.slice.info.source
                write_ct_slice(path, simulated.slice, instance_number=index + 1, identity=identity)
                pose_sinks.write(truth(index, simulated))
                spot_sinks.write((index, simulated))
                rods_seen.append(len(simulated.rod_index))
    return rods_seen


def entropy_of(header: ResultsHeader, R_patient_slice: FloatArray, trajectory: Trajectory) -> str:
    """Text that differs whenever the images do: frame, options, poses, and the program that drew them."""
    arrays = (R_patient_slice, trajectory.T_slice_model, trajectory.plane_mm, trajectory.times_s)
    digests = [hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest() for array in arrays]
    return repr((__version__, header.model.name, header.model.sha256, sorted(header.options.items()), digests))


def _spots_encoding(model: RodModel) -> Encoding[tuple[int, SimulatedSlice]]:
    def rows(item: tuple[int, SimulatedSlice]) -> list[list[object]]:
        index, simulated = item
        info = simulated.slice.info
        scale = (info.scale.s_x, info.scale.s_y) if info.scale else (None, None)
        head = [index, info.source, info.time_s, *scale]
        places = [
            [float(u), float(v), model.ids[rod], float(lambda_mm), int(through)]
            for (u, v), rod, lambda_mm, through in zip(
                simulated.uv_px, simulated.rod_index, simulated.lambda_mm, simulated.through, strict=True
            )
        ]
        places += [[float(u), float(v), None, None, None] for u, v in simulated.false_px]
        if not places:
            return [head + [None] * (len(SPOT_COLUMNS) - len(head))]
        return [[*head, spot, *place] for spot, place in enumerate(places)]

    def no_document(_item: object) -> Mapping[str, object]:
        return {}

    return Encoding(columns=SPOT_COLUMNS, rows=rows, record=no_document, header=no_document, records_key="slices")
