"""`virtual_bench`: a whole pour on the bench of numbers: seeds, checkpoints, what is hidden, and what happens when
something fails.
"""

from __future__ import annotations

import asyncio
import os
import signal
import statistics
import time
from dataclasses import replace

import numpy as np
import pytest

from actors.bench.ground_truth import draw_pose_error, spill_of
from actors.interfaces import InvalidActionError, NotPouredError, PourFailedError, UnknownPourError
from actors.laboratory import open_laboratory
from actors.laboratory_settings import BenchSettings, LaboratorySettings
from sim_engine.action import DEG
from sim_engine.outcome import PourOutcome
from sim_engine.scene import PoseError
from tests.support.waiting import PATIENCE, reach


@pytest.fixture
def open_bench(fake, bench_spec):
    """Opens a laboratory around the fake liquid."""

    def open_it(*, ray: bool = False, make=None, simulators: int = 1, **changes):
        spec = LaboratorySettings(
            name="virtual", simulators=simulators, bench=bench_spec.with_values(**changes), in_process=not ray
        )
        return open_laboratory(spec, pours=True, make=make or fake())

    return open_it


@pytest.mark.realtime
async def test_same_seed_and_action_measure_the_same_bits_whatever_was_poured_before(open_bench, scene, action):
    async with open_bench() as fresh:
        first = await fresh.bench.pour(scene, action, seed=5)
    async with open_bench() as used:
        await used.bench.pour(scene, action.with_values(x_offset=0.1), seed=8)
        other = await used.bench.pour(scene, action, seed=6)
        again = await used.bench.pour(scene, action, seed=5)
    assert first == again
    assert first != other


@pytest.mark.realtime
async def test_measured_masses_are_those_of_the_hidden_liquid_within_the_balance(
    open_bench, scene, action, fake, bench_spec
):
    """The fake liquid retains exactly a tenth, and spills what its seed says."""
    async with open_bench() as laboratory:
        measured = [await laboratory.bench.pour(scene, action, seed=seed) for seed in range(40)]
    # Two readings, tare and weight: each with the noise and a rounding error.
    deviation = np.sqrt(2 * (bench_spec.balance.noise**2 + bench_spec.balance.resolution**2 / 12))
    assert statistics.mean(m.loaded for m in measured) == pytest.approx(0.2, abs=4 * deviation / np.sqrt(40) + 1e-5)
    assert statistics.stdev([m.loaded for m in measured]) == pytest.approx(deviation, rel=0.5)
    assert statistics.mean(m.retained for m in measured) == pytest.approx(0.02, abs=4 * deviation / np.sqrt(40) + 1e-5)
    assert max(m.spilled for m in measured) - min(m.spilled for m in measured) > 0.02


@pytest.mark.realtime
def test_a_clean_pour_never_gains_liquid(scene, action):
    dry = PourOutcome(1.0, 0.0, 0.0, 0.0, 0.0, 1000, 4e-3, 0.0, 5.0, 10, 0.1, 1)
    assert spill_of(dry, 0.2).spilled == 0.0
    dripping = replace(dry, received=0.6, spilled=0.2, retained=0.1, in_flight=0.1)
    assert spill_of(dripping, 1.0).spilled == pytest.approx(0.2 + 0.1 * 0.25)


@pytest.mark.realtime
def test_pose_errors_scatter_about_the_systematic_one_and_follow_the_seed(bench_spec):
    errors = [draw_pose_error(bench_spec, seed) for seed in range(500)]
    assert draw_pose_error(bench_spec, 3) == errors[3]
    assert statistics.mean(e.x for e in errors) == pytest.approx(0.002, abs=4 * 5e-4 / np.sqrt(500))
    assert statistics.stdev(e.tilt for e in errors) == pytest.approx(2e-3, rel=0.15)
    assert {e.y for e in errors} == {0.0}
    exact = BenchSettings(liquid=bench_spec.liquid)
    assert draw_pose_error(exact, 3) == PoseError()


@pytest.mark.realtime
async def test_checkpoints_come_in_order_and_the_bar_never_runs_backwards(open_bench, scene, action):
    seen = []
    async with open_bench(time_scale=25.0) as laboratory:
        await laboratory.bench.pour(scene, action, seed=5, progress=seen.append)
    order = ["operator", "approach", "tilt", "hold", "return", "settle", "weigh", "record"]
    passed = list(dict.fromkeys(p.checkpoint for p in seen))
    assert [c for c in order if c in passed] == passed
    assert {"operator", "approach", "tilt", "settle", "weigh", "record"} <= set(passed)
    assert [p.fraction for p in seen] == sorted(p.fraction for p in seen)
    assert seen[-1].fraction == pytest.approx(1.0)
    assert max(p.tilt for p in seen if p.tilt is not None) > 0.5
    assert max(p.balance for p in seen if p.balance is not None) > 0.15


@pytest.mark.realtime
async def test_a_watcher_that_fails_does_not_disturb_the_pour(open_bench, scene, action):
    def watcher(progress):
        raise RuntimeError("the screen is gone")

    async with open_bench() as laboratory:
        measured = await laboratory.bench.pour(scene, action, seed=5, progress=watcher)
    assert measured.loaded == pytest.approx(0.2, abs=1e-3)


