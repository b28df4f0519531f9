"""`stages`: the stages that a plan asks for, with the real strategies and the real optimiser on a toy laboratory."""

from __future__ import annotations

import asyncio
import html
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from actors.optimizer.questions import Suggestion, SuggestionQuery
from actors.optimizer.suggest import propose
from decant.run_results import open_run
from orchestrator.campaigns.file_loading import predicts_with_posterior
from orchestrator.learning.campaign_plan import (
    CalibrationPlan,
    CampaignPlan,
    RecordedPour,
    RecordSet,
)
from orchestrator.learning.requests import Pour, Simulate
from orchestrator.learning.run_errors import RunError
from orchestrator.records.codec import canonical
from orchestrator.records.events import Event, RequestFinished
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.reports.console_view import summary_table
from orchestrator.reports.progress_state import work_of
from orchestrator.reports.publishing import publish
from orchestrator.reports.summarise import summarise
from orchestrator.runs.motion_approval import pour_count
from orchestrator.runs.stages import deployed_theta, scenes_of, stages_of
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Loss
from sim_engine.search_space import Axis, Space
from sim_engine.vessel.shapes import cylinder
from tests.support import plans
from tests.support.example_results import changed, shown
from tests.support.toy_campaign import SCENE, SPACE, ToyLaboratory, logical_record, run_toy, toy_plan

NARROW = replace(SCENE, name="narrow", receiver=cylinder("narrow", inner_radius=0.02, inner_height=0.1))
PARAMETERS = Space((Axis("cohesion", 0.0, 0.1), Axis("friction", 0.0, 0.5)))


class Optimizer:
    async def suggest(self, query: SuggestionQuery) -> Suggestion:
        return propose(query)


def laboratory() -> ToyLaboratory:
    return ToyLaboratory(optimizer=Optimizer())  # type: ignore[arg-type]


def calibration(**changes: Any) -> CalibrationPlan:
    values: dict[str, Any] = {
        "scene": SCENE,
        "actions": SPACE,
        "parameters": PARAMETERS,
        "fixed_parameters": {"particles": 700, "xsph_rate": 4.0},
        "pour_count": 5,
        "holdout": 1,
        "simulations": 5,
        "random_baseline": 3,
        "initial_samples": 4,
    }
    return plans.calibration(**values | changes)


def campaign(directory: Path, **changes: Any) -> CampaignPlan:
    deployment = plans.deployment(
        scenes=(SCENE, NARROW),
        actions=SPACE,
        loss=Loss(),
        pours=2,
        prior_simulations=4,
        simulations_per_pour=2,
        initial_samples=3,
    )
    values = {"calibration": calibration(), "deployment": deployment, "on_unknown": "repeat"}
    return toy_plan(directory, **(values | changes))


def records(split: str, scene: Any, count: int) -> RecordSet:
    pours = [
        RecordedPour(scene.action(SPACE.decode([(i + 0.5) / count, 0.5])), 0.19, 0.01 * (i + 1), 0.01, split)
        for i in range(count)
    ]
    return RecordSet(scene, tuple(pours), Path("pours.csv"))


def run(directory: Path, plan: CampaignPlan, **arguments: Any) -> Any:
    return asyncio.run(run_toy(directory, laboratory(), plan=plan, stages=None, **arguments))


def test_a_whole_campaign_calibrates_and_then_pours_with_what_it_found(tmp_path: Path) -> None:
    events: list[Event] = []
    result = run(tmp_path / "run", campaign(tmp_path), subscribers=[events.append])
    assert list(result.results) == ["pours", "calibration", "evaluation", "deployment:cup", "deployment:narrow"]
    theta = result.results["calibration"].found.theta
    assert (theta.particles, theta.xsph_rate) == (700, 4.0)
    done = [e for e in events if isinstance(e, RequestFinished)]
    deployed = [e.request for e in done if e.stage.startswith("deployment") and isinstance(e.request, Simulate)]
    assert deployed
    used = deployed_theta(result.results)
    assert {canonical(request.parameters.model_dump()) for request in deployed} == {canonical(used.model_dump())}
    assert {r.request.scene for r in done if r.stage == "deployment:narrow" and isinstance(r.request, Pour)} == {
        "narrow"
    }
    evaluation = result.results["evaluation"]
    drawn = {f"posterior {k}" for k in range(1, 6)}
    assert set(evaluation.discrepancy) == {"theta", "uncalibrated", "random 1", "random 2", "random 3"} | drawn
    assert evaluation.posterior_mean.keys() == {"test"}
    scored = [e for e in done if e.stage == "evaluation"]
    assert len(scored) == work_of(campaign(tmp_path), ["evaluation"])["evaluation"].simulations
    assert evaluation.discrepancy["theta"].keys() == {"test", "train"}
    assert evaluation.random_median.keys() == {"test"}  # random θ are not simulated on training pours
    assert evaluation.mean_predictor["test"] is not None
    assert evaluation.regression["test"] is not None


