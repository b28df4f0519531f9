"""The structure of the product: no import cycles, unique file names, and texts that name modules or classes resolve."""

from __future__ import annotations

import ast
import collections
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
LAYERS = ("sim_engine", "actors", "orchestrator", "decant")


def modules() -> dict[str, Path]:
    files = [path for layer in LAYERS for path in (ROOT / layer).rglob("*.py")]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files}


SLEEPS = ("time.sleep", "asyncio.sleep")

PROCESSES = ("python_module", "ConnectedProcess")
"""Functions that start the module which their first argument names, in a process of its own."""

NAMED_ONLY = ("sim_engine.solver_fingerprint",)
"""Modules whose texts are no imports of theirs: the fingerprint reads the sources that it names."""


def imported(name: str, path: Path, known: dict[str, Path]) -> set[str]:
    """Modules that one imports: at the top, within functions, for types only, and by a text that names them."""
    found: set[str] = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = list(ast.walk(tree))
    started = {id(node.args[0]) for node in nodes if isinstance(node, ast.Call) and _called(node) in PROCESSES}
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in started:
            text = node.value.partition(":")[0]
            found |= {text} if "." in text and name not in NAMED_ONLY else set()
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            full = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {module if module in known else node.module for module in full}
    return (found & known.keys()) - {name}


def _called(node: ast.Call) -> str:
    return node.func.id if isinstance(node.func, ast.Name) and node.args else ""


def test_no_module_imports_itself_through_others() -> None:
    known = modules()
    order = TopologicalSorter({name: imported(name, path, known) for name, path in known.items()})
    try:
        order.prepare()
    except CycleError as error:
        raise AssertionError(" → ".join(error.args[1])) from None


def test_every_file_name_is_unique() -> None:
    names = collections.Counter(path.name for path in modules().values() if not path.name.startswith("__"))
    assert [name for name, count in names.items() if count > 1] == []


def test_tests_mirror_the_product() -> None:
    """`actors/arm/ur/ur_driver.py` is tested in `tests/actors/arm/ur/test_ur_driver.py` and `test_ur_driver_losses.py`.

    A file about a whole package has the package's name. What spans packages stands in a folder named by its subject.
    """
    known = {path.parent / path.stem.replace("__init__", path.parent.name) for path in modules().values()}
    tests = ROOT / "tests"
    wrong = []
    for path in [path for layer in LAYERS for path in (tests / layer).rglob("*.py") if path.name != "conftest.py"]:
        folder, words = ROOT / path.relative_to(tests).parent, path.stem.split("_")
        tested = {folder / "_".join(words[1:end]) for end in range(2, len(words) + 1)}
        if words[0] != "test" or not tested & known:
            wrong.append(str(path.relative_to(ROOT)))
    assert wrong == []


def test_every_file_of_tests_has_a_name_of_its_own() -> None:
    names = collections.Counter(path.name for path in (ROOT / "tests").rglob("test_*.py"))
    assert [name for name, count in names.items() if count > 1] == []


def test_no_import_is_written_as_text() -> None:
    """import-linter and the test of circles see imports only."""
    pattern = re.compile(r'"((?:sim_engine|actors|orchestrator|decant)(?:\.\w+)+:\w+)"')
    assert [text for path in modules().values() for text in pattern.findall(path.read_text("utf-8"))] == []


def test_modules_that_commands_name_exist() -> None:
    """`python -m MODULE` and the modules in docstrings, comments and pages: a file or a package of that name exists."""
    known = modules()
    pattern = re.compile(r"(?<![\w./])((?:sim_engine|actors|orchestrator)(?:\.[a-z_0-9]+)+)")
    wrong = []
    for path in [*known.values(), *(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]:
        for name in pattern.findall(path.read_text(encoding="utf-8")):
            parts = name.split(".")
            # the last part may be a function or constant of a module
            if name not in known and ".".join(parts[:-1]) not in known:
                wrong.append(f"{path.relative_to(ROOT)}: {name}")
    assert wrong == []


def test_journals_are_read_by_one_module_outside_the_engine() -> None:
    readers = [name for name, path in modules().items() if "JournalReader" in path.read_text(encoding="utf-8")]
    engine = ("orchestrator.records.journal", "orchestrator.runs.")
    assert [name for name in readers if not name.startswith(engine)] == ["orchestrator.records.run_record"]


def test_a_test_that_sleeps_says_why() -> None:
    """A loop that polls waits for its condition. A sleep elsewhere has a comment in its line or in the one above."""
    silent = []
    for path in (ROOT / "tests").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        polls = {id(node) for loop in ast.walk(tree) if isinstance(loop, ast.While) for node in ast.walk(loop)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and id(node) not in polls and ast.unparse(node.func) in SLEEPS:
                yields = isinstance(node.args[0], ast.Constant) and node.args[0].value == 0
                lines = text.splitlines()[max(node.lineno - 2, 0) : node.lineno]
                if not yields and not any("  # " in line or line.strip().startswith("#") for line in lines):
                    silent.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert silent == []
