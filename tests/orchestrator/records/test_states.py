"""`states`: the states of a campaign, its stages and their seeds."""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrator.learning.run_errors import RunError
from orchestrator.records.states import RESTING, TRANSITIONS, State, check_transition
from orchestrator.runs.stages import stage_seed
from tests.support.scripted_strategy import run, states
from tests.support.toy_campaign import ToyLaboratory, toy_stages


def test_an_undisturbed_run_goes_the_straight_way(tmp_path: Path) -> None:
    run(tmp_path / "run")
    assert states(tmp_path / "run") == ["preparing", "running", "finished"]


def test_the_state_table_has_no_dead_ends_but_the_end() -> None:
    assert set(TRANSITIONS) == set(State)
    assert {state for state, ways in TRANSITIONS.items() if not ways} == {State.FINISHED}
    for state in RESTING - {State.FINISHED}:
        assert TRANSITIONS[state] == {State.PREPARING}
    with pytest.raises(RuntimeError, match="can't go from finished to running"):
        check_transition(State.FINISHED, State.RUNNING)


def test_a_finished_run_is_not_run_again(tmp_path: Path) -> None:
    first = run(tmp_path / "run")
    laboratory = ToyLaboratory()
    again = run(tmp_path / "run", laboratory, resume=True)
    assert again.results == first.results
    assert laboratory.simulators.tasks == []


def test_stage_seeds_are_the_same_on_every_machine_and_differ_between_stages() -> None:
    assert stage_seed(7, "calibration") == 38555389313445059
    assert len({stage_seed(seed, name) for seed in range(20) for name in ("pours", "calibration", "evaluation")}) == 60


def test_two_stages_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="stages with different names"):
        run(tmp_path / "run", stages=[toy_stages()[0]] * 2)
