"""`real_pours`: no spillage is predicted without its spread over seeds: plans, pours, summaries."""

from __future__ import annotations

import asyncio
import math
import statistics
from dataclasses import replace
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest

from actors.optimizer.questions import Suggestion, SuggestionQuery
from actors.optimizer.suggest import propose
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.learning.deployment import deployment_base
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.deployment.d1 import D1Settings, OneShotPlanning
from orchestrator.learning.deployment.d2 import RealOnly
from orchestrator.learning.deployment.d3 import Hybrid
from orchestrator.learning.deployment.real_pours import DeploymentTrial, scaled_interval
from orchestrator.learning.requests import Failed, Outcome, Pour, Prediction, Request, Simulate, Slots
from orchestrator.learning.single_action import RepeatedSimulation
from orchestrator.learning.strategy import Progress, Strategy
from orchestrator.reports.console_view import summary_table
from orchestrator.reports.loss_units import loss_unit
from orchestrator.reports.progress_state import ProgressState
from orchestrator.reports.summarise import summarise
from orchestrator.runs.request_executor import Deadlines, RequestExecutor
from orchestrator.runs.run_tasks import plan_task
from orchestrator.runs.stages import deployment_stages, prediction_stages, with_left_over
from orchestrator.runs.strategy_harness import SCENE, THETA, StrategyHarness
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Loss
from sim_engine.prediction_band import CalibrationResidual, resolution_shift
from sim_engine.vessel.shapes import VesselSpec
from tests.support import example_run
from tests.support.example_results import changed, shown
from tests.support.plans import deployment_plan
from tests.support.toy_campaign import ToyLaboratory, run_toy, toy_plan
from tests.support.toy_spillage import narrow_cup

CAMPAIGNS = Path(__file__).parents[4] / "configs" / "campaigns"
ACTION = SCENE.action({"angular_velocity": 1.0, "x_offset": 0.1})


class Learning:
    """The real optimiser, in this process."""

    async def suggest(self, query: SuggestionQuery) -> Suggestion:
        return propose(query)


def learning_laboratory() -> ToyLaboratory:
    return ToyLaboratory(optimizer=Learning())  # type: ignore[arg-type]


def repeated(count: int = 5, seed: int = 3, loss: Loss | None = None) -> RepeatedSimulation:
    return RepeatedSimulation(Costing(loss or Loss(), SCENE, THETA), ACTION, count, seed)


def test_the_prediction_is_the_mean_of_fresh_seeds_with_their_deviation() -> None:
    strategy = repeated(loss=Loss(name="grams"))
    assert isinstance(strategy, Strategy)
    played = StrategyHarness(narrow_cup).run(strategy)
    assert {(r.action, r.purpose) for r in played.simulations} == {(ACTION, "predict")}
    assert len({r.seed for r in played.simulations}) == 5
    spilled = [o.outcome.fractions.spilled for _, o in played.told]  # type: ignore[union-attr]
    found: Any = strategy.result().over_seeds
    assert found["spilled"].mean == pytest.approx(statistics.mean(spilled))
    assert found["spilled"].deviation == pytest.approx(statistics.stdev(spilled))
    assert found["spilled"].count == 5
    assert found["loss"].mean == pytest.approx(200.0 * statistics.mean(spilled))
    assert strategy.progress() == Progress(5, 5)
    assert (
        StrategyHarness(narrow_cup).run(repeated()).simulations
        == StrategyHarness(narrow_cup).run(repeated()).simulations
    )
    assert StrategyHarness(narrow_cup).run(repeated(seed=4)).simulations != played.simulations


def measured_cup() -> VesselSpec:
    """The scene's receiver, known to half a millimetre."""
    shape = SCENE.receiver.shape.model_copy(update={"radius_deviations": ((0.0, 5e-4, 5e-4),)})
    return SCENE.receiver.model_copy(update={"shape": shape})


