"""`campaign_resolution`: what campaigns may say about strategies: their own keys, what they cost, and errors that
say where.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.campaigns.yaml.section_validation import RENAMED
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.deployment.objectives import TargetVolume

CONFIGS = Path(__file__).parents[3] / "configs"

CALIBRATED = f"""\
name: test
laboratory: {CONFIGS}/laboratories/virtual.yaml
liquid: {{name: water, mass: 200 g}}
pourer: {CONFIGS}/vessels/beaker.yaml
receiver: {CONFIGS}/vessels/tumbler.yaml
motion: {{max_angle: 110 deg, x_offset: 110 mm, height: 90 mm}}
simulator:
  parameters:
    particles: {{range: [500, 2500], scale: log}}
    cohesion: [0 N/m, 0.1 N/m]
calibration:
  actions: {{angular_velocity: [15 deg/s, 120 deg/s]}}
  pours: {{count: 32, holdout: 4}}
"""


def load(folder: Path, text: str) -> CampaignPlan:
    path = folder / "campaign.yaml"
    path.write_text(text)
    return load_campaign(path)


def refusal(folder: Path, text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load(folder, text)
    assert str(caught.value).count("campaign.yaml:") == 1, "one cause, one message"
    return str(caught.value)


@pytest.mark.parametrize("pours", ["", "12", "[]", "{count: many}"])
def test_pours_that_are_no_section_are_one_error_with_their_place(tmp_path: Path, pours: str) -> None:
    """They ended with a traceback."""
    text = CALIBRATED.replace("{count: 32, holdout: 4}", pours)
    assert "campaign.yaml:13:" in refusal(tmp_path, text)
    assert "calibration.pours" in refusal(tmp_path, text)


@pytest.mark.parametrize(
    ("keys", "simulations", "settled"),
    [
        ("strategy: C1\n  grid: {particles: 5, cohesion: 6}", 840, {"grid": {"particles": 5, "cohesion": 6}}),
        ("strategy: C1\n  points_per_axis: 10", 2800, {"grid": {"particles": 10, "cohesion": 10}}),
        ("strategy: C1\n  simulations: 504", 448, {"grid": {"particles": 4, "cohesion": 4}}),
        ("strategy: C2\n  samples: 18", 504, {"samples": 18}),
        ("strategy: C2\n  simulations: 520", 504, {"samples": 18}),
        ("strategy: C3\n  iterations: 59", 1652, {"iterations": 59}),
        ("strategy: C3\n  simulations: 1652", 1652, {"iterations": 59}),
        ("strategy: C4\n  simulations: 108", 108, {"simulations": 108}),
        ("simulations: 108", 108, {"simulations": 108}),
    ],
)
def test_budgets_count_single_simulated_pours(
    keys: str, simulations: int, settled: dict[str, Any], tmp_path: Path
) -> None:
    plan = load(tmp_path, f"{CALIBRATED}  {keys}\n")
    assert plan.calibration is not None
    found = plan.calibration
    assert found.simulations == simulations
    assert {name: getattr(found.settings, name) for name in settled} == settled
    (tmp_path / "again.json").write_text(json.dumps(plan.resolved))
    assert dataclasses.replace(load_campaign(tmp_path / "again.json"), source=plan.source) == plan


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("strategy: C4\n  simulations: many", "calibration.simulations: should be a whole number, or 'auto'"),
    ],
)
def test_a_budget_that_makes_no_sense_is_refused(keys: str, expected: str, tmp_path: Path) -> None:
    assert expected in refusal(tmp_path, f"{CALIBRATED}  {keys}\n")


# -- losses and objectives -----------------------------------------------------------------------------------------

DEPLOYED = f"""\
name: test
laboratory: {CONFIGS}/laboratories/virtual.yaml
liquid: {{name: water, mass: 200 g}}
pourer: {CONFIGS}/vessels/beaker.yaml
receiver: {CONFIGS}/vessels/narrow.yaml
motion: {{x_offset: 110 mm, height: 50 mm}}
deployment:
  strategy: D1
  actions: {{angular_velocity: [15 deg/s, 120 deg/s], max_angle: [70 deg, 125 deg], hold_time: [0 s, 3 s]}}
