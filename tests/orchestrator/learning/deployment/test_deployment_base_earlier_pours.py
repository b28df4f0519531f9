"""`deployment_base`: pours of before a campaign, from files and former runs: refused where they don't belong,
learnt from elsewhere.
"""

from __future__ import annotations

import asyncio
import dataclasses
import json
import sqlite3
from pathlib import Path
from typing import Any

import pytest

from actors.optimizer.questions import Suggestion, SuggestionQuery
from actors.optimizer.suggest import propose
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.learning.campaign_plan import CampaignPlan, DeploymentPlan
from orchestrator.learning.deployment.d1 import D1Settings, OneShotPlanning
from orchestrator.learning.deployment.d2 import RealOnly
from orchestrator.learning.deployment.d3 import Hybrid
from orchestrator.learning.requests import Suggest
from orchestrator.learning.strategy import Progress
from orchestrator.records.codec import digest
from orchestrator.runs.strategy_harness import THETA, StrategyHarness
from sim_engine.action import DEG
from tests.support.toy_campaign import ToyLaboratory, run_toy
from tests.support.toy_spillage import narrow_cup

CONFIGS = Path(__file__).parents[4] / "configs"

CAMPAIGN = f"""\
name: test
laboratory: {CONFIGS}/laboratories/virtual.yaml
liquid: {{name: water, mass: 200 g}}
pourer: {CONFIGS}/vessels/beaker.yaml
receiver: {CONFIGS}/vessels/narrow.yaml
motion: {{max_angle: 120 deg, height: 50 mm}}
deployment:
  strategy: D2
  actions: {{angular_velocity: [15 deg/s, 120 deg/s], x_offset: [90 mm, 150 mm]}}
  pours: 5
  initial_samples: 4
"""

WITH_RUN = CAMPAIGN + "  data: {run: former}\n"

CSV = """\
angular_velocity_deg_s,x_offset_mm,poured_g,spilled_g,retained_g
30,100,199,20,1
60,120,198,5,2
90,140,200,60,0
"""

CALIBRATION = """\
simulator: {parameters: {cohesion: [0 N/m, 0.1 N/m]}}
calibration:
  actions: {angular_velocity: [15 deg/s, 120 deg/s], x_offset: [90 mm, 150 mm]}
  pours: {count: 8, holdout: 2}
  simulations: 9
"""


class Optimizer:
    async def suggest(self, query: SuggestionQuery) -> Suggestion:
        return propose(query)


def load(folder: Path, text: str) -> CampaignPlan:
    (folder / "campaign.yaml").write_text(text)
    return load_campaign(folder / "campaign.yaml")


def run(folder: Path, text: str) -> None:
    """A run of a campaign on the toy laboratory, in the folder 'former'."""
    laboratory = ToyLaboratory(optimizer=Optimizer())  # type: ignore[arg-type]
    asyncio.run(run_toy(folder / "former", laboratory, plan=load(folder, text), stages=None))