def test_a_prediction_simulates_a_measured_vessel_with_another_shape_each_time() -> None:
    scene = replace(SCENE, receiver=measured_cup())
    strategy = RepeatedSimulation(Costing(Loss(), scene, THETA), ACTION, 4, 3)
    requests = StrategyHarness(narrow_cup).run(strategy).simulations
    laboratory = ToyLaboratory()

    async def run() -> None:
        lanes = RequestExecutor(laboratory, {scene.name: scene}, Deadlines(), 0.0)
        for request in (*requests, replace(requests[0], purpose="plan", drawn_shapes=False)):
            await lanes.simulate(request, record=False, started=lambda: None)

    asyncio.run(run())
    *predicted, planned = (task.scene for task in laboratory.simulators.tasks)
    radii = {shape.inner[-1][0] for one in predicted if (shape := one.receiver.shape.outline()) is not None}
    assert len(radii) == 4
    assert {one.pourer for one in predicted} == {SCENE.pourer}
    assert planned == scene


def test_a_shape_in_which_the_cups_would_touch_is_the_worst_and_not_lost() -> None:
    scene = replace(SCENE, receiver=measured_cup())
    answers = iter([Failed("invalid_action", "cups touch")])
    strategy = RepeatedSimulation(Costing(Loss(), scene, THETA), ACTION, 4, 3)
    StrategyHarness(narrow_cup, answer=lambda request: next(answers, None)).run(strategy)
    result: Any = strategy.result()
    assert (result.touching, result.simulations_lost, result.over_seeds["loss"].count) == (1, 0, 4)


def test_simulations_that_failed_are_counted_and_left_out_of_the_prediction() -> None:
    answers = iter([Failed("simulation", "it leaked"), Failed("invalid_action", "cups touch")])

    def answer(request: Request) -> Outcome | None:
        return next(answers, None)

    strategy = repeated()
    StrategyHarness(narrow_cup, answer=answer).run(strategy)
    result: Any = strategy.result()
    assert (result.simulations, result.simulations_lost) == (5, 2)
    assert result.over_seeds["loss"].count == 3


def test_without_a_planned_action_nothing_is_simulated() -> None:
    strategy = RepeatedSimulation(Costing(Loss(), SCENE, THETA), None, 5, 1)
    assert strategy.finished
    assert strategy.result().over_seeds == {}


def test_a_plan_ends_with_fresh_simulations_of_what_it_recommends(tmp_path: Path) -> None:
    plan = toy_plan(tmp_path)
    assert plan.deployment is not None
    planned = replace(plan.deployment, settings=D1Settings(pours=0, iterations=4))
    plan = replace(plan, deployment=planned)
    stages = [*deployment_stages(plan, planned), *prediction_stages(plan, planned, 3)]
    result = asyncio.run(run_toy(tmp_path / "run", learning_laboratory(), plan=plan, stages=stages))
    assert list(result.results) == ["deployment:cup", "prediction:cup"]
    assert result.simulations == 4 * 2 + 3
    found = result.results["prediction:cup"].over_seeds
    assert found["spillage"].count == 3
    assert found["spillage"].deviation > 0.0
    summary = summarise(plan, result.results)
    assert summary.outcome.receivers["cup"].prediction == found
    text = " ".join(shown(summary_table(summary)).split())
    mean, deviation = (100 * getattr(found["spillage"], name) for name in ("mean", "deviation"))
    assert f"Simulated again with 3 new seeds: spilled / poured {mean:.2f} ± {deviation:.2f} %" in text
    assert "(mean ± standard deviation)" in text
    band = summary.outcome.receivers["cup"].prediction_interval
    assert band is not None
    assert band.low < found["spillage"].mean < band.high
    assert f"Uncalibrated: nine single pours in ten spill {band.percent(0)} of what is poured" in text


def test_a_planned_pour_has_the_band_of_an_uncalibrated_simulator_or_of_what_calibration_left_over() -> None:
    bands = []
    for residual in (CalibrationResidual(0.4), CalibrationResidual(0.6), None):
        strategy = RepeatedSimulation(Costing(Loss(), SCENE, THETA), ACTION, 5, 3, residual=residual)
        StrategyHarness(narrow_cup).run(strategy)
        found = strategy.result().interval
        assert found is not None
        bands.append(found)
    few, more, uncalibrated = bands
    assert uncalibrated.low < more.low < few.low < few.high < more.high < uncalibrated.high
    assert uncalibrated.discrepancy is None


