"""Places that cannot be used are refused before anything starts, each with one clear error."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError
from ruamel.yaml import YAML

from actors.arm.arm_geometry import Pose
from actors.arm.planning.place_ways import FULL_SPEED, SWINGS, full_acceleration, way_to
from actors.arm.planning.trajectory import TOOL_ACCELERATION, SampledPath
from actors.arm.ur_settings import UrArmSettings
from actors.bench.pour_feasibility import vessel
from actors.bench.vessel_handling import check_handling, plan_back
from actors.grippers.gripper_interface import GRIPPERS
from actors.interfaces import InvalidActionError
from actors.places import UnattendedSettings
from orchestrator.campaigns.campaign_checks import check_campaign
from orchestrator.campaigns.file_loading import load_campaign, load_laboratory
from orchestrator.campaigns.place_writing import write_place
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from sim_engine.vessel.shapes import VesselGrip, cylinder

CONFIGS = Path(__file__).parents[3] / "configs"
NIGHT = CONFIGS / "laboratories" / "night.yaml"

Change = Callable[[dict[str, Any]], None]


def changed(folder: Path, change: Change) -> Path:
    yaml = YAML(typ="safe")
    document = yaml.load(NIGHT.read_text(encoding="utf-8"))
    change(document)
    path = folder / "night.yaml"
    with path.open("w", encoding="utf-8") as file:
        YAML().dump(document, file)
    return path


def at(place: int, **values: Any) -> Change:
    return lambda document: document["places"][place].update(values)


def moved(place: int, **pose: str) -> Change:
    return lambda document: document["places"][place]["pose"].update(pose)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (at(1, tool={"z": "150 mm"}), "place 'left' was taught with another tool than the arm's"),
        (at(1, name="right"), "two places are named 'right'"),
        (moved(1, x="1150 mm"), "the foot of a vessel at 'left' is outside the box"),
        (moved(1, z="50 mm"), "below the table"),
        (moved(2, rx="1.4 rad"), "a vessel at 'right' would lean by"),
        (moved(0, x="720 mm"), "place 'pan' is on the balance, and 30 mm away from cell.receiver"),
        (moved(2, x="600 mm", y="-420 mm"), "places 'left' and 'right' overlap"),
        (lambda document: document.pop("gripper"), "vessels are carried between places by a gripper"),
        (lambda document: document["balance"].update(placement="tray"), "with places the balance stands under the"),
    ],
)
def test_places_that_cannot_be_used_are_refused(change: Change, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        load_laboratory(changed(tmp_path, change))
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda document: document.pop("safeguard"), "need 'safeguard' in the file of laboratory 'night'"),
        (lambda document: (document.pop("gripper"), document.pop("places")), "need 'gripper' and 'places'"),
        (lambda document: document["places"].pop(), "it needs one with 'use: balance' for both vessels"),
        (lambda document: document["arm"].update(payload="0.45 kg"), "'beaker' is too heavy when full: 512 g"),
        (lambda document: document["gripper"].update(model="2F-85"), "the gripper opens to 85.0 mm"),
        (moved(2, x="700 mm", y="60 mm"), "places 'pan' and 'right' overlap"),
        (moved(2, x="750 mm", y="-420 mm"), "a vessel at 'left'"),
    ],
)
def test_campaigns_that_a_cell_cannot_pour_alone_are_refused(change: Change, message: str, tmp_path: Path) -> None:
    campaign = tmp_path / "campaign.yaml"
    text = (CONFIGS / "campaigns" / "night.yaml").read_text(encoding="utf-8")
    campaign.write_text(text.replace("../laboratories/night.yaml", str(changed(tmp_path, change))), encoding="utf-8")
    try:
        found = "; ".join(str(one) for one in check_campaign(load_campaign(campaign)))
    except ConfigError as error:
        found = str(error)
    assert message in found


def test_a_full_vessel_is_carried_so_slowly_that_its_liquid_stays_below_the_rim() -> None:
    spec = load_laboratory(NIGHT)
    assert isinstance(spec.arm, UrArmSettings)
    cup = replace_grip(cylinder("cup", inner_radius=0.035, inner_height=0.1))
    vessels = {"pourer": vessel(cup), "receiver": vessel(cup)}
    brim = math.pi * 0.035**2 * 0.1
    hardest = full_acceleration(vessels["pourer"], 0.95 * brim)
    assert SWINGS * 0.035 * hardest / 9.81 == pytest.approx(0.005, rel=0.05)
    assert full_acceleration(vessels["pourer"], 0.5 * brim) == TOOL_ACCELERATION
    slow, fast = (way_to(spec.places[1], spec.places, spec.arm, vessels, volume) for volume in (0.5 * brim, None))
    assert slow.approach_time > fast.approach_time
    path = SampledPath("way", slow.approach.times, slow.approach.joints, spec.arm)
    assert path.point_speeds(vessels["pourer"].solid_vertices[:1]).max() <= 1.05 * FULL_SPEED
    with pytest.raises(InvalidActionError, match="would be too full to be carried"):
        way_to(spec.places[1], spec.places, spec.arm, vessels, 0.999 * brim)


def replace_grip(spec: Any) -> Any:
    return spec.model_copy(update={"grip": VesselGrip(mass=0.2)})


def test_a_taught_place_is_written_and_comments_stay(tmp_path: Path) -> None:
    path = tmp_path / "night.yaml"
    path.write_text(NIGHT.read_text(encoding="utf-8"), encoding="utf-8")
    before = load_laboratory(path).places[1]
    write_place(path, before.with_values(pose=Pose.of(0.6, -0.43, 0.08, 1.2092, 1.2092, 1.2092)))
    write_place(path, before.with_values(name="rear", pose=Pose.of(0.45, -0.25, 0.08, 1.2092, 1.2092, 1.2092)))
    text = path.read_text(encoding="utf-8")
    assert "# under the outlet of the pump" in text
    places = load_laboratory(path).places
    assert [place.name for place in places] == ["pan", "left", "right", "rear"]
    assert places[1].pose.y == pytest.approx(-0.43)
    assert places[3].use == "source"


def test_the_shipped_night_can_be_poured() -> None:
    plan = load_campaign(CONFIGS / "campaigns" / "night.yaml")
    lab = plan.laboratory
    assert lab.arm is not None
    assert plan.calibration is not None
    assert lab.unattended is not None
    gripper = GRIPPERS.get("robotiq")(model="2F-140")
    ways = check_handling(lab.places, lab.arm, gripper, plan.calibration.scene)
    assert sorted({name for name, _ in ways}) == ["left", "pan", "right"]
    back = plan_back(lab.places, lab.arm, plan.calibration.scene)
    assert back.report.tilt == pytest.approx(math.radians(135.0), abs=0.02)
    lonely = replace(plan.calibration.scene, receiver=cylinder("tumbler", inner_radius=0.032, inner_height=0.1))
    with pytest.raises(InvalidActionError, match="its vessel file needs its empty mass"):
        check_handling(lab.places, lab.arm, gripper, lonely)


def test_the_end_of_a_night_is_a_time_of_day() -> None:
    with pytest.raises(ValidationError, match=r"'25:00' should be a time of day from 00:00 to 23:59, such as '07:00'"):
        UnattendedSettings(until="25:00")
