"""`continuous_calibration`: C4, the pours that it designs, and the scores of its result."""

import math
from dataclasses import replace

import numpy as np
import pytest

from orchestrator.learning.calibration.action_prior import Contexts
from orchestrator.learning.calibration.calibration_scores import (
    JUSTIFIED,
    NOT_JUSTIFIED,
    CalibrationEvaluation,
    Evaluation,
    ScoredPair,
    ScoredPour,
    calibration_gain,
    mean_predictor_discrepancy,
    random_parameters,
    regression_discrepancy,
)
from orchestrator.learning.calibration.continuous_calibration import ContinuousBayesianCalibration
from orchestrator.learning.calibration.pour_design import StratifiedDesign, choose_holdout, stratified
from orchestrator.learning.campaign_plan import MeasuredPour
from orchestrator.learning.requests import Failed, Simulate, Simulated, Suggest, Suggested
from orchestrator.learning.run_errors import LearningError
from orchestrator.runs.stages import POURS, measured_pours
from orchestrator.runs.strategy_harness import (
    CALIBRATION_ACTIONS,
    PARAMETERS,
    SCENE,
    StrategyHarness,
    outcome_of,
    replay,
)
from sim_engine.liquids import SimulationParameters
from sim_engine.search_space import Axis, Space
from tests.support.plans import calibration_plan, unit
from tests.support.toy_spillage import TRUE_THETA, calibration_spill, weighed


class Quiet:
    """A generator without noise."""

    def standard_normal(self) -> float:
        return 0.0


def measured(seed=0, count=32, holdout=4):
    design = StratifiedDesign((SCENE,), CALIBRATION_ACTIONS, count, holdout, seed)
    StrategyHarness(weighed).run(design)
    return design.measured


def true_discrepancy(theta: SimulationParameters) -> float:
    """E_{a~g} |c_r − c_s| of the toy, which no calibration is told."""
    rng = np.random.default_rng(0)
    spills = []
    for _ in range(200):
        action = SCENE.action(CALIBRATION_ACTIONS.draw(rng))
        spills.append(abs(calibration_spill(action, theta, Quiet()) - calibration_spill(action, TRUE_THETA, Quiet())))
    return float(np.mean(spills))


# -- the design ----------------------------------------------------------------------------------------------------


def test_thirty_two_pours_lie_two_in_each_of_four_by_four_strata():
    pours = measured(seed=3)
    assert len(pours) == 32
    cells = [tuple((4 * unit(p.action, CALIBRATION_ACTIONS)).astype(int)) for p in pours]
    assert {cells.count(cell) for cell in cells} == {2}
    assert len(set(cells)) == 16


def test_four_test_pours_come_from_the_four_quarters_of_the_first_axis():
    tests = [p for p in measured(seed=3) if p.split == "test"]
    assert sorted(int(4 * unit(p.action, CALIBRATION_ACTIONS)[0]) for p in tests) == [0, 1, 2, 3]


def test_any_other_number_of_pours_uses_every_slice_of_every_axis_once():
    strata = stratified(7, 3, np.random.default_rng(0))
    for axis in range(3):
        assert sorted(round(7 * s.lower[axis]) for s in strata) == list(range(7))


def test_an_impossible_action_is_replaced_by_another_of_its_stratum():
    refused = []

    def sometimes_touching(action, theta, rng):
        if action.max_angle > CALIBRATION_ACTIONS.decode([0.5, 0.95])["max_angle"]:
            refused.append(action)
            raise ValueError("cups touch")
        return 0.1

    design = StratifiedDesign((SCENE,), CALIBRATION_ACTIONS, 32, 4, 1)
    played = StrategyHarness(sometimes_touching).run(design)
    assert refused
    assert len(played.pours) == 32 + len(refused)
    assert len(design.measured) == 32
    cells = [tuple((4 * unit(p.action, CALIBRATION_ACTIONS)).astype(int)) for p in design.measured]
    assert {cells.count(cell) for cell in cells} == {2}


def test_a_stratum_without_a_possible_action_is_given_up_with_its_reason():
    def never(action, theta, rng):
        raise ValueError("cups touch: at tilt 37° …")

    design = StratifiedDesign((SCENE,), CALIBRATION_ACTIONS, 2, 0, 1)
    StrategyHarness(never).run(design)
    assert design.measured == ()
    assert "cups touch" in str(design.result().pours[0].given_up)