def test_the_band_of_a_mirrored_pour_contains_what_finer_particles_spill() -> None:
    """A fast pour into a shallow bowl spills 5 % with 2,000 particles, 21 % with 20,000 and 33 % with 80,000."""

    def splash(_: Action, parameters: SimulationParameters, rng: np.random.Generator) -> float:
        return (0.21 if parameters.particles == 20_000 else 0.05) + 0.003 * rng.standard_normal()

    bands = {}
    elsewhere = CalibrationResidual(0.1)
    here = replace(elsewhere, here=True)  # its pours were weighed in this scene: it contains the resolution
    for scene, residual in (
        (SCENE, elsewhere),
        (replace(SCENE, mirrored=True), elsewhere),
        (replace(SCENE, mirrored=True), here),
    ):
        theta = THETA.model_copy(update={"particles": 2_000})
        strategy = RepeatedSimulation(Costing(Loss(), scene, theta), ACTION, 5, 3, residual=residual)
        played = StrategyHarness(splash).run(strategy)
        found = strategy.result()
        bands[len(played.simulations), residual] = found.interval
        assert found.over_seeds["spillage"].mean == pytest.approx(0.05, abs=0.01)  # of the usual particles alone
    whole, mirrored, weighed = bands[5, elsewhere], bands[6, elsewhere], bands[5, here]
    assert whole is not None
    assert mirrored is not None
    assert weighed is not None
    assert mirrored.holds(0.33)
    assert not whole.holds(0.33)
    assert not weighed.holds(0.33)
    assert mirrored.resolution > whole.resolution > weighed.resolution == 0.0


def test_a_planned_action_at_the_edge_of_the_box_is_said_to_be(tmp_path: Path) -> None:
    plan = toy_plan(tmp_path)
    assert plan.deployment is not None
    plan = replace(plan, deployment=replace(plan.deployment, settings=D1Settings(pours=0, iterations=4)))
    assert plan.deployment is not None
    stages = deployment_stages(plan, plan.deployment)
    result = asyncio.run(run_toy(tmp_path / "run", learning_laboratory(), plan=plan, stages=stages))
    deployed: Any = result.results["deployment:cup"]
    axis = plan.deployment.actions.axes[0]
    for value, said in ((axis.upper, 1), (0.5 * (axis.lower + axis.upper), 0)):
        where = {
            name: 0.5 * (a.lower + a.upper)
            for name, a in zip(plan.deployment.actions.names, plan.deployment.actions.axes, strict=True)
        }
        recommended = deployed.recommended.model_copy(update={"action_si": {**where, axis.name: value}})
        changed_result = deployed.model_copy(update={"recommended": recommended})
        summary = summarise(plan, {"deployment:cup": changed_result})
        text = " ".join(shown(summary_table(summary)).split())
        assert text.count("Better actions may lie outside the searched range: ") == said
        assert len(summary.outcome.receivers["cup"].at_bounds) == said


@pytest.mark.parametrize(("name", "strategy"), [("D3", Hybrid), ("D1", OneShotPlanning)])
def test_pours_are_predicted_with_how_well_the_mean_is_known_and_how_much_a_pour_scatters(
    name: str, strategy: Any
) -> None:
    played = StrategyHarness(narrow_cup).run(strategy(deployment_plan(strategy=name, pours=3), SCENE, THETA, 1))
    predictions = [r.predicted for r in played.asked if isinstance(r, Pour)]
    assert predictions
    assert all(p is not None and p.scatter is not None and p.scatter > 0.0 for p in predictions)


@pytest.mark.parametrize(("left_over", "own"), [(None, False), (0.1, False), (0.8, False), (0.8, True)])
def test_d1_tells_how_far_a_single_pour_may_be_from_its_mean(left_over: float | None, own: bool) -> None:
    """Means of four seeds scatter half as much as a single one; what the simulator lacks is a shift of the stream."""
    plan = deployment_plan(strategy="D1", simulations_per_iteration=4, iterations=8)
    residual = None if left_over is None else CalibrationResidual.of(left_over, [SCENE] if own else []).at(SCENE)
    strategy = OneShotPlanning(replace(plan, left_over=residual), SCENE, THETA, 1)
    StrategyHarness(narrow_cup).run(strategy)
    result: Any = strategy.result()
    seeds, z = (
        2.0 * result.recommended.hyperparameters["noise"],
        NormalDist().inv_cdf(result.recommended.predicted_loss),
    )
    shift = max(left_over or 0.0, resolution_shift(THETA.particles))
    lacking = NormalDist().cdf(z + 0.01 * shift) - NormalDist().cdf(z)
    expected = 100 * lacking if own else math.hypot(seeds, 100 * lacking)  # the residual contains the seeds' scatter
    assert result.recommended.predicted_scatter == pytest.approx(expected, rel=0.02)
    assert result.recommended.predicted_spillage_deviation > 0.0
    assert result.pours[0].predicted_scatter == result.recommended.predicted_scatter


