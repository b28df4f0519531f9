"""`posterior_summary`: what weighed pours say about θ beside θ*: a region, what it leaves open, and the file and
picture that carry it.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.optimizer.questions import Posterior
from orchestrator.campaigns.file_loading import load_discrepancy, load_parameters, load_posterior
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.learning.calibration.calibration_scores import ScoredPair, Scores
from orchestrator.learning.calibration.continuous_calibration import ContinuousBayesianCalibration
from orchestrator.learning.calibration.posterior_summary import (
    PosteriorFound,
    PosteriorSummary,
    RemainingDiscrepancy,
    central,
    left_open,
    posterior_found,
    region,
)
from orchestrator.learning.campaign_plan import MeasuredPour
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.single_action import RepeatedSimulation
from orchestrator.reports.figure_style import save
from orchestrator.reports.publishing import theta_file
from orchestrator.reports.surrogate_figures import draw_posterior
from orchestrator.reports.wording import identified_viscosity, posterior_lines
from orchestrator.runs.strategy_harness import CALIBRATION_ACTIONS, PARAMETERS, SCENE, StrategyHarness
from sim_engine.action import DEG
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import Loss
from sim_engine.search_space import Axis, Space
from tests.support.example_results import is_picture
from tests.support.plans import calibration_plan
from tests.support.toy_spillage import TRUE_THETA, calibration_spill, weighed

TIED = Space((Axis("cohesion", 0.0, 0.1), Axis("friction", 0.0, 0.5)))


def summed(action: Any, theta: SimulationParameters, rng: np.random.Generator) -> float:
    """Only the sum of two parameters matters (each over its range)."""
    speed = (action.angular_velocity / DEG - 15) / 105
    both = 0.5 * (theta.cohesion / 0.1 + theta.friction / 0.5)
    return float(0.1 + 0.5 * speed * both + 0.005 * rng.standard_normal())


def calibrated(spill: Any, truth: Any, seed: int = 0, **changes: Any) -> Any:
    rng = np.random.default_rng(seed)
    pours = []
    for _ in range(16):
        action = SCENE.action(CALIBRATION_ACTIONS.draw(rng))
        pours.append(MeasuredPour(action, min(max(truth(action, None, rng), 0.0), 1.0), 0.98, "train"))
    strategy = ContinuousBayesianCalibration(calibration_plan(simulations=40, **changes), pours, seed)
    StrategyHarness(spill).run(strategy)
    return strategy.result()


@pytest.fixture(scope="module")
def determined() -> Any:
    return calibrated(calibration_spill, weighed, 1)


@pytest.fixture(scope="module")
def tied() -> Any:
    truth = SimulationParameters(cohesion=0.05, friction=0.25)
    return calibrated(
        summed, lambda action, _, rng: summed(action, truth, rng), parameters=TIED, fixed_parameters={"particles": 2000}
    )


@pytest.mark.slow
def test_the_region_holds_the_truth_and_is_smaller_than_what_was_searched(determined: Any) -> None:
    posterior = determined.found.posterior
    assert PosteriorFound.model_validate_json(json.dumps(posterior.model_dump(), allow_nan=False)) == posterior
    for name, (low, high) in posterior.region.items():
        assert low <= getattr(TRUE_THETA, name) <= high, name
        assert PARAMETERS.contains({**PARAMETERS.decode((0.5, 0.5)), name: low})
    low, high = posterior.region["particles"]
    assert np.log(high / low) < 0.7 * np.log(8)
    assert posterior.effective > 50


@pytest.mark.slow
def test_regions_of_nine_tenths_mostly_hold_the_truth() -> None:
    held = []
    for seed in range(8):
        region = calibrated(calibration_spill, weighed, seed).found.posterior.region
        held += [low <= getattr(TRUE_THETA, name) <= high for name, (low, high) in region.items()]
    assert sum(held) >= 12  # of 16; fewer than that has a chance of 2 % if nine in ten held


@pytest.mark.slow
def test_parameters_that_make_up_for_each_other_are_named(tied: Any) -> None:
    posterior = tied.found.posterior
    said = " ".join(posterior.directions)
    assert "cohesion and friction compensate each other: more of one, less of the other" in said
    sums = [0.5 * (t["cohesion"] / 0.1 + t["friction"] / 0.5) for t in posterior.thetas]
    low, high = np.quantile(sums, [0.05, 0.95])
    assert low <= 0.5 <= high
    apart = np.ptp(np.quantile([t["cohesion"] / 0.1 for t in posterior.thetas], [0.05, 0.95]))
    assert high - low < 0.6 * apart  # the sum is known, neither of the two is


def test_open_directions_are_put_into_words() -> None:
    rng = np.random.default_rng(0)
    names = ("friction", "cohesion")
    free = np.column_stack([rng.random(500), 0.5 + 0.01 * rng.standard_normal(500)])
    assert left_open(drawn(free), names) == ["the pours leave friction open"]
    u = rng.random(500)
    ridge = drawn(np.column_stack([u, u + 0.02 * rng.standard_normal(500)]))
    assert "friction and cohesion compensate each other: more of one, more of the other" in " ".join(
        left_open(ridge, names)
    )
    assert left_open(drawn(0.5 + 0.01 * rng.standard_normal((500, 2))), names) == []


def drawn(points: Any) -> Posterior:
    return Posterior(tuple(map(tuple, points.tolist())), (0.01,) * len(points), float(len(points)))


def test_a_region_reaches_the_bound_at_which_the_draws_heap_up() -> None:
    points = np.abs(0.1 * np.random.default_rng(0).standard_normal((400, 1)))
    low, high = region(points)
    assert low[0] < np.quantile(points, 0.02)  # an interval between quantiles would begin at the twentieth part
    assert 0.9 <= np.mean((points >= low) & (points <= high)) < 0.96


def test_the_central_theta_is_a_draw_on_a_bent_ridge_and_not_the_mean_beside_it() -> None:
    turn = np.linspace(0.0, np.pi / 2, 201)
    points = np.column_stack([np.cos(turn), np.sin(turn)])
    at = np.array(central(drawn(points)))
    assert np.hypot(*at) == pytest.approx(1.0)
    assert np.hypot(*points.mean(axis=0)) < 0.95
    assert np.arctan2(at[1], at[0]) == pytest.approx(np.pi / 4, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_the_best_theta_is_one_that_the_pours_do_not_exclude(seed: int) -> None:
    result = calibrated(calibration_spill, weighed, seed)
    for name, (low, high) in result.found.posterior.region.items():
        assert low <= getattr(result.found.theta, name) <= high, name


@pytest.mark.slow
def test_what_is_expected_and_the_map_are_those_of_the_theta_that_is_recommended(tied: Any) -> None:
    grids, theta = tied.found.map, tied.found.theta.model_dump()
    assert grids.over == ("cohesion", "friction") or not grids.held
    x, y = (int(np.argmin(np.abs(np.array(grids.axes[name]) - theta[name]))) for name in ("cohesion", "friction"))
    assert grids.mean[y][x] == pytest.approx(tied.found.predicted_discrepancy, abs=0.01)


def test_people_read_what_is_determined_and_what_is_not() -> None:
    said = PosteriorSummary(
        level=0.9,
        mean={},
        region={"particles": (900.0, 1300.0), "cohesion": (0.001, 0.097)},
        open=("cohesion",),
        correlation=(),
        directions=(),
        remaining_discrepancy=RemainingDiscrepancy(low=0.0, median=0.0, high=0.0),
        effective=100.0,
    )
    assert posterior_lines(said, PARAMETERS) == [
        "90 % of the θ that fit the pours have particles 900 … 1 300 (searched 500 … 4 000)",
        "the pours do not determine cohesion (0 … 0.1 N/m): nearly the whole searched range fits them as well as θ*",
    ]


def test_people_read_the_viscosity_that_the_pours_mean() -> None:
    said = PosteriorSummary(
        level=0.9,
        mean={},
        region={"viscosity_factor": (0.5, 0.8)},
        open=(),
        correlation=(),
        directions=(),
        remaining_discrepancy=RemainingDiscrepancy(low=0.0, median=0.0, high=0.0),
        effective=100.0,
    )
    shampoo = Liquid(name="shampoo", mass=0.18, density=1000.0, dynamic_viscosity=0.15)
    wanted = "Viscosity of shampoo, by these pours: 75 … 120 mPa*s (90 %; declared 150 mPa*s)."
    assert identified_viscosity(said, shampoo) == [wanted]
    undetermined = said.model_copy(update={"open": ("viscosity_factor",)})
    water = Liquid(mass=0.18)  # simulated without its viscosity
    for posterior, liquid in ((undetermined, shampoo), (said, water)):
        assert identified_viscosity(posterior, liquid) == []


@pytest.mark.slow
def test_theta_file_carries_the_posterior_and_can_still_be_planned_with(determined: Any, tmp_path: Path) -> None:
    content = theta_file(determined.found)
    path = tmp_path / "theta.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    assert load_parameters(path) == determined.found.theta
    assert len(content["posterior"]) >= 50
    assert sum(one["weight"] for one in content["posterior"]) == pytest.approx(1.0)
    for one in content["posterior"]:
        assert SimulationParameters.model_validate(one["theta"]).friction == 0.1  # what was fixed stays so


def test_theta_file_says_what_calibration_left_over_of_its_training_pours(determined: Any, tmp_path: Path) -> None:
    def pair(split: str, measured: float, simulated: float, theta: str = "theta") -> ScoredPair:
        return ScoredPair(theta=theta, split=split, scene="cup", measured=measured, simulated=simulated, reason="")

    near = [pair("train", 0.2 + 0.01 * i, 0.19 + 0.01 * i) for i in range(20)]
    others = [pair("test", 0.2, 0.9), pair("train", 0.2, 0.9, "uncalibrated")]
    wrong = [pair("train", 0.2 + 0.01 * i, 0.1 + 0.01 * i) for i in range(20)]
    found = []
    for pairs, plan in (([*near, *others], calibration_plan()), (wrong, None)):
        scores = Scores(simulations=20, undefined={}, discrepancy={}, random_median={}, thetas={}, pairs=tuple(pairs))
        path = tmp_path / "theta.json"
        path.write_text(json.dumps(theta_file(determined.found, scores, plan)), encoding="utf-8")
        left = load_discrepancy(path)
        assert left is not None
        assert left.at(SCENE).here == (plan is not None)
        assert not left.at(replace(SCENE, receiver=SCENE.pourer)).here
        found.append(left.shift)
    assert 0.02 < found[0] < 0.05  # 0.01 of spillage where the stream's density is 0.28 to 0.4
    assert 0.3 < found[1] < 0.5
    path.write_text('{"theta": {"cohesion": 0.02}}', encoding="utf-8")
    assert load_discrepancy(path) is None


def test_the_posterior_is_drawn(determined: Any, tmp_path: Path) -> None:
    figure = draw_posterior(determined.found.posterior, PARAMETERS, determined.found.theta.model_dump())
    assert is_picture(save(figure, tmp_path / "posterior.png"))


def test_lengths_of_the_posterior_are_drawn_in_the_units_of_its_axes() -> None:
    space = Space((PARAMETERS.axes[0], Axis("receiver_x", -0.025, 0.025)))
    points = tuple((0.5, 0.8 + 0.002 * k) for k in range(20))
    found = posterior_found(Posterior(points, (0.01,) * 20, 20.0), space)
    figure = draw_posterior(found, space, space.decode((0.5, 0.82)))
    across = figure.axes[3]
    assert across.get_xlabel() == "receiver x [mm]"
    (star,) = [line for line in across.lines if line.get_label() == "θ*"]
    assert star.get_xdata()[0] == pytest.approx(16.0)  # type: ignore[index]
    cloud = next(line for line in figure.axes[2].lines if line.get_label() == "a draw")
    assert min(cloud.get_ydata()) == pytest.approx(15.0)  # type: ignore[arg-type]


def test_a_prediction_takes_turns_with_thetas_of_the_posterior(tmp_path: Path) -> None:
    path = tmp_path / "theta.json"
    rows = [{"theta": {**TRUE_THETA.model_dump(), "cohesion": 0.02 * k}, "weight": 1.0} for k in range(4)]
    path.write_text(json.dumps({"theta": TRUE_THETA.model_dump(), "posterior": rows}), encoding="utf-8")
    thetas = load_posterior(path, 4)
    assert len(set(thetas)) == 4
    action = SCENE.action({"angular_velocity": 80 * DEG, "max_angle": 100 * DEG})
    costing = Costing(Loss(), SCENE, TRUE_THETA)
    one, several = (RepeatedSimulation(costing, action, 8, 3, drawn) for drawn in ((), thetas))
    played = StrategyHarness(calibration_spill).run(several)
    assert [request.parameters for request in played.simulations] == [*thetas, *thetas]
    StrategyHarness(calibration_spill).run(one)
    spreads: Any = [strategy.result().over_seeds for strategy in (one, several)]
    assert spreads[1]["spilled"].deviation > spreads[0]["spilled"].deviation


def test_thetas_are_drawn_by_their_weights_and_a_file_without_them_says_so(tmp_path: Path) -> None:
    path = tmp_path / "theta.json"
    rows = [{"theta": {"cohesion": 0.01}, "weight": 3.0}, {"theta": {"cohesion": 0.05}, "weight": 1.0}]
    path.write_text(json.dumps({"theta": {"cohesion": 0.02}, "posterior": rows}), encoding="utf-8")
    assert [theta.cohesion for theta in load_posterior(path, 4)] == [0.01, 0.01, 0.01, 0.05]
    path.write_text('{"theta": {"cohesion": 0.02}}', encoding="utf-8")
    with pytest.raises(ConfigError, match="has no 'posterior'"):
        load_posterior(path, 4)
    path.write_text('{"posterior": [{"theta": {"cohesion": 0.02}, "weight": -1}]}', encoding="utf-8")
    with pytest.raises(ConfigError, match="'weight' above 0"):
        load_posterior(path, 4)
