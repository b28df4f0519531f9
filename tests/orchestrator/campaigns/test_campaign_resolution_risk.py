"""`campaign_resolution`: `deployment.risk` as people write it: what it means, what is wrong, what a run keeps."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.cli import campaign_commands as campaigns
from orchestrator.cli.json_schema import campaign_schema
from orchestrator.learning.deployment.d1 import D1Settings
from sim_engine.action import DEG
from sim_engine.errors import DecantError
from sim_engine.scene import PoseError
from tests.support import plans

CONFIGS = Path(__file__).parents[3] / "configs"


def written(tmp_path: Path, deployment: dict[str, Any], **top: Any) -> Path:
    content = yaml.safe_load((CONFIGS / "campaigns" / "quickstart.yaml").read_text(encoding="utf-8"))
    for key in ("laboratory", "pourer"):
        content[key] = str(CONFIGS / "campaigns" / content[key])
    calibration, old = content["calibration"], content.pop("deployment")
    calibration["receiver"] = str(CONFIGS / "campaigns" / calibration["receiver"])
    kept = {key: old[key] for key in ("motion", "actions")}
    receiver = str(CONFIGS / "campaigns" / old["receiver"])
    content["deployment"] = {"strategy": "D1", "receiver": receiver, **kept, **deployment}
    path = tmp_path / "campaign.yaml"
    path.write_text(yaml.safe_dump({**content, **top}), encoding="utf-8")
    return path


RISK = {
    "measure": "cvar",
    "level": 0.9,
    "pose_error": {"x": "3 mm", "y": "3 mm", "tilt": "0.5 deg", "speed_factor": 0.02},
    "theta": "posterior",
}


def test_a_risk_is_read_as_it_was_meant_and_can_be_read_again(tmp_path: Path) -> None:
    path = written(tmp_path, {"risk": RISK})
    jsonschema.validate(yaml.safe_load(path.read_text(encoding="utf-8")), campaign_schema())
    plan = load_campaign(path)
    assert plan.deployment is not None
    settings = plan.deployment.settings
    assert isinstance(settings, D1Settings)
    risk = settings.risk
    assert risk is not None
    assert (risk.measure, risk.level, risk.tail, risk.theta) == ("cvar", 0.9, 0.9, "posterior")
    assert risk.errors == PoseError(3e-3, 3e-3, pytest.approx(0.5 * DEG), 0.02)  # type: ignore[arg-type]
    assert (settings.rounds, settings.simulations_per_iteration) == (30, 2)
    again = tmp_path / "again.yaml"
    again.write_text(json.dumps(plan.resolved), encoding="utf-8")
    loaded = load_campaign(again)
    assert loaded.deployment == plan.deployment


def test_a_run_may_not_be_gone_on_with_under_another_risk(tmp_path: Path) -> None:
    plain, risky = (load_campaign(written(tmp_path, d)) for d in ({}, {"risk": RISK}))
    assert fingerprint(risky)["deployment"]["settings"]["risk"]["measure"] == "cvar"
    assert plain.deployment is not None
    assert isinstance(plain.deployment.settings, D1Settings)
    assert (plain.deployment.settings.rounds, plain.deployment.settings.simulations_per_iteration) == (15, 2)
    other = plain.deployment.with_settings(risk=plans.risk("cvar", 0.8, PoseError(x=3e-3, speed_factor=0.02)))
    assert fingerprint(replace(plain, deployment=other)) != fingerprint(plain)


@pytest.mark.parametrize(
    ("deployment", "complaint"),
    [
        ({"risk": {**RISK, "level": 1.0}}, "outside 0.01 … 0.99"),
        ({"risk": {**RISK, "measure": "expected"}}, "belongs to 'measure: cvar'"),
        ({"risk": {"measure": "expected"}}, "names nothing that could go wrong"),
        ({"risk": {**RISK, "measure": "worst"}}, "cvar"),
        ({"risk": {**RISK, "pose_error": {"x": "3 kg"}}}, "should be a length"),
        ({"risk": {**RISK, "theta": "all"}}, "posterior"),
        ({"risk": RISK, "simulations_per_iteration": 1}, "at least 2 are needed"),
        ({"strategy": "D2", "pours": 5, "risk": RISK}, "belongs to D1, not to D2"),
        ({"strategy": "D3", "pours": 5, "risk": RISK}, "belongs to D1, not to D3"),
        ({"risk": RISK, "objectives": [{"name": "spilled"}]}, "can't be combined with 'objectives'"),
    ],
)
def test_each_thing_that_is_wrong_is_one_error(tmp_path: Path, deployment: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load_campaign(written(tmp_path, deployment))
    assert complaint in str(refused.value)
    assert len(refused.value.problems) == 1


def test_a_posterior_that_nobody_makes_is_refused_before_anything_starts(tmp_path: Path) -> None:
    path = written(tmp_path, {"risk": RISK}, outputs={"directory": str(tmp_path / "runs")})
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    del content["calibration"]
    content["simulator"] = {"parameters": {"particles": 500}}
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(DecantError, match="this campaign has no calibration") as refused:
        campaigns.run(path, in_process=True)
    assert refused.value.exit_code == 2
    assert not (tmp_path / "runs").exists()


def test_planning_takes_the_posterior_from_parameters_and_nowhere_else(tmp_path: Path) -> None:
    plan = load_campaign(written(tmp_path, {"risk": RISK}))
    with pytest.raises(DecantError, match="needs --parameters") as refused:
        campaigns.planning_request(plan, None, None, None)
    assert refused.value.exit_code == 2
    theta = tmp_path / "theta.json"
    theta.write_text('{"theta": {"cohesion": 0.02}}', encoding="utf-8")
    with pytest.raises(DecantError, match="has no 'posterior'") as refused:
        campaigns.planning_request(plan, theta, None, None)
    assert refused.value.exit_code == 2
    rows = [{"theta": {"cohesion": 0.01}, "weight": 3.0}, {"theta": {"cohesion": 0.05}, "weight": 1.0}]
    theta.write_text(json.dumps({"theta": {"cohesion": 0.02}, "posterior": rows}), encoding="utf-8")
    planning = campaigns.planning_request(plan, theta, None, None).campaign
    assert planning.deployment is not None
    drawn = [one.cohesion for one in planning.deployment.thetas]
    assert drawn.count(0.01) == 3 * drawn.count(0.05) > 0
    assert planning.parameters.cohesion == 0.02