def test_a_strategy_gets_the_residual_for_its_scene() -> None:
    plan = replace(deployment_plan(), left_over=CalibrationResidual.of(0.5, [SCENE]))
    scenes = SCENE, replace(SCENE, receiver=SCENE.pourer)
    left = [with_left_over(plan, {}, None, scene).left_over for scene in scenes]
    assert [one is not None and one.here for one in left] == [True, False]


@pytest.mark.parametrize(
    ("mean", "deviation", "scatter"), [(0.3, 0.04, 0.03), (0.05, 0.03, 0.0), (0.004, 0.02, None), (-0.01, 0.004, 0.001)]
)
def test_nine_pours_in_ten_lie_in_the_band_whatever_the_model_told(
    mean: float, deviation: float, scatter: float | None
) -> None:
    predicted = Prediction(mean, deviation, scatter)
    low, high = predicted.of_a_pour()
    normal = NormalDist(mean, math.hypot(deviation, scatter or 0.0))
    inside = normal.cdf(high) - (normal.cdf(low) if low > 0.0 else 0.0)
    assert inside >= 0.9 - 1e-9
    assert low >= 0.0
    assert inside == pytest.approx(0.9) or high == 0.0
    assert high - low <= 2.0 * 1.645 * normal.stdev
    assert replace(predicted, band=(0.1, 0.2)).of_a_pour() == (0.1, 0.2)


def poured(*losses: float | None) -> list[DeploymentTrial]:
    """Pours that were each predicted as 0.2 ± 0.05."""
    predicted = Prediction(0.2, 0.03, 0.04)
    return [DeploymentTrial(i, (0.5,), {}, predicted, 0.04, cost=loss) for i, loss in enumerate(losses, start=1)]


def test_intervals_become_as_wide_as_the_earlier_pours_deviated() -> None:
    predicted = Prediction(0.3, 0.03, 0.04, (0.2, 0.45))
    assert scaled_interval(predicted, poured(), 1.0) == (0.2, 0.45)
    assert scaled_interval(predicted, poured(None), 1.0) == (0.2, 0.45)
    exact = scaled_interval(predicted, poured(*[0.2] * 6), 1.0)
    assert exact == pytest.approx((0.25, 0.375))
    twice = scaled_interval(predicted, poured(0.1, 0.3), 1.0)
    assert twice == pytest.approx((0.3 - 0.1 * math.sqrt(2.5), 0.3 + 0.15 * math.sqrt(2.5)))
    # one pour far outside counts as three deviations; a loss is between 0 and the worst
    assert scaled_interval(predicted, poured(0.9), 1.0) == scaled_interval(predicted, poured(0.36), 1.0)
    assert scaled_interval(predicted, poured(*[0.9] * 9), 0.5) == (pytest.approx(0.02, abs=0.02), 0.5)


def test_an_interval_that_begins_at_nothing_or_ends_with_everything_still_does() -> None:
    little, much = (Prediction(mean, 0.01, 0.01, band) for mean, band in ((0.02, (0.0, 0.06)), (0.7, (0.4, 1.0))))
    assert scaled_interval(little, poured(*[0.2] * 6), 1.0) == (0.0, pytest.approx(0.04))
    assert scaled_interval(much, poured(*[0.2] * 6), 1.0) == (pytest.approx(0.55), 1.0)


