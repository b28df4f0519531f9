"""A virtual bench whose connections are really cut: what the pour reports, and that a restarted bench makes it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import psutil
import pytest

from actors.arm.arm_interface import ArmLostError, ArmStoppedError
from actors.bench.ground_truth import GroundTruth
from actors.interfaces import LinkLostError, NotPouredError
from tests.support.waiting import PATIENCE
from tests.support.wired_bench import Stage, wired_spec


async def drop_for_good(stage: Stage) -> None:
    await stage.site.fault("refuse")


async def kill_emulator(stage: Stage) -> None:
    (emulator,) = (p for p in psutil.Process().children() if "actors.emulators.ur_controller" in p.cmdline())
    emulator.kill()


async def cut(stage: Stage, hook: str, fault: Callable[[Stage], Awaitable[None]]) -> BaseException:
    """Pour, and let the fault happen when the ground truth comes to a step of the pour."""
    truth = stage.bench.ground_truth
    step: Callable[[], Awaitable[None]] = getattr(truth, hook)

    async def struck() -> None:
        await fault(stage)
        await step()

    setattr(truth, hook, struck)
    with pytest.raises(NotPouredError) as raised:
        await asyncio.wait_for(stage.pour(), PATIENCE)
    return raised.value


@pytest.mark.realtime
@pytest.mark.parametrize("fault", [drop_for_good, kill_emulator])
async def test_a_pour_is_made_by_a_restarted_bench_after_the_link_was_lost_before_the_tilt(
    open_stage: Any, fault: Callable[[Stage], Awaitable[None]]
) -> None:
    """The arm stands above the receiver, the pourer upright."""
    async with open_stage(wired_spec(hurried=True)) as stage:
        error = await cut(stage, "note", fault)
        assert isinstance(error, LinkLostError), error
        await stage.laboratory.restart_bench()
        stage.attend()
        measured = await asyncio.wait_for(stage.pour(), PATIENCE)
        assert measured.spilled > 0.0


@pytest.mark.realtime
async def test_a_link_that_was_lost_when_the_tilt_was_asked_for_poured_nothing_if_the_arm_never_tilted(
    open_stage: Any,
) -> None:
    """The program never starts: the motion counts as begun, and the history of the emulated arm shows no tilt."""
    async with open_stage(wired_spec(hurried=True)) as stage:
        error = await cut(stage, "tilts", lambda stage: stage.site.fault("drop"))
        assert isinstance(error, LinkLostError), error


@pytest.mark.realtime
@pytest.mark.parametrize(("kind", "repeatable"), [("watchdog", True), ("protective stop", False)])
async def test_a_pour_may_be_made_again_after_the_host_was_too_slow_for_the_heartbeat(
    open_stage: Any, monkeypatch: pytest.MonkeyPatch, kind: str, repeatable: bool
) -> None:
    """Any other stop is looked into by a person, also on a virtual bench."""

    async def stopped(*_: object) -> None:
        raise ArmStoppedError("the heartbeat paused for 28.0 s", kind, "approach", 0.0, 0.0)

    async with open_stage(wired_spec(hurried=True)) as stage:
        monkeypatch.setattr(stage.bench.arm, "move_to_start", stopped)
        with pytest.raises(NotPouredError, match=r"paused for 28\.0 s\. Nothing was poured") as raised:
            await asyncio.wait_for(stage.pour(), PATIENCE)
        assert isinstance(raised.value, LinkLostError) == repeatable


@pytest.mark.realtime
@pytest.mark.parametrize("losses", [1, 2])
async def test_a_pour_is_planned_with_the_calibration_of_a_robot_that_was_connected_at_the_second_attempt(
    open_stage: Any, monkeypatch: pytest.MonkeyPatch, losses: int
) -> None:
    """It was planned with nominal lengths after the first one failed, and the arm refused it."""
    async with open_stage(wired_spec(hurried=True)) as stage:
        connect, left = stage.bench.arm.ready, iter(range(losses))

        async def ready() -> Any:
            for _ in left:
                raise ArmLostError("the arm's worker did not answer")
            return await connect()

        monkeypatch.setattr(stage.bench.arm, "ready", ready)
        if losses > 1:
            with pytest.raises(LinkLostError, match=r"did not answer\. Nothing was poured"):
                await asyncio.wait_for(stage.pour(), PATIENCE)
        measured = await asyncio.wait_for(stage.pour(), PATIENCE)
        assert measured.spilled > 0.0


def test_hardware_never_knows_that_nothing_flowed() -> None:
    assert not asyncio.run(GroundTruth(1.0).untouched())
