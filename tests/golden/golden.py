"""Compares what the program writes with what it wrote before, and stores it anew on `pytest tests/golden --regenerate`.

A golden file is text of lines. Text has to be equal. Numbers with a point or an exponent may differ by a relative
`RTOL`: libraries of linear algebra and vector instructions differ in the last bits between machines. Integers have to
be equal, because seeds and counts are integers.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
DATA = Path(__file__).parent / "data"

RTOL = 1e-9
"""Allowed relative difference of two numbers."""

ATOL = 1e-12
"""Allowed absolute difference: results that cancel to nothing differ by the rounding of what they were made of."""

SHOWN = 120
"""Lines of a difference that a failing test shows."""

_NUMBER = re.compile(r"(?<![\w.#])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.])")


class Golden:
    """Golden files of one test session.

    Args:
        regenerate: whether to write what is given, instead of comparing.
    """

    def __init__(self, regenerate: bool) -> None:
        self.regenerate = regenerate

    def check(self, name: str, text: str, *, rtol: float = RTOL) -> None:
        """Compare a text with the golden file of that name below `data/`.

        Raises:
            pytest.fail.Exception: they differ; the message has the differing lines.
        """
        path = DATA / name
        text = text if text.endswith("\n") else text + "\n"
        if self.regenerate:
            self._store(path, text, rtol)
            return
        if not path.is_file():
            pytest.fail(f"{_relative(path)} is missing; {ADVICE}", pytrace=False)
        expected = path.read_text(encoding="utf-8")
        difference = differing(expected, text, rtol)
        if difference:
            shown = "\n".join(_shortened(difference)[:SHOWN])
            more = f"\n… and {len(difference) - SHOWN} more lines" if len(difference) > SHOWN else ""
            pytest.fail(f"{_relative(path)} differs (- before, + now):\n{shown}{more}\n{ADVICE}", pytrace=False)

    def check_json(self, name: str, value: Any, *, rtol: float = RTOL) -> None:
        """The same for a JSON-ready value, which is stored with one entry to a line."""
        self.check(name, json.dumps(value, indent=1, ensure_ascii=False, sort_keys=True), rtol=rtol)

    def check_lines(self, name: str, rows: Iterable[Any], *, rtol: float = RTOL) -> None:
        """The same for JSON-ready values, one to a line."""
        self.check(name, "\n".join(map(line, rows)), rtol=rtol)

    def _store(self, path: Path, text: str, rtol: float) -> None:
        """Write the file, unless it holds the same within the tolerance."""
        if path.is_file() and not differing(path.read_text(encoding="utf-8"), text, rtol):
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


ADVICE = "If the change is intended: pytest tests/golden --regenerate, and look at the difference before you commit it."


def differing(expected: str, actual: str, rtol: float = RTOL) -> list[str]:
    """Lines of a unified difference, without those that agree within the tolerance; empty if all do."""
    before, now = expected.splitlines(), actual.splitlines()
    # Lines are paired by their text without numbers, so that one inserted line does not shift all others.
    pairs = (
        difflib.SequenceMatcher(None, [_masked(s) for s in before], [_masked(s) for s in now], autojunk=False)
        if before != now
        else None
    )
    if pairs is None:
        return []
    for first, second, size in pairs.get_matching_blocks():
        for i in range(size):
            if agree(before[first + i], now[second + i], rtol):
                now[second + i] = before[first + i]
    return [s for s in difflib.unified_diff(before, now, lineterm="", n=1) if not s.startswith(("---", "+++"))]


def _shortened(difference: Sequence[str], width: int = 160) -> list[str]:
    """Long lines that changed, each around the place where it begins to differ from its counterpart."""
    found, start = list(difference), 0
    while start < len(found):
        end = start
        while end < len(found) and found[end][:1] in ("-", "+"):
            end += 1
        old = [i for i in range(start, end) if found[i].startswith("-")]
        new = [i for i in range(start, end) if found[i].startswith("+")]
        for i, j in zip(old, new, strict=False):
            same = next((n for n, (a, b) in enumerate(zip(found[i][1:], found[j][1:], strict=False)) if a != b), 0)
            for k in (i, j):
                if len(found[k]) > width and same > width // 2:
                    found[k] = f"{found[k][:30]} … {found[k][same - width // 2 : same + width // 2]} …"
        start = max(end, start + 1)
    return [text if len(text) <= 2 * width else text[: 2 * width] + " …" for text in found]


def agree(expected: str, actual: str, rtol: float = RTOL) -> bool:
    """Whether two lines have the same text and, within the tolerance, the same numbers."""
    if expected == actual:
        return True
    if _masked(expected) != _masked(actual):
        return False
    pairs = zip(_NUMBER.findall(expected), _NUMBER.findall(actual), strict=True)
    return all(a == b or (_is_float(a) and _is_float(b) and _close(float(a), float(b), rtol)) for a, b in pairs)


def _masked(text: str) -> str:
    return _NUMBER.sub("#", text)


def _is_float(number: str) -> bool:
    return not number.lstrip("+-").isdigit()


def _close(a: float, b: float, rtol: float) -> bool:
    return math.isclose(a, b, rel_tol=rtol, abs_tol=ATOL)


def _relative(path: Path) -> Path:
    return path.relative_to(ROOT)


# -- what is stored ----------------------------------------------------------------------------------------------------


def line(value: Any) -> str:
    """A JSON-ready value on one line."""
    return json.dumps(value, ensure_ascii=False, separators=(", ", ": "))


LONGEST = 6
"""Numbers of a list that are stored one by one."""


def compact(value: Any) -> Any:
    """A JSON-ready value with 11 significant digits, in which long lists are replaced by sums.

    Of numbers there are two sums. The second one is weighted by position, so that an exchange of two numbers shows.
    Of mappings there are the sums of each key.
    """
    if isinstance(value, float):
        return _rounded(value)
    if isinstance(value, Mapping):
        return {str(key): compact(found) for key, found in value.items()}
    if isinstance(value, list | tuple):
        if len(value) > LONGEST and all(isinstance(one, Mapping) for one in value):
            return columns(value)
        numbers = _numbers(value)
        if numbers is not None and len(numbers) > LONGEST:
            weighted = math.fsum((i + 1) * number for i, number in enumerate(numbers)) / len(numbers)
            return {"numbers": len(numbers), "sum": _rounded(math.fsum(numbers)), "weighted": _rounded(weighted)}
        return [compact(found) for found in value]
    return value


def columns(table: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A long table by column: sums of numbers, and how often there is each other value."""
    rows = [flat(row, sums=True) for row in table]
    found: dict[str, Any] = {"rows": len(rows)}
    for key in dict.fromkeys(key for row in rows for key in row):
        cells = [row[key] for row in rows if key in row]
        numbers = [one for one in cells if _numbers(one) is not None]
        others = Counter(text_digest(one) for one in cells if _numbers(one) is None)
        found[key] = {
            "of": len(cells),
            **({} if not numbers else {"is": compact(numbers)}),
            **dict(sorted(others.items())),
        }
    return found


