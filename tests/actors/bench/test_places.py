"""An arm that carries the vessels between places, pours the receiver back, and accounts for every gram."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from actors.arm.arm_geometry import Pose
from actors.balance.weighing_plan import Placement
from actors.bench.bench_operators import BenchContents
from actors.bench.night_consent import NightConsent
from actors.grippers.gripper_interface import GRIPPERS
from actors.interfaces import Notice, NotPouredError, OperatorQuestion
from actors.laboratory_settings import LaboratorySettings
from actors.liquid_devices import PUMPS, SourceSettings
from actors.places import PlaceSettings, UnattendedSettings
from orchestrator.materials.vessel_account import LaboratoryPlaces, VesselAccount
from sim_engine.vessel.shapes import VesselGrip, VesselSpec
from tests.support.wired_bench import ACTION, SCENE, OpenStage, Stage, wired_spec

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


def carried(vessel: VesselSpec, mass: float) -> VesselSpec:
    return vessel.model_copy(update={"grip": VesselGrip(mass=mass)})


HANDLED = replace(SCENE, pourer=carried(SCENE.pourer, 0.312), receiver=carried(SCENE.receiver, 0.186))


def placed_spec(**changes: Any) -> LaboratorySettings:
    spec = wired_spec(Placement.RECEIVER, hurried=True)
    gripper = GRIPPERS.get("robotiq")(model="2F-140")
    return spec.with_values(**{"gripper": gripper, "places": PLACES, **changes})


class Watched(LaboratoryPlaces):
    """An account of places that tells when a motion begins or ends."""

    def __init__(self, folder: Path) -> None:
        super().__init__(account(folder), "virtual")
        self.once: dict[str, Callable[[], Awaitable[Any]]] = {}
        self.tasks: list[asyncio.Future[Any]] = []
        self.truth: BenchContents | None = None

    def follow(self, truth: BenchContents) -> None:
        """Compare with the true places whenever one of them changes: then a killed program leaves a true account."""
        move, self.truth = truth.move, truth

        def moved(vessel: str, place: str, *, on_balance: bool) -> None:
            assert self.stands()[vessel] is None, f"{vessel} moves, and is not UNKNOWN"
            move(vessel, place, on_balance=on_balance)

        truth.move = moved  # type: ignore[method-assign]

    def put(self, vessel: str, place: str | None, note: str = "") -> None:
        super().put(vessel, place, note)
        if place is not None and self.truth is not None:
            assert self.truth.stands.get(vessel) == place, f"{vessel} is not at '{place}'"
        if (hook := self.once.pop(f"{vessel}: {note}", None)) is not None:
            self.tasks.append(asyncio.ensure_future(hook()))


def account(folder: Path) -> VesselAccount:
    return VesselAccount(folder / "vessels.sqlite")


def standing(folder: Path) -> dict[str, str | None]:
    return {name.removeprefix("virtual/"): one.place for name, one in account(folder).places().items()}


def played(
    open_stage: OpenStage, folder: Path, play: Callable[[Stage, Watched], Awaitable[Any]], **changes: Any
) -> tuple[Any, Stage]:
    async def run() -> tuple[Any, Stage]:
        record = Watched(folder)
        async with open_stage(spec=placed_spec(**changes), record=record) as stage:
            record.follow(stage.contents)
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

    (first, second), stage = played(open_stage, tmp_path, play)
    assert stage.heard == [
        *PREPARED,
        *("move", "start", "move", "move"),
        *("move", "top_up", "move", "start", "move", "move"),
    ]
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
    assert held.mass == pytest.approx(1e-3 * second.notes["received_g"], abs=1e-5)


@pytest.mark.realtime
@pytest.mark.slow
def test_one_consent_lasts_for_a_night_of_pours_and_every_gram_is_accounted(
    open_stage: OpenStage, tmp_path: Path
) -> None:
    async def play(stage: Stage, record: Watched) -> list[Any]:
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
        await pour(stage)
        return seen

    seen, stage = played(open_stage, tmp_path, play, **NIGHT)
    assert [one["receiver"] for one in seen] == [None, None]
    assert stage.heard == [
        *(*PREPARED, "unattended", "recover", "home"),
        *("laid_out", "cleared", "pourer_full", "move", "start", "move", "move"),  # the consent does not renew itself
    ]
    assert "it is unknown where the receiver stands" in stage.operator.heard[7].problem
    assert "unattended: the consent has ended. a question: the gripper may have lost" in stage.said("warning")
    assert stage.unsafe == []


@pytest.mark.slow
@pytest.mark.realtime
def test_masses_that_do_not_close_are_asked_about(open_stage: OpenStage, tmp_path: Path) -> None:
    async def play(stage: Stage, record: Watched) -> Any:
        await pour(stage)
        stage.contents.spilt_back = 5e-3
        return await pour(stage)

    measured, stage = played(open_stage, tmp_path, play, **NIGHT)
    asked = next(one for one in stage.operator.heard if one.about == "mass")
    assert asked.details["missing_g"] == pytest.approx(5.0, abs=0.5)
    assert measured.notes["cycle"]["missing_g"] == pytest.approx(5.0, abs=0.5)
    assert stage.heard[stage.heard.index("mass") :] == ["mass", "move", "start", "move", "move"]


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
    assert stage.heard == [*PREPARED, "unattended", "grasp_failed", "move", "start", "move", "move"]
    assert "the receiver was not grasped at 'right'" in next(
        one.problem for one in stage.operator.heard if one.about == "grasp_failed"
    )
    assert measured.loaded == pytest.approx(0.2, abs=5e-3)


async def protective_stop(stage: Stage) -> None:
    await stage.site.fault("protective_stop")


async def lost(stage: Stage) -> None:
    await stage.site.gripper_fault("lost")


async def spilt(stage: Stage) -> None:
    stage.contents.spilt_back = 5e-3


FAULTS: dict[int, tuple[str, Callable[[Stage], Awaitable[None]], str]] = {
    2: ("receiver: the arm began to take it from 'right'", spilt, "mass"),
    3: ("pourer: the arm began to carry it to 'left'", protective_stop, "recover"),
    4: ("receiver: the arm began to carry it to 'right'", lost, "recover"),
    5: ("receiver: the arm began to take it from 'right'", protective_stop, "recover"),
}
"""Number of a pour, the motion at whose begin something fails, the failure, and what a person is asked first."""


@pytest.mark.slow
@pytest.mark.realtime
def test_a_virtual_night_with_faults_ends_each_in_a_safe_state_and_a_person_continues_it(
    open_stage: OpenStage, tmp_path: Path
) -> None:
    async def play(stage: Stage, record: Watched) -> dict[int, list[str]]:
        asked: dict[int, list[str]] = {}
        measured: list[Any] = []

        for number in range(1, 7):
            begun = len(stage.heard)
            if number in FAULTS:
                where, fault, _ = FAULTS[number]
                record.once[where] = lambda fault=fault: fault(stage)  # type: ignore[misc]
            try:
                measured.append(await pour(stage))
            except NotPouredError:
                measured.append(await pour(stage))  # the campaign is resumed
            asked[number] = stage.heard[begun:]
            assert record.once == {}
        assert len(measured) == 6
        for one in measured:
            assert one.loaded == pytest.approx(0.2, abs=5e-3)
            missing = one.notes["cycle"].get("missing_g", 0.0)
            assert abs(missing) < 0.5 or missing == pytest.approx(5.0, abs=0.5)
        return asked

    places = (PLACES[0], PLACES[1].with_values(use="source"), PLACES[2])
    asked, stage = played(open_stage, tmp_path, play, **NIGHT, places=places)
    assert asked[1] == [*PREPARED, "unattended"]
    for number, (_, _, first) in FAULTS.items():
        motions = {"move", "start"}
        assert next(one for one in asked[number] if one not in motions) == first, asked[number]
    assert stage.heard.count("unattended") == 1
    assert stage.unsafe == []
    assert stage.said("warning").count("unattended: the consent has ended") == 1
    assert standing(tmp_path) == {"pourer": "pan", "receiver": "right"}


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
