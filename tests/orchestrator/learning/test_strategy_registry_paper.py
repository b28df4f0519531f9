"""`strategy_registry`: the paper's own methods, as campaigns and studies name them, are what the paper has and not
our changes to them.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from actors.optimizer.questions import MinimumQuery, SuggestionQuery
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.learning.campaign_plan import CampaignPlan, DeploymentPlan
from orchestrator.learning.deployment.d2 import RealOnly
from orchestrator.learning.deployment.d3 import D3Settings, Hybrid
from orchestrator.learning.requests import Suggest
from orchestrator.runs.stages import calibration_stages
from orchestrator.runs.strategy_harness import ACTIONS, CALIBRATION_ACTIONS, PARAMETERS, SCENE, THETA, StrategyHarness
from orchestrator.study.calibration_figures import colour, draw_calibrations
from orchestrator.study.deployment_figures import draw_deployments
from orchestrator.study.study_file import load_study
from orchestrator.study.study_folder import finished_results, read_result
from orchestrator.study.study_page import tables
from orchestrator.study.study_plan import StudyPlan, cells_of
from orchestrator.study.study_runner import run_cell
from orchestrator.study.study_statistics import gather
from tests.support.campaign_files import CAMPAIGN, DEPLOYED, report, write
from tests.support.study_files import read, written
from tests.support.toy_spillage import calibration_spill, narrow_cup, narrow_cup_biased, weighed
from tests.support.toy_study import TOYS


def campaign(folder: Path, keys: str) -> CampaignPlan:
    """The deployment of a file with other keys after `strategy`."""
    return load_campaign(write(folder, "campaign.yaml", DEPLOYED.replace("strategy: D3", keys)))


def questions(strategy: RealOnly | Hybrid, purpose: str) -> list[SuggestionQuery]:
    """What the optimiser is asked for a purpose in a whole campaign."""
    asked = StrategyHarness(narrow_cup_biased, narrow_cup).run(strategy).asked
    return [request.query for request in asked if isinstance(request, Suggest) and request.purpose == purpose]


def on_the_toy(plan: DeploymentPlan | None) -> DeploymentPlan:
    assert plan is not None
    plan = plan.with_settings(pours=1, prior_simulations=8)
    return replace(plan, scenes=(SCENE,), actions=ACTIONS)


@pytest.mark.parametrize(("keys", "plain"), [("model: residual", True), ("model: adaptive", False)])
def test_the_simulations_before_the_first_pour_keep_kappa_in_the_papers_model_alone(
    folder: Path, keys: str, plain: bool
) -> None:
    plan = on_the_toy(campaign(folder, f"strategy: D3\n  {keys}").deployment)
    every = questions(Hybrid(plan, SCENE, THETA, 1), "prior")
    asked = [query for query in every if isinstance(query, MinimumQuery)]
    assert (len(asked) == len(every)) is plain  # the adaptive model has the last ones chosen for the first pour
    assert len(asked) > 2
    assert {query.mean for query in asked} == {"constant"}
    assert {query.plain for query in asked} == {plain}


# -- C4 ----------------------------------------------------------------------------------------------------------------


def calibration(folder: Path, keys: str = "") -> CampaignPlan:
    """A calibration of a file with further keys."""
    return load_campaign(write(folder, "calibration.yaml", f"{CAMPAIGN}{keys}"))


@pytest.mark.parametrize(("keys", "paper"), [("", False), ("  averaging: noise\n", True)])
def test_c4_as_in_the_paper_takes_the_actions_influence_for_noise(folder: Path, keys: str, paper: bool) -> None:
    plan = calibration(folder, keys).calibration
    assert plan is not None
    plan = plan.with_settings(simulations=8, initial_samples=4)
    plan = replace(plan, scene=SCENE, actions=CALIBRATION_ACTIONS, parameters=PARAMETERS)
    results: dict[str, Any] = {}
    for stage in calibration_stages(plan)[:2]:
        played = StrategyHarness(calibration_spill, weighed).run(strategy := stage.build(results, 3))
        results[stage.name] = strategy.result()
    asked = [r.query for r in played.asked if isinstance(r, Suggest) and r.purpose in ("calibrate", "conclude")]
    assert len(asked) > 3
    assert {isinstance(query, MinimumQuery) and query.plain for query in asked} == {paper}
    assert {len(query.data.points[0]) for query in asked} == ({2} if paper else {4})
    assert all(cost >= 0.0 for cost in asked[-1].data.costs) is paper
    assert (results["calibration"].found.posterior is None) is paper


def test_how_c4_averages_is_written_down_and_may_not_change_under_a_run(folder: Path) -> None:
    usual, paper = calibration(folder), calibration(folder, "  averaging: noise\n")
    before = fingerprint(usual)
    assert before["calibration"]["settings"]["averaging"] == "context"
    assert fingerprint(paper)["calibration"]["settings"]["averaging"] == "noise"
    again = load_campaign(write(folder, "again.yaml", yaml.safe_dump(paper.resolved)))
    assert fingerprint(again) == fingerprint(paper)


def test_only_c4_averages(folder: Path) -> None:
    text = CAMPAIGN.replace("simulations: 20", "strategy: C2\n  samples: 5\n  averaging: noise")
    message = "calibration.averaging: belongs to C4, not to C2; remove it"
    assert message in report(write(folder, "campaign.yaml", text))


# -- studies -----------------------------------------------------------------------------------------------------------


def study(folder: Path, **changes: Any) -> StudyPlan:
    """The quick study with the paper's methods beside ours, and as little of them as possible."""
    quick = read("quick")
    c4 = {"repetitions": 1, "simulations": 6, "initial_samples": 4}
    d2, d3 = ({"repetitions": 1, "pours": 2, "initial_samples": 1, **more} for more in ({}, {"prior_simulations": 4}))
    arms = {
        "calibration": {"C4": c4, "C4_paper": c4},
        "deployment": {"D2": d2, "D2_paper": d2, "D3": d3, "D3_paper": {**d3, "simulations_per_pour": 0}},
    }
    return load_study(written(folder, {**quick, "mismatch": quick["mismatch"][:1], **arms, **changes}))


