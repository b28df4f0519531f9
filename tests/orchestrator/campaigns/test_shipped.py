"""`shipped`: the files that come with Decant load, fit their schemas, and say what they should."""

from __future__ import annotations

import dataclasses
import itertools
import json
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

from actors.arm.arm_settings import arm_kind
from actors.arm.ur_settings import UrArmSettings
from actors.emulators.ur_controller.robot import MODELS as CONTROLLED
from actors.emulators.ur_controller.robot import calibrated
from actors.runtime.child_process import child_environment
from orchestrator.campaigns.campaign_checks import check_campaign
from orchestrator.campaigns.file_loading import load_campaign, load_laboratory, load_vessel
from orchestrator.campaigns.yaml.yaml_source import Document
from orchestrator.cli.json_schema import (
    campaign_schema,
    laboratory_schema,
    study_schema,
    vessel_schema,
)
from sim_engine.action import DEG, Action
from sim_engine.vessel.mesh_shape import MeshShape
from tests.support.waiting import PATIENCE

CONFIGS = Path(__file__).parents[3] / "configs"
CAMPAIGNS = sorted((CONFIGS / "campaigns").glob("*.yaml"))
SCHEMAS = {
    "campaigns": campaign_schema,
    "vessels": vessel_schema,
    "laboratories": laboratory_schema,
    "studies": study_schema,
}
SHIPPED = [CONFIGS / "daemon.yaml", *(path for kind in SCHEMAS for path in sorted((CONFIGS / kind).glob("*.yaml")))]


def named(path: Path) -> str:
    return path.stem


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ur3e-kern", "ur5e-mettler", "ur10e-a-and-d"])
def test_the_first_pours_fit_every_laboratory_of_hardware_also_with_a_calibrated_robot(name: str) -> None:
    plan = load_campaign(CONFIGS / "campaigns" / "first-pour.yaml", CONFIGS / "laboratories" / f"{name}.yaml")
    assert check_campaign(plan) == []
    arm = plan.laboratory.arm
    assert isinstance(arm, UrArmSettings)
    own = arm.with_values(calibration=calibrated(CONTROLLED[arm.model]).calibration)
    calibrated_plan = dataclasses.replace(plan, laboratory=plan.laboratory.with_values(arm=own))
    assert check_campaign(calibrated_plan) == []


