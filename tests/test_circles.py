"""No two files need each other, directly or around corners: each can be read and tested after those below it.

Modules that import others by text name what exists.
"""

from __future__ import annotations

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from pkgutil import resolve_name

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = ("sim_engine", "actors", "orchestrator")

SETTINGS = ("spec.py", "settings.py")
MAKERS = ("build", "driver", "stand_in", "look", "plan", "resolve", "unknown_tag", "set_parameters")
"""Methods of settings that make what they are settings of, hand it their values, or ask the door they are found at."""


def modules() -> dict[str, Path]:
    files = [path for floor in FLOORS for path in (ROOT / floor).rglob("*.py")]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files}


def needed(name: str, path: Path, known: dict[str, Path]) -> set[str]:
    """Modules that one imports, wherever in its text: also for types only, also within functions.

    Settings know what is made of them: where they make it, and what it is made with, they may name it.
    """
    found: set[str] = set()
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and (node.name in MAKERS or path.name in SETTINGS):
            node.body = [line for line in node.body if not isinstance(line, ast.Import | ast.ImportFrom)]
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test) and path.name in SETTINGS:
            node.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {module if module in known else node.module for module in inner}
    return (found & known.keys()) - {name}


def test_no_file_is_needed_by_what_it_needs() -> None:
    known = modules()
    order = TopologicalSorter({name: needed(name, path, known) for name, path in known.items()})
    try:
        order.prepare()
    except CycleError as error:
        raise AssertionError(" → ".join(error.args[1])) from None


NAMED = re.compile(r"(?:actors|orchestrator|sim_engine)(?:\.\w+)+:\w+")


def names_given_as_text() -> list[str]:
    """'module:name' texts of the product, except in docstrings: what is imported by `resolve_name`."""
    trees = [ast.parse(path.read_text()) for path in modules().values()]
    texts = (node.value for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant))
    return sorted({text for text in texts if isinstance(text, str) and NAMED.fullmatch(text)})


@pytest.mark.parametrize("name", names_given_as_text())
def test_a_name_given_as_text_exists(name: str) -> None:
    assert resolve_name(name) is not None