def test_weighed_pours_survive_the_journal():
    design = StratifiedDesign((SCENE,), CALIBRATION_ACTIONS, 6, 1, 1)
    StrategyHarness(weighed).run(design)
    read_back = measured_pours(calibration_plan(), {POURS: design.result()})
    assert tuple(scored.pour for scored in read_back) == design.measured


def test_holding_everything_back_is_refused():
    with pytest.raises(ValueError, match="holdout 3"):
        choose_holdout(stratified(3, 2, np.random.default_rng(0)), 3, np.random.default_rng(0))


# -- C4 ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_c4_finds_a_theta_better_than_random_ones():
    pours = measured()
    baseline = np.median(
        [true_discrepancy(t) for t in random_parameters(PARAMETERS, {"friction": 0.1}, 20, 1).values()]
    )
    scores = []
    for seed in range(2):
        strategy = ContinuousBayesianCalibration(calibration_plan(simulations=30), pours, seed)
        played = StrategyHarness(calibration_spill).run(strategy)
        assert len(played.simulations) == 30
        scores.append(true_discrepancy(strategy.theta))
    assert max(scores) < 0.5 * baseline


def test_c4_asks_for_the_same_whatever_finishes_first_and_when_replayed():
    def campaign(order="first", seed=5):
        strategy = ContinuousBayesianCalibration(calibration_plan(simulations=16), measured(), seed)
        return StrategyHarness(calibration_spill, slots=3, order=order).run(strategy)

    first, reversed_order = campaign(), campaign("last")
    assert first.simulations == reversed_order.simulations
    assert campaign(seed=6).simulations != first.simulations
    fresh = ContinuousBayesianCalibration(calibration_plan(simulations=16), measured(), 5)
    assert replay(fresh, first) == first.asked


def test_every_simulated_theta_and_action_lies_in_its_box_and_keeps_what_is_fixed():
    strategy = ContinuousBayesianCalibration(calibration_plan(simulations=30), measured(), 2)
    for request in StrategyHarness(calibration_spill).run(strategy).simulations:
        theta = request.parameters
        assert PARAMETERS.contains({"particles": theta.particles, "cohesion": theta.cohesion})
        assert theta.friction == 0.1
        assert isinstance(theta.particles, int)
        assert CALIBRATION_ACTIONS.contains(
            {"angular_velocity": request.action.angular_velocity, "max_angle": request.action.max_angle}
        )


def test_failed_and_leaking_simulations_never_reach_the_fit():
    lost = []

    def unlucky(request):
        if isinstance(request, Simulate) and request.seed % 3 == 0:
            lost.append(request)
            if request.seed % 2:
                return Failed("simulation", "diverged")
            return Simulated(replace(outcome_of(0.9), invalid="escaped 1.2 %"))
        return None

    strategy = ContinuousBayesianCalibration(calibration_plan(simulations=40), measured(), 1)
    played = StrategyHarness(calibration_spill, answer=unlucky).run(strategy)
    final = [r for r in played.asked if isinstance(r, Suggest)][-1].query
    assert lost
    assert len(final.data) == 40 - len(lost)
    assert all(map(math.isfinite, final.data.costs))
    assert strategy.result().lost == len(lost)
    assert true_discrepancy(strategy.theta) < 0.03


def test_pours_too_small_for_a_spillage_are_left_out_and_their_actions_not_simulated():
    # below 0.4 of the angle's range the toy beaker keeps its liquid
    def is_poured(action):
        return unit(action, CALIBRATION_ACTIONS)[1] > 0.4

    pours = [
        MeasuredPour(p.action, p.spillage, 1.0) if is_poured(p.action) else MeasuredPour(p.action, None, 0.0)
        for p in measured(count=32, holdout=0)
    ]
    strategy = ContinuousBayesianCalibration(calibration_plan(simulations=30), pours, 1)
    simulations = StrategyHarness(calibration_spill).run(strategy).simulations
    assert np.mean([is_poured(r.action) for r in simulations]) > 0.9
    with pytest.raises(LearningError, match="at least 2 training pours"):
        ContinuousBayesianCalibration(calibration_plan(), [MeasuredPour(pours[0].action, None, 0.0)] * 5, 1)


