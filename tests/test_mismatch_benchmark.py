"""`benchmarks/mismatch.py` compares only what was run on the same benches."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest


@pytest.fixture
def mismatch(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
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


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("level", ["cliff, moderate", "cliff, four axes"])
def test_one_hypothesis_of_the_ideal_player_is_the_bench(mismatch: ModuleType, level: str, seed: int) -> None:
    import ideal_player

    rng = np.random.default_rng(seed)
    valley = mismatch.Valley(level, seed)
    hypotheses = ideal_player.Hypotheses(valley, "sign", rng)
    actions = rng.random((200, len(valley.space.axes)))
    differences = np.abs(hypotheses.losses(actions) - [valley.true(one) for one in actions]).max(axis=1)
    assert differences.min() < 1e-9
    assert differences.max() > 0.1, "hypotheses differ"
