"""A virtual bench whose connections are really cut: what the pour reports, and that a restarted bench makes it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import psutil
import pytest

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


def test_hardware_never_knows_that_nothing_flowed() -> None:
    assert not asyncio.run(GroundTruth(1.0).untouched())
