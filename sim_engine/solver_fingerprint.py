"""Digests of sources: results of the same sources belong together.

- `solver_fingerprint` covers the solver's code, without comments and layout. Records of validation carry it.
- `folder_digest` covers the files of a folder. A study's cells carry it, and nodes of a cluster compare it.
"""

from __future__ import annotations

import ast
import hashlib
from pathlib import Path

ROOT = Path(__file__).parent.parent
BEGINNINGS = ("sim_engine.simulator", "sim_engine.fluid.engine")
"""Modules from which the search begins; the engine is imported only when it is needed."""


def solver_fingerprint(root: Path = ROOT) -> str:
    """Hash of the solver's code, in 16 digits: comments, docstrings and layout do not change it.

    Args:
        root: folder that contains `sim_engine`.
    """
    digest = hashlib.sha256()
    for name, tree in sorted(_modules(root).items()):
        digest.update(f"{name}\n{ast.dump(tree)}\n".encode())
    return digest.hexdigest()[:16]


def folder_digest(folder: Path) -> str:
    """Digest of a folder's Python sources, in 12 digits; any change of a file changes it."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        if path.parent.name == "validation":
            continue  # it evaluates outcomes but does not produce any
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def _modules(root: Path) -> dict[str, ast.Module]:
    """The modules that `BEGINNINGS` import from this project, directly or indirectly, without docstrings."""
    trees: dict[str, ast.Module] = {}
    waiting = list(BEGINNINGS)
    while waiting:
        name = waiting.pop()
        path = root.joinpath(*name.split(".")).with_suffix(".py")
        if name in trees or not path.exists():
            continue
        trees[name] = tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.level == 0 and node.module is not None:
                waiting += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            elif isinstance(node, ast.Import):
                waiting += [alias.name for alias in node.names]
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                # A string expression has no effect: it is a docstring, or explains the name above it.
                node.body = [each for each in node.body if not _is_text(each)] or [ast.Pass()]
    return trees


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