@pytest.mark.realtime
async def test_the_operator_takes_bench_time(open_bench, scene, action):
    async with open_bench(time_scale=100.0, operator_time=85.0) as laboratory:
        started = time.monotonic()
        await laboratory.bench.pour(scene, action, seed=5)
        # 85 s of operator and some 30 s of everything else, a hundred times as fast.
        assert time.monotonic() - started > 0.85 + 0.1


@pytest.mark.realtime
async def test_touching_vessels_are_refused_before_the_operator_has_been_called(open_bench, scene, action):
    seen = []
    touching = action.with_values(x_offset=0.05, height=-0.05)
    async with open_bench() as laboratory:
        with pytest.raises(InvalidActionError, match="cups touch"):
            await laboratory.bench.pour(scene, touching, seed=1, progress=seen.append)
        state = await laboratory.bench.arm.state()
    assert seen == []
    assert state.phase == "idle"
    assert state.time == 0.0


@pytest.mark.realtime
async def test_vessels_that_touch_as_they_truly_stand_make_the_pour_fail_and_the_bench_pours_on(
    open_bench, scene, action
):
    async with open_bench() as laboratory:
        with pytest.raises(PourFailedError, match="as they truly stand: cups touch"):
            await laboratory.bench.pour(replace(scene, name="touching"), action, seed=1)
        measured = await laboratory.bench.pour(scene, action, seed=5)
    assert measured.loaded == pytest.approx(0.2, abs=1e-3)


@pytest.mark.realtime
async def test_a_load_beyond_the_brim_is_refused(open_bench, scene, action):
    async with open_bench() as laboratory:
        flood = replace(scene, liquid=scene.liquid.model_copy(update={"mass": 2.0}))
        with pytest.raises(InvalidActionError, match="to the brim"):
            await laboratory.bench.pour(flood, action, seed=1)


async def tilting(arm):
    """Wait until the arm itself moves: the bench tells of a tilt just before it asks for one."""
    end = time.monotonic() + PATIENCE
    while (state := await arm.state()).phase != "tilt" or not state.moving:
        assert time.monotonic() < end, "the arm never tilted"
        await asyncio.sleep(0.02)


@pytest.mark.realtime
@pytest.mark.parametrize("ray", [False, pytest.param(True, marks=[pytest.mark.ray, pytest.mark.slow])])
def test_a_stop_during_the_pour_leaves_it_unknown_and_the_bench_usable(request, open_bench, scene, action, ray):
    if ray:
        request.getfixturevalue("ray_running")
    slow = action.with_values(angular_velocity=4 * DEG)

    async def play():
        async with open_bench(ray=ray, time_scale=20.0, operator_time=1.0) as laboratory:
            pour = asyncio.create_task(laboratory.bench.pour(scene, slow, seed=5))
            await tilting(laboratory.bench.arm)
            await laboratory.bench.arm.stop()
            with pytest.raises(UnknownPourError, match=r"the arm was stopped .* What was poured is unknown"):
                await pour
            return await laboratory.bench.pour(scene, action, seed=5)

    assert asyncio.run(play()).loaded == pytest.approx(0.2, abs=1e-3)


@pytest.mark.realtime
async def test_a_cancelled_pour_stops_the_arm_and_the_liquid(open_bench, scene, action):
    async with open_bench(time_scale=2.0, operator_time=0.5) as laboratory:
        seen = []
        pour = asyncio.create_task(laboratory.bench.pour(scene, action, seed=5, progress=seen.append))
        await reach(seen, "approach", pour)
        pour.cancel()
        with pytest.raises(NotPouredError, match="nothing was poured"):
            await pour
        await asyncio.sleep(0.1)  # an arm that moves on would be seen to
        state = await laboratory.bench.arm.state()
        assert not state.moving
        assert state.stopped


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.ray
def test_the_death_of_the_arm_fails_the_pour_and_the_next_one_has_a_new_arm(ray_running, open_bench, scene, action):
    async def play():
        async with open_bench(ray=True, time_scale=20.0, operator_time=1.0) as laboratory:
            seen = []
            pour = asyncio.create_task(
                laboratory.bench.pour(
                    scene, action.with_values(angular_velocity=20 * DEG), seed=5, progress=seen.append
                )
            )
            victim = await laboratory.bench.arm.device.pid()
            await reach(seen, "tilt", pour)
            os.kill(victim, signal.SIGKILL)
            with pytest.raises(UnknownPourError, match="arm: its process died during 'execute'"):
                await pour
            return await laboratory.bench.pour(scene, action, seed=5)

    assert asyncio.run(play()).loaded == pytest.approx(0.2, abs=1e-3)


@pytest.mark.realtime
@pytest.mark.ray
@pytest.mark.slow
def test_a_pour_needs_no_simulator_of_the_pool(ray_running, open_bench, scene, action, task, fake):
    async def play():
        async with open_bench(ray=True, make=fake(4.0)) as laboratory:
            jobs = [asyncio.create_task(laboratory.simulators.simulate(task(seed=s))) for s in range(12)]
            await laboratory.bench.pour(scene, action, seed=5)
            waiting = sum(not job.done() for job in jobs)
            for job in jobs:
                job.cancel()
            await asyncio.gather(*jobs, return_exceptions=True)
            return waiting

    # The pool of one has 48 seconds of work; the pour's own liquid takes four.
    assert asyncio.run(play()) >= 2
