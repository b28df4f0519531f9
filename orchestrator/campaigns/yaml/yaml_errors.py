"""Problems of input files with their places, and the error that reports them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from sim_engine.errors import DecantError, shown_path

PROBLEMS_SHOWN = 20
LINE_SHOWN, TEXT_SHOWN = 200, 1500
"""Maximum number of characters of a source line and of a message in a report."""


@dataclass(frozen=True)
class Problem:
    """One problem at one place.

    Attributes:
        path: the file.
        line: from 1; 0 for the file as a whole.
        column: from 1.
        where: dotted location in the file, e.g. 'deployment.pours'; empty for the whole file.
        message: the problem, and a correct value.
        source_line: the line as written in the file.
    """

    path: Path
    line: int
    column: int
    where: str
    message: str
    source_line: str = ""

    def __str__(self) -> str:
        """`path:line:col: where: message` with the source line and a caret below."""
        place = shown_path(self.path) if self.line == 0 else f"{shown_path(self.path)}:{self.line}:{self.column}"
        head = ": ".join(text for text in (place, _cut(self.where), _cut(self.message)) if text)
        if not self.source_line.strip():
            return head
        # Tabs would move the caret: both lines are shown with each tab as one space.
        source = self.source_line.replace("\t", " ").rstrip()
        before = self.column - 1
        if len(source) > LINE_SHOWN:  # only the part around the place
            begin = max(0, before - LINE_SHOWN // 2)
            source, before = source[begin : begin + LINE_SHOWN], before - begin
        return f"{head}\n{self.line:5d} | {source}\n      | {' ' * before}^"


class ConfigError(DecantError):
    """A campaign, vessel, laboratory, record or parameter file is invalid; the text is the whole report.

    Attributes:
        problems: all problems, in the order of the files and lines.
    """

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems: tuple[Problem, ...] = tuple(problems)
        lines = [str(problem) for problem in self.problems[:PROBLEMS_SHOWN]]
        if len(self.problems) > PROBLEMS_SHOWN:
            lines.append(f"… and {len(self.problems) - PROBLEMS_SHOWN} more problems; mend these first")
        super().__init__("\n".join(lines))


def _cut(text: str) -> str:
    return text if len(text) <= TEXT_SHOWN else f"{text[: TEXT_SHOWN // 2]} … {text[-TEXT_SHOWN // 4 :]}"


def dotted(loc: Iterable[str | int]) -> str:
    """`('pours', 0, 'mass')` → 'pours[0].mass'."""
    text = ""
    for key in loc:
        text += f"[{key}]" if isinstance(key, int) else f".{key}" if text else str(key)
    return text
