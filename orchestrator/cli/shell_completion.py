"""Candidates for shell completion: input files of the right kind, runs, vessels, and campaigns of a daemon.

Typer makes the completion scripts for bash, zsh and fish (`decant --install-completion`). The functions here return the
candidates for one argument. They never fail: without a candidate, bash and zsh complete names of files.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

RUNS = Path("runs")
"""Folder in which commands search runs that are given by name."""

DEPTH = 3
"""Number of folder levels that are searched for files."""

FILE_LIMIT = 500
"""Number of YAML files after which a search ends."""

_TOP_LEVEL_KEY = re.compile(r"""^["']?(\w+)["']?\s*:""", re.MULTILINE)


def files_of(kind: str) -> Callable[[str], list[str]]:
    """Return the completion of an argument that takes an input file.

    Args:
        kind: 'campaign', 'study', 'vessel', 'laboratory' or 'daemon', as `yaml_source.kind_of` returns it.
    """

    def complete(incomplete: str) -> list[str]:
        from orchestrator.campaigns.yaml.yaml_source import kind_of

        matching = []
        for path in _yaml_files(incomplete):
            try:
                keys = _TOP_LEVEL_KEY.findall(path.read_text(encoding="utf-8", errors="replace"))
            except OSError:
                continue
            if kind_of(dict.fromkeys(keys)) == kind:
                matching.append(str(path))
        return matching

    return complete


def _yaml_files(incomplete: str) -> list[Path]:
    """The YAML files whose paths begin with the text, also in folders further down; run folders are left out."""
    from orchestrator.records.journal import JOURNAL_NAME

    start, beginning = os.path.split(incomplete)
    files: list[Path] = []
    for folder, folders, names in os.walk(start or "."):
        parent = Path(folder)
        depth = len(parent.relative_to(start or ".").parts)
        first = beginning if depth == 0 else ""
        if JOURNAL_NAME in names or len(files) > FILE_LIMIT:
            folders.clear()
            continue
        folders[:] = sorted(name for name in folders if name.startswith(first) and not name.startswith("."))
        if depth == DEPTH:
            folders.clear()
        files += [
            parent / name for name in sorted(names) if name.startswith(first) and name.endswith((".yaml", ".yml"))
        ]
    return files


def catalogued_runs(incomplete: str) -> list[str]:
    """Names of the runs in this machine's catalogue, newest first."""
    from orchestrator.records.run_registry import known, state_directory

    try:
        folders = [path for path in known(state_directory()) if path.is_dir()]
    except OSError:
        return []
    return [path.name for path in reversed(folders) if path.name.startswith(incomplete)]


def local_runs(incomplete: str) -> list[str]:
    """Names of the runs in the folder runs/."""
    from orchestrator.records.journal import JOURNAL_NAME

    return sorted(
        path.parent.name for path in RUNS.glob(f"*/{JOURNAL_NAME}") if path.parent.name.startswith(incomplete)
    )


def catalogued(column: str) -> Callable[[str], list[str]]:
    """Return the completion of a condition on the catalogue, for example the names of all receivers.

    Args:
        column: of the runs in the catalogue.
    """

    def complete(incomplete: str) -> list[str]:
        return sorted({name for name in _values(column) if name.startswith(incomplete)})

    return complete


def _values(column: str) -> Iterator[str]:
    from orchestrator.catalogue.catalogue import Catalogue
    from orchestrator.learning.run_errors import RunError
    from orchestrator.records.run_registry import known, state_directory

    try:
        if not known(state_directory()):
            return
        with Catalogue() as catalogue:
            catalogue.refresh()
            rows = catalogue.runs({})
    except (OSError, RunError):
        return
    for row in rows:
        value = row.get(column)
        yield from value if isinstance(value, list) else [value] if isinstance(value, str) else []


def queued_campaigns(incomplete: str) -> list[str]:
    """Ids of the daemon's newest campaigns; none if no daemon answers."""
    from orchestrator.learning.run_errors import RunError

    try:
        from orchestrator.daemon.api.daemon_client import Client

        with Client() as client:
            return [c["id"] for c in client.get("/campaigns", limit=50) if c["id"].startswith(incomplete)]
    except (ImportError, OSError, RunError):
        return []
