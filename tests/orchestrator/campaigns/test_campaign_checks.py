"""`campaign_checks`: what can be run and makes little sense is told, with what would: offsets that no stream
bridges, tilts too fast.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from actors.optimizer.questions import Linear
from orchestrator.campaigns.campaign_checks import check_campaign
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.yaml.yaml_errors import Problem
from orchestrator.learning.deployment.d2 import D2Settings, RealOnly
from orchestrator.runs.strategy_harness import StrategyHarness
from tests.support.campaign_files import CAMPAIGN, RECORDED, write
from tests.support.toy_spillage import narrow_cup

CONFIGS = Path(__file__).parents[3] / "configs"
QUICKSTART = (CONFIGS / "campaigns" / "quickstart.yaml").read_text(encoding="utf-8").replace("../", f"{CONFIGS}/")

LINE = 1 + QUICKSTART[: QUICKSTART.rindex("x_offset: [")].count("\n")
INTO_NARROW = f"bad.yaml:{LINE}:15: deployment.actions.x_offset: deployment into 'narrow': "


def warnings(path: Path) -> list[str]:
    told: list[Problem] = []
    check_campaign(load_campaign(path), warn=told.append)
    return [str(problem).splitlines()[0].replace(f"{path.parent}/", "") for problem in told]


@pytest.mark.parametrize("path", sorted((CONFIGS / "campaigns").glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_campaigns_can_start_and_make_sense(path: Path) -> None:
    told: list[Problem] = []
    assert check_campaign(load_campaign(path), warn=told.append) == []
    assert told == []


def test_offsets_from_which_no_stream_hits_are_told_with_those_from_which_one_does(tmp_path: Path) -> None:
    for ends, share in (
        ("400 mm, 500 mm", "from no x_offset in this range can a stream hit"),
        ("1 mm, 10 mm", "from no x_offset in this range can a stream hit"),
        ("130 mm, 230 mm", "only from 21 % of this range can a stream hit"),
    ):
        (told,) = warnings(write(tmp_path, "bad.yaml", QUICKSTART.replace("95 mm, 150 mm", ends)))
        assert told.startswith(INTO_NARROW + share)
        # slower pours come down nearer to the pourer
        assert told.endswith("'narrow': a free jet comes down in it from an x_offset of 56 … 150 mm")


def test_a_fixed_offset_is_looked_at_as_well(folder: Path) -> None:
    assert warnings(write(folder, "good.yaml", CAMPAIGN)) == []
    (told,) = warnings(write(folder, "bad.yaml", CAMPAIGN.replace("x_offset: 84 mm", "x_offset: 300 mm")))
    assert told.startswith("bad.yaml:6:40: motion.x_offset: calibration: from this x_offset no stream can hit 'cup'")


def test_pours_that_were_made_are_not_doubted(folder: Path) -> None:
    assert warnings(write(folder, "good.yaml", RECORDED.replace("x_offset: 84 mm", "x_offset: 300 mm"))) == []


def test_a_stream_beside_the_receiver_hits_nothing(folder: Path) -> None:
    beside = CAMPAIGN.replace("height: 90 mm", "height: 90 mm, y_offset: 60 mm")
    (told,) = warnings(write(folder, "bad.yaml", beside))
    assert told.startswith("bad.yaml:6:72: motion.y_offset: calibration: the stream passes 60 mm beside the axis")
    assert told.endswith("of 'cup', whose opening has a radius of 32 mm")


def test_a_lip_below_the_rim_pours_nothing_in(folder: Path) -> None:
    low = CAMPAIGN.replace("height: 90 mm", "height: -20 mm").replace("x_offset: 84 mm", "x_offset: 120 mm")
    (told,) = warnings(write(folder, "bad.yaml", low))
    assert told.startswith(
        "bad.yaml:6:56: motion.height: calibration: the liquid leaves the lip below the rim of 'cup'"
    )


def test_tilts_faster_than_the_laboratory_allows_are_told_with_the_limit(tmp_path: Path) -> None:
    fast = QUICKSTART.replace("[50 deg/s, 150 deg/s]", "[50 deg/s, 200 deg/s]")
    (told,) = warnings(write(tmp_path, "bad.yaml", fast))
    assert told == (
        f"bad.yaml:{LINE - 1}:23: deployment.actions.angular_velocity: deployment into 'narrow': goes up to 200 deg/s, "
        "and the arm turns the pourer at 150 deg/s at most (arm.limits): the search ends there"
    )
    # at 180 deg/s² a turn of 120 deg comes to 147 deg/s on its way
    slow = fast.replace("angular_acceleration: 600 deg/s^2", "angular_acceleration: 180 deg/s^2")
    assert warnings(write(tmp_path, "good.yaml", slow)) == []


def test_a_search_without_simulations_ends_at_the_speed_of_the_arm_too(tmp_path: Path) -> None:
    fast = QUICKSTART.replace("[50 deg/s, 150 deg/s]", "[50 deg/s, 300 deg/s]")
    fast = fast.replace("[40 deg/s, 140 deg/s]", "[40 deg/s, 300 deg/s]")
    plan = load_campaign(write(tmp_path, "fast.yaml", fast))
    assert plan.calibration is not None
    assert plan.deployment is not None
    for stage in (plan.calibration, plan.deployment):
        assert stage.constraints == (Linear((("angular_velocity", 1.0),), math.radians(150.0)),)
    searching = replace(plan.deployment, settings=D2Settings(pours=12))
    played = StrategyHarness(narrow_cup).run(RealOnly(searching, searching.scenes[0], plan.parameters, 3))
    assert max(pour.action.angular_velocity for pour in played.pours) <= math.radians(150.0) + 1e-9
    assert load_campaign(write(tmp_path, "slow.yaml", QUICKSTART)).deployment.constraints == ()


def test_a_single_pour_whose_vessels_touch_is_refused_at_its_motion(folder: Path) -> None:
    text = CAMPAIGN[: CAMPAIGN.index("simulator:")].replace("max_angle: ", "angular_velocity: 60 deg/s, max_angle: ")
    assert check_campaign(load_campaign(write(folder, "good.yaml", text + "pour: true\n"))) == []
    touching = write(folder, "bad.yaml", text.replace("x_offset: 84 mm", "x_offset: 10 mm") + "pour: true\n")
    (problem,) = check_campaign(load_campaign(touching))
    assert str(problem).splitlines()[0].removeprefix(f"{folder}/").startswith("bad.yaml:6:9: motion: pour into 'cup': ")


def test_a_bench_without_an_arm_that_should_record_pours_is_told_of_before_they_are_made(folder: Path) -> None:
    recorded = "outputs: {pour_recordings: true}\n"
    (told,) = warnings(write(folder, "bad.yaml", CAMPAIGN + recorded))
    assert told.startswith("bad.yaml:14:28: outputs.pour_recordings: records doses alone in laboratory 'lab'")
    assert warnings(write(folder, "weighed.yaml", RECORDED + recorded)) == []
