"""`vessel_handling`: an arm that carries the vessels between places, pours the receiver back, and accounts for
every gram.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from actors.arm_geometry import Pose
from actors.balance.weighing_plan import Placement
from actors.bench.night_consent import NightConsent
from actors.grippers.gripper_interface import GRIPPERS
from actors.interfaces import Notice, NotPouredError, OperatorQuestion
from actors.laboratory_settings import LaboratorySettings
from actors.liquid_devices import PUMPS, SourceSettings
from actors.places import PlaceSettings, UnattendedSettings
from orchestrator.materials.vessel_account import VesselAccount
from tests.reliability.night import HANDLED, Watched
from tests.support.wired_bench import ACTION, OpenStage, Stage, wired_spec

TURN = 2.0 * math.pi / (3.0 * math.sqrt(3.0))


def place(name: str, x: float, y: float, z: float, **values: Any) -> PlaceSettings:
    """A place of a vessel's foot in the cell of the virtual laboratory, gripped 60 mm above its underside."""
    pose = Pose.of(x, y, z + 0.06, TURN, TURN, TURN)
    return PlaceSettings(name=name, pose=pose, tool=Pose(z=0.17), **values)


PLACES = (
    place("pan", 0.75, 0.0, 0.06, use="balance"),
    place("left", 0.60, -0.42, 0.02),
    place("right", 0.62, 0.24, 0.02, holds=("receiver",)),
)


def placed_spec(**changes: Any) -> LaboratorySettings:
    spec = wired_spec(Placement.RECEIVER, hurried=True)
    gripper = GRIPPERS.get("robotiq")(model="2F-140")
    return spec.with_values(**{"gripper": gripper, "places": PLACES, **changes})


def account(folder: Path) -> VesselAccount:
    return VesselAccount(folder / "vessels.sqlite")


def standing(folder: Path) -> dict[str, str | None]:
    return {name.removeprefix("virtual/"): one.place for name, one in account(folder).places().items()}


def played(
    open_stage: OpenStage, folder: Path, play: Callable[[Stage, Watched], Awaitable[Any]], **changes: Any
) -> tuple[Any, Stage]:
    async def run() -> tuple[Any, Stage]:
        record = Watched(folder, "virtual")
        async with open_stage(spec=placed_spec(**changes), record=record) as stage:
            record.follow(stage)
            return await play(stage, record), stage

    return asyncio.run(run())


async def pour(stage: Stage, **changes: Any) -> Any:
    return await stage.bench.pour(HANDLED, ACTION, seed=5, **changes)


PREPARED = ["laid_out", "cleared", "pourer_empty", "pourer_full"]
"""What a person does at the beginning."""

NIGHT: dict[str, Any] = {
    "safeguard": "fence, gate at input SI0",
    "unattended": UnattendedSettings(pours=200, until="07:00"),
    "source": SourceSettings(refill=PUMPS.get("simulated")()),
}


@pytest.mark.slow
@pytest.mark.realtime
def test_the_arm_does_what_the_operator_did_between_two_pours(open_stage: OpenStage, tmp_path: Path) -> None:
    async def play(stage: Stage, record: Watched) -> list[Any]:
        return [await pour(stage) for _ in range(2)]

    places = (PLACES[0].with_values(tray=204e-6), *PLACES[1:])
    (first, second), stage = played(open_stage, tmp_path, play, places=places)
    assert stage.heard == [
        *("tray_full", *PREPARED),
        *("move", "start", "move"),
        *("tray_full", "move", "top_up", "move", "start", "move"),  # one more pour could overflow it
    ]
    assert stage.operator.heard[0].text.startswith("An unknown mass is in the spill tray")
    spilled = next(one for one in reversed(stage.operator.heard) if one.about == "tray_full").details["held_g"]
    assert spilled == pytest.approx(1e3 * first.spilled, abs=0.1)
    in_tray = account(tmp_path).content("virtual/tray")
    assert in_tray is not None
    assert in_tray.mass == pytest.approx(stage.contents.on_tray, abs=3e-4)
    assert stage.unsafe == []
    assert first.notes["cycle"] == {}
    cycle = second.notes["cycle"]
    assert cycle["film_g"] == pytest.approx(0.4, abs=0.3)
    assert cycle["poured_back_g"] == pytest.approx(first.notes["received_g"] - cycle["film_g"], abs=0.3)
    assert abs(cycle["missing_g"]) < cycle["uncertainty_g"]
    assert second.spilled == pytest.approx(first.spilled, abs=3e-4)
    assert standing(tmp_path) == {"pourer": "pan", "receiver": "right"}
    held = account(tmp_path).content("virtual/receiver")
    assert held is not None
    assert held.mass == pytest.approx(stage.contents.in_receiver, abs=1e-4)  # with the film


@pytest.mark.realtime
@pytest.mark.slow
def test_one_consent_lasts_for_a_night_of_pours_and_every_gram_is_accounted(
    open_stage: OpenStage, tmp_path: Path
) -> None:
    async def play(stage: Stage, record: Watched) -> list[Any]:
        record.content("reservoir", 2.0, 1e-3, "water")
        return [await pour(stage) for _ in range(3)]

    places = (PLACES[0], PLACES[1].with_values(use="source"), PLACES[2])
    measured, stage = played(open_stage, tmp_path, play, **NIGHT, places=places)
    assert stage.heard == [*PREPARED, "unattended"]
    text = stage.operator.heard[-1].text
    assert "up to 200 pours until 07:00" in text
    assert "between 'pan', 'left', 'right'" in text
    assert "fence, gate at input SI0" in text
    for one in measured[1:]:
        assert abs(one.notes["cycle"]["missing_g"]) < 0.5
        assert one.loaded == pytest.approx(0.2, abs=5e-3)
    there = stage.contents.in_pourer + stage.contents.in_receiver + stage.contents.on_tray
    reserve = account(tmp_path).content("virtual/reservoir")
    assert reserve is not None
    assert reserve.mass == pytest.approx(2.0 - (there - measured[0].loaded), abs=5e-4)


