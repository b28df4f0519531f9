"""The check of a campaign before anything starts uses what a virtual run will use."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from actors.arm.arm_settings import ArmSettings, arm_kind
from actors.arm.pour_feasibility import vessel
from actors.arm.ur_settings import UrArmSettings
from actors.interfaces import InvalidActionError
from actors.places import PlaceSettings
from orchestrator.campaigns.campaign_checks import check_campaign
from orchestrator.campaigns.file_loading import load_campaign, load_laboratory
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import Vessel
from tests.actors.arm.ur.test_robot_comparison import first_state

CONFIGS = Path(__file__).parents[3] / "configs"
VIAL = {
    "name": "vial",
    "profile": {"unit": "mm", "inner": [[0, 0], [18, 0], [18, 70]], "wall": "2 mm", "floor": "2 mm"},
}


def connected(spec: ArmSettings) -> ArmSettings:
    """The arm of a virtual run, once its controller has been read; planned ways are shared with the check before."""
    assert isinstance(spec, UrArmSettings)
    reported = first_state(spec.model).calibration
    assert reported is not None
    return spec.fitted_to(SimpleNamespace(kinematics=replace(reported, checksum="virtual")))  # type: ignore[arg-type]


def refusal(spec: ArmSettings, place: PlaceSettings, cup: Vessel) -> str:
    """Why the first position of a rack cannot be reached among the others; '' if it can."""
    try:
        arm_kind(spec).way(place.each[0], place.each, {"cup": cup})
    except InvalidActionError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("draws", [25, pytest.param(200, marks=pytest.mark.slow)])
def test_racks_around_the_limits_are_judged_as_in_a_virtual_run(draws: int) -> None:
    lab, rng = load_laboratory(CONFIGS / "laboratories" / "rack.yaml"), np.random.default_rng(20)
    assert lab.arm is not None
    assert lab.expected_arm is not None
    run, verdicts = connected(lab.arm), Counter[bool]()
    shipped = next(place for place in lab.places if place.rack is not None)
    assert shipped.rack is not None
    for _ in range(draws):
        radius = rng.uniform(0.012, 0.03)
        cup = vessel(cylinder("cup", inner_radius=radius, inner_height=rng.uniform(0.05, 0.1), wall=0.002))
        pitch = 0.057 + radius + rng.uniform(-0.008, 0.012)  # fingers and neighbour have 15 mm between them at about 0
        pose = shipped.pose.model_copy(update={"x": rng.uniform(0.5, 0.62), "y": rng.uniform(0.15, 0.45)})
        values = {"rows": 1, "columns": 2, "column_pitch": pitch}
        place = shipped.with_values(pose=pose, holds=("cup",), rack=shipped.rack.with_values(**values))
        before = refusal(lab.expected_arm, place, cup)
        assert refusal(run, place, cup) == before
        verdicts[not before] += 1
    assert min(verdicts.values()) > 0.2 * draws  # both sides of the limits


def campaign(folder: Path, rack: dict[str, Any], wanted: dict[str, Any], **place: Any) -> Path:
    """The shipped mixtures on the shipped rack, with other cups and another rack."""
    yaml = YAML(typ="safe")
    laboratory = yaml.load(CONFIGS / "laboratories" / "rack.yaml")
    entry = next(entry for entry in laboratory["places"] if entry["name"] == "rack")
    entry["rack"] |= rack
    entry["pose"] |= place
    mixtures = yaml.load(CONFIGS / "campaigns" / "mixtures.yaml")
    mixtures |= {"laboratory": "rack.yaml", "receiver": VIAL | {"grip": {"mass": "50 g"}}}
    mixtures["mixtures"] |= {"wanted": wanted, "liquids": mixtures["mixtures"]["liquids"][:1]}
    yaml.dump(laboratory, folder / "rack.yaml")
    yaml.dump(mixtures, folder / "mixtures.yaml")
    return folder / "mixtures.yaml"


def test_cups_that_the_robots_own_lengths_bring_too_near_are_refused_before_the_run(tmp_path: Path) -> None:
    wanted = {"A1": {"water": "20 g"}, "A2": {"water": "20 g"}}
    narrow = {"rows": 1, "columns": 2, "column_pitch": "80 mm"}
    problems = check_campaign(load_campaign(campaign(tmp_path, narrow, wanted)))
    assert "the gripper would come within 14 mm of a vessel at 'rack/A2'" in "\n".join(map(str, problems))
    wider = narrow | {"column_pitch": "85 mm"}
    assert check_campaign(load_campaign(campaign(tmp_path, wider, wanted))) == []


def test_a_cup_in_the_way_of_the_pour_itself_is_refused_before_the_run(tmp_path: Path) -> None:
    high = {"x": "700 mm", "y": "-150 mm", "z": "200 mm"}  # the arm can carry cups there, and passes it with the source
    path = campaign(tmp_path, {"rows": 1, "columns": 1}, {"A1": {"water": "20 g"}}, **high)
    problems = check_campaign(load_campaign(path))
    assert "would run into a vessel at 'rack/A1'" in "\n".join(map(str, problems))
    low = high | {"z": "80 mm"}
    path = campaign(tmp_path, {"rows": 1, "columns": 1}, {"A1": {"water": "20 g"}}, **low)
    assert check_campaign(load_campaign(path)) == []


@pytest.mark.parametrize("virtual", [False, True])
def test_a_recorded_calibration_is_expected_of_hardware_alone(virtual: bool) -> None:
    spec = load_laboratory(CONFIGS / "laboratories" / "rack.yaml").arm
    recorded = first_state("ur10").calibration
    assert isinstance(spec, UrArmSettings)
    expected = spec.with_values(calibration=recorded).expected(virtual=virtual)
    assert (expected.calibration == recorded) is not virtual
    assert spec.expected(virtual=False).calibration is not None  # that of a plausible robot, not nominal lengths
