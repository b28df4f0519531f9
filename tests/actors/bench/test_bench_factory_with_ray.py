"""`bench_factory`: the wired bench in processes of its own: what a stopped arm says survives the way here, and so
does a dead driver.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from typing import Any

import pytest

from actors.interfaces import Notice, UnknownPourError
from actors.laboratory import RayLaboratory
from tests.support.waiting import reach
from tests.support.wired_bench import ACTION, SCENE, Trickle, wired_spec

pytestmark = [pytest.mark.ray]


@pytest.fixture
def laboratory(ray_running):
    import ray

    ray.cloudpickle.register_pickle_by_value(sys.modules[Trickle.__module__])  # workers can't import test modules
    spec = wired_spec(pace=2.0, hurried=True).with_values(in_process=False, simulators=1)
    return RayLaboratory(spec, Trickle, pours=True)


async def stopped(opened: RayLaboratory, action: Any, how: Any) -> tuple[UnknownPourError, list[Any]]:
    seen: list[Any] = []
    pour = asyncio.create_task(opened.bench.pour(SCENE, action, seed=5, progress=seen.append))
    await reach(seen, "tilt", pour, tilt=0.1)
    await how()
    with pytest.raises(UnknownPourError) as error:
        await pour
    return error.value, seen


@pytest.mark.realtime
@pytest.mark.slow
def test_a_stop_and_the_death_of_the_driver_are_told_and_the_bench_pours_on(laboratory):
    slow = ACTION.with_values(angular_velocity=0.4)

    async def play():
        notices: list[Notice] = []
        async with laboratory as opened:
            opened.listen(notices.append)
            site, operator = opened.opened.emulators, opened.opened.operator

            first, _ = await stopped(opened, slow, lambda: site.fault("protective_stop"))
            asked = next(question for question in operator.heard if question.about == "recover")

            driver = await opened.bench.arm.device.pid()  # asked before, so that it dies while it tilts

            async def kill() -> None:
                os.kill(driver, signal.SIGKILL)

            second, _ = await stopped(opened, slow, kill)
            return first, second, asked, await opened.bench.pour(SCENE, ACTION, seed=6)

    first, second, asked, measured = asyncio.run(play())
    assert "protective stop during tilt" in str(first)
    assert asked.details["phase"] == "tilt"
    assert 0.0 < asked.details["tilt_deg"] < 90.0
    assert "pourer_after" in str(first)
    assert "its process died" in str(second)
    assert "pourer_after" in str(second)
    assert measured.loaded == pytest.approx(0.2, abs=5e-3)