@pytest.mark.realtime
def test_a_vessel_lost_on_its_way_is_unknown_and_ends_the_consent(open_stage: OpenStage, tmp_path: Path) -> None:
    async def play(stage: Stage, record: Watched) -> list[dict[str, str | None]]:
        seen: list[dict[str, str | None]] = []

        async def lose() -> None:
            await stage.site.gripper_fault("lost")

        async def look() -> None:
            seen.append(standing(tmp_path))

        record.once["receiver: the arm began to carry it to 'pan'"] = lose
        stage.before["recover"] = look
        with pytest.raises(NotPouredError, match="the gripper may have lost the receiver"):
            await pour(stage)
        stage.before["laid_out"] = look
        assert (
            account(tmp_path).places()["virtual/receiver"].shown().startswith("UNKNOWN (interrupted: the arm began to ")
        )
        await pour(stage)
        return seen

    seen, stage = played(open_stage, tmp_path, play, **NIGHT)
    assert [one["receiver"] for one in seen] == [None, None]
    assert stage.heard == [
        *(*PREPARED, "unattended", "recover", "home"),
        *("laid_out", "cleared", "pourer_full", "move", "start", "move"),  # the consent does not renew itself
    ]
    assert "it is unknown where the receiver stands" in stage.operator.heard[7].problem
    assert "unattended: the consent has ended. a question: the gripper may have lost" in stage.said("warning")
    assert stage.unsafe == []


@pytest.mark.slow
@pytest.mark.realtime
def test_masses_that_do_not_close_are_asked_about(open_stage: OpenStage, tmp_path: Path) -> None:
    async def play(stage: Stage, record: Watched) -> Any:
        async def fill() -> None:
            record.content("reservoir", 1.0, 1e-3, "water")

        record.content("reservoir", 1e-3, 1e-4, "water")
        stage.before["reservoir"] = fill
        await pour(stage)
        stage.contents.spilt_back = 5e-3
        return await pour(stage)

    places = (PLACES[0], PLACES[1].with_values(use="source"), PLACES[2])
    measured, stage = played(open_stage, tmp_path, play, **NIGHT, places=places)
    assert stage.heard.count("reservoir") == 1
    assert stage.said("warning").count("the consent has ended. a question: The reservoir of the refill device") == 1
    asked = next(one for one in stage.operator.heard if one.about == "mass")
    assert asked.details["missing_g"] == pytest.approx(5.0, abs=0.5)
    assert measured.notes["cycle"]["missing_g"] == pytest.approx(5.0, abs=0.5)
    assert stage.heard[stage.heard.index("mass") :] == ["mass", "move", "start", "move"]


@pytest.mark.slow
@pytest.mark.realtime
def test_a_vessel_that_is_not_grasped_is_put_right_by_a_person(open_stage: OpenStage, tmp_path: Path) -> None:
    async def play(stage: Stage, record: Watched) -> Any:
        async def absent() -> None:
            await stage.site.gripper_fault("absent")

        async def present() -> None:
            await stage.site.gripper_fault("absent", 0.0)

        record.once["receiver: the arm began to take it from 'right'"] = absent
        stage.before["grasp_failed"] = present
        return await pour(stage)

    measured, stage = played(open_stage, tmp_path, play, **NIGHT)
    assert stage.heard == [*PREPARED, "unattended", "grasp_failed", "move", "start", "move"]
    assert "the receiver was not grasped at 'right'" in next(
        one.problem for one in stage.operator.heard if one.about == "grasp_failed"
    )
    assert measured.loaded == pytest.approx(0.2, abs=5e-3)


@pytest.mark.parametrize(
    ("wall", "elapsed", "asked", "said"),
    [
        (8.9, 8.9, "move", ""),
        (9.0, 9.0, "move", "it is 07:00"),
        (-50.0, 9.0, "move", "it is 07:00"),  # the clock was set back meanwhile
        (9.0, 0.1, "move", "it is 07:00"),
        (1.0, 1.0, "refill", "a question: is it full"),
    ],
)
def test_a_consent_ends_in_the_morning_or_with_a_question_and_never_returns(
    wall: float, elapsed: float, asked: str, said: str
) -> None:
    evening, notices = datetime(2026, 11, 26, 22), list[Notice]()
    hours = [0.0, 0.0]
    consent = NightConsent(
        UnattendedSettings(pours=3, until="07:00"),
        "a fence",
        "ur10",
        PLACES,
        notices.append,
        now=lambda: evening + timedelta(hours=hours[0]),
        elapsed=lambda: 3600.0 * hours[1],
    )
    consent.answered("yes")
    assert consent.agrees(OperatorQuestion("pour?", "yes or no", about="start"))
    hours[:] = wall, elapsed
    assert consent.agrees(OperatorQuestion("is it full", "yes or no", about=asked)) == (not said)
    assert said in notices[-1].text
    hours[:] = 0.0, 0.0
    assert consent.agrees(OperatorQuestion("carry?", "yes or no", about="move")) == (not said)
