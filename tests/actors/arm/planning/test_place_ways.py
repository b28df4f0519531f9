"""`place_ways`: places that cannot be used are refused before anything starts, each with one clear error."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from pydantic import ValidationError
from ruamel.yaml import YAML

from actors.arm.planning.kinematics import transform_of
from actors.arm.planning.place_ways import FULL_SPEED, SWINGS, full_acceleration, place_problems, way_to
from actors.arm.planning.trajectory import TOOL_ACCELERATION, SampledPath
from actors.arm.pour_feasibility import vessel
from actors.arm.ur.robot_models import MODELS
from actors.arm.ur.ur_kinematics import forward
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import Pose
from actors.bench.vessel_handling import check_handling, plan_back
from actors.grippers.gripper_interface import GRIPPERS
from actors.interfaces import InvalidActionError
from actors.places import UnattendedSettings, all_places, check_places
from orchestrator.campaigns.campaign_checks import check_campaign
from orchestrator.campaigns.file_loading import load_campaign, load_laboratory
from orchestrator.campaigns.place_writing import write_place
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from sim_engine.vessel.shapes import VesselGrip, cylinder

CONFIGS = Path(__file__).parents[4] / "configs"
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


def racked(**rack: Any) -> Change:
    """Place 'right' of the night as a rack of 2 × 2 positions with a pitch of 100 mm."""
    values = {"rows": 2, "columns": 2, "row_pitch": "100 mm", "column_pitch": "100 mm", **rack}
    return at(2, name="rack", rack=values)


def corner(x: float, y: float, z: float = 80.0) -> dict[str, str]:
    turn = dict.fromkeys(("rx", "ry", "rz"), "1.2092 rad")
    return {"x": f"{x} mm", "y": f"{y} mm", "z": f"{z} mm", **turn}


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
        (racked(column_pitch="95 mm"), "'rack/A1' and 'rack/A2' overlap when the gripper is open: its fingers"),
        (racked(column_pitch="80 mm"), "places 'rack/A1' and 'rack/A2' overlap: what stands there is 8 mm apart"),
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


def test_each_position_of_a_rack_is_a_place_between_its_taught_corners(tmp_path: Path) -> None:
    # A1 at (620, 240), B1 to its left and A2 below it in the base's plane: the rack is turned by -90 deg, less 1 mm
    change = racked(last_row=corner(521, 240), last_column=corner(620, 139))
    places = all_places(load_laboratory(changed(tmp_path, change)).places)
    assert [place.name for place in places[2:]] == ["rack/A1", "rack/A2", "rack/B1", "rack/B2"]
    b2 = places[-1].pose.as_list
    assert b2[:3] == pytest.approx([0.5200, 0.1400, 0.080], abs=1.5e-3)
    assert b2[3:] == places[2].pose.as_list[3:]
    assert {place.holds for place in places[2:]} == {("receiver",)}
    alone = all_places(load_laboratory(changed(tmp_path, racked(direction="90 deg"))).places)
    assert alone[3].pose.as_list[:2] == pytest.approx([0.62, 0.34])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (racked(last_row=corner(512, 240), last_column=corner(620, 140)), "up to 4.9 mm"),
        (racked(last_row=corner(720, 240), last_column=corner(620, 140)), "are up to"),  # a mirror image
        (racked(last_row=corner(520, 240, 90), last_column=corner(620, 140)), "'rack' slopes by 5.7 deg"),
        (racked(columns=1, last_column=corner(620, 140)), "is A1 itself"),
        (lambda document: (racked()(document), at(1, name="rack/A2")(document)), "two places are named 'rack/A2'"),
        (lambda document: (racked()(document), at(2, use="source")(document)), "a rack is a place with 'use: stand'"),
        (racked(row_pitch="10 mm"), "places 'rack/A1' and 'rack/B1' overlap"),
        (racked(direction="90 deg", column_pitch="400 mm"), "the foot of a vessel at 'rack/A2' is outside the box"),
    ],
)
def test_racks_that_cannot_be_as_taught_are_refused(change: Change, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        load_laboratory(changed(tmp_path, change))
    assert message in str(refused.value)


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


# What others have published of places that they taught by hand.


def test_a_tool_counts_as_the_same_with_the_opposite_rotation_vector() -> None:
    """A UR3e showed both signs for one pose, from one reading to the next: dof.robotiq.com/discussion/1785."""
    shown, later = (2.221970676, 0.000207703, 2.220909453), (-2.221970757, 0.000233551, -2.220909802)
    angle = math.hypot(*shown)
    opposite = tuple((1.0 - 2.0 * math.pi / angle) * part for part in shown)
    assert max(abs(a - b) for a, b in zip(opposite, later, strict=True)) < 5e-4  # the vector that the arm showed later
    for tool, wanted in ((opposite, 0), ((2.2, 0.0, 2.2), 1)):
        places = [load_laboratory(NIGHT).places[0].with_values(tool=Pose.of(0.0, 0.0, 0.17, *tool))]
        problems = Mock()
        check_places(problems, places, Pose.of(0.0, 0.0, 0.17, *shown))
        assert problems.add.call_count == wanted


def test_a_waypoint_that_polyscope_saved_without_a_tool_is_refused_for_an_arm_with_one() -> None:
    """Joints, pose and TCP offset of a UR10e's waypoint as its .urp and .script files have them: notes.md of
    github.com/pharmbio/robotlab."""
    q = (
        1.9942498207092285,
        -1.6684614620604457,
        1.9330504576312464,
        -0.2718423169902344,
        1.3209004402160645,
        0.0036344528,
    )
    pose = Pose.of(0.433025361705, -0.467959205379, 0.522310714714, 1.500318891221, 0.521427297251, 0.530987104689)
    rotation, position = forward(np.array([q]), MODELS["ur10e"])
    taught = transform_of(pose)
    assert np.linalg.norm(position[0] - taught.position) < 5e-3  # the pose is the flange's: its robot is calibrated
    assert np.abs(rotation[0] - taught.rotation).max() < 5e-3
    place = load_laboratory(NIGHT).places[0].with_values(pose=pose, tool=Pose())
    problems = Mock()
    check_places(problems, [place], Pose(z=0.17))
    assert "was taught with another tool than the arm's" in problems.add.call_args.args[0]


@pytest.mark.parametrize(
    ("first", "second", "overlap"),
    [
        ((197.7, -603.5, 562.9), (392.4, -603.6, 562.8), False),  # next to each other: A21.jsonl
        ((132.8, -521.8, 454.2), (132.8, -521.8, 420.4), True),  # shelves of a hotel: H12.jsonl
    ],
)
def test_places_of_a_plate_hotel_are_told_apart_from_above_only(
    first: tuple[float, ...], second: tuple[float, ...], overlap: bool
) -> None:
    """Positions [mm] that github.com/pharmbio/robotlab has taught for plates, in cellpainter/movelists."""
    spec = load_laboratory(NIGHT)
    assert isinstance(spec.arm, UrArmSettings)
    old = spec.places[1]
    places = [
        old.with_values(name=name, pose=Pose.of(*(1e-3 * value for value in at), *old.pose.as_list[3:]))
        for name, at in (("one", first), ("other", second))
    ]
    cup = replace_grip(cylinder("cup", inner_radius=0.06, inner_height=0.02))
    problems = [text for _, text in place_problems(places, spec.arm, {"pourer": vessel(cup), "receiver": vessel(cup)})]
    assert any("places 'one' and 'other' overlap" in text for text in problems) == overlap
