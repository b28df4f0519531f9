"""`pool`: the pool of simulators: deaths, cancellation, deadlines, and its twin without Ray."""

from __future__ import annotations

import asyncio
import dataclasses
import errno
import gc
import multiprocessing
import os
import signal
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from actors.arm.simulated_arm import SimulatedArm, SimulatedArmSettings
from actors.interfaces import InvalidActionError, LaboratoryError, SimulationError
from actors.laboratory import InProcessLaboratory
from actors.laboratory_settings import LaboratorySettings
from actors.runtime.child_process import ConnectedProcess
from actors.runtime.ray_cluster import versions
from actors.runtime.remote_object import RayDevice
from actors.simulators import local_worker
from actors.simulators import pool as pools
from actors.simulators.local_worker import process_pool, thread_pool
from actors.simulators.pool import WorkerPool
from actors.simulators.ray_worker import ray_pool
from tests.support.waiting import PATIENCE, alive


async def until(what, timeout=PATIENCE):
    end = time.monotonic() + timeout
    while not what():
        assert time.monotonic() < end, "waited in vain"
        await asyncio.sleep(0.02)


def lines(log: Path) -> list[str]:
    return log.read_text().splitlines() if log.exists() else []


def count(log: Path, what: str) -> int:
    return sum(line.startswith(what) for line in lines(log))


@pytest.fixture(params=["in_process", "processes", pytest.param("ray", marks=pytest.mark.ray)])
def make_pool(request):
    """All pools, so that one test speaks for each."""
    if request.param == "ray":
        request.getfixturevalue("ray_running")
        return lambda make: ray_pool(1, make=make)
    if request.param == "processes":
        return lambda make: process_pool(1, make=make)
    return lambda make: thread_pool(make=make)


def test_a_loop_that_ends_before_its_simulators_are_up_leaves_no_task_behind(fake, caplog, recwarn):
    """As when a run ends for lack of memory while workers are being replaced."""

    class Starting(local_worker.ProcessWorker):
        async def start(self):
            await asyncio.Event().wait()

    async def play():
        WorkerPool(2, partial(Starting, fake())).open()
        await asyncio.sleep(0)

    asyncio.run(play())
    gc.collect()
    assert "Task was destroyed" not in caplog.text
    assert not [str(w.message) for w in recwarn if "never awaited" in str(w.message)]


async def test_while_no_process_can_be_started_simulations_fail_with_the_reason_and_nothing_spins(
    fake, task, monkeypatch
):
    attempts = []

    class NoMemory(ConnectedProcess):
        def __init__(self, *args):
            attempts.append(args)
            raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))

    monkeypatch.setattr(local_worker, "ConnectedProcess", NoMemory)
    reported = []
    pool = WorkerPool(2, partial(local_worker.ProcessWorker, fake()), tell=reported.append)
    with pytest.raises(LaboratoryError, match=r"a simulator can't be started: .*Cannot allocate memory"):
        await pool.simulate(task())
    await pool.close()
    assert len(attempts) == 2
    assert len(reported) == 1


async def test_a_process_killed_while_the_pool_closes_leaves_no_task_behind(fake, task, tmp_path, caplog, recwarn):
    log = tmp_path / "log"
    pool = process_pool(2, make=fake(60.0, log))
    jobs = [asyncio.create_task(pool.simulate(task(seed=s))) for s in (1, 2)]
    await until(lambda: count(log, "begin") == 2)
    closing = asyncio.create_task(pool.close())
    await asyncio.sleep(0)
    for line in lines(log):
        if line.startswith("made"):
            os.kill(int(line.split()[1]), signal.SIGKILL)
    await closing
    await asyncio.gather(*jobs, return_exceptions=True)
    gc.collect()
    assert "Task was destroyed" not in caplog.text
    assert not [str(w.message) for w in recwarn if "never awaited" in str(w.message)]
    assert not any(alive(int(line.split()[1])) for line in lines(log))


async def test_simulators_end_although_the_bench_can_not_be_closed(fake):
    class Broken:
        async def close(self):
            raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))

    laboratory = InProcessLaboratory(LaboratorySettings(name="test"), fake(), processes=1)
    await laboratory.__aenter__()
    pids = await laboratory.simulators.pids()
    laboratory._opened = Broken()
    with pytest.raises(OSError, match="Cannot allocate memory"):
        await laboratory.__aexit__()
    left = [pid for pid in pids if alive(pid)]
    assert pids
    assert left == []


