"""Rewrites files of earlier versions: retired keys and values get their present names, and everything else stays.

The settings classes declare the names (`Settings.retired`); reading a file finds those that it uses, with their places.
Only these places of the text are replaced, so that comments and layout are kept.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from orchestrator.config.yaml.file_access import resolved
from orchestrator.config.yaml.yaml_errors import ConfigError, Problem

ROUNDS = 20
"""Keys below a renamed key are found in a further round: the nesting of settings is less deep."""


@dataclass(frozen=True)
class Migration:
    """The result of a file.

    Attributes:
        renamed: (line, old name, new name), in the order in which they were found.
        problems: what is left, which a person has to change.
    """

    renamed: tuple[tuple[int, str, str], ...]
    problems: tuple[Problem, ...]


def migrate_file(path: Path, load: Callable[[Path], object]) -> Migration:
    """Rename what is retired in a file, in place. Files that it refers to are read and not changed.

    Args:
        path: the file.
        load: reads a file of its kind, and raises `ConfigError` with all problems.

    Raises:
        ConfigError: the file can't be read.
        OSError: it can't be written.
    """
    path = resolved(path)
    renamed: list[tuple[int, str, str]] = []
    for _ in range(ROUNDS):
        try:
            load(path)
        except ConfigError as error:
            problems = error.problems
        else:
            return Migration(tuple(renamed), ())
        found = [problem for problem in problems if problem.path == path and problem.renamed]
        text, done = _replaced(path.read_bytes().decode("utf-8"), found)
        if not done:
            return Migration(tuple(renamed), problems)
        complete = path.with_name(f".{path.name}.migrated")
        complete.write_bytes(text.encode("utf-8"))
        shutil.copymode(path, complete)
        complete.replace(path)  # at once: an interruption leaves the old file or the new one
        renamed += done
    return Migration(tuple(renamed), problems)


def _replaced(text: str, problems: Iterable[Problem]) -> tuple[str, list[tuple[int, str, str]]]:
    """The text with the new names, and what was replaced."""
    lines, done = list(io.StringIO(text, newline="")), []  # the line breaks that the parser counts
    for problem in sorted(problems, key=lambda one: (one.line, one.column), reverse=True):
        assert problem.renamed is not None
        old, new = problem.renamed
        line, at = lines[problem.line - 1], problem.column - 1
        at += line[at : at + 1] in ("'", '"')
        if line.startswith(old, at):
            lines[problem.line - 1] = line[:at] + new + line[at + len(old) :]
            done.append((problem.line, old, new))
    return "".join(lines), done[::-1]