def test_d3_reports_intervals_scaled_by_its_earlier_pours(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same pours with and without: the first interval is equal, later ones have other widths."""

    def pours() -> list[Any]:
        strategy = Hybrid(deployment_plan(strategy="D3", pours=6, model="adaptive"), SCENE, THETA, 1)
        StrategyHarness(narrow_cup).run(strategy)
        result: Any = strategy.result()
        return list(result.pours)

    scaled = pours()
    monkeypatch.setattr(deployment_base, "scaled_interval", lambda prediction, *_: prediction.of_a_pour())
    plain = pours()
    assert [(a.loss, a.predicted) for a in scaled] == [(a.loss, a.predicted) for a in plain]
    intervals = [[pour.predicted_interval for pour in some] for some in (scaled, plain)]
    assert intervals[0][0] == intervals[1][0]
    assert any(a != b for a, b in zip(*intervals, strict=True))


def test_d2_reports_intervals_averaged_over_hyperparameters_up_to_the_worst_loss() -> None:
    strategy = RealOnly(deployment_plan(strategy="D2", pours=6), SCENE, THETA, 1)
    played = StrategyHarness(narrow_cup).run(strategy)
    predicted = [request.predicted for request in played.pours if request.predicted is not None]
    assert len(predicted) >= 2
    found: Any = strategy.result()
    shown = [pour.predicted_interval for pour in found.pours if pour.predicted is not None]
    assert shown == [one.band for one in predicted]
    for one in predicted:
        assert one.band is not None
        low, high = replace(one, band=None).of_a_pour()
        assert one.band[1] - one.band[0] > min(high, 1.0) - low
        assert 0.0 <= one.band[0] <= one.band[1] <= 1.0


def test_the_line_of_a_pour_says_both() -> None:
    predicted = Prediction(0.008, 0.009, 0.005)
    assert loss_unit(Loss()).prediction(predicted) == "0.80 ± 0.90 %, a pour ± 0.50 %"
    assert loss_unit(Loss()).prediction(replace(predicted, scatter=None)) == "0.80 ± 0.90 %"
    assert loss_unit(Loss()).prediction(replace(predicted, band=(0.0, 0.021))) == "0.80 ± 0.90 %, a pour: 0.00 … 2.10 %"
    rare = Prediction(0.0162, 0.0432, None, (0.0, 0.0262))  # a few simulations spill everything
    assert loss_unit(Loss()).prediction(rare) == "1.62 ± 4.32 %, a pour: 0.00 … 2.62 %, seldom far more"
    plan = example_run.campaign()
    tally = ProgressState(plan)
    for event in example_run.events(plan):
        request = getattr(event, "request", None)
        known = isinstance(request, Pour)
        tally(replace(event, request=replace(request, predicted=predicted)) if known else event)  # type: ignore[type-var]
    assert "predicted 0.80 ± 0.90 %, a pour ± 0.50 %" in (tally.pour_line() or "")


def test_the_summary_s_best_expected_loss_has_both(results: dict[str, Any]) -> None:
    plan = example_run.campaign()
    learnt = results["narrow cup"]
    known = changed(learnt.recommended, predicted_loss=0.02, predicted_deviation=0.01, predicted_scatter=0.03)
    deployed = changed(learnt, recommended=known)
    text = shown(summary_table(summarise(plan, {"narrow cup": deployed})))
    assert "2.00 ± 1.00 %, a pour ± 3.00 %" in text
    unknown = changed(learnt, recommended=changed(known, predicted_scatter=None))
    assert "a pour ±" not in shown(summary_table(summarise(plan, {"narrow cup": unknown})))


def test_what_is_asked_for_is_simulations_of_the_slots_that_are_free() -> None:
    strategy = repeated(count=3)
    first = strategy.ask(Slots(2))
    assert [type(r) for r in first] == [Simulate, Simulate]
    assert len(strategy.ask(Slots(2))) == 1
    with pytest.raises(ValueError, match="not asked for"):
        strategy.tell(replace(first[0], seed=-1), Failed("simulation", ""))  # type: ignore[type-var]


def test_a_plan_simulates_each_action_once_unless_the_campaign_says_how() -> None:
    for name, simulations in ("quickstart", 15), ("recorded", 30):
        deployment = plan_task(load_campaign(CAMPAIGNS / f"{name}.yaml")).campaign.deployment
        assert deployment is not None
        assert deployment.settings.simulations == simulations, name
