"""A night over the protocols: a few pours of what `tests.reliability.night` and `night_kills` make hundreds of."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from actors.runtime.child_process import child_environment
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.records.run_registry import VARIABLE
from orchestrator.runs.run_engine import run_campaign
from tests.reliability.afterwards import record
from tests.reliability.mixture_night import KINDS, MixtureNight, night_plan
from tests.reliability.night import FAULTS, ROOT, Night, chosen
from tests.reliability.night_verdict import compare, night
from tests.reliability.program import Optimizer
from tests.support.toy_campaign import ToyLaboratory


@pytest.mark.slow
@pytest.mark.realtime
def test_each_fault_of_a_night_ends_in_a_safe_state_with_one_message_and_a_person_continues_it(tmp_path: Path) -> None:
    lost, spilled = (next(fault for fault in FAULTS if fault.kind.startswith(word)) for word in ("lost", "spilled"))
    night = Night(tmp_path, 5, {2: spilled, 4: lost})
    asyncio.run(night.run())
    assert night.wrong == []
    assert [(cycle.fault, cycle.first) for cycle in night.cycles if cycle.messages] == [
        (spilled.kind, "mass"),
        (lost.kind, "recover"),
    ]


@pytest.mark.slow
@pytest.mark.realtime
def test_a_fault_in_a_night_of_mixtures_ends_safe_with_one_message_and_every_cup_is_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    lost = next(fault for fault in KINDS if fault.kind == "lost while moving" and "{cup}" in fault.at)
    night = MixtureNight(tmp_path, night_plan(tmp_path, 2, 3, ("water", "oil")), [(1, lost)])
    result = asyncio.run(night.run())
    assert night.wrong == []
    assert [(attempt.outcome, attempt.messages) for attempt in night.tries if attempt.fault] == [("weighed", 1)]
    assert night.runs == 2
    assert [cup.state for cup in result.cups] == ["full", "full"]
    assert all(abs(share - true) <= 2.0 * half for share, half, true in night.shares(result))


@pytest.mark.slow
@pytest.mark.realtime
def test_every_place_tells_the_same_verdict_of_a_night_in_which_doses_are_missed_refused_and_unknown(
    tmp_path: Path,
) -> None:
    """Five cups; `night_verdict` plays 24 of them."""
    assert compare(asyncio.run(night(tmp_path, 5, ("water", "oil")))) == []


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(("series", "kills"), [([], 3), (["--mixtures"], 2)], ids=["pours", "mixtures"])
def test_a_daemon_that_is_killed_in_a_night_moves_nothing_again_without_consent(
    series: list[str], kills: int, tmp_path: Path
) -> None:
    """In a process of its own: the daemons are forked from it."""
    command = [sys.executable, "-m", "tests.reliability.night_kills", *series, "--kills", str(kills)]
    ended = subprocess.run(
        [*command, "--results", str(tmp_path / "kills.jsonl")],
        check=False,
        cwd=ROOT,
        env=child_environment(),
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr[-2000:]


@pytest.mark.parametrize("strategy", ["C3", "C4"])
def test_a_night_makes_the_decisions_of_the_attended_campaign_with_the_same_seed(tmp_path: Path, strategy: str) -> None:
    """Compared are all requests and decisions, on a bench whose outcomes follow from action and seed."""

    def decided(name: str, *, attended: bool) -> list[Any]:
        (folder := tmp_path / name).mkdir()
        yaml = YAML()
        laboratory, campaign = (
            yaml.load(ROOT / "configs" / kind / "night.yaml") for kind in ("laboratories", "campaigns")
        )
        if attended:
            del campaign["unattended"]
            for key in ("gripper", "places", "safeguard", "source"):
                del laboratory[key]
        yaml.dump(laboratory, folder / "lab.yaml")
        calibration = campaign["calibration"]
        calibration |= {
            "strategy": strategy,
            "simulations": 6,
            "initial_samples": 2,
            "pours": {"count": 5, "holdout": 2},
        }
        campaign |= {"laboratory": "lab.yaml", "outputs": {"directory": "runs", "recording": False, "figures": False}}
        yaml.dump(campaign, folder / "night.yaml")
        plan = load_campaign(folder / "night.yaml")
        toy: Any = ToyLaboratory(optimizer=Optimizer())  # type: ignore[arg-type]
        asyncio.run(run_campaign(plan, toy, folder / "run", ask_operator=None))
        assert toy.bench.poured
        return record(folder / "run")

    night = decided("night", attended=False)
    assert len(night) > 20
    assert night == decided("attended", attended=True)


def test_faults_of_a_night_happen_in_different_cycles_that_do_not_follow_each_other() -> None:
    numbers = list(chosen(200, 20))
    assert len(numbers) == 20
    assert all(later - sooner > 1 for sooner, later in pairwise(numbers))
    assert min(numbers) > 1