@pytest.mark.slow
def test_a_theta_that_the_pours_do_not_justify_is_not_deployed_and_everything_published_says_so(tmp_path: Path) -> None:
    # the toy's simulations do not depend on θ, so that no θ fits the pours better than another one
    plan = campaign(tmp_path, calibration=calibration(random_baseline=0))
    events: list[Event] = []
    result = run(tmp_path / "run", plan, subscribers=[events.append])
    evaluation = result.results["evaluation"]
    gain = evaluation.gain
    assert (gain.recommended, gain.pours) == ("uncalibrated", 5)
    scored = [e for e in events if isinstance(e, RequestFinished) and e.stage == "evaluation"]
    assert len(scored) == work_of(plan, ["evaluation"])["evaluation"].simulations == 2 * 5
    plain = SimulationParameters(particles=700, xsph_rate=4.0)
    assert evaluation.thetas["uncalibrated"] == plain
    assert {
        event.request.parameters
        for event in events
        if isinstance(event, RequestFinished)
        and event.stage.startswith("deployment")
        and isinstance(event.request, Simulate)
    } == {plain}
    found = result.results["calibration"].found
    published = publish(plan, result)
    assert (published.summary.learning.theta, published.summary.learning.calibrated_theta) == (plain, found.theta)
    assert gain.text[1:] in " ".join(shown(summary_table(published.summary), width=400).split())
    assert published.theta is not None
    assert published.report is not None
    written = json.loads(published.theta.read_text())
    assert (written["theta"], written["why"]) == (plain.model_dump(), gain.text)
    assert written["calibrated"] == found.theta.model_dump()
    assert not predicts_with_posterior(published.theta)
    assert (
        json.loads((tmp_path / "run" / "summary.json").read_text())["learning"]["calibration_gain"]["text"] == gain.text
    )
    page = html.unescape(published.report.read_text())
    assert gain.text[1:] in page
    with JournalReader(tmp_path / "run" / JOURNAL_NAME) as journal:
        decisions = [entry.body["text"] for entry in journal.entries(stage="evaluation", kinds=[Kind.DECISION])]
    assert decisions[-1] == gain.text
    opened = open_run(tmp_path / "run", plan)
    assert (opened.theta, opened.calibration_gain) == (plain, gain)


def test_a_theta_that_the_pours_justify_is_deployed(tmp_path: Path) -> None:
    results = dict(run(tmp_path / "run", campaign(tmp_path, deployment=None)).results)
    theta, evaluation = results["calibration"].found.theta, results["evaluation"]
    assert deployed_theta(results) == evaluation.thetas["uncalibrated"] != theta
    results["evaluation"] = changed(evaluation, gain=changed(evaluation.gain, recommended="calibrated"))
    assert deployed_theta(results) == theta
    results["evaluation"] = changed(evaluation, gain=None)  # of a run by a version that did not compare
    assert deployed_theta(results) == theta