def text_digest(value: Any) -> str:
    """A text as it is, if it is short; else a hash of its characters, with five digits of its numbers."""
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    text = _NUMBER.sub(lambda found: f"{float(found[0]):.5g}", text)
    return text if len(text) <= 40 else hashlib.sha256(text.encode()).hexdigest()[:12]


def _rounded(value: float) -> float:
    """11 significant digits; always written with a point or an exponent."""
    return float(f"{value:.11g}") if math.isfinite(value) else value


def _numbers(value: Any) -> list[float] | None:
    """All numbers of nested lists in their order; None if there is something else in them."""
    if isinstance(value, bool):
        return None
    if isinstance(value, int | float):
        return [float(value)]
    if not isinstance(value, list | tuple):
        return None
    found: list[float] = []
    for one in value:
        numbers = _numbers(one)
        if numbers is None:
            return None
        found += numbers
    return found


def flat(value: Any, prefix: str = "", *, sums: bool = False) -> dict[str, Any]:
    """A nested mapping as one mapping of dotted keys; sums of numbers stay together, unless asked."""
    if not isinstance(value, Mapping) or not value or ("weighted" in value and not sums):
        return {prefix: value}
    found: dict[str, Any] = {}
    for key, one in value.items():
        found |= flat(one, f"{prefix}.{key}" if prefix else str(key), sums=sums)
    return found


class Changes:
    """Rows of a table of mappings, each without what is as it was in the row of the same kind before."""

    def __init__(self) -> None:
        self._last: dict[str, dict[str, Any]] = {}

    def __call__(self, kind: str, row: Mapping[str, Any]) -> dict[str, Any]:
        """What has changed, dotted; keys that have gone are null."""
        now, last = flat(compact(row)), self._last.get(kind, {})
        self._last[kind] = now
        gone = {key: None for key in last if key not in now}
        return {key: value for key, value in now.items() if key not in last or last[key] != value} | gone


def normalised(text: str, replaced: Sequence[tuple[str, str]] = ()) -> str:
    """A text without what depends on the place, the day and the machine.

    Args:
        replaced: texts such as the paths of folders, with what stands in their place; applied first, in this order.
    """
    for old, new in replaced:
        text = text.replace(old, new)
    text = text.replace(str(ROOT), "<root>")
    for pattern, new in _PASSING:
        text = pattern.sub(new, text)
    return "\n".join(one.rstrip() for one in text.splitlines()) + "\n"


_Replacement = str | Callable[[re.Match[str]], str]

_PASSING: tuple[tuple[re.Pattern[str], _Replacement], ...] = (
    (re.compile(r"\b\d{4}-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d(?:\.\d+)?)?(?:Z|[+-]\d\d:\d\d)?"), "<time>"),
    (
        re.compile(
            r"\b\d\d? (?:January|February|March|April|May|June|July|August|September|October|November|December) "
            r"\d{4}(?:,? (?:at )?\d\d:\d\d(?: UTC)?)?"
        ),
        "<time>",
    ),
    (re.compile(r"\b\d{4}-\d\d-\d\d\b"), "<date>"),
    (re.compile(r"-20\d{6}-(\d+)\b"), r"-<date>-\1"),
    (re.compile(r"\x1b\[[0-9;]*m"), ""),
    (re.compile(r"[\x00-\x08\x0b-\x1f\x7f]"), lambda found: f"\\x{ord(found[0]):02x}"),
)