@pytest.mark.parametrize("kind", ["processes", pytest.param("ray", marks=pytest.mark.ray)])
async def test_simulators_that_crash_are_lost_with_their_last_messages(request, kind, fake, task):
    """A lack of memory leaves none; else it would be a false cause."""
    if kind == "ray":
        request.getfixturevalue("ray_running")
    make_pool = ray_pool if kind == "ray" else process_pool

    pool = make_pool(1, make=fake())
    with pytest.raises(SimulationError, match=r"3 simulators died .*Assertion failure: home != nullptr") as error:
        await pool.simulate(task(name="aborting"))
    await pool.close()
    assert "memory" not in str(error.value)


@pytest.mark.slow
def test_a_dead_process_is_replaced_and_what_kills_every_one_is_given_up(fake, task, tmp_path):
    log = tmp_path / "log"

    async def play():
        pool = process_pool(2, make=fake(2.0, log))
        both = [asyncio.create_task(pool.simulate(task(seed=s))) for s in (1, 2)]
        await until(lambda: count(log, "begin") == 2)
        os.kill(int(lines(log)[-1].split()[1]), signal.SIGKILL)
        results = await asyncio.gather(*both)
        with pytest.raises(SimulationError, match=r"3 simulators died over this job \(the last one: status -9\)"):
            await pool.simulate(task(name="deadly"))
        await pool.simulate(task(name="quick"))
        await pool.close()
        return [result.outcome.seed for result in results]

    assert asyncio.run(play()) == [1, 2]
    assert count(log, "made") == 2 + 1 + 2, "those that died are made anew"
    assert not any(alive(int(line.split()[1])) for line in lines(log))


async def test_a_process_that_hangs_holds_nobody_up(fake, task, tmp_path, monkeypatch):
    log = tmp_path / "log"
    monkeypatch.setattr(pools, "DRAIN_DEADLINE", 0.5)

    pool = process_pool(1, make=fake(60.0, log))
    job = asyncio.create_task(pool.simulate(task()))
    await until(lambda: count(log, "begin") == 1)
    os.kill(int(lines(log)[-1].split()[1]), signal.SIGSTOP)
    job.cancel()
    result = await asyncio.wait_for(pool.simulate(task(name="quick", seed=2)), PATIENCE)
    await pool.close()
    assert result.outcome.seed == 2


def test_simulating_processes_end_with_a_killed_owner(fake, task, tmp_path):
    log = tmp_path / "log"

    def own() -> None:
        async def play():
            await process_pool(1, make=fake(60.0, log)).simulate(task())

        asyncio.run(play())

    owner = multiprocessing.get_context("fork").Process(target=own)
    owner.start()
    until_begun = time.monotonic() + PATIENCE
    while count(log, "begin") == 0:
        assert time.monotonic() < until_begun, "waited in vain"
        time.sleep(0.02)
    os.kill(owner.pid, signal.SIGKILL)
    owner.join()
    asyncio.run(until(lambda: count(log, "closed") == 1))


@pytest.mark.realtime
async def test_vessels_that_touch_are_an_invalid_action_and_the_pool_goes_on(make_pool, fake, task):
    pool = make_pool(fake())
    with pytest.raises(InvalidActionError, match=r"enters the receiver by 4\.1 mm"):
        await pool.simulate(task(name="touching"))
    result = await pool.simulate(task())
    await pool.close()
    assert result.outcome.seed == 1


@pytest.mark.realtime
async def test_an_error_of_the_engine_names_itself_and_the_pool_goes_on(make_pool, fake, task):
    pool = make_pool(fake())
    with pytest.raises(SimulationError, match="ZeroDivisionError: spacing"):
        await pool.simulate(task(name="broken"))
    with pytest.raises(SimulationError, match="answered with a str, not with a simulated pour"):
        await pool.simulate(task(name="odd"))
    assert (await pool.simulate(task())).outcome.seed == 1
    assert pool.statistics().deaths == 0
    await pool.close()


@pytest.mark.realtime
async def test_a_cancelled_simulation_really_stops_and_the_next_one_runs_at_once(make_pool, fake, task, tmp_path):
    log = tmp_path / "log"
    pool = make_pool(fake(2 * PATIENCE, log))
    job = asyncio.create_task(pool.simulate(task()))
    await until(lambda: count(log, "begin") == 1)
    job.cancel()
    with pytest.raises(asyncio.CancelledError):
        await job
    await pool.simulate(task(name="quick"))
    statistics = pool.statistics()
    await pool.close()
    assert count(log, "cancelled") == 1
    assert count(log, "made") == 1, "the member was kept, its compiled kernels with it"
    assert statistics.cancelled == 1
    assert statistics.deaths == 0
    assert count(log, "closed") == 1


