"""`decant.plugins` and `decant.plugins.testing` are enough to write plug-ins with, and cheap to import."""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

from decant import plugins
from decant.plugins import testing

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "tests" / "plugins" / "decant_example"
PAGES = sorted((ROOT / "docs" / "extend").glob("*.md"))
REFERENCE = ROOT / "docs" / "reference" / "plugins.md"
PUBLIC = {"decant", "decant.plugins", "decant.plugins.testing"}
OWN = {"decant", "orchestrator", "actors", "sim_engine"}
HEAVY = ["ray", "taichi", "rerun", "sqlite3"]

IMPORTS = """
import json, sys
import decant.plugins as plugins, decant.plugins.testing as testing
first = sorted({name.partition(".")[0] for name in sys.modules})
for module in (plugins, testing):
    for name in module.__all__:
        getattr(module, name)
print(json.dumps([first, sorted({name.partition(".")[0] for name in sys.modules})]))
"""


def imported(text: str) -> Iterator[str]:
    """Modules of Decant that a program imports, wherever in its text, with each name that it imports from them."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.partition(".")[0] in OWN)
        elif isinstance(node, ast.ImportFrom) and node.module is not None and node.module.partition(".")[0] in OWN:
            yield from (f"{node.module}:{alias.name}" for alias in node.names)


@pytest.mark.slow
def test_importing_the_names_of_plug_ins_loads_no_heavy_package() -> None:
    done = subprocess.run(
        [sys.executable, "-c", IMPORTS],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    first, with_all_names = json.loads(done.stdout)
    assert not {*HEAVY, "numpy", "pydantic", "orchestrator", "actors", "sim_engine"} & set(first)
    assert not set(HEAVY) & set(with_all_names)


@pytest.mark.parametrize("path", sorted(EXAMPLE.glob("*.py")), ids=lambda path: path.name)
def test_the_example_imports_only_public_names(path: Path) -> None:
    used = set(imported(path.read_text(encoding="utf-8")))
    assert {name.partition(":")[0] for name in used} <= PUBLIC


def test_the_page_for_authors_of_plug_ins_imports_only_public_names() -> None:
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    blocks = re.findall(r"^( *)```python\n(.*?)^ *```", text, re.MULTILINE | re.DOTALL)
    used = {name for _, block in blocks for name in imported(textwrap.dedent(block))}
    assert "decant.plugins.testing:BalanceContract" in used
    for name in used:
        module, _, public = name.partition(":")
        assert module in PUBLIC
        assert not public or public in import_module(module).__all__


def test_the_page_for_authors_of_plug_ins_lists_every_public_name() -> None:
    page = "".join(path.read_text(encoding="utf-8") for path in [REFERENCE, *PAGES])
    assert [name for module in (plugins, testing) for name in module.__all__ if f"`{name}`" not in page] == []


@pytest.mark.parametrize("module", [plugins, testing], ids=lambda module: module.__name__)
def test_a_type_checker_and_the_interpreter_find_the_same_names(module: ModuleType) -> None:
    assert module.__file__ is not None
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    (guarded,) = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    for_types = {
        alias.asname or alias.name: (node.module, alias.name)
        for node in guarded.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert sorted(for_types) == sorted(module.__all__) == dir(module)
    for name, (source, original) in for_types.items():
        assert source is not None
        assert getattr(module, name) is getattr(import_module(source), original)
    with pytest.raises(AttributeError, match="has no attribute 'Quantty'"):
        module.Quantty  # noqa: B018


UNTYPED = ["--ignore-missing-imports"]
"""For roslibpy, which has no types, and which not everybody installs."""


@pytest.mark.slow
def test_a_strict_type_checker_accepts_the_example_and_finds_misspelt_names(tmp_path: Path) -> None:
    shutil.copytree(EXAMPLE, tmp_path / "decant_example")
    (tmp_path / "decant_example" / "misspelt.py").write_text("from decant.plugins import Quantty\n")
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), *UNTYPED, "decant_example"],
        cwd=tmp_path,
        env={**os.environ, "MYPYPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    (problem,) = [line for line in done.stdout.splitlines() if line.startswith("decant_example") and ": error:" in line]
    assert 'misspelt.py:1: error: Module "decant.plugins" has no attribute "Quantty"' in problem