"""
TARGET = "{name: target_volume, volume: 150 mL, tolerance: 2 mL}"


LEAST_FOR_NOT_POURING = [
    ("name: grams", "campaign.yaml:10:16: deployment.loss.name: 'grams' is least where next to nothing is poured"),
    ("name: particles", "deployment.loss.name: 'particles' is least where next to nothing is poured"),
    ("name: normalised", "deployment.loss.name: 'normalised' is least where next to nothing is poured"),
    ("retained_weight: 0", "campaign.yaml:10:27: deployment.loss.retained_weight: with 0 the loss is least where next"),
]


@pytest.mark.parametrize("stop", ["max_angle: [70 deg, 125 deg]", "hold_time: [0 s, 3 s]"])
@pytest.mark.parametrize(("loss", "expected"), LEAST_FOR_NOT_POURING)
def test_a_loss_that_not_pouring_serves_best_is_refused_where_a_pour_may_stop_so_early(
    loss: str, expected: str, stop: str, tmp_path: Path
) -> None:
    angle = "" if stop.startswith("max_angle") else "  motion: {max_angle: 120 deg}\n"
    actions = f"actions: {{angular_velocity: [15 deg/s, 120 deg/s], {stop}}}"
    text = f"{DEPLOYED[: DEPLOYED.index('actions')]}{actions}\n  loss: {{{loss}}}\n{angle}"
    said = refusal(tmp_path, text)
    assert expected in said
    assert f"fix {stop.partition(':')[0]} under motion, use spilled_and_retained" in said
    assert load(tmp_path, text.replace(loss, "retained_weight: 0.5")).deployment is not None


@pytest.mark.parametrize("loss", [loss for loss, _ in LEAST_FOR_NOT_POURING])
def test_any_loss_may_be_had_where_every_pour_empties_the_pourer(loss: str, tmp_path: Path) -> None:
    text = DEPLOYED.replace(", max_angle: [70 deg, 125 deg], hold_time: [0 s, 3 s]", "")
    plan = load(tmp_path, f"{text}  motion: {{max_angle: 120 deg}}\n  loss: {{{loss}}}\n")
    assert plan.deployment is not None


def objective(text: str) -> str:
    return f"{DEPLOYED}  objective: {text}\n"


def test_an_objective_is_read_in_si_and_written_out_again(tmp_path: Path) -> None:
    plan = load(tmp_path, objective(TARGET.replace("}", ", floor: 0.3}")))
    assert plan.deployment is not None
    target = plan.deployment.objective
    assert isinstance(target, TargetVolume)
    assert (target.volume, target.tolerance, target.floor) == (1.5e-4, 2e-6, 0.3)
    assert plan.deployment.loss_name == "target_volume"
    (tmp_path / "again.json").write_text(json.dumps(plan.resolved))
    assert dataclasses.replace(load_campaign(tmp_path / "again.json"), source=plan.source) == plan
    assert fingerprint(plan) != fingerprint(load(tmp_path, DEPLOYED))
    assert fingerprint(plan)["deployment"]["objective"]["floor"] == 0.3


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (objective("{name: spiled}"), "objective.name: 'spiled' is not known here; did you mean 'spilled'?"),
        (
            objective("{name: spillage}"),
            "spillage is spilled / poured, and this objective is spilled / loaded: write 'spilled'",
        ),
    ],
)
def test_an_objective_that_makes_no_sense_is_refused(text: str, expected: str, tmp_path: Path) -> None:
    assert expected in refusal(tmp_path, text)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("pareto: true", "pareto: unknown key; a deployment has one 'objective'; remove it"),
        (
            "objectives: [{name: spilled}, {name: time, weight: 0.2}]",
            "objectives: unknown key; weighted sums are gone; give one, as 'objective: {name: target_volume, ",
        ),
        ("floor: 0.3", "floor: unknown key; it is a key of the objective: 'objective: {name: spilled, floor: 0.5}'"),
        ("risk: {measure: cvar, theta: posterior}", "risk: unknown key; planning under errors of execution is gone; "),
    ],
)
def test_a_key_that_is_gone_is_one_error_that_says_so(line: str, expected: str, tmp_path: Path) -> None:
    text = refusal(tmp_path, f"{DEPLOYED}  {line}\n")
    assert expected in text
    assert text.count("campaign.yaml:") == 1


OF_VERSION_0_2 = f"""\
name: test
laboratory: {CONFIGS}/laboratories/virtual.yaml
liquid: {{density: 998 kg/m^3, dynamic_viscosity: 1 mPa s, mass: 200 g}}
pourer: {CONFIGS}/vessels/beaker.yaml
receiver: {CONFIGS}/vessels/tumbler.yaml
motion: {{max_angle: 110 deg, height: 90 mm, hold_time: until_flow_ends, hold_cap: 3 s}}
simulator: {{parameters: {{viscosity: [0 1/s, 10 1/s], lip_drop: 0.5}}}}
calibration:
  strategy: C1
  actions: {{angular_velocity: [60 deg/s, 120 deg/s], x_offset: [90 mm, 120 mm]}}
  pours: {{count: 4}}
  per_axis: 4