def test_what_is_recommended_is_poured_again_after_each_deployment(tmp_path: Path) -> None:
    plan = campaign(tmp_path, calibration=None)
    assert plan.deployment is not None
    plan = replace(plan, deployment=replace(plan.deployment, confirm=2))
    events: list[Event] = []
    result = run(tmp_path / "run", plan, subscribers=[events.append])
    assert list(result.results) == ["deployment:cup", "confirmation:cup", "deployment:narrow", "confirmation:narrow"]
    assert pour_count(plan, stages_of(plan)) == 2 * (2 + 2)
    for scene in (SCENE, NARROW):
        recommended = result.results[f"deployment:{scene.name}"].recommended
        pours = [
            event.request
            for event in events
            if isinstance(event, RequestFinished) and event.stage == f"confirmation:{scene.name}"
        ]
        assert [pour.action for pour in pours if isinstance(pour, Pour)] == 2 * [scene.action(recommended.action_si)]
        confirmed = result.results[f"confirmation:{scene.name}"]
        assert (confirmed.scene, confirmed.loss.count) == (scene.name, 2)
    summary = summarise(plan, result.results)
    found = summary.outcome.receivers[SCENE.name].confirmed
    assert found is not None
    text = " ".join(shown(summary_table(summary)).split())
    assert "poured again" in text
    assert "(2 pours)" in text
    assert work_of(plan, ["confirmation:cup"])["confirmation:cup"].pours == 2


@pytest.mark.slow
def test_the_real_strategies_resume_as_if_nothing_had_happened(tmp_path: Path) -> None:
    run(tmp_path / "undisturbed", campaign(tmp_path))
    expected = logical_record(tmp_path / "undisturbed")
    told = [i for i, entry in enumerate(expected) if entry[1] == "told"]
    directory, resume = tmp_path / "run", False
    for fraction in (0.15, 0.4, 0.6, 0.75, 0.9):
        with pytest.raises(asyncio.CancelledError):
            run(directory, campaign(tmp_path), resume=resume, subscribers=[Stopper(int(fraction * len(told)))])
        resume = True
        assert logical_record(directory) == expected[: len(logical_record(directory))]
    run(directory, campaign(tmp_path), resume=True)
    assert logical_record(directory) == expected


class Stopper:
    """Pauses the run that it watches after so many outcomes."""

    def __init__(self, outcomes: int) -> None:
        self._left = outcomes

    def __call__(self, event: Event) -> None:
        if isinstance(event, RequestFinished):
            self._left -= 1
            if self._left == 0:
                main = next(t for t in asyncio.all_tasks() if t.get_coro().__name__ == "run_toy")  # type: ignore[union-attr]
                main.cancel()


def test_records_take_the_place_of_pours(tmp_path: Path) -> None:
    plan = calibration(
        pour_count=0,
        records=records("train", SCENE, 4),
        transfer=records("transfer", NARROW, 2),
        random_baseline=2,
    )
    result = run(tmp_path / "run", campaign(tmp_path, calibration=plan, deployment=None))
    assert list(result.results) == ["calibration", "evaluation"]
    assert result.pours == 0
    evaluation = result.results["evaluation"]
    assert set(evaluation.discrepancy["theta"]) == {"train", "transfer"}
    assert set(evaluation.random_median) == {"transfer"}
    assert evaluation.regression == {}  # no answer for another vessel
    assert {pair.scene for pair in evaluation.pairs if pair.split == "transfer"} == {"narrow"}


def test_the_calibrated_and_the_random_meet_the_same_seeds(tmp_path: Path) -> None:
    events: list[Event] = []
    plan = calibration(pour_count=0, records=records("train", SCENE, 4), transfer=records("transfer", NARROW, 3))
    result = run(tmp_path / "run", campaign(tmp_path, calibration=plan, deployment=None), subscribers=[events.append])
    thetas = result.results["evaluation"].thetas
    drawn = [canonical(theta.model_dump()) for label, theta in thetas.items() if label.startswith("posterior ")]
    seeds: dict[str, set[tuple[Any, int]]] = {}
    for event in events:
        if isinstance(event, RequestFinished) and event.stage == "evaluation" and isinstance(event.request, Simulate):
            request = event.request
            if request.scene == "narrow":
                theta = canonical(request.parameters.model_dump())
                if theta in drawn:
                    continue
                seeds.setdefault(theta, set()).add((request.action, request.seed))
    assert len(seeds) == 5  # θ*, the uncalibrated θ and three random ones
    assert len({frozenset(of_theta) for of_theta in seeds.values()}) == 1


def test_two_scenes_of_one_name_are_refused(tmp_path: Path) -> None:
    assert set(scenes_of(campaign(tmp_path))) == {"cup", "narrow"}
    plan = campaign(tmp_path, calibration=calibration(scene=replace(NARROW, name="cup")))
    with pytest.raises(RunError, match="two different scenes are both named 'cup'"):
        scenes_of(plan)
