"""No two files need each other, directly or around corners: each can be read and tested after those below it."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

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
