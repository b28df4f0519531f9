"""`laboratory`: opening laboratories, and the optimiser in them."""

from __future__ import annotations

import asyncio
import os
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from actors.interfaces import LaboratoryError
from actors.laboratory import check_laboratory, open_laboratory
from actors.laboratory_settings import LaboratorySettings, TrueLiquid
from actors.optimizer.questions import Data, MinimumQuery
from actors.runtime.remote_object import DeviceLostError
from orchestrator.campaigns.file_loading import load_laboratory
from sim_engine.engine_package import LIBRARIES
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PourTask
from sim_engine.search_space import Axis, Space

PROBLEM = MinimumQuery(
    space=Space((Axis("x_offset", 0.08, 0.15), Axis("angular_velocity", 0.3, 2.0))),
    data=Data(((0.1, 0.2), (0.6, 0.4), (0.9, 0.8), (0.3, 0.9)), (0.4, 0.1, 0.5, 0.3)),
    count=2,
    seed=3,
)


def laboratory(in_process, fake, **changes):
    return open_laboratory(
        LaboratorySettings(name="desk", simulators=1, in_process=in_process, **changes), pours=False, make=fake()
    )


@pytest.mark.realtime
def test_a_campaign_that_pours_is_refused_a_laboratory_without_a_bench():
    with pytest.raises(LaboratoryError, match="desk has no bench, but the campaign pours"):
        open_laboratory(LaboratorySettings(name="desk"), pours=True)


@pytest.mark.realtime
def test_an_arm_of_hardware_is_not_opened_without_a_person_to_ask():
    spec = load_laboratory(Path(__file__).parents[2] / "configs" / "laboratories" / "ur10-kern.yaml")
    with pytest.raises(LaboratoryError, match="ur10-kern needs a person beside it who answers questions"):
        open_laboratory(spec, pours=True)


@pytest.mark.realtime
async def test_no_bench_is_made_where_none_is_needed(fake, bench_spec, task):
    async with laboratory(True, fake, bench=bench_spec) as opened:
        assert opened.bench is None
        assert (await opened.simulators.simulate(task(seed=4))).outcome.seed == 4


@pytest.mark.realtime
async def test_a_question_that_makes_no_sense_is_an_error_that_says_so(fake):
    question = MinimumQuery(space=PROBLEM.space, data=Data(((0.5, 0.5), (float("nan"), 0.1)), (1.0, 2.0)))
    async with laboratory(True, fake) as opened:
        with pytest.raises(LaboratoryError, match="the optimiser can't answer"):
            await opened.optimizer.suggest(question)


@pytest.mark.realtime
@pytest.mark.ray
async def test_optimiser_and_its_twin_propose_the_same_also_after_a_death(ray_running, fake):
    async with laboratory(True, fake) as opened:
        twin = await opened.optimizer.suggest(PROBLEM)
    async with laboratory(False, fake) as opened:
        victim = await opened.optimizer.device.pid()
        first = asyncio.create_task(opened.optimizer.suggest(PROBLEM))
        await asyncio.sleep(0.02)  # the query is under way, and takes longer than this
        os.kill(victim, signal.SIGKILL)
        with pytest.raises(DeviceLostError):
            await first
        answer = await opened.optimizer.suggest(PROBLEM)
        assert await opened.optimizer.device.pid() != victim
    assert len(answer.points) == 2
    for ours, theirs in zip(answer.points, twin.points, strict=True):
        assert ours == pytest.approx(theirs, abs=1e-6)


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.ray
def test_the_real_simulator_gives_the_same_bits_in_a_pool_a_twin_and_the_hidden_liquid(
    ray_running, bench_spec, scene, action
):
    bench = bench_spec.with_values(liquid=TrueLiquid(particles=400))
    coarse = SimulationParameters(particles=300)

    async def play(in_process):
        spec = LaboratorySettings(name="desk", simulators=1, bench=bench, in_process=in_process)
        async with open_laboratory(spec, pours=True) as opened:
            job = opened.simulators.simulate(PourTask(scene, action, coarse, 3, frame_rate=4.0))
            return await asyncio.gather(job, opened.bench.pour(scene, action, seed=5))

    (ours, measured), (twins, measured_twin) = asyncio.run(play(False)), asyncio.run(play(True))
    assert replace(ours.outcome, cpu_s=0.0) == replace(twins.outcome, cpu_s=0.0)
    assert ours.outcome.invalid is None
    np.testing.assert_array_equal(np.array(ours.frames.positions), np.array(twins.frames.positions))
    assert measured == measured_twin
    assert measured.loaded == pytest.approx(0.2, abs=1e-3)


def test_an_engine_without_its_shared_libraries_is_refused_before_anything_starts(monkeypatch):
    monkeypatch.setenv("DECANT_ENGINE", "taichi")
    monkeypatch.setitem(LIBRARIES, "taichi", {"libNone.so.6": "libnone-6"})
    with pytest.raises(LaboratoryError, match=r"DECANT_ENGINE=taichi: .*apt install libnone-6"):
        check_laboratory(LaboratorySettings(name="planning"), pours=False, plain_processes=True)


async def test_a_moments_work_needs_no_ray_and_still_simulates_side_by_side(monkeypatch, fake, task):
    """`decant plan`: a person waits, and nothing is poured."""
    monkeypatch.setattr("actors.laboratory.installed", lambda name: name != "ray")
    spec = LaboratorySettings(name="planning", simulators=2)
    check_laboratory(spec, pours=False, plain_processes=True)
    with pytest.raises(LaboratoryError, match="Ray, which is not installed"):
        check_laboratory(spec, pours=False)

    async with open_laboratory(spec, pours=False, plain_processes=True, make=fake()) as laboratory:
        pool = laboratory.simulators
        results = await asyncio.gather(*(pool.simulate(task(seed=s)) for s in range(4)))
        assert (pool.size, pool.separate) == (2, True)
        assert [result.outcome.seed for result in results] == [0, 1, 2, 3]
