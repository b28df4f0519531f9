"""`console_view`: tables at the widths of terminals."""

from __future__ import annotations

import itertools
import re

import pytest
from rich.console import Console

from orchestrator.reports.console_view import TextTable

HEADS = ["run", "strategies", "angular velocity [deg/s]", "spilled / poured", "remark"]
ROWS = [
    ["quickstart-20300301-1", "C4, D3", "72.6", "0.96 %", ""],
    ["quickstart-20300301-2", "D2", "150", "91.33 %", "the cups touch at the start of the pour"],
]


def shown(width: int) -> list[str]:
    console = Console(width=width, force_terminal=False, record=True, quiet=False, file=None)
    with console.capture() as captured:
        console.print(TextTable(HEADS, ROWS, numbers={2, 3}, title="all runs"))
    return captured.get().splitlines()


@pytest.mark.parametrize("width", [40, 60, 80, 90, 100, 110, 120, 200])
def test_no_word_of_a_table_is_cut(width: int) -> None:
    lines = shown(width)
    assert max(map(len, lines)) <= width
    words = set(re.findall(r"\S+", "\n".join(lines)))
    assert words >= {word for text in itertools.chain(HEADS, *ROWS) for word in text.split()}
    assert "…" not in "".join(words)


def test_a_row_that_does_not_fit_as_columns_is_a_list_of_heads_and_cells() -> None:
    assert shown(60) == [
        "all runs",
        "run quickstart-20300301-1",
        "  strategies C4, D3 · angular velocity [deg/s] 72.6",
        "  spilled / poured 0.96 %",
        "run quickstart-20300301-2",
        "  strategies D2 · angular velocity [deg/s] 150",
        "  spilled / poured 91.33 %",
        "  remark the cups touch at the start of the pour",
    ]


def test_short_columns_keep_their_line_and_the_longest_one_is_wrapped() -> None:
    lines = [line.rstrip() for line in shown(110)]
    assert any("0.96 %" in line and "C4, D3" in line for line in lines)
    assert "the cups touch at the" in "\n".join(lines)
