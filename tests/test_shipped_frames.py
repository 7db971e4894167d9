"""The frames that come with ctreg: readable by name, true to their sources, and described by the schema that ships."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from ctreg_cli.cli.model import app
from ctreg_cli.io.rod_file import frame_schema, load_rod_model, rod_model_to_yaml, shipped_frames
from ctreg_cli.rods import RodModel

REPOSITORY = Path(__file__).parent.parent
NAMES = sorted(shipped_frames())
#: RAS → LPS, and Leksell → LPS
RAS, LEKSELL = np.diag([-1.0, -1, 1]), np.diag([1.0, -1, -1])


def rods_of(model: RodModel) -> set[frozenset[tuple[float, ...]]]:
    """Rods as unordered pairs of ends: what stands where, whichever end is the start."""
    return {frozenset((tuple(rod.start.tolist()), tuple(rod.end.tolist()))) for rod in model.rods}


def upright(x: float, y: float, bottom: float, top: float) -> frozenset[tuple[float, ...]]:
    return rod((x, y, bottom), (x, y, top))


def rod(a: tuple[float, float, float], b: tuple[float, float, float]) -> frozenset[tuple[float, ...]]:
    return frozenset((tuple(map(float, a)), tuple(map(float, b))))


def test_the_frames_there_are() -> None:
    assert NAMES == [
        "brw",
        "leksell-g-2-panel",
        "leksell-g-3-panel",
        "leksell-g-4-panel",
        "micromar-tm-03b",
        "plus-fcal-2.0",
        "rod-cube-30x30x40",
        "z-frame-elongated",
        "z-frame-z001",
        "z-frame-z005",
    ]


@pytest.mark.parametrize("name", NAMES)
def test_each_loads_by_its_name_and_path(name: str) -> None:
    model = load_rod_model(name)
    assert model.name == name
    assert model.description
    assert load_rod_model(shipped_frames()[name]).sha256 == model.sha256
    assert name == "rod-cube-30x30x40" or "nominal" in model.description
    assert name == "rod-cube-30x30x40" or model.tolerances.min() > 0
    assert model.targets or name == "rod-cube-30x30x40"


def test_the_sample_data_have_the_shipped_cube() -> None:
    assert (
        load_rod_model(REPOSITORY / "sample_data" / "frame.yaml").sha256 == load_rod_model("rod-cube-30x30x40").sha256
    )


def test_schema_file_is_what_the_command_writes(tmp_path: Path) -> None:
    shipped = (REPOSITORY / "configs" / "frame.schema.json").read_text(encoding="utf-8")
    result = CliRunner().invoke(app, ["schema"])
    assert result.exit_code == 0
    assert result.stdout == shipped
    assert CliRunner().invoke(app, ["schema", "-o", str(tmp_path / "s.json")]).exit_code == 0
    assert (tmp_path / "s.json").read_text(encoding="utf-8") == shipped
    assert json.loads(shipped) == frame_schema()


@pytest.fixture(scope="module")
def validator() -> jsonschema.Draft202012Validator:
    schema = frame_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("name", NAMES)
def test_each_is_valid_by_the_schema(name: str, validator: jsonschema.Draft202012Validator) -> None:
    validator.validate(yaml.safe_load(shipped_frames()[name].read_text(encoding="utf-8")))
    validator.validate(yaml.safe_load(rod_model_to_yaml(load_rod_model(name))))


@pytest.mark.parametrize(
    "change",
    [
        {"schema": "ctreg/frame/2"},
        {"name": None},
        {"units": "inch"},
        {"tolerance": -1},
        {"rods": []},
        {"rods": [{"id": "a", "start": [0, 0, 0], "end": [0, 0, 1]}] * 2},
        {"rods": [{"id": "a", "start": [0, 0, 0], "end": [0, 0]}] * 3},
        {"rods": [{"id": "a", "start": [0, 0, 0], "end": [0, 0, 1], "diameter": 0}] * 3},
        {"rods": [{"id": "a", "start": [0, 0, 0], "ende": [0, 0, 1]}] * 3},
        {"mount": {"patient_from_model": [[1, 0, 0], [0, 1, 0]]}},
        {"mount": {"max_angle_deg": 45}},
        {"colour": "red"},
    ],
)
def test_the_schema_refuses_what_the_loader_refuses(
    change: dict[str, object], validator: jsonschema.Draft202012Validator
) -> None:
    good = yaml.safe_load(shipped_frames()["brw"].read_text(encoding="utf-8"))
    assert not validator.is_valid({**good, **change})


def test_leksell_boxes_differ_by_their_panels() -> None:
    """Numbers checked on a real CT: 190 between the side panels, the anterior plate at y = 215."""
    two, three, four = (rods_of(load_rod_model(f"leksell-g-{n}-panel")) for n in (2, 3, 4))
    assert two < three < four
    assert [len(two), len(three), len(four)] == [6, 9, 12]
    side = {upright(5, 160, 40, 160), rod((5, 40, 40), (5, 160, 160)), upright(5, 40, 40, 160)}
    other = {frozenset((x + 190, y, z) for x, y, z in panel) for panel in side}
    assert two == side | other
    anterior = {upright(40, 215, 40, 160), rod((40, 215, 40), (160, 215, 160)), upright(160, 215, 40, 160)}
    assert three - two == anterior
    assert four - three == {frozenset((x, y - 230, z) for x, y, z in panel) for panel in anterior}
    for n in (2, 3, 4):
        mount = load_rod_model(f"leksell-g-{n}-panel").mount
        assert mount is not None
        np.testing.assert_array_equal(mount.patient_from_model, LEKSELL)


#: half sizes along x, y, z, and diagonals
Z_FRAMES = {
    "z-frame-z001": (
        (30, 30, 30),
        [((30, 30, -30), (30, -30, 30)), ((-30, 30, -30), (30, 30, 30)), ((-30, -30, -30), (-30, 30, 30))],
    ),
    "z-frame-z005": (
        (60.5, 50, 50),
        [
            ((60.5, -50, 50), (60.5, 50, -50)),
            ((-49.931, -50, 50), (50.069, -50, -50)),
            ((-60.5, 50, 50), (-60.5, -50, -50)),
        ],
    ),
    "z-frame-elongated": (
        (7.5, 6, 40),
        [((7.5, 6, -40), (7.5, -6, 40)), ((-7.5, 6, -40), (7.5, 6, 40)), ((-7.5, -6, -40), (-7.5, 6, 40))],
    ),
}


@pytest.mark.parametrize("name", Z_FRAMES)
def test_z_frames_have_four_uprights_and_three_diagonals(name: str) -> None:
    model = load_rod_model(name)
    (x, y, z), diagonals = Z_FRAMES[name]
    uprights = {upright(i * x, j * y, -z, z) for i in (-1, 1) for j in (-1, 1)}
    assert rods_of(model) == uprights | {rod(*ends) for ends in diagonals}
    assert model.mount is not None
    np.testing.assert_array_equal(model.mount.patient_from_model, RAS)


def test_nine_rod_localizers() -> None:
    brw = {
        upright(x, y, -86, 103)
        for x, y in [(-70, -121.25), (70, -121.25), (-70, 121.25), (70, 121.25), (140, 0), (-140, 0)]
    }
    brw |= {
        rod((-70, -121.25, -86), (70, -121.25, 103)),
        rod((140, 0, -86), (70, 121.25, 103)),
        rod((-70, 121.25, -86), (-140, 0, 103)),
    }
    assert rods_of(load_rod_model("brw")) == brw
    corners = [(130, -70), (130, 70), (70, 130), (-70, 130), (-130, 70), (-130, -70)]
    micromar = {upright(x, y, 0, 140) for x, y in corners} | {
        rod((130, -70, 0), (130, 70, 140)),
        rod((-70, 130, 0), (70, 130, 140)),
        rod((-130, -70, 0), (-130, 70, 140)),
    }
    assert rods_of(load_rod_model("micromar-tm-03b")) == micromar


def test_fcal_wires() -> None:
    wires = {
        20: [(30, 30), (55, 35), (60, 60)],
        10: [(30, 30), (35, 55), (60, 60)],
        0: [(35, 35), (55, 40), (60, 60)],
    }
    expected = {rod((near, 0, z), (far, 40, z)) for z, layer in wires.items() for near, far in layer}
    assert rods_of(load_rod_model("plus-fcal-2.0")) == expected


def test_list_names_every_frame() -> None:
    result = CliRunner().invoke(app, ["list"])
    assert result.exit_code == 0
    assert [line.split()[0] for line in result.stdout.splitlines()[2:]] == NAMES
    listed = json.loads(CliRunner().invoke(app, ["list", "--json"]).stdout)
    assert [entry["name"] for entry in listed] == NAMES
    assert [entry["sha256"] for entry in listed] == [load_rod_model(name).sha256 for name in NAMES]


@pytest.mark.parametrize("name", NAMES)
def test_show_tells_what_the_file_holds(name: str) -> None:
    model = load_rod_model(name)
    page = CliRunner().invoke(app, ["show", name]).stdout
    assert all(rod_id in page for rod_id in model.ids)
    assert model.sha256 in page
    shown = json.loads(CliRunner().invoke(app, ["show", name, "--json"]).stdout)
    np.testing.assert_array_equal([entry["start"] for entry in shown["rods"]], model.starts)
    np.testing.assert_allclose([entry["length_mm"] for entry in shown["rods"]], model.lengths)
    assert (shown["mount"] is None) == (model.mount is None)
