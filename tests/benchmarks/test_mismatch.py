"""`benchmarks/mismatch.py` compares only what was run on the same benches."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest


@pytest.fixture
def mismatch(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import mismatch

    return mismatch


def run(level: str, seed: int, lost: float) -> dict[str, Any]:
    return {"level": level, "seed": seed, "poured": [lost, lost]}


def test_a_number_of_simulations_without_all_seeds_has_no_figure(mismatch: ModuleType) -> None:
    usual = [run(level, seed, 0.2) for level in mismatch.BUDGET_LEVELS for seed in (1, 2)]
    fewer = [run("cliff, small", 1, 0.3), run("cliff, small", 2, 0.3), run("cliff, moderate", 1, 0.3)]
    assert mismatch.budget_rows(usual, {37: usual, 9: fewer}) == [
        ["9", "0.300 (+0.100, +0.100 … +0.100)", "–", "–"],
        ["37", "0.200", "0.200", "0.200"],
    ]


def test_a_table_says_where_its_figures_come_from(
    mismatch: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    import machine

    (tmp_path / "results.json").write_text('{"other": 1}')
    monkeypatch.setattr(machine, "TABLES", tmp_path / "results.json")
    machine.write_table("budgets", ["a"], [["b"]], "a command", "some settings")
    tables = machine.json.loads(machine.TABLES.read_text())
    assert tables["other"] == 1
    assert tables["budgets"] | {"head": ["a"], "rows": [["b"]], "command": "a command"} == tables["budgets"]
    assert tables["budgets"]["settings"] == "some settings"
    assert {"date", "version", "machine"} <= set(tables["budgets"])


def test_the_table_of_wrong_simulators_is_of_the_runs_that_were_kept(
    mismatch: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    kept, page, data = tmp_path / "runs.jsonl", tmp_path / "page.md", tmp_path / "rows.csv"
    asked = ["--levels", "small", "--strategies", "adaptive", "--first", "0", "--seeds", "1", "--pours", "3"]
    monkeypatch.setattr(sys, "argv", ["mismatch.py", *asked, "--simulations", "8", "--out", str(kept)])
    mismatch.main()
    made = kept.read_text()
    run = json.loads(made)
    assert (run["level"], run["arm"], run["seed"], len(run["poured"])) == ("small", "adaptive", 0, 3)
    monkeypatch.setattr(mismatch, "campaign", None)  # nothing is made again
    mismatch.main()
    stored = [
        mismatch.HEAD,
        *([level, "D3, `adaptive`", *6 * [word]] for level, word in (("small", "old"), ("large", "kept"))),
    ]
    with data.open("w", newline="") as file:
        csv.writer(file).writerows(stored)
    page.write_text("before\n<!-- measured: mismatch -->\n<!-- end of measured -->\nafter\n")
    monkeypatch.setattr(mismatch, "PAGE", page)
    monkeypatch.setattr(mismatch, "DATA", data)
    monkeypatch.setattr(mismatch, "FEWEST", 1)
    monkeypatch.setattr(sys, "argv", ["mismatch.py", "--first", "0", "--seeds", "1", "--out", str(kept), "--write"])
    mismatch.main()
    assert kept.read_text() == made
    written = page.read_text()
    assert f"| small | D3, `adaptive` | {np.mean(run['poured']):.3f} (" in written
    inside = [low <= lost <= high for low, high, lost in run["bands"]]
    assert f"{int(inside[0])} of 1, then {sum(inside[1:])} of 2" in data.read_text()
    assert "old" not in written
    assert "| large | D3, `adaptive` | kept | kept |\n" in written
    assert data.read_text().splitlines()[2] == 'large,"D3, `adaptive`",kept,kept,kept,kept,kept,kept'
    assert written.startswith("before")
    assert written.endswith("after\n")