deployment:
  strategy: D3
  actions: {{angular_velocity: [60 deg/s, 120 deg/s], x_offset: [90 mm, 120 mm]}}
  pours: 6
  initial: 2
  per_pour: 4
  risk_limit: {{loss: 10 %, otherwise: stop}}
  stop: {{gain_below: 0.2 %}}
outputs: {{rrd: true}}
"""


def test_the_keys_of_version_0_2_are_errors_with_their_present_names(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        load(tmp_path, OF_VERSION_0_2)
    text = str(refused.value)
    for key, now in RENAMED.items():
        if f"{key}:" in OF_VERSION_0_2:
            assert f".{key}: unknown key; it is '{now}' now" in text
    assert text.count("campaign.yaml:") == text.count("unknown key; it is") == 10


CONFIRMED = f"""\
name: test
laboratory: {CONFIGS}/laboratories/virtual.yaml
liquid: {{name: water, mass: 200 g}}
pourer: {CONFIGS}/vessels/beaker.yaml
receiver: {CONFIGS}/vessels/tumbler.yaml
motion: {{max_angle: 110 deg, height: 90 mm}}
deployment:
  strategy: D1
  actions: {{angular_velocity: [60 deg/s, 120 deg/s], x_offset: [90 mm, 120 mm]}}
  pours: 0
  confirm: 3
"""


def test_confirming_pours_are_part_of_the_plan_whatever_the_strategy(tmp_path: Path) -> None:
    for strategy, text in (("D1", CONFIRMED), ("D2", CONFIRMED.replace("D1", "D2").replace("pours: 0", "pours: 4"))):
        plan = load(tmp_path, text)
        assert plan.deployment is not None
        assert (plan.deployment.strategy, plan.deployment.confirm) == (strategy, 3)
    without = load(tmp_path, CONFIRMED.replace("  confirm: 3\n", ""))
    assert without.deployment is not None
    assert without.deployment.confirm == 0


def test_confirming_pours_need_a_bench(tmp_path: Path) -> None:
    problem = refusal(tmp_path, CONFIRMED.replace("laboratories/virtual.yaml", "laboratories/planning.yaml"))
    assert "campaign.yaml:11:12: deployment.confirm: laboratory 'planning' has no bench to pour on" in problem


# -- keys that do not exist ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("good", "other", "told"),
    [
        ("deployment:", "outputs: {record_rate: 4 1/s}\ndeployment:", "outputs.record_rate: unknown key; did you mean"),
        ("strategy: D1", "strategy: D1\n  initial: 4", "deployment.initial: unknown key; it is 'initial_samples' now"),
        ("strategy: D1", "strategy: D3\n  pours: 5\n  model: scaled", "deployment.model: 'scaled' is not known here"),
        ("strategy: D1", "strategy: D3\n  pours: 5\n  trust: always", "deployment.trust: unknown key"),
    ],
)
def test_a_name_of_an_earlier_version_is_unknown(tmp_path: Path, good: str, other: str, told: str) -> None:
    assert told in refusal(tmp_path, DEPLOYED.replace(good, other))