def test_test_pours_are_not_used_for_fitting():
    pours = measured()
    strategy = ContinuousBayesianCalibration(calibration_plan(simulations=4), pours, 1)
    regression = StrategyHarness(calibration_spill).run(strategy).asked[0]
    assert isinstance(regression, Suggest)
    assert len(regression.query.data) == 28


@pytest.mark.slow
def test_signed_differences_calibrate_better_than_noise_at_the_same_price():
    pours = measured()
    scores = {}
    for averaging in ("context", "noise"):
        scores[averaging] = []
        for seed in range(4):
            plan = calibration_plan(simulations=24, averaging=averaging)
            strategy = ContinuousBayesianCalibration(plan, pours, seed)
            StrategyHarness(calibration_spill).run(strategy)
            scores[averaging].append(true_discrepancy(strategy.theta))
    assert np.mean(scores["context"]) < 0.7 * np.mean(scores["noise"])


BOX = Space((*PARAMETERS.axes, Axis("xsph_rate", 0.0, 1.0), Axis("friction", 0.0, 0.5)))


def spill_by_two(action, theta, rng):
    """A liquid to which of four searched parameters cohesion and friction matter."""
    u, v = unit(action, CALIBRATION_ACTIONS)
    return 0.2 * u + 0.1 * v + 5.0 * abs(theta.cohesion - 0.04) ** 1.5 + 0.8 * (theta.friction - 0.2) ** 2


def calibrated_in_four():
    truth = SimulationParameters(cohesion=0.04, friction=0.2)
    pours = [replace(p, spillage=spill_by_two(p.action, truth, None)) for p in measured()]
    strategy = ContinuousBayesianCalibration(calibration_plan(parameters=BOX, simulations=40), pours, 4)
    return strategy, StrategyHarness(spill_by_two).run(strategy)


@pytest.mark.slow
def test_of_four_parameters_the_result_maps_the_two_that_matter_with_the_others_at_theta_star():
    strategy, _ = calibrated_in_four()
    result = strategy.result()
    drawn, theta = result.found.map, result.found.theta.model_dump()
    assert drawn.over == ("cohesion", "friction")
    assert drawn.held == {"particles": theta["particles"], "xsph_rate": theta["xsph_rate"]}
    mean, deviation = np.array(drawn.mean), np.array(drawn.deviation)
    assert mean.shape == deviation.shape == (30, 30)
    # the map goes through θ*: what it says there is what the result expects there, and nowhere is less expected
    across, up = (np.abs(np.array(drawn.axes[name]) - theta[name]).argmin() for name in drawn.over)
    assert mean[up, across] == pytest.approx(result.found.predicted_discrepancy, abs=0.01)
    assert mean.min() > result.found.predicted_discrepancy - 1e-4
    assert mean.max() > 5 * mean.min()


@pytest.mark.slow
def test_those_who_watch_get_a_map_about_every_ten_simulations_and_replay_asks_for_the_same():
    _, played = calibrated_in_four()
    maps, simulations = [], 0
    for request, outcome in played.told:
        simulations += isinstance(request, Simulate)
        if isinstance(outcome, Suggested) and outcome.suggestion.surrogate is not None:
            maps.append((simulations, len(outcome.suggestion.surrogate.axes)))
    assert maps[-1] == (40, 2)
    assert len(maps) == 4
    assert all(abs(many - 10 * (i + 1)) <= 2 for i, (many, _) in enumerate(maps))
    truth = SimulationParameters(cohesion=0.04, friction=0.2)
    pours = [replace(p, spillage=spill_by_two(p.action, truth, None)) for p in measured()]
    fresh = ContinuousBayesianCalibration(calibration_plan(parameters=BOX, simulations=40), pours, 4)
    assert replay(fresh, played) == played.asked


def test_without_an_answer_of_the_optimiser_calibration_stops_with_its_reason():
    def broken(request):
        return Failed("optimizer", "out of memory") if isinstance(request, Suggest) else None

    with pytest.raises(LearningError, match="out of memory"):
        StrategyHarness(calibration_spill, answer=broken).run(
            ContinuousBayesianCalibration(calibration_plan(), measured(), 1)
        )