def refusal(folder: Path, text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(folder, text)
    assert str(caught.value).count("campaign.yaml:") == 1, "one cause, one message"
    return str(caught.value)


def deployment(folder: Path, text: str) -> DeploymentPlan:
    plan = load(folder, text).deployment
    assert plan is not None
    return plan


def strategy(plan: DeploymentPlan) -> Any:
    return {"D2": RealOnly, "D3": Hybrid}[plan.strategy](plan, plan.scenes[0], THETA, 1)


def questions(played: StrategyHarness) -> list[SuggestionQuery]:
    return [request.query for request in played.asked if isinstance(request, Suggest)]


def test_a_run_goes_on_from_the_pours_of_a_former_one_and_pours_its_own_budget(tmp_path: Path) -> None:
    run(tmp_path, CAMPAIGN)
    plan = deployment(tmp_path, WITH_RUN)
    assert plan.data is not None
    (former,) = plan.data.pours.values()
    assert len(former) == 5
    played = StrategyHarness(narrow_cup).run(strategy(plan))
    assert len(played.pours) == 5
    assert [len(problem.data) for problem in questions(played)] == [5, 6, 7, 8, 9, 10], "no drawn action to begin with"
    made = {pour.action for pour in former}
    assert not made & {pour.action for pour in played.pours}
    costs = [(pour.spilled + pour.retained) / 0.2 for pour in former]
    assert questions(played)[0].data.costs == pytest.approx(costs)


def test_former_pours_count_only_where_it_is_said(tmp_path: Path) -> None:
    run(tmp_path, CAMPAIGN)
    some = WITH_RUN.replace("pours: 5", "pours: 7").replace("former}", "former, counts: true}")
    assert len(StrategyHarness(narrow_cup).run(strategy(deployment(tmp_path, some))).pours) == 2
    none = strategy(deployment(tmp_path, some.replace("pours: 7", "pours: 3")))
    assert StrategyHarness(narrow_cup).run(none).pours == []
    assert none.best_values is not None, "something was known all the same"
    assert none.progress() == Progress(pours=3, of_pours=3)


@pytest.mark.slow
def test_a_hybrid_pours_first_where_the_former_pours_and_the_simulations_say(tmp_path: Path) -> None:
    (tmp_path / "pours.csv").write_text(CSV)
    text = CAMPAIGN.replace("D2", "D3") + "  prior_simulations: 6\n  data: {from: pours.csv}\n"
    hybrid = strategy(deployment(tmp_path, text))
    played = StrategyHarness(narrow_cup).run(hybrid)
    first = next(r.query for r in played.asked if isinstance(r, Suggest) and r.purpose == "pour")
    assert (len(first.data), len(first.simulated), first.acquisition) == (3, 6, "least_loss")
    assert hybrid.result().former_pours == 3


def test_planning_with_the_same_campaign_learns_from_no_pour(tmp_path: Path) -> None:
    (tmp_path / "pours.csv").write_text(CSV)
    plan = deployment(tmp_path, CAMPAIGN + "  data: {from: pours.csv, counts: true}\n")
    planner = OneShotPlanning(dataclasses.replace(plan, settings=D1Settings()), plan.scenes[0], THETA, 1)
    played = StrategyHarness(narrow_cup).run(planner)
    assert len(played.pours) == 1
    assert planner.result().former_pours == 0
    assert not any("former" in decision.text for decision in planner.decisions)


def test_a_csv_needs_no_split_and_its_pours_outside_the_bounds_are_told(tmp_path: Path) -> None:
    (tmp_path / "pours.csv").write_text(CSV)
    text = CAMPAIGN.replace("[90 mm, 150 mm]", "[90 mm, 130 mm]") + "  data: {from: pours.csv}\n"
    plan = deployment(tmp_path, text)
    assert plan.data is not None
    assert [len(pours) for pours in plan.data.pours.values()] == [2]
    told = strategy(plan).decisions[0].text
    assert told == (
        f"2 former pours enter the data ({tmp_path.name}/pours.csv); "
        "left out: 1 pour: x_offset is outside 90 mm … 130 mm"
    )


def test_pours_of_another_motion_are_left_out(tmp_path: Path) -> None:
    run(tmp_path, CAMPAIGN)
    text = refusal(tmp_path, WITH_RUN.replace("height: 50 mm", "height: 60 mm"))
    assert "data.run: has no pour that this deployment could have made: 5 pours: height was 50 mm, here" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("narrow.yaml", "mug.yaml", "it poured in another scene: its receiver 'narrow' is not shaped as 'mug'"),
        ("mass: 200 g", "mass: 150 g", "it poured in another scene: its liquid has 200 g, here 150 g"),
        ("run: former", "run: formre", "data.run: {folder}/formre: no such folder; name that of a run"),
        ("run: former", "run: .", "data.run: {folder}: has no journal; name the folder of a run"),
        ("{run: former}", "{run: former, from: pours.csv}", "data.run: stands beside 'from'; keep one of them"),
        ("{run: former}", "{counts: true}", "data: needs 'from' (a CSV file of weighed pours) or 'run'"),
        ("{run: former}", "{run: former, receiver: mug}", "data.receiver: belongs to a CSV file; a run knows it"),
        ("strategy: D2", "strategy: D1", "deployment.data: belongs to D2 and D3, not to D1; remove it"),
        ("{run: former}", "{from: pours.csv, receiver: nrrow}", "has no receiver 'nrrow'; did you mean 'narrow'?"),
    ],
)
def test_what_does_not_belong_is_refused_with_words(old: str, new: str, expected: str, tmp_path: Path) -> None:
    run(tmp_path, CAMPAIGN)
    (tmp_path / "pours.csv").write_text(CSV)
    assert expected.replace("{folder}", str(tmp_path)) in refusal(tmp_path, WITH_RUN.replace(old, new))


