"""Frame files: what is accepted, what is refused and how, and that writing and reading are each other's inverse."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ctreg_cli.arrays import frozen
from ctreg_cli.errors import InputError, RodModelError
from ctreg_cli.geometry.pose import exp_rotation
from ctreg_cli.io.rod_file import load_rod_model, rod_model_to_yaml, save_rod_model
from ctreg_cli.rods import Mount, Rod, RodModel, Target

GOOD = """\
schema: ctreg/frame/1
name: three
rods:
  - {id: a, start: [0, 0, 0], end: [0, 0, 10]}
  - {id: b, start: [5, 0, 0], end: [5, 1, 10]}
  - {id: c, start: [0, 5, 0], end: [1, 5, 10]}
"""


def write(folder: Path, text: str | bytes, name: str = "frame.yaml") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def refusal(folder: Path, text: str | bytes) -> list[str]:
    """The lines of the error, without the path."""
    path = write(folder, text)
    with pytest.raises(RodModelError) as caught:
        load_rod_model(path)
    lines = str(caught.value).splitlines()
    assert all(line.startswith(str(path)) for line in lines)
    return [line.removeprefix(f"{path}:") for line in lines]


def the_refusal(folder: Path, text: str | bytes) -> str:
    lines = refusal(folder, text)
    assert len(lines) == 1, lines
    return lines[0]


def test_a_small_file(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD)
    model = load_rod_model(path)
    assert model.name == "three"
    assert model.ids == ("a", "b", "c")
    np.testing.assert_array_equal(model.starts, [[0, 0, 0], [5, 0, 0], [0, 5, 0]])
    np.testing.assert_allclose(model.ends, [[0, 0, 10], [5, 1, 10], [1, 5, 10]])
    assert model.mount is None
    assert model.targets == ()
    assert not model.tolerances.any()
    assert model.rods[0].diameter_mm is None
    assert model.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize(("units", "mm"), [("mm", 1), ("cm", 10), ("m", 1000)])
def test_units_reach_every_length_and_nothing_else(tmp_path: Path, units: str, mm: float) -> None:
    text = GOOD.replace("end: [0, 0, 10]", "end: [0, 0, 10], diameter: 0.5, tolerance: 0.25") + (
        f"units: {units}\ntolerance: 0.125\n"
        "mount: {patient_from_model: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], max_angle_deg: 20}\n"
        "targets: [{id: tip, point: [1, 2, 3]}]\n"
    )
    model = load_rod_model(write(tmp_path, text))
    np.testing.assert_allclose(model.lengths[0], 10 * mm)
    assert model.rods[0].diameter_mm == 0.5 * mm
    np.testing.assert_allclose(model.tolerances, np.array([0.25, 0.125, 0.125]) * mm)
    np.testing.assert_allclose(model.targets[0].point, np.array([1, 2, 3]) * mm)
    assert model.mount is not None
    assert model.mount.max_angle_deg == 20
    np.testing.assert_array_equal(model.mount.patient_from_model, np.eye(3))


@pytest.mark.parametrize("written", ["1e-3", "1E-3", "+0.001", ".001", "0.0010", "1.e-3"])
def test_numbers_as_people_write_them(tmp_path: Path, written: str) -> None:
    model = load_rod_model(write(tmp_path, GOOD.replace("[5, 1, 10]", f"[5, {written}, 10]")))
    assert model.rods[1].end[1] == 1e-3


@pytest.mark.parametrize("name", ["no", "012", "1", "null", "1e3", "true", "~x", "Nº 5", "a b"])
def test_an_id_is_the_text_that_was_written(tmp_path: Path, name: str) -> None:
    assert load_rod_model(write(tmp_path, GOOD.replace("id: a", f"id: {name}"))).ids[0] == name


def test_what_is_empty_or_null_counts_as_left_out(tmp_path: Path) -> None:
    text = GOOD.replace("end: [0, 0, 10]", "end: [0, 0, 10], diameter: null, tolerance: ~") + "mount:\ndescription:\n"
    model = load_rod_model(write(tmp_path, text))
    assert model.rods[0].diameter_mm is None
    assert model.mount is None
    assert model.description == ""


def test_a_byte_order_mark_and_windows_line_ends(tmp_path: Path) -> None:
    assert load_rod_model(write(tmp_path, b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())).name == "three"


@pytest.mark.parametrize(
    ("old", "new", "place", "says"),
    [
        ("frame/1", "frame/2", "1:9: schema: ", "write 'ctreg/frame/1'"),
        ("schema: ctreg/frame/1\n", "", "1:1: schema: ", "is missing"),
        ("name: three\n", "", "1:1: name: ", "is missing"),
        ("name: three\n", "name:\n", "2:6: name: ", "nothing is not text"),
        ("name: three", "naem: three\nname: x", "2:1: naem: ", "unknown key; did you mean name?"),
        ("name: three", "name: three\nname: four", "3:1: name: ", "written twice, first in line 2"),
        ("name: three", "name: three\nunits: inch", "3:8: units: ", "write 'mm', 'cm' or 'm'"),
        ("name: three", "name: three\ntolerance: -0.1", "3:12: tolerance: ", "must not be less than 0"),
        ("name: three", "name: three\ntargets: [{id: t, point: [1, 2]}]", "3:26: targets.0.point: ", "needs 3 values"),
        ("name: three", "name: three\nmount: {max_angle_deg: 4}", "3:8: mount.patient_from_model: ", "is missing"),
        ("id: b", "id: a", "5:10: rods.1.id: ", "already the id of rods.0"),
        ("id: b", "id: ''", "5:10: rods.1.id: ", "is empty"),
        ("id: b, ", "", "5:5: rods.1.id: ", "is missing"),
        ("[5, 1, 10]", "[5, 0, 0]", "5:5: rods.1: ", "rod b has no length"),
        ("[5, 1, 10]", "[5, 1]", "5:36: rods.1.end: ", "needs 3 values, has 2"),
        ("[5, 1, 10]", "[5, 1, 10, 2]", "5:36: rods.1.end: ", "needs 3 values, has 4"),
        ("[5, 1, 10]", "5", "5:36: rods.1.end: ", "must be a list, not '5'"),
        ("[5, 1, 10]", "[5, .nan, 10]", "5:40: rods.1.end.1: ", "not a finite number"),
        ("[5, 1, 10]", "[5, -.inf, 10]", "5:40: rods.1.end.1: ", "not a finite number"),
        ("[5, 1, 10]", "[5, 1e999, 10]", "5:40: rods.1.end.1: ", "too large"),
        ("[5, 1, 10]", "[5, 1e200, 10]", "5:40: rods.1.end.1: ", "must not be more than 100000"),
        ("[5, 1, 10]", "[5, 012, 10]", "5:40: rods.1.end.1: ", "octal"),
        ("[5, 1, 10]", "[5, 1:30, 10]", "5:40: rods.1.end.1: ", "not a number"),
        ("[5, 1, 10]", "[5, 1_000, 10]", "5:40: rods.1.end.1: ", "not a number"),
        ("[5, 1, 10]", "[5, 0x1F, 10]", "5:40: rods.1.end.1: ", "not a number"),
        ("[5, 1, 10]", "[5, yes, 10]", "5:40: rods.1.end.1: ", "not a number"),
        ("[5, 1, 10]", "[5, , 10]", "5:", "YAML"),
        ("[5, 1, 10]", "[5, '1', 10]", "5:40: rods.1.end.1: ", "take the quotes away"),
        ("[5, 1, 10]", "[5, [1], 10]", "5:40: rods.1.end.1: ", "a list is not a number"),
        ("[5, 1, 10]}", "[5, 1, 10], diameter: 0}", "5:58: rods.1.diameter: ", "must be more than 0"),
        ("[5, 1, 10]}", "[5, 1, 10], diameter: 1,5}", "5:60: rods.1.5: ", "unknown key"),
        ("[5, 1, 10]}", "[5, 1, 10], tolerance: -1}", "5:59: rods.1.tolerance: ", "not be less than 0"),
        ("[5, 1, 10]}", "[5, 1, 10], diamter: 1}", "5:48: rods.1.diamter: ", "did you mean diameter?"),
        ("  - {id: c, start: [0, 5, 0], end: [1, 5, 10]}\n", "", "4:3: rods: ", "has 2 rods"),
        ("  - {id: c", "  - 7\n  - {id: c", "6:5: rods.2: ", "must be a group of keys (id, start, end"),
        ("[5, 1, 10]", "&x [5, 1, 10]", "5:36: ", "anchors and aliases are not allowed"),
        ("[5, 1, 10]", "!!python/object:os.system [5]", "5:36: ", "tags like"),
        ("  - {id: b", "\t- {id: b", "5:1: ", "tab"),
        ("[5, 1, 10]}", "[5, 1, 10}", "5:45: ", "is not YAML"),
    ],
)
def test_each_mistake_is_named_with_its_place(tmp_path: Path, old: str, new: str, place: str, says: str) -> None:
    assert old in GOOD
    line = refusal(tmp_path, GOOD.replace(old, new, 1))[0]
    assert line.startswith(place), line
    assert says in line, line


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ("[[1, 0, 0], [0, 1, 0], [0, 0, -1]]", "mirror"),
        ("[[2, 0, 0], [0, 1, 0], [0, 0, 1]]", "not a rotation"),
        ("[[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]", "not a rotation"),
        ("[[0, 0, 0], [0, 0, 0], [0, 0, 0]]", "not a rotation"),
        ("[[1, 0, 0], [0, 1, 0]]", "needs 3 values"),
    ],
)
def test_a_mount_must_be_a_rotation(tmp_path: Path, rows: str, says: str) -> None:
    line = the_refusal(tmp_path, GOOD + f"mount: {{patient_from_model: {rows}}}\n")
    assert line.startswith("7:29: mount.patient_from_model: ")
    assert says in line


def test_a_mount_written_to_three_decimals_is_made_exact(tmp_path: Path) -> None:
    rows = "[[0.866, -0.5, 0], [0.5, 0.866, 0], [0, 0, 1]]"
    mount = load_rod_model(write(tmp_path, GOOD + f"mount: {{patient_from_model: {rows}}}\n")).mount
    assert mount is not None
    np.testing.assert_allclose(mount.patient_from_model @ mount.patient_from_model.T, np.eye(3), atol=1e-14)
    assert mount.max_angle_deg == 45


def test_all_mistakes_come_at_once_in_the_order_of_the_file(tmp_path: Path) -> None:
    text = GOOD.replace("frame/1", "frame/9").replace("[0, 0, 10]", "[0, x, 10]").replace("id: c", "id: b")
    text = text.replace("name: three", "nam: three") + "tolerance: -1\n"
    lines = refusal(tmp_path, text)
    assert [line.split(": ")[1] for line in lines] == [
        "name",
        "schema",
        "nam",
        "rods.0.end.1",
        "rods.2.id",
        "tolerance",
    ]
    places = [tuple(map(int, line.split(":")[:2])) for line in lines]
    assert places == sorted(places)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty"),
        (b"# nothing but a remark\n", "is empty"),
        (b"- 1\n- 2\n", "must hold keys"),
        (b"just words\n", "must hold keys"),
        (GOOD.encode("utf-16"), "is not UTF-8"),
        (GOOD.replace("three", "Stra\xdfe").encode("latin-1"), "2: is not UTF-8"),
        ((GOOD + "---\n" + GOOD).encode(), "is not YAML"),
        (b"name: \x00\x01\n", "is not YAML"),
        (b"schema: " + b"[" * 5000, "nested too deeply"),
        (b"a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n", "anchors"),
        (b"x: " + b"y" * 300_000, "larger than 256 kB"),
        (b"? [a, b]\n: 1\n", "a key must be one word"),
    ],
)
def test_files_that_are_no_frame_files(tmp_path: Path, content: bytes, says: str) -> None:
    assert any(says in line for line in refusal(tmp_path, content))


def test_a_flood_of_mistakes_is_cut_short(tmp_path: Path) -> None:
    rods = "".join(f"  - {{id: r{i}, start: [0, 0, x], end: [0, 0, 1]}}\n" for i in range(80))
    lines = refusal(tmp_path, f"schema: ctreg/frame/1\nname: many\nrods:\n{rods}")
    assert len(lines) == 51
    assert lines[-1].endswith("and 30 more mistakes")


def test_paths_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(RodModelError, match=r"nothing\.yaml: no such file"):
        load_rod_model(tmp_path / "nothing.yaml")
    with pytest.raises(RodModelError, match="cannot be read"):
        load_rod_model(tmp_path)
    with pytest.raises(RodModelError, match=r"did you mean leksell-g-.-panel\?"):
        load_rod_model("leksell-g-panel")


coordinates = st.floats(-1e5, 1e5, allow_subnormal=False)
names = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S", "Zs")), min_size=1, max_size=12).filter(
    lambda text: text.strip() == text
)


@st.composite
def models(draw: st.DrawFn) -> RodModel:
    ids = draw(st.lists(names, min_size=3, max_size=6, unique=True))
    common = draw(st.booleans())
    tolerance = draw(st.floats(0, 5))
    rods = []
    for i, name in enumerate(ids):
        start = np.array(draw(st.tuples(coordinates, coordinates, coordinates)))
        step = np.array([0.0, 0.0, 1.0 + i]) * (1 if start[2] < 0 else -1)
        rods.append(
            Rod(
                id=name,
                start=frozen(start, (3,)),
                end=frozen(start + step, (3,)),
                diameter_mm=draw(st.none() | st.floats(1e-6, 100)),
                tolerance_mm=tolerance if common else draw(st.floats(0, 5)),
            )
        )
    omega = draw(st.tuples(*[st.floats(-3, 3)] * 3))
    mount = Mount(
        patient_from_model=frozen(exp_rotation(np.array(omega)), (3, 3)), max_angle_deg=draw(st.floats(1, 180))
    )
    points = draw(st.lists(st.tuples(coordinates, coordinates, coordinates), max_size=3))
    return RodModel(
        name=draw(names),
        rods=tuple(rods),
        mount=draw(st.sampled_from([None, mount])),
        targets=tuple(Target(id=f"t{i}", point=frozen(point, (3,))) for i, point in enumerate(points)),
        description=draw(st.just("") | st.text(st.characters(codec="utf-8", exclude_categories=("C",)), max_size=200)),
    )


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(model=models())
def test_what_is_saved_is_loaded_to_the_last_bit(tmp_path: Path, model: RodModel) -> None:
    path = tmp_path / "saved.yaml"
    save_rod_model(model, path)
    loaded = load_rod_model(path)
    assert loaded.name == model.name
    assert loaded.description == model.description
    assert [(r.id, r.diameter_mm, r.tolerance_mm) for r in loaded.rods] == [
        (r.id, r.diameter_mm, r.tolerance_mm) for r in model.rods
    ]
    np.testing.assert_array_equal(loaded.starts, model.starts)
    np.testing.assert_array_equal([r.end for r in loaded.rods], [r.end for r in model.rods])
    assert (loaded.mount is None) == (model.mount is None)
    if loaded.mount and model.mount:
        np.testing.assert_array_equal(loaded.mount.patient_from_model, model.mount.patient_from_model)
        assert loaded.mount.max_angle_deg == model.mount.max_angle_deg
    assert [t.id for t in loaded.targets] == [t.id for t in model.targets]
    for mine, theirs in zip(loaded.targets, model.targets, strict=True):
        np.testing.assert_array_equal(mine.point, theirs.point)
    assert rod_model_to_yaml(loaded) == rod_model_to_yaml(model)


def test_saving_is_complete_or_not_at_all(tmp_path: Path) -> None:
    model = load_rod_model(write(tmp_path, GOOD))
    with pytest.raises(InputError, match="does not exist"):
        save_rod_model(model, tmp_path / "no" / "where.yaml")
    save_rod_model(model, tmp_path / "copy.yaml")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy.yaml", "frame.yaml"]