@pytest.mark.parametrize("path", CAMPAIGNS, ids=named)
def test_resolved_campaign_loads_to_the_same_plan(path: Path, tmp_path: Path) -> None:
    plan = load_campaign(path)
    copy = tmp_path / "campaign.json"
    copy.write_text(json.dumps(plan.resolved))
    again = load_campaign(copy)
    assert dataclasses.replace(again, source=plan.source) == plan


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_shipped_file_names_its_schema_and_satisfies_it(path: Path) -> None:
    first, _, text = path.read_text(encoding="utf-8").partition("\n")
    reference = first.removeprefix("# yaml-language-server: $schema=")
    schema = json.loads((path.parent / reference).read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator(schema).validate(Document.parse(text, path).data)


def test_schema_refuses_what_an_editor_should_underline() -> None:
    good = load_campaign(CONFIGS / "campaigns" / "quickstart.yaml").resolved
    validator = jsonschema.Draft202012Validator(campaign_schema())
    assert validator.is_valid(good)
    for bad in (
        good | {"sed": 1},
        {k: v for k, v in good.items() if k != "liquid"},
        good | {"liquid": {"mass": 200}},
        good | {"motion": {"return_velocity": "step"}},
        good | {"actions": {"x_offset": ["80 mm"]}},
    ):
        assert not validator.is_valid(bad)


def test_first_pours_of_a_real_arm_fit_the_limits_of_its_first_day(tmp_path: Path) -> None:
    text = (CONFIGS / "laboratories" / "ur10-kern.yaml").read_text(encoding="utf-8")
    page = (CONFIGS.parent / "docs" / "laboratory" / "commissioning.md").read_text(encoding="utf-8")
    for usual, first_day in (("tool_speed: 800 mm/s", "tool_speed: 250 mm/s"), ("130 deg/s", "45 deg/s")):
        assert usual in text
        assert first_day in page
        text = text.replace(usual, first_day)
    slow = tmp_path / "rig.yaml"
    slow.write_text(text, encoding="utf-8")
    plan = load_campaign(CONFIGS / "campaigns" / "first-pour.yaml", slow)
    assert check_campaign(plan) == []
    assert plan.deployment is not None
    assert plan.laboratory.arm is not None
    assert (plan.laboratory.mode, plan.deployment.strategy, plan.deployment.pours) == ("hardware", "D2", 3)
    scene, plan_path = plan.deployment.scenes[0], arm_kind(plan.laboratory.arm).plan
    speeds, offsets = ([axis.lower, axis.upper] for axis in plan.deployment.actions.axes)
    for speed, offset in itertools.product(speeds, offsets):
        action = Action(**scene.fixed, angular_velocity=speed, x_offset=offset)
        report = plan_path(scene, action).report  # refuses what the arm can't do
        assert report.tool_speed <= 0.25


def test_recorded_campaign_describes_the_scene_of_its_records() -> None:
    plan = load_campaign(CONFIGS / "campaigns" / "recorded.yaml")
    assert plan.calibration is not None
    records, transfer = plan.calibration.records, plan.calibration.transfer
    assert records is not None
    assert transfer is not None
    first = records.pours[0]
    assert (first.action.angular_velocity, first.action.max_angle) == pytest.approx((15.1 * DEG, 95.0 * DEG))
    assert first.action.x_offset == pytest.approx(0.084)
    assert first.action.height == pytest.approx(0.090)
    assert (first.action.angular_acceleration, first.action.return_velocity) == (None, None)
    assert first.action.hold_time == pytest.approx(1.2)
    assert first.spilled == pytest.approx(0.1e-3)
    assert [sum(p.split == split for p in records.pours) for split in ("train", "test")] == [28, 4]
    assert len(transfer.pours) == 16
    assert transfer.pours[0].action.x_offset == pytest.approx(0.1401)
    assert transfer.pours[0].action.height == pytest.approx(0.060)
    assert transfer.scene.receiver.name == "cone"
    assert plan.calibration.scene.fixed["x_offset"] == pytest.approx(0.084)


def test_hidden_liquid_of_the_bench_is_nowhere_in_what_calibration_gets() -> None:
    plan = load_campaign(CONFIGS / "campaigns" / "quickstart.yaml")
    assert plan.laboratory.bench is not None
    assert plan.calibration is not None
    hidden = plan.laboratory.bench.theta
    assert plan.parameters != hidden
    assert hidden.particles > plan.calibration.parameters.axes[0].upper
    assert str(hidden.particles) not in repr(plan.calibration)


def test_paths_resolve_against_the_file_that_names_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    plan = load_campaign(CONFIGS / "campaigns" / "quickstart.yaml")
    assert plan.outputs.folder == CONFIGS.parent / "runs"
    mug = load_vessel(CONFIGS / "vessels" / "mug.yaml")
    assert isinstance(mug.shape, MeshShape)
    assert mug.shape.path == CONFIGS / "vessels" / "meshes" / "mug.stl"
    assert load_laboratory(CONFIGS / "laboratories" / "planning.yaml").bench is None


@pytest.mark.slow
def test_loading_a_campaign_starts_nothing_heavy() -> None:
    code = (
        "import sys; from pathlib import Path; from orchestrator.campaigns.file_loading import load_campaign;"
        f"load_campaign(Path({str(CONFIGS / 'campaigns' / 'recorded.yaml')!r}));"
        "heavy = ('ray', 'taichi', 'rerun', 'sklearn', 'scipy.stats', 'matplotlib', 'trimesh');"
        "print([m for m in heavy if m in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE, env=child_environment()
    )
    assert result.stdout.strip() == "[]", result.stderr