def test_a_virtual_bench_teaches_no_real_one(tmp_path: Path) -> None:
    run(tmp_path, CAMPAIGN)
    journal = sqlite3.connect(tmp_path / "former" / "journal.sqlite")
    with journal:
        journal.execute("update header set fingerprint = json_set(fingerprint, '$.laboratory.mode', 'hardware')")
    journal.close()
    assert "was poured in a hardware laboratory, and 'virtual' is virtual" in refusal(tmp_path, WITH_RUN)


def test_several_receivers_get_each_their_own_pours(tmp_path: Path) -> None:
    (tmp_path / "pours.csv").write_text(CSV)
    both = CAMPAIGN.replace(
        f"receiver: {CONFIGS}/vessels/narrow.yaml",
        f"receivers: [{CONFIGS}/vessels/narrow.yaml, {CONFIGS}/vessels/mug.yaml]",
    )
    assert "says not into which receiver; add 'receiver:' and one of narrow, mug" in refusal(
        tmp_path, both + "  data: {from: pours.csv}\n"
    )
    plan = deployment(tmp_path, both + "  data: {from: pours.csv, receiver: mug}\n")
    narrow, mug = (RealOnly(plan, scene, THETA, 1).result().former_pours for scene in plan.scenes)
    assert (narrow, mug) == (0, 3)


@pytest.mark.parametrize("section", ["{run: former}", "{from: pours.csv, counts: true}"])
def test_the_resolved_campaign_has_the_same_pours_and_a_run_without_any_may_not_go_on_with_them(
    section: str, tmp_path: Path
) -> None:
    run(tmp_path, CAMPAIGN)
    (tmp_path / "pours.csv").write_text(CSV)
    plan = load(tmp_path, CAMPAIGN + f"  data: {section}\n")
    (tmp_path / "again.json").write_text(json.dumps(plan.resolved))
    assert dataclasses.replace(load_campaign(tmp_path / "again.json"), source=plan.source) == plan
    plain = load(tmp_path, CAMPAIGN)
    assert digest(fingerprint(plain)) != digest(fingerprint(plan))


def test_a_calibration_uses_the_pours_of_a_former_run_with_their_splits(tmp_path: Path) -> None:
    run(tmp_path, CAMPAIGN[: CAMPAIGN.index("deployment:")] + CALIBRATION)
    text = CAMPAIGN[: CAMPAIGN.index("deployment:")] + CALIBRATION.replace(
        "{count: 8, holdout: 2}", "{from_run: former}"
    )
    plan = load(tmp_path, text)
    assert plan.calibration is not None
    assert plan.calibration.records is not None
    splits = [pour.split for pour in plan.calibration.records.pours]
    assert (len(splits), splits.count("test"), plan.calibration.pour_count) == (8, 2, 0)
    speeds = [pour.action.angular_velocity / DEG for pour in plan.calibration.records.pours]
    assert len(set(speeds)) == 8
    (tmp_path / "again.json").write_text(json.dumps(plan.resolved))
    assert dataclasses.replace(load_campaign(tmp_path / "again.json"), source=plan.source) == plan
    narrower = text.replace("[15 deg/s, 120 deg/s]", "[15 deg/s, 60 deg/s]")
    assert "from_run: has pours that this calibration could not have made" in refusal(tmp_path, narrower)
    other = text.replace("narrow.yaml", "mug.yaml")
    assert "has nothing to calibrate on: it poured in another scene" in refusal(tmp_path, other)