def test_a_study_has_the_papers_methods_beside_ours(tmp_path: Path) -> None:
    plan = study(tmp_path, mismatch=read("quick")["mismatch"])
    ours, papers = plan.calibration("C4").plan, plan.calibration("C4-paper").plan
    assert papers.with_settings(averaging="context") == ours != papers
    ours, papers = (plan.deployment(label).plan for label in ("D2", "D2-paper"))
    assert papers.with_settings(mean="constant") == ours != papers
    own, papers_own = (plan.deployment(label).plan.settings for label in ("D3", "D3-paper"))
    assert isinstance(own, D3Settings)
    assert isinstance(papers_own, D3Settings)
    assert (own.model, own.simulations_per_pour) == ("adaptive", 2)
    assert (papers_own.model, papers_own.simulations_per_pour) == ("residual", 0)
    cells = {cell.id: cell for cell in cells_of(plan)}
    assert "calibration.small.C4-paper.01" in cells
    assert "calibration.large.C4-paper.01" not in cells, "it is compared at one level, and nobody uses its θ*"
    assert cells["deployment.large.D3-paper.deployment-narrow.01"].needs == ("calibration.large.C4.01",)
    assert cells["deployment.large.D2-paper.deployment-narrow.01"].needs == ()


def test_another_mean_than_the_papers_is_none_of_d2_paper(tmp_path: Path) -> None:
    arm = {"repetitions": 1, "pours": 2, "mean": "constant"}
    with pytest.raises(ConfigError, match="D2_paper has the paper's mean, 'zero'"):
        study(tmp_path, deployment={"D2_paper": arm})


@pytest.mark.slow
def test_the_papers_methods_run_and_stand_in_figures_and_tables(tmp_path: Path) -> None:
    plan = study(tmp_path)
    for cell in cells_of(plan):
        run_cell(plan, cell, plan.folder, TOYS)
    alone = read_result(plan.folder, "deployment.small.D3-paper.deployment-narrow.01")
    assert (alone.simulations, alone.pours) == (4, 2), "none beside the pours"
    found = gather(plan, finished_results(plan.folder, cells_of(plan)))
    drawn = {one.number: one for one in (*draw_calibrations(plan, found), *draw_deployments(plan, found))}
    boxes, curves, losses = (drawn[number].rows for number in ("3b", "3c", "6"))
    assert {row[0] for row in boxes} == {"uncalibrated", "C4", "C4-paper"}
    assert sum(row[0] == "C4-paper" for row in curves) > 1, "one point for every θ that was chosen, as for C4"
    assert {row[2] for row in losses} == {"D2", "D2-paper", "D3", "D3-paper"}
    effects = next(table for table in tables(plan, found) if table.name == "table-effects")
    assert {"C4 − C4-paper", "D3-paper − D2-paper", "D2 − D2-paper"} <= {row[0] for row in effects.rows}


def test_arms_are_told_apart_in_figures() -> None:
    for family in (("C1", "C2", "C3", "C4", "C4-paper"), ("D1-15", "D2", "D2-paper", "D3", "D3-paper")):
        assert len({colour(arm) for arm in family}) == len(family)