@pytest.mark.realtime
async def test_a_job_cancelled_in_the_queue_never_begins(make_pool, fake, task, tmp_path):
    log = tmp_path / "log"
    pool = make_pool(fake(0.5, log))
    first = asyncio.create_task(pool.simulate(task(seed=1)))
    await until(lambda: count(log, "begin") == 1)
    second = asyncio.create_task(pool.simulate(task(seed=2)))
    await asyncio.sleep(0.05)  # it waits behind the first, and must not be given to a worker
    second.cancel()
    await first
    await pool.simulate(task(seed=3))
    await pool.close()
    assert count(log, "begin") == 2


@pytest.mark.realtime
async def test_busy_time_counts_the_jobs_and_not_the_waiting(make_pool, fake, task):
    pool = make_pool(fake(0.3))
    await pool.simulate(task(name="quick"))
    before = pool.statistics().busy_s
    await asyncio.sleep(0.3)  # the pool is idle, which must not be counted
    assert pool.statistics().busy_s == before
    begin = time.monotonic()
    await asyncio.gather(*(pool.simulate(task(seed=s)) for s in range(3)))
    elapsed = time.monotonic() - begin
    after = pool.statistics()
    await pool.close()
    assert after.jobs == 4
    assert 0.9 - 0.05 < after.busy_s - before < elapsed + 0.05, (
        "one simulator, however late a busy machine lets it work"
    )


@pytest.mark.realtime
@pytest.mark.ray
def test_simulators_step_back_behind_an_arm_s_driver_which_does_not(ray_running, fake, task):
    async def play():
        arm = RayDevice("arm", SimulatedArm, SimulatedArmSettings(time_scale=0.0))
        pool = ray_pool(2, make=fake())
        try:
            await pool.simulate(task())
            return [os.getpriority(os.PRIO_PROCESS, pid) for pid in [await arm.pid(), *await pool.pids()]]
        finally:
            await asyncio.gather(pool.close(), arm.close())

    own = os.getpriority(os.PRIO_PROCESS, 0)
    assert asyncio.run(play()) == [own, *[min(own + 15, 19)] * 2]


@pytest.mark.realtime
@pytest.mark.ray
async def test_a_job_whose_simulator_is_killed_is_answered_by_its_replacement(ray_running, fake, task, tmp_path):
    log = tmp_path / "log"
    pool = ray_pool(2, make=fake(1.0, log))
    jobs = [asyncio.create_task(pool.simulate(task(seed=s))) for s in range(4)]
    await until(lambda: count(log, "begin") == 2)
    victim = int(next(line for line in lines(log) if line.startswith("begin")).split()[1])
    os.kill(victim, signal.SIGKILL)
    results = await asyncio.gather(*jobs)
    statistics, members = pool.statistics(), await pool.pids()
    await pool.close()
    assert [r.outcome.seed for r in results] == [0, 1, 2, 3]
    assert statistics.deaths == 1
    assert len(members) == 2
    assert victim not in members


@pytest.mark.realtime
@pytest.mark.ray
async def test_a_job_that_kills_every_simulator_is_given_up_and_the_pool_survives(ray_running, fake, task):
    pool = ray_pool(1, make=fake(), retries=1)
    with pytest.raises(SimulationError, match="2 simulators died over this job"):
        await pool.simulate(task(name="deadly"))
    assert (await pool.simulate(task())).outcome.seed == 1
    assert pool.statistics().deaths == 2
    await pool.close()


@pytest.mark.realtime
@pytest.mark.ray
async def test_a_simulation_that_hangs_past_its_deadline_costs_its_simulator(ray_running, fake, task):
    pool = ray_pool(1, make=fake(60.0), deadline=1.0)
    with pytest.raises(SimulationError, match="no result within 1 s"):
        await pool.simulate(task())
    pool._deadline = PATIENCE  # for a simulator that starts on a busy machine
    assert (await pool.simulate(task(name="quick"))).outcome.seed == 1
    await pool.close()


@pytest.mark.realtime
@pytest.mark.ray
def test_a_simulator_goes_on_with_the_next_job_while_the_program_is_held_up(ray_running, fake, task, tmp_path):
    log = tmp_path / "log"

    async def play():
        pool = ray_pool(1, make=fake(0.3, log))
        jobs = [asyncio.create_task(pool.simulate(task(seed=s))) for s in range(2)]
        await until(lambda: count(log, "begin") == 1)
        time.sleep(1.2)  # the event loop stands still
        ended = count(log, "end")
        await asyncio.gather(*jobs)
        await pool.close()
        return ended

    assert asyncio.run(play()) == 2


