"""The house stays as it is drawn: imports go down only, siblings do not know each other, nothing turns in a circle."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "ctreg_cli"

#: from the top down; a room imports rooms below its own floor, and itself, but no neighbour on the same floor
FLOORS: tuple[frozenset[str], ...] = tuple(
    frozenset(floor.split(" | "))
    for floor in (
        "__main__",
        "cli",
        "report | interop",
        "simulation | io",
        "pipeline",
        "tracking",
        "registration",
        "design",
        "rods",
        "geometry | imaging",
        "scale",
        "checks",
        "arrays | errors | _version",
    )
)
#: the package's own door reaches into every room, but only when a name is asked for
DOOR = "ctreg_cli"

ABOVE_PIPELINE = frozenset().union(*FLOORS[:4])
#: what touches files, screens and networks, and belongs above the pipeline
OUTER_WORLD = frozenset(
    {"PIL", "dask", "distributed", "gdcm", "matplotlib", "plotly", "pydantic", "pydicom", "pynetdicom"}
    | {"rich", "socket", "typer", "yaml", "click"}
)


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def imports(path: Path) -> tuple[tuple[str, int, bool], ...]:
    """(module, line, whether it is loaded with the file) of every import, wherever in the file it stands."""
    return tuple(_imports(path))


def _imports(path: Path) -> Iterator[tuple[str, int, bool]]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    late: set[ast.AST] = set()
    for node in ast.walk(tree):
        is_type_checking = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        if is_type_checking or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            late.update(ast.walk(node))
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno, node not in late
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}:{node.lineno}: relative import"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                yield (whole if whole in SOURCES else str(node.module)), node.lineno, node not in late


def room(module: str) -> str:
    return module.split(".")[1] if "." in module else DOOR


def floor_of(name: str) -> int:
    found = [number for number, floor in enumerate(FLOORS) if name in floor]
    assert found, f"{name}: a new room; say on which floor of the house it stands"
    return found[0]


def test_the_sources_are_found() -> None:
    assert {"ctreg_cli.errors", "ctreg_cli.io.results", "ctreg_cli.cli.app"} <= SOURCES.keys()


@pytest.mark.parametrize("module", [name for name in SOURCES if name != DOOR])
def test_imports_go_down(module: str) -> None:
    own = room(module)
    wrong = [
        f"{SOURCES[module]}:{line}: {own} imports {imported}"
        for imported, line, _ in imports(SOURCES[module])
        if imported.split(".")[0] == DOOR and room(imported) != own
        # a bare `import ctreg_cli` reaches everything
        if room(imported) == DOOR or floor_of(room(imported)) <= floor_of(own)
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("module", [name for name in SOURCES if name == DOOR or room(name) not in ABOVE_PIPELINE])
def test_the_method_knows_no_outer_world(module: str) -> None:
    found = [name for name, _, _ in imports(SOURCES[module]) if name.split(".")[0] in OUTER_WORLD]
    assert not found, f"{module} imports {found}"


def test_nobody_imports_click() -> None:
    """typer brings its own copy, so that nobody can count on the other one being there."""
    assert not [name for name, path in SOURCES.items() if any(i.split(".")[0] == "click" for i, _, _ in imports(path))]


def test_no_circles() -> None:
    graph = {
        module: {imported for imported, _, at_once in imports(path) if at_once and imported in SOURCES} - {module}
        for module, path in SOURCES.items()
    }
    assert len(list(TopologicalSorter(graph).static_order())) == len(SOURCES)


def test_the_rules_can_be_broken(tmp_path: Path) -> None:
    """The reader of imports sees those inside functions, and both ways of writing them."""
    file = tmp_path / "x.py"
    file.write_text("import yaml\ndef f():\n    from ctreg_cli.io import results\n    import pydicom.uid\n")
    assert imports(file) == (
        ("yaml", 1, True),
        ("ctreg_cli.io.results", 3, False),
        ("pydicom.uid", 4, False),
    )
