"""Motions from a table: any pose CSV, and what is wrong with one, all at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ctreg_cli.errors import InputError
from ctreg_cli.io.results import ResultsHeader, write_results
from ctreg_cli.simulation.motion import MotionSettings, move, slice_times
from ctreg_cli.simulation.motion_file import parse_motion, read_motion
from ctreg_cli.simulation.series import simulate_series, truth
from tests.simulation.scenes import bare, pose_near_middle, small_frame

HEADER = "time_s,tx_mm,ty_mm,tz_mm,qx,qy,qz,qw\n"


def test_a_truth_file_can_be_followed_again(tmp_path: Path) -> None:
    model, settings, rng = small_frame(), bare(shape=(32, 32)), np.random.default_rng(3)
    path = move(pose_near_middle(settings, rng), model.centre, slice_times(6, 0.7), MotionSettings(), rng)
    slices = simulate_series(model, path, settings, np.eye(3), rng)
    file = tmp_path / "truth.csv"
    write_results((truth(i, s) for i, s in enumerate(slices)), file, ResultsHeader(model=model))
    again = read_motion(file, interval_s=99.0)
    # the table holds nine digits of a millimetre
    assert np.allclose(again.T_slice_model, path.T_slice_model, atol=1e-6)
    assert again.times_s == pytest.approx(path.times_s)
    assert len(read_motion(file, interval_s=99.0, frames=4)) == 4
    with pytest.raises(InputError, match="6 poses, fewer than the 7 slices"):
        read_motion(file, interval_s=99.0, frames=7)


def test_columns_in_any_order_without_time_and_lost_slices() -> None:
    text = "qw,qx,qy,qz,note,tx_mm,ty_mm,tz_mm\n1,0,0,0,here,1,2,3\n,,,,lost,,,\n0.8,0,0,0.6,there,4,5,6\n"
    path = parse_motion(text, "m.csv", interval_s=0.25)
    assert path.times_s == pytest.approx([0, 0.25])
    assert path.T_slice_model[:, :3, 3].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert path.T_slice_model[1, :3, 0] == pytest.approx([0.28, 0.96, 0])


def test_every_mistake_is_named_with_its_line_and_column() -> None:
    text = HEADER + "0,1,2,x,0,0,0,1\n1,1,2,3,0,0,0,2\n2,1,inf,3,0,0,0,1\n3,1,2,3,0,0,0\n"
    with pytest.raises(InputError) as caught:
        parse_motion(text, "m.csv", interval_s=1.0)
    lines = str(caught.value).splitlines()
    places = ["m.csv:2: tz_mm:", "m.csv:3: qx,qy,qz,qw:", "m.csv:4: ty_mm:", "m.csv:5: qw:"]
    assert [line.startswith(place) for line, place in zip(lines, places, strict=True)] == [True] * 4


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "column tx_mm, .* is missing"),
        ("time_s,tx_mm\n0,1\n", "column ty_mm"),
        (HEADER, "holds no pose"),
        (HEADER + "0,0,0,0,0,0,0,1\n0,0,0,0,0,0,0,1\n", "must grow"),
        (HEADER + "0,0,0,0,0,0,0,1\n,0,0,0,0,0,0,1\n", "in all rows, or empty in all"),
    ],
)
def test_tables_that_hold_no_motion_are_refused(text: str, what: str) -> None:
    with pytest.raises(InputError, match=what):
        parse_motion(text, "m.csv", interval_s=1.0)


def test_a_file_that_is_not_there_names_the_motions_there_are(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="breathing"):
        read_motion(tmp_path / "swaying", interval_s=1.0)
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="no UTF-8"):
        read_motion(tmp_path / "bytes.csv", interval_s=1.0)
