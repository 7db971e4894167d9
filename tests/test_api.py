"""The package's door: every public name opens, and looking at the door costs nothing."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import ctreg_cli

HEAVY = ("numpy", "scipy", "skimage", "pydicom", "PIL", "yaml", "matplotlib", "plotly")


def loaded_by(code: str) -> set[str]:
    """Top-level packages in ``sys.modules`` after running the code in a fresh interpreter."""
    script = f"{code}\nimport sys; sys.stderr.write('\\n'.join({{name.split('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(done.stderr.split())


@pytest.mark.parametrize("name", ctreg_cli.__all__)
def test_every_public_name_opens(name: str) -> None:
    assert getattr(ctreg_cli, name) is not None
    assert name in dir(ctreg_cli)


def test_the_three_lists_of_names_agree() -> None:
    tree = ast.parse(Path(ctreg_cli.__file__).read_text(encoding="utf-8"))
    (guard,) = [node for node in tree.body if isinstance(node, ast.If)]
    for_checkers = {
        alias.name: str(node.module).removeprefix("ctreg_cli.")
        for node in guard.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert for_checkers == ctreg_cli._HOME
    assert set(ctreg_cli.__all__) == {*ctreg_cli._HOME, "__version__"}


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'poze'"):
        _ = ctreg_cli.poze  # type: ignore[attr-defined]


def test_importing_the_package_loads_nothing_heavy() -> None:
    assert not loaded_by("import ctreg_cli") & {*HEAVY, "typer", "rich", "pydantic"}


@pytest.mark.parametrize(
    "arguments",
    [
        [["--help"], ["--version"]],
        [[name, "--help"] for name in ("segment", "calibrate", "pose", "track", "simulate", "model", "info")],
    ],
    ids=["ctreg", "commands"],
)
def test_asking_for_help_loads_nothing_heavy(arguments: list[list[str]]) -> None:
    script = f"""
import sys
from ctreg_cli.cli.app import main
for arguments in {arguments!r}:
    sys.argv = ["ctreg", *arguments]
    try:
        main()
    except SystemExit as end:
        assert not end.code, arguments
"""
    assert not loaded_by(script) & set(HEAVY)