@pytest.mark.realtime
@pytest.mark.ray
async def test_a_job_that_waits_at_a_busy_simulator_is_taken_to_an_idle_one_and_runs_once(
    ray_running, fake, task, tmp_path
):
    log = tmp_path / "log"
    pool = ray_pool(2, make=fake(4.0, log))
    await pool.pids()
    long, other, waiting = (asyncio.create_task(pool.simulate(task(seed=s))) for s in range(3))
    await until(lambda: count(log, "begin") == 2)
    other.cancel()  # its simulator becomes idle; the third job was sent behind the first or behind this one
    await until(lambda: count(log, "begin") == 3)
    waited_for_the_first = long.done()
    assert (await waiting).outcome.seed == 2
    assert (await long).outcome.seed == 0
    deaths = pool.statistics().deaths
    await pool.close()
    assert not waited_for_the_first
    assert deaths == 0
    assert count(log, "begin") == 3


@pytest.mark.realtime
@pytest.mark.ray
async def test_a_simulator_with_other_code_than_this_machine_s_is_not_used_and_named(ray_running, fake, task):
    told = []
    other = dataclasses.replace(versions(), engine="taichi 1.6.0")
    pool = ray_pool(1, make=fake(), expected=other, tell=told.append)
    with pytest.raises(
        LaboratoryError, match=r"is not like this machine's: Engine: \w+ [\d.]+ there, taichi 1\.6\.0 here"
    ):
        await pool.simulate(task())
    await pool.close()
    assert len(told) == 1


@pytest.mark.realtime
@pytest.mark.ray
async def test_a_loss_is_told_with_what_is_repeated_and_only_once(ray_running, fake, task, tmp_path, capsys):
    told, log = [], tmp_path / "log"
    pool = ray_pool(1, make=fake(0.5, log), tell=told.append)
    jobs = [asyncio.create_task(pool.simulate(task(seed=s))) for s in range(2)]
    await until(lambda: count(log, "begin") == 1)
    os.kill((await pool.pids())[0], signal.SIGKILL)
    await asyncio.gather(*jobs)
    await until(lambda: told)
    await pool.close()
    assert "1 simulator(s) lost" in told[0]
    assert "2 simulation(s) are repeated" in told[0]
    assert "raylet" not in "".join(capsys.readouterr())  # Ray says it before it gives up the task


@pytest.mark.realtime
@pytest.mark.ray
def test_a_simulator_that_dies_without_a_job_is_told_and_replaced(ray_running, fake, task):
    told = []

    async def play():
        pool = ray_pool(1, make=fake(), tell=told.append)
        (victim,) = await pool.pids()
        os.kill(victim, signal.SIGKILL)
        await until(lambda: told)
        replaced = await pool.pids() != [victim]
        answer = await pool.simulate(task())
        statistics = pool.statistics()
        await pool.close()
        return replaced, answer.outcome.seed, statistics.deaths

    assert asyncio.run(play()) == (True, 1, 1)
    (text,) = told
    assert text.startswith("1 simulator(s) lost")
    assert "no simulation has to be repeated" in text


@pytest.mark.realtime
@pytest.mark.ray
def test_both_pools_give_the_same_results_bit_for_bit(ray_running, fake, task):
    tasks = [task(seed=s, frame_rate=5.0) for s in range(3)]

    async def play(pool):
        results = await asyncio.gather(*(pool.simulate(t) for t in tasks))
        await pool.close()
        return results

    async def both():
        return await play(ray_pool(2, make=fake())), await play(thread_pool(make=fake()))

    for ours, twins in zip(*asyncio.run(both()), strict=True):
        assert ours.outcome == twins.outcome
        for a, b in zip(ours.frames.positions, twins.frames.positions, strict=True):
            assert a.dtype == b.dtype == np.float32
            np.testing.assert_array_equal(a, b)


@pytest.mark.realtime
@pytest.mark.ray
async def test_a_closed_pool_lets_no_process_live_and_says_so(ray_running, fake, task):
    pool = ray_pool(2, make=fake())
    members = await pool.pids()
    await pool.close()
    await until(lambda: not any(map(alive, members)))
    with pytest.raises(SimulationError, match="closed"):
        await pool.simulate(task())
