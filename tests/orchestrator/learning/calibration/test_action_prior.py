"""`action_prior`: the prior g over actions: what a file may say of it, and that C4 simulates where it says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.stats import kstest, truncnorm

from actors.optimizer.questions import Linear
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.learning.calibration.action_prior import actions_of_prior
from orchestrator.learning.campaign_plan import CalibrationPlan, NormalPrior
from orchestrator.runs.stages import calibration_stages
from orchestrator.runs.strategy_harness import CALIBRATION_ACTIONS, StrategyHarness
from sim_engine.action import DEG
from sim_engine.search_space import Axis, Space
from tests.support.campaign_files import CAMPAIGN, DEPLOYED, report, write
from tests.support.plans import calibration_plan
from tests.support.toy_spillage import calibration_spill, weighed

SLOW = NormalPrior("angular_velocity", 30 * DEG, 10 * DEG)
"""A prior on 15 … 120 deg/s: a deviation and a half above the lowest."""

WRITTEN = "prior: {mean: 30 deg/s, deviation: 10 deg/s}"
RANGE = "angular_velocity: [15 deg/s, 120 deg/s]"
WITH_PRIOR = CAMPAIGN.replace(RANGE, f"angular_velocity: {{range: [15 deg/s, 120 deg/s], {WRITTEN}}}")


# -- what is drawn -----------------------------------------------------------------------------------------------------


def values(space: Space, name: str, count: int = 256, **arguments: Any) -> np.ndarray:
    """Values of one dimension of a sequence of actions."""
    return np.array([space.decode(point)[name] for point in actions_of_prior(space, count, 7, **arguments)])


@pytest.mark.parametrize("scale", ["linear", "log"])
@pytest.mark.parametrize("mean", [30 * DEG, 15 * DEG, 120 * DEG])
def test_speeds_are_distributed_as_the_file_says_whatever_the_scale_of_the_search(scale: Any, mean: float) -> None:
    axis = Axis("angular_velocity", 15 * DEG, 120 * DEG, scale)
    space = Space((Axis("x_offset", 0.08, 0.15), axis))
    drawn = values(space, "angular_velocity", prior=(NormalPrior("angular_velocity", mean, 10 * DEG),))
    bounds = [(end - mean) / (10 * DEG) for end in (axis.lower, axis.upper)]
    # evenly: any stretch of a Sobol sequence of n keeps within a few 1/n, where independent draws stray by 1/√n
    assert kstest(drawn, truncnorm(*bounds, loc=mean, scale=10 * DEG).cdf).statistic < 4 / 256


def test_the_other_dimensions_are_drawn_as_without_it() -> None:
    one = values(CALIBRATION_ACTIONS, "max_angle", prior=(SLOW,))
    assert (one == values(CALIBRATION_ACTIONS, "max_angle")).all()
    assert actions_of_prior(CALIBRATION_ACTIONS, 8, 1) == actions_of_prior(CALIBRATION_ACTIONS, 8, 1, prior=())


@pytest.mark.parametrize("deviation", [1e-9, 6.2])
def test_the_narrowest_and_the_widest_stay_in_the_box(deviation: float) -> None:
    for mean in (15 * DEG, 60 * DEG, 120 * DEG):
        prior = (NormalPrior("angular_velocity", mean, deviation),)
        points = np.array(actions_of_prior(CALIBRATION_ACTIONS, 128, 3, prior=prior))
        assert np.isfinite(points).all()
        assert ((points >= 0.0) & (points <= 1.0)).all()


def test_constraints_hold_under_a_prior_that_lies_beside_them() -> None:
    fast = (Linear((("angular_velocity", -1.0),), -40 * DEG),)
    drawn = values(CALIBRATION_ACTIONS, "angular_velocity", constraints=fast, prior=(SLOW,))
    assert drawn.min() >= 40 * DEG - 1e-9
    assert np.median(drawn) < 50 * DEG, "near the mean, as far as they let it"


def calibration(**changes: Any) -> CalibrationPlan:
    return calibration_plan(**{"fixed_parameters": {}, "simulations": 24, "initial_samples": 24} | changes)


def speeds(**changes: Any) -> tuple[list[float], list[float]]:
    """Speeds of all weighed and all simulated pours of a calibration [deg/s]."""
    results: dict[str, Any] = {}
    for stage in calibration_stages(calibration(**changes))[:2]:
        played = StrategyHarness(calibration_spill, weighed).run(strategy := stage.build(results, 3))
        results[stage.name] = strategy.result()
        if stage.pours:
            poured = [request.action.angular_velocity / DEG for request in played.pours]
    return poured, [request.action.angular_velocity / DEG for request in played.simulations]


def test_c4_simulates_where_the_prior_lies_and_weighs_all_over_the_ranges() -> None:
    weighed_at, simulated_at = speeds(prior=(SLOW,))
    assert len(simulated_at) == 24
    assert np.mean(simulated_at) == pytest.approx(truncnorm(-1.5, 9.0, loc=30.0, scale=10.0).mean(), abs=2.0)
    assert max(simulated_at) < 62
    counts = np.histogram(weighed_at, bins=4, range=(15, 120))[0]
    assert set(counts) == {8}, "stratified, as without a prior"


# -- what a file may say -----------------------------------------------------------------------------------------------


def test_it_stands_in_the_plan_and_the_resolved_file_means_the_same(folder: Path) -> None:
    plan = load_campaign(write(folder, "campaign.yaml", WITH_PRIOR))
    assert plan.calibration is not None
    assert plan.calibration.prior == (SLOW,)
    again = load_campaign(write(folder, "again.yaml", yaml.safe_dump(plan.resolved)))
    assert again.calibration is not None
    assert again.calibration.prior == (SLOW,)
    assert fingerprint(again) == fingerprint(plan)


def test_a_run_may_not_be_gone_on_with_under_another_one(folder: Path) -> None:
    before = fingerprint(load_campaign(write(folder, "campaign.yaml", CAMPAIGN)))
    one = fingerprint(load_campaign(write(folder, "campaign.yaml", WITH_PRIOR)))
    other = fingerprint(load_campaign(write(folder, "campaign.yaml", WITH_PRIOR.replace("10 deg/s", "11 deg/s"))))
    assert len({str(each) for each in (before, one, other)}) == 3


def test_actions_at_the_top_may_have_one_for_calibration(folder: Path) -> None:
    actions = WITH_PRIOR.split("  actions: ")[1].splitlines()[0]
    text = DEPLOYED.replace(f"  actions: {{{RANGE}}}\n", "").replace("simulator:", f"actions: {actions}\nsimulator:")
    plan = load_campaign(write(folder, "campaign.yaml", text))
    assert plan.calibration is not None
    assert plan.calibration.prior == (SLOW,)
    again = load_campaign(write(folder, "again.yaml", yaml.safe_dump(plan.resolved)))
    assert fingerprint(again) == fingerprint(plan)


AT = "calibration.actions.angular_velocity.prior"

WRONG = {
    "beside the range": ("mean: 30 deg/s", "mean: 130 deg/s", f"{AT}.mean: 130 deg/s is outside the range, 15 … 120"),
    "no spread": ("deviation: 10 deg/s", "deviation: 0 deg/s", f"{AT}.deviation: 0 deg/s should be above 0"),
    "negative": ("deviation: 10 deg/s", "deviation: -1 deg/s", f"{AT}.deviation: -1 deg/s should be above 0"),
    "an angle": ("mean: 30 deg/s", "mean: 30 deg", f"{AT}.mean: '30 deg' is an angle; should be an angular velocity"),
    "a length": ("deviation: 10 deg/s", "deviation: 10 mm", f"{AT}.deviation: '10 mm' is a length"),
    "no unit": ("mean: 30 deg/s", "mean: 30", f"{AT}.mean: 30 has no unit; write '30 deg/s'"),
    "no deviation": (", deviation: 10 deg/s", "", f"{AT}: key 'deviation' is missing; add for example"),
    "no range beside it": (
        "{angular_velocity: {range: [15 deg/s, 120 deg/s], ",
        "{height: [80 mm, 99 mm], angular_velocity: {",
        "calibration.actions.angular_velocity: key 'range' is missing; add for example 'range: [lowest, highest]'",
    ),
    "misspelt": ("deviation:", "deviaton:", f"{AT}.deviaton: unknown key; did you mean 'deviation'?"),
    "beside the constraints": (
        "10 deg/s}}",
        "1 deg/s}, }, constraints: [angular_velocity >= 60 deg/s]",
        "calibration.actions.constraints: leave next to nothing where the prior lies",
    ),
    "not C4's": (
        "simulations: 20",
        "strategy: C2\n  samples: 4",
        f"{AT}: belongs to C4, which averages over the prior; C2 simulates the weighed pours; remove it",
    ),
    "of a parameter": (
        "cohesion: [0 N/m, 0.1 N/m]",
        "cohesion: {range: [0 N/m, 0.1 N/m], prior: {mean: 0.05 N/m, deviation: 0.01 N/m}}",
        "simulator.parameters.cohesion.prior: unknown key; known here: measured, range, scale, tolerance",
    ),
    "used by nobody": (
        "simulator:",
        f"actions: {{angular_velocity: {{range: [15 deg/s, 120 deg/s], {WRITTEN}}}}}\nsimulator:",
        "actions.angular_velocity.prior: decides nothing: no calibration takes its actions from here; remove it",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_with_one_is_said_with_its_place(case: str, folder: Path) -> None:
    old, new, message = WRONG[case]
    assert old in WITH_PRIOR
    found = report(write(folder, "campaign.yaml", WITH_PRIOR.replace(old, new)))
    assert message in found
    assert found.count("campaign.yaml:") == 1, "one cause, one message"


def test_deployment_averages_over_nothing(folder: Path) -> None:
    text = DEPLOYED.replace(RANGE, f"angular_velocity: {{range: [15 deg/s, 120 deg/s], {WRITTEN}}}")
    message = "deployment.actions.angular_velocity.prior: is what calibration averages over"
    assert message in report(write(folder, "campaign.yaml", text))