def test_simulations_that_all_fail_end_the_calibration_with_a_reason_and_not_a_traceback():
    def hopeless(request):
        return Failed("simulation", "leaked") if isinstance(request, Simulate) else None

    strategy = ContinuousBayesianCalibration(calibration_plan(simulations=6), measured(), 1)
    with pytest.raises(LearningError, match="6 simulations 6 gave no discrepancy"):
        StrategyHarness(calibration_spill, answer=hopeless).run(strategy)


# -- scores --------------------------------------------------------------------------------------------------------


def test_the_true_theta_scores_best_and_undefined_pours_are_left_out():
    pours = [ScoredPour("cup", p) for p in measured()]
    pours.append(ScoredPour("cup", MeasuredPour(pours[0].pour.action, None, 0.01)))
    thetas = {"best": TRUE_THETA, **random_parameters(PARAMETERS, {}, 5, 2)}
    evaluation = Evaluation(thetas, pours, 1)
    played = StrategyHarness(calibration_spill).run(evaluation)
    assert len(played.simulations) == 6 * 32
    for split in ("train", "test"):
        assert evaluation.discrepancy("best", split) < 0.025  # noise of 1 % in both
        assert evaluation.discrepancy("best", split) < evaluation.random_median(split)


def test_a_score_is_the_mean_absolute_difference():
    action = SCENE.action({"angular_velocity": 1.0, "max_angle": 2.0})
    pours = [ScoredPour("cup", MeasuredPour(action, r, 1.0, "test")) for r in (0.1, 0.5)]
    evaluation = Evaluation({"one": TRUE_THETA}, pours, 1)
    StrategyHarness(lambda a, t, rng: 0.2).run(evaluation)
    assert evaluation.discrepancy("one", "test") == pytest.approx((0.1 + 0.3) / 2)


def test_draws_of_the_posterior_are_scored_by_the_mean_of_their_simulations():
    action = SCENE.action({"angular_velocity": 1.0, "max_angle": 2.0})
    pours = [ScoredPour("cup", MeasuredPour(action, r, 1.0, split)) for r, split in ((0.1, "train"), (0.5, "test"))]
    wide = SimulationParameters(wall_distance=1.0)
    spilled = {TRUE_THETA.wall_distance: 0.3, 1.0: 0.6}
    card = CalibrationEvaluation(
        TRUE_THETA, {}, pours, Contexts(CALIBRATION_ACTIONS, (SCENE,)), 3, sampled=(TRUE_THETA, wide, TRUE_THETA)
    )
    played = StrategyHarness(lambda a, theta, rng: spilled[theta.wall_distance]).run(card)
    assert len(played.simulations) == 2 + 3, "draws are simulated on pours that calibration did not see"
    result = card.result()
    assert result.posterior_mean == {"test": pytest.approx(0.5 - (0.3 + 0.6 + 0.3) / 3)}
    assert result.discrepancy["theta"]["test"] == pytest.approx(0.2)


def test_a_regression_beats_the_mean_inside_the_scene_it_was_fitted_in():
    pours = measured()
    train, test = [p for p in pours if p.split == "train"], [p for p in pours if p.split == "test"]
    mean = mean_predictor_discrepancy(train, test)
    assert mean == pytest.approx(np.mean([abs(p.spillage - np.mean([q.spillage for q in train])) for p in test]))
    assert regression_discrepancy(Contexts(CALIBRATION_ACTIONS, (SCENE,)), train, test) < 0.5 * mean
    assert mean_predictor_discrepancy(train, []) is None


