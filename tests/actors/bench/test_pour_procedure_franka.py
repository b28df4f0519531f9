"""`pour_procedure` with a Franka: what stops in the middle of a pour, and what is recorded.

It needs the extra 'franka-sim', which is not in the tests' lock.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import psutil
import pytest

pytest.importorskip("pinocchio")
pytest.importorskip("franky")
pytest.importorskip("franky_sim")

from actors.arm.franka.franka_arm import FrankaSettings
from actors.arm.planning.motion_segments import leans
from actors.interfaces import UnknownPourError
from sim_engine.action import DEG
from tests.support.waiting import PATIENCE
from tests.support.wired_bench import ACTION, Stage, opened_stage, wired_spec

pytestmark = [pytest.mark.slow, pytest.mark.realtime]

SLOWLY = ACTION.with_values(angular_velocity=18 * DEG, return_velocity=18 * DEG, hold_time=5.0, height=0.11)
"""A tilt must last long enough to be hit."""

SPEC = wired_spec(hurried=True, laboratory="franka.yaml")
ARM = SPEC.arm
assert isinstance(ARM, FrankaSettings)

TILTED = 40 * DEG


async def kill_worker(stage: Stage) -> None:
    (worker,) = (
        p for p in psutil.Process().children(recursive=True) if "actors.arm.franka.franka_worker" in p.cmdline()
    )
    worker.kill()


async def pour_struck(stage: Stage, strike: Callable[[Stage], Awaitable[Any]]) -> tuple[UnknownPourError, float]:
    """Have something happen while the cup is tilted; the error, and the simulated robot's time then [s]."""
    pour = asyncio.create_task(stage.pour(SLOWLY))
    try:
        async with asyncio.timeout(PATIENCE):
            while (state := await stage.bench.arm.state()).tilt < TILTED or state.phase != "tilt":
                assert not pour.done(), f"the pour ended before its tilt was seen: {pour.result()}"
                await asyncio.sleep(0.005)
            struck = (await stage.site.history(math.inf)).now
            await strike(stage)
            with pytest.raises(UnknownPourError) as error:
                await pour
    finally:
        pour.cancel()
        await asyncio.gather(pour, return_exceptions=True)
    return error.value, struck


STRIKES = {
    "reflex": lambda stage: stage.site.fault("trip"),
    "cable": lambda stage: stage.site.fault("unplug"),
    "process of the driver": kill_worker,
}


@pytest.mark.parametrize("name", STRIKES)
def test_what_stops_a_tilt_leaves_a_pour_of_unknown_outcome_and_an_upright_cup_after_consent(name: str) -> None:
    async def run() -> None:
        async with opened_stage(SPEC) as stage:

            async def mend() -> None:
                if name == "cable":
                    await stage.site.fault("plug")

            stage.before["recover"] = mend
            error, struck = await pour_struck(stage, STRIKES[name])
            assert stage.heard.index("recover") < stage.heard.index("untilt")
            tilts = leans(np.array((await stage.site.history(struck)).joints), ARM)
            assert tilts[-1] < 1 * DEG
            assert tilts.max() < tilts[0] + 3 * DEG, "it tilts on"
            for key in ("pourer_full", "spilled", "pourer_after"):
                assert f"weighed, {key}:" in stage.said("note")
            loaded = stage.contents.in_receiver + stage.contents.on_tray + stage.contents.in_pourer
            assert f"{1e3 * loaded:.1f}"[:4] in str(error)

    asyncio.run(run())


def test_a_simulator_that_ends_in_a_tilt_leaves_a_pour_of_unknown_outcome() -> None:
    async def run() -> None:
        async with opened_stage(SPEC) as stage:
            error, _ = await pour_struck(stage, lambda stage: stage.site.fault("kill"))
            assert "What was poured is unknown. All weighings: pourer_empty" in str(error)
            assert "recover" not in stage.heard, "there is no arm that could be made ready"

    asyncio.run(run())
