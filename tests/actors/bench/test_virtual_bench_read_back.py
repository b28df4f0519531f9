"""`virtual_bench`: a virtual bench whose arm has nothing at its far end: the liquid follows what the driver read
back.
"""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from actors.arm.planned_pour import slipped
from actors.arm.simulated_arm import SimulatedArmSettings
from actors.interfaces import UnknownPourError
from sim_engine.action import DEG
from sim_engine.scene import SampledMotion
from tests.support.waiting import reach
from tests.support.wired_bench import ACTION, wired_spec

PACE = 10.0


def without_a_robot():
    return wired_spec(pace=PACE, hurried=True).with_values(arm=SimulatedArmSettings(time_scale=PACE, warning_time=1.0))


@pytest.mark.realtime
def test_what_an_arm_read_back_is_poured_and_weighed_on_the_wire(open_stage):
    async def play():
        async with open_stage(without_a_robot()) as stage:
            return await stage.pour(), stage

    measured, stage = asyncio.run(play())
    # 90 of the 100 deg that empty the pourer, and a twentieth beside the receiver
    assert measured.retained / measured.loaded == pytest.approx(1.0 / 7.0, abs=0.02)
    assert measured.spilled == pytest.approx(stage.contents.on_tray, abs=3e-4)
    assert measured.notes["arm"]["model"] == "simulated"
    assert stage.heard == ["tray_wiped", "pourer_empty", "pourer_full", "set_up", "start", "pourer_after"]


@pytest.mark.realtime
def test_of_a_pour_that_was_broken_off_nobody_makes_up_what_became_of_the_liquid(open_stage):
    seen = []

    async def play():
        async with open_stage(without_a_robot()) as stage:
            pour = asyncio.create_task(stage.pour(ACTION.with_values(angular_velocity=20 * DEG), progress=seen.append))
            await reach(seen, "tilt", pour, tilt=1e-6)
            await stage.bench.arm.stop()
            with pytest.raises(UnknownPourError, match="only tells of pours that it completed"):
                await pour
            again = await stage.pour()
            return stage.heard, again

    heard, again = asyncio.run(play())
    assert [about for about in heard if about in ("recover", "untilt")] == ["recover", "untilt"]
    assert again.loaded == pytest.approx(0.2, abs=5e-3)


def test_a_pourer_that_slipped_in_the_grip_is_so_much_more_tilted():
    times = np.linspace(0.0, 1.0, 20)
    half = 0.5 * times
    poses = np.stack([0 * half, 0 * half, 0 * half, np.cos(half), 0 * half, np.sin(half), 0 * half], axis=-1)
    motion = SampledMotion(times, poses)
    np.testing.assert_allclose(slipped(motion, 0.1).tilt(times), motion.tilt(times) + 0.1, atol=1e-6)