def test_the_uncalibrated_simulator_is_scored_on_all_pours_with_the_seeds_of_the_calibrated_one():
    pours = [ScoredPour("cup", pour) for pour in measured(count=8, holdout=2)]
    plain = SimulationParameters(particles=4000, cohesion=0.0)
    rivals = random_parameters(PARAMETERS, {}, 2, 1)
    card = CalibrationEvaluation(
        TRUE_THETA, rivals, pours, Contexts(CALIBRATION_ACTIONS, (SCENE,)), 3, uncalibrated=plain
    )
    without = CalibrationEvaluation(TRUE_THETA, rivals, pours, Contexts(CALIBRATION_ACTIONS, (SCENE,)), 3)
    played, before = StrategyHarness(calibration_spill).run(card), StrategyHarness(calibration_spill).run(without)
    asked = {theta: [r for r in played.simulations if r.parameters == theta] for theta in (TRUE_THETA, plain)}
    assert [(r.action, r.seed) for r in asked[TRUE_THETA]] == [(r.action, r.seed) for r in asked[plain]]
    assert played.simulations[: len(before.simulations)] == before.simulations, (
        "what was asked before is asked as before"
    )
    result = card.result()
    assert result.discrepancy["uncalibrated"]["train"] > 2 * result.discrepancy["theta"]["train"]
    assert sum(pair.theta == "uncalibrated" for pair in result.pairs) == 8
    assert "uncalibrated" not in without.result().discrepancy
    same = CalibrationEvaluation(
        TRUE_THETA, rivals, pours, Contexts(CALIBRATION_ACTIONS, (SCENE,)), 3, uncalibrated=TRUE_THETA
    )
    StrategyHarness(calibration_spill).run(same)
    assert "uncalibrated" not in same.result().discrepancy


def pairs(*simulated: float | None) -> list[ScoredPair]:
    """Pours that all spilled 0.5, with what was simulated of them."""
    return [
        ScoredPair(theta="one", split="train", scene="cup", measured=0.5, simulated=value, reason="")
        for value in simulated
    ]


@pytest.mark.parametrize(
    ("calibrated", "uncalibrated", "recommended", "why"),
    [
        # gains 0.1, 0.1, 0.1, 0.2: 0.125 ± 0.025
        ((0.4, 0.4, 0.4, 0.4), (0.3, 0.3, 0.3, 0.2), "calibrated", "gain 12.50 ± 2.50 points"),
        ((0.3, 0.3, 0.3, 0.2), (0.4, 0.4, 0.4, 0.4), "uncalibrated", "gain -12.50 ± 2.50 points"),
        # gains 0.3, −0.2, 0.1, −0.1: better in the mean, by less than its standard error
        ((0.5, 0.3, 0.5, 0.4), (0.2, 0.5, 0.4, 0.5), "uncalibrated", "gain 2.50 ± 11.09 points"),
        ((0.4, 0.4), (0.4, 0.4), "uncalibrated", "gain 0.00 ± 0.00 points"),
        ((0.5, None, None), (0.1, None, None), "uncalibrated", "fewer than two pours could be compared"),
        ((0.4, 0.4, 0.4), (None, 0.2, None), "calibrated", "with the uncalibrated parameters only 1 of 3 pours"),
        ((None, 0.5, None), (0.4, 0.4, 0.4), "uncalibrated", "with θ* only 1 of 3 pours"),
    ],
)
def test_theta_is_recommended_only_if_it_is_closer_to_the_pours_by_more_than_a_standard_error(
    calibrated, uncalibrated, recommended, why
):
    gain = calibration_gain(pairs(*calibrated), pairs(*uncalibrated))
    assert gain.recommended == recommended
    assert gain.text.startswith(f"{JUSTIFIED if recommended == 'calibrated' else NOT_JUSTIFIED}: ")
    assert why in gain.text


@pytest.mark.parametrize("swapped", [False, True])
def test_a_scorecard_says_at_its_end_whether_the_training_and_test_pours_justify_theta(swapped):
    pours = [ScoredPour("cup", pour) for pour in measured(count=8, holdout=2)]
    # a pour of another receiver, from which both are far, does not take part
    pours.append(ScoredPour("cup", replace(pours[0].pour, spillage=1.0, split="transfer")))
    plain = SimulationParameters(particles=4000, cohesion=0.0)
    theta, other = (plain, TRUE_THETA) if swapped else (TRUE_THETA, plain)
    card = CalibrationEvaluation(theta, {}, pours, Contexts(CALIBRATION_ACTIONS, (SCENE,)), 3, uncalibrated=other)
    assert card.result().gain is None
    StrategyHarness(calibration_spill).run(card)
    gain = card.result().gain
    assert (gain.pours, gain.pairs) == (8, 8)
    assert gain.recommended == ("uncalibrated" if swapped else "calibrated")
    assert gain.gain == pytest.approx(gain.uncalibrated - gain.calibrated)
    assert card.decisions[-1].text == gain.text
