"""The house: what is installed, what may import what, what the documents promise."""

from __future__ import annotations

import ast
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from rtmap_cli.cli import COMMANDS

ROOT = Path(__file__).resolve().parents[1]


def _leaves() -> list[tuple[str, str]]:
    leaves = []
    for name, entry in COMMANDS.items():
        if isinstance(entry[1], dict):
            leaves += [(f"{name} {sub}", module) for sub, (module, _) in entry[1].items()]
        else:
            leaves.append((name, entry[0]))
    return leaves


def test_every_command_has_a_module_and_every_module_a_command() -> None:
    files = {p.stem for p in (ROOT / "rtmap_cli/commands").glob("*.py")} - {"__init__"}
    assert {module for _, module in _leaves()} == files


@pytest.mark.parametrize(("name", "module"), _leaves())
def test_help_ends_with_an_example(name: str, module: str, rtmap) -> None:  # type: ignore[no-untyped-def]
    text = rtmap(*name.split(), "--help").out
    assert f"rtmap {name}" in text
    assert "Example" in text, f"rtmap {name} --help shows no example"


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_verb_has_a_page(name: str) -> None:
    page = ROOT / "docs" / f"{name}.md"
    assert page.exists(), f"docs/{name}.md is missing"
    text = page.read_text(encoding="utf-8")
    for leaf, _ in _leaves():
        if leaf.split()[0] == name:
            assert f"rtmap {leaf}" in text, f"docs/{name}.md does not mention rtmap {leaf}"


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from rtmap_cli.cli import run; run(['--help']);"
        "heavy = {'numpy', 'pyarrow', 'scipy', 'shapely', 'onnxruntime', 'deltalake'};"
        "sys.exit(str(heavy & set(sys.modules)) if heavy & set(sys.modules) else 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_command_modules_import_lightly() -> None:
    code = (
        "import sys, importlib, pathlib;"
        "[importlib.import_module('rtmap_cli.commands.' + p.stem)"
        " for p in pathlib.Path('rtmap_cli/commands').glob('*.py')];"
        "heavy = {'numpy', 'pyarrow', 'scipy', 'shapely', 'onnxruntime', 'deltalake', 'torch'};"
        "sys.exit(str(heavy & set(sys.modules)) if heavy & set(sys.modules) else 0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert result.returncode == 0, result.stderr


def test_rtmap_cli_imports_torch_nowhere() -> None:
    for path in (ROOT / "rtmap_cli").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names.append(node.module)
            assert not any(n.split(".")[0] == "torch" for n in names), path


def test_import_rules() -> None:
    tool = Path(sys.executable).with_name("lint-imports")
    if not tool.exists():
        pytest.skip("import-linter is not installed (extra: dev)")
    result = subprocess.run([str(tool)], capture_output=True, text=True, cwd=ROOT)
    assert result.returncode == 0, result.stdout


def test_wheel_has_two_top_level_names(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", str(tmp_path)]
    result = subprocess.run([*command, str(ROOT)], capture_output=True, text=True)
    if result.returncode and "Could not find a version" in result.stderr:
        pytest.skip("the build backend cannot be fetched without a package index")
    assert result.returncode == 0, result.stderr
    (wheel,) = tmp_path.glob("*.whl")
    names = {n.split("/")[0] for n in zipfile.ZipFile(wheel).namelist()}
    assert {n for n in names if not n.endswith(".dist-info")} == {"rtmap_cli", "rtmap_models"}


def test_zoo_stays_small() -> None:
    files = list((ROOT / "models/rtmap_models/zoo").glob("*.onnx"))
    assert files, "the zoo is empty"
    assert sum(f.stat().st_size for f in files) <= 40e6
    for file in files:
        assert file.with_suffix(".md").exists(), f"{file.name} has no card"
