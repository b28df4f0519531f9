"""The optimiser's benchmarks: their tables are made of what was measured, and what was kept is not made again."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture(autouse=True)
def _apart(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path))


def result_of(
    module: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str
) -> dict[str, Any]:
    """What it prints last, on whatever cores this process has."""
    monkeypatch.setattr(module, "pin", lambda core: core)
    monkeypatch.setattr(sys, "argv", [f"{module.__name__}.py", *arguments, "--json"])
    module.main()
    result: dict[str, Any] = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    return result


OPTIMISERS = ("--problems", "spill2", "--optimisers", "Decant", "Sobol", "scikit-optimize", "--seeds", "2")


def test_the_table_of_optimisers_is_of_the_runs_that_were_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    import optimisers

    rival = {"problem": "spill2", "visited": 0.1, "poured": 0.5, "cpu_s": 0.2, "total_s": 1.0}
    before = [{**rival, "optimiser": "scikit-optimize", "seed": seed, "reported": 0.2 + seed} for seed in (0, 1)]
    path = tmp_path / "optimisers.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in before), encoding="utf-8")
    result = result_of(optimisers, monkeypatch, capsys, *OPTIMISERS)
    kept = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    assert [(row["optimiser"], row["seed"]) for row in kept[2:]] == [
        (name, seed) for name in ("Decant", "Sobol") for seed in (0, 1)
    ]
    assert [row["optimiser"] for row in result["rows"]] == ["Decant", "Sobol", "scikit-optimize"]
    for row in result["rows"]:
        runs = [run for run in kept if run["optimiser"] == row["optimiser"]]
        assert row["seeds"] == 2
        assert row["reported"] == pytest.approx(np.mean([run["reported"] for run in runs]), abs=1e-4)
        assert row["visited"] == pytest.approx(np.mean([run["visited"] for run in runs]), abs=1e-4)
        low, high = row["interval"]
        assert low <= row["reported"] <= high
    ours, sobol, theirs = result["rows"]
    assert theirs["interval"] == [0.2, 1.2]
    assert 0.0 <= ours["visited"] <= ours["reported"] <= 1.0
    assert ours["per_evaluation"] < sobol["per_evaluation"]

    monkeypatch.setattr(optimisers, "ours", lambda name, world: pytest.fail("made again"))
    assert result_of(optimisers, monkeypatch, capsys, *OPTIMISERS)["rows"] == result["rows"]


def test_what_is_forgotten_is_made_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    import optimisers

    arguments = ("--problems", "spill2", "--optimisers", "Sobol", "--seeds", "1")
    first = result_of(optimisers, monkeypatch, capsys, *arguments)
    made = []
    run = optimisers.ours
    monkeypatch.setattr(optimisers, "ours", lambda name, world: made.append(name) or run(name, world))
    again = result_of(optimisers, monkeypatch, capsys, *arguments, "--fresh", "Sobol")
    assert made == ["Sobol"]
    assert again["rows"][0]["reported"] == first["rows"][0]["reported"]


def test_regret_is_nothing_at_the_minimum_and_observations_scatter_around_it() -> None:
    from optimiser_problems import BY_NAME, Instance

    branin = Instance(BY_NAME["branin"], 0)
    assert branin.true(np.array([(np.pi + 5) / 15, 2.275 / 15])) == pytest.approx(0.0, abs=1e-4)
    hartmann = np.array([0.20169, 0.150011, 0.476874, 0.275332, 0.311652, 0.6573])
    assert Instance(BY_NAME["hartmann6"], 0).true(hartmann) == pytest.approx(0.0, abs=1e-4)
    spill = Instance(BY_NAME["spill2"], 3)
    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 60)] * 2), axis=-1).reshape(-1, 2)
    costs = np.array([spill.true(point) for point in grid])
    assert costs.min() == 0.0
    assert 0.02 < float(np.mean(costs == 0.0)) < 0.12
    assert costs.max() <= 1.0
    noisy = [spill.observe(grid[int(np.argmax(costs))], i) for i in range(15)]
    assert all(0.0 <= cost <= 1.0 for cost in noisy)
    assert np.std(noisy) > 0.0


def test_the_table_of_wrong_simulators_is_of_the_runs_that_were_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    import mismatch

    kept, page = tmp_path / "runs.jsonl", tmp_path / "page.md"
    asked = ["--levels", "small", "--arms", "adaptive", "--first", "0", "--seeds", "1", "--pours", "3"]
    monkeypatch.setattr(sys, "argv", ["mismatch.py", *asked, "--simulations", "8", "--out", str(kept)])
    mismatch.main()
    made = kept.read_text()
    run = json.loads(made)
    assert (run["level"], run["arm"], run["seed"], len(run["poured"])) == ("small", "adaptive", 0, 3)
    monkeypatch.setattr(mismatch, "campaign", None)  # nothing is made again
    mismatch.main()
    rows = "| small | D3, `adaptive` | old |\n| large | D3, `adaptive` | kept |\n"
    page.write_text(f"before\n<!-- measured: mismatch -->\n{rows}<!-- end of measured -->\nafter\n")
    monkeypatch.setattr(mismatch, "PAGE", page)
    monkeypatch.setattr(mismatch, "FEWEST", 1)
    monkeypatch.setattr(sys, "argv", ["mismatch.py", "--first", "0", "--seeds", "1", "--out", str(kept), "--write"])
    mismatch.main()
    assert kept.read_text() == made
    written = page.read_text()
    assert f"| small | D3, `adaptive` | {np.mean(run['poured']):.3f} (" in written
    inside = [low <= lost <= high for low, high, lost in run["bands"]]
    assert f"| {int(inside[0])} of 1, then {sum(inside[1:])} of 2 |" in written
    assert "old" not in written
    assert "| large | D3, `adaptive` | kept |" in written
    assert written.startswith("before")
    assert written.endswith("after\n")
