"""`held_vessel`: a pour with a gripper: what the operator is asked, and what happens to a pourer that slips away."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from actors.grippers.gripper_interface import GRIPPERS
from actors.interfaces import UnknownPourError
from tests.actors.bench.test_dose_procedure import ACTION as DOSE_ACTION
from tests.actors.bench.test_dose_procedure import SCENE as DOSE_SCENE
from tests.actors.bench.test_dose_procedure import check_amount, dosed, dosing_spec
from tests.actors.bench.test_dose_procedure import target as dose_target
from tests.support.waiting import reach
from tests.support.wired_bench import OpenStage, Stage, wired_spec

GRIPPER = GRIPPERS.get("robotiq")(model="2F-85")
"""The pourer of the wired bench is 78 mm wide."""

Play = Callable[[Stage], Awaitable[Any]]


def played(open_stage: OpenStage, play: Play, gripper: Any = GRIPPER, **options: Any) -> tuple[Any, Stage]:
    async def run() -> tuple[Any, Stage]:
        async with open_stage(spec=wired_spec(hurried=True).with_values(gripper=gripper), **options) as stage:
            return await play(stage), stage

    return asyncio.run(run())


@pytest.mark.slow  # the steps are those of the next test, whose grasp is repeated
@pytest.mark.realtime
def test_the_operator_hands_the_pourer_over_and_takes_it_back(open_stage: OpenStage) -> None:
    measured, stage = played(open_stage, lambda stage: stage.pour())
    assert stage.heard == [
        *("tray_wiped", "pourer_empty", "pourer_full", "set_up", "open_gripper", "grasp", "start"),
        *("let_go", "pourer_after"),
    ]
    assert measured.loaded == pytest.approx(0.2, abs=5e-3)
    assert stage.unsafe == []
    texts = {question.about: question.text for question in stage.operator.heard}
    assert "Give the pourer to the gripper" not in texts["set_up"]
    assert "closes with 128 N" in texts["grasp"]
    assert re.search(r"'beaker' is in the gripper: fingers at 7[78]\.\d mm, holds an object", stage.said("note"))


@pytest.mark.realtime
def test_a_crooked_grasp_is_repeated_before_anything_moves(open_stage: OpenStage) -> None:
    async def play(stage: Stage) -> Any:
        async def straighten() -> None:
            await stage.site.gripper_fault("crooked", 0.0)

        await stage.site.gripper_fault("crooked")

        async def crooked() -> None:
            stage.before["open_gripper"] = straighten

        stage.before["grasp"] = crooked
        return await stage.pour()

    _, stage = played(open_stage, play)
    assert stage.heard[3:] == [
        *("set_up", "open_gripper", "grasp", "open_gripper", "grasp", "start"),
        *("let_go", "pourer_after"),
    ]
    assert stage.unsafe == []
    assert "'beaker' is 78.0 ± 3.0 mm wide where it is gripped" in stage.said("warning")
    assert stage.heard.count("start") == 1


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("gripper", "checkpoint", "fault"),
    [
        (GRIPPER, "approach", ("lost", 1.0)),
        pytest.param(GRIPPER, "tilt", ("power", 0.0), marks=pytest.mark.slow),
        pytest.param(GRIPPERS.get("onrobot")(model="RG6"), "tilt", ("lost", 1.0), marks=pytest.mark.slow),
    ],
)
def test_a_pourer_lost_while_the_arm_moves_stops_it_and_is_unknown(
    open_stage: OpenStage, gripper: Any, checkpoint: str, fault: tuple[str, float]
) -> None:
    async def play(stage: Stage) -> float:
        seen: list[Any] = []
        stage.answers["recover"] = ["no"]
        pouring = asyncio.ensure_future(stage.pour(progress=seen.append))
        await reach(seen, checkpoint, pouring)
        await stage.site.gripper_fault(*fault)
        with pytest.raises(UnknownPourError, match="the gripper may have lost the pourer"):
            await pouring
        assert (await stage.site.fault("state"))["runtime_state"] != "PLAYING"
        return await stage.moved(stage.answered_at["recover"])

    moved, stage = played(open_stage, play, gripper)
    assert moved < 1e-3
    asked = next(question for question in stage.operator.heard if question.about == "recover")
    assert "may have lost the pourer" in asked.problem
    assert "Nothing was poured" not in asked.text


@pytest.mark.slow
@pytest.mark.realtime
def test_a_pourer_that_still_stands_on_the_balance_is_not_in_the_gripper(open_stage: OpenStage) -> None:
    async def play(stage: Stage) -> Any:
        do, contents = stage.contents.do, stage.contents

        def forgetful(about: str, fill: float) -> None:
            do(about, fill)
            if about == "set_up":  # something else is between the fingers
                contents.on_balance = {"tray", "pourer"}
            if about == "grasp" and stage.heard.count("grasp") > 1:
                contents.on_balance = {"tray"}

        contents.do = forgetful  # type: ignore[method-assign]

        async def cleared() -> None:
            await stage.site.put(contents.mass("tray"))

        async def once() -> None:
            stage.before["grasp"] = cleared

        stage.before["grasp"] = once
        return await stage.pour()

    _, stage = played(open_stage, play)
    assert stage.heard.count("grasp") == 2
    assert "does the pourer still stand on it?" in stage.said("warning")


@pytest.mark.slow
@pytest.mark.realtime
def test_doses_are_poured_from_a_held_pourer_and_a_lost_one_ends_them(open_stage: OpenStage) -> None:
    async def play() -> Stage:
        async with open_stage(dosing_spec().with_values(gripper=GRIPPER.with_values(model="2F-140"))) as stage:
            check_amount(stage, await dosed(stage, 25), 25)
            again = dose_target(10, fill=False)
            await stage.bench.pour(DOSE_SCENE, DOSE_ACTION, seed=5, dose=again)  # the pourer stays in the gripper
            seen: list[Any] = []
            stage.answers["recover"] = ["no"]
            pouring = asyncio.ensure_future(dosed(stage, 100, progress=seen.append))
            await reach(seen, "dose", pouring)
            await stage.site.gripper_fault("lost")
            with pytest.raises(UnknownPourError, match="the gripper may have lost the pourer"):
                await pouring
            return stage

    stage = asyncio.run(play())
    assert stage.heard == [
        *("dose_source", "open_gripper", "grasp", "dose_receiver", "start", "dose_cleared", "dose_receiver", "start"),
        *("let_go", "dose_source", "open_gripper", "grasp", "dose_receiver", "start", "recover"),
    ]
