"""`decant.simulate` and `decant.simulate_many`: the same outcomes in every thread and in a batch."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import decant
from sim_engine.errors import InvalidSceneError
from sim_engine.outcome import PourOutcome

ACTIONS: list[dict[str, str | float]] = [{"angular_velocity": speed, "x_offset": 100} for speed in (60, 80, 100)]


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> decant.CampaignPlan:
    """The quickstart with few particles."""
    content = dict(decant.load_campaign(decant.shipped("campaigns/quickstart.yaml")).resolved)
    content["simulator"] = {"parameters": {"particles": 250}}
    content["calibration"] = None
    content = {name: section for name, section in content.items() if section is not None}
    return decant.build_campaign(content, tmp_path_factory.mktemp("campaign"))


def outcomes(simulation: decant.Simulation) -> list[PourOutcome]:
    return [replace(pour.outcome, cpu_s=0.0) for pour in simulation.pours]


def test_a_batch_and_threads_have_the_outcomes_of_calls_one_after_the_other(campaign: decant.CampaignPlan) -> None:
    told: list[tuple[int, int]] = []
    alone = [outcomes(decant.simulate(campaign, action, seeds=2)) for action in ACTIONS]
    batch = decant.simulate_many(
        campaign, ACTIONS, seeds=2, workers=2, progress=lambda done, of: told.append((done, of))
    )
    assert [outcomes(simulation) for simulation in batch] == alone
    assert told[-1] == (6, 6)
    with ThreadPoolExecutor(3) as threads:
        assert list(threads.map(lambda a: outcomes(decant.simulate(campaign, a, seeds=2)), ACTIONS)) == alone
    with pytest.raises(decant.InvalidArgumentError, match=r"draw this action with decant\.simulate"):
        batch[0].figure()


def test_theta_is_also_a_file_as_for_a_plan(campaign: decant.CampaignPlan, tmp_path: Path) -> None:
    theta = campaign.parameters.model_copy(update={"friction": 0.5})
    path = tmp_path / "theta.json"
    path.write_text(json.dumps(theta.model_dump()), encoding="utf-8")
    by_value = decant.simulate(campaign, ACTIONS[0], theta=theta)
    by_path = decant.simulate(campaign, ACTIONS[0], theta=str(path))
    assert by_path.task.parameters == theta
    assert outcomes(by_path) == outcomes(by_value)


@pytest.mark.parametrize(
    ("actions", "options", "error", "said"),
    [
        ([ACTIONS[0], {"angular_velocity": "3 kg"}], {}, decant.AssignmentError, r"actions\[1\]: .*angular_velocity"),
        ([ACTIONS[0], {**ACTIONS[0], "x_offset": 20, "height": 2}], {}, InvalidSceneError, r"actions\[1\]: "),
        (ACTIONS[0], {}, decant.InvalidArgumentError, "should be a list of actions"),
        (ACTIONS, {"workers": 0}, decant.InvalidArgumentError, "workers=0: should be 1 or more"),
        (ACTIONS, {"seeds": 0}, decant.InvalidArgumentError, "seeds=0: should be 1 or more"),
    ],
)
def test_a_batch_is_refused_before_its_first_simulation(
    campaign: decant.CampaignPlan, actions: Any, options: dict[str, Any], error: type[Exception], said: str
) -> None:
    told: list[int] = []
    with pytest.raises(error, match=said):
        decant.simulate_many(campaign, actions, progress=lambda done, of: told.append(done), **options)
    assert not told


def test_an_action_that_the_laboratorys_arm_can_not_make_is_simulated_with_a_warning(
    campaign: decant.CampaignPlan,
) -> None:
    with pytest.warns(UserWarning, match="the arm can't make this pour"):
        decant.simulate(campaign, {"angular_velocity": 200, "x_offset": 100})


def test_no_action_is_no_simulation(campaign: decant.CampaignPlan) -> None:
    assert decant.simulate_many(campaign, []) == []
