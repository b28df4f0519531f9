"""Opening laboratories, and the optimiser in them."""

from __future__ import annotations

import asyncio
import os
import signal

import pytest

from actors.laboratory import open_laboratory
from actors.optimizer.core.problem import Data, SuggestProblem
from actors.protocols import LaboratoryError
from actors.spec import LaboratorySpec
from sim_engine.space import Axis, Space

PROBLEM = SuggestProblem(
    space=Space((Axis("x_offset", 0.08, 0.15), Axis("angular_velocity", 0.3, 2.0))),
    data=Data(((0.1, 0.2), (0.6, 0.4), (0.9, 0.8), (0.3, 0.9)), (0.4, 0.1, 0.5, 0.3)),
    count=2,
    seed=3,
)


def laboratory(in_process, fake, **changes):
    return open_laboratory(
        LaboratorySpec("desk", simulators=1, in_process=in_process, **changes), need_bench=False, make=fake()
    )


def test_a_campaign_that_pours_is_refused_a_laboratory_without_a_bench():
    with pytest.raises(LaboratoryError, match="desk has no bench, but the campaign pours"):
        open_laboratory(LaboratorySpec("desk"), need_bench=True)


def test_an_unknown_mode_is_refused_before_anything_starts():
    with pytest.raises(LaboratoryError, match="mode 'hardware' is not available"):
        open_laboratory(LaboratorySpec("desk", mode="hardware"), need_bench=False)


def test_no_bench_is_made_where_none_is_needed(fake, bench_spec, task):
    async def play():
        async with laboratory(True, fake, bench=bench_spec) as opened:
            assert opened.bench is None
            return (await opened.simulators.simulate(task(seed=4))).outcome.seed

    assert asyncio.run(play()) == 4


def test_a_question_that_makes_no_sense_is_an_error_that_says_so(fake):
    async def play():
        async with laboratory(True, fake) as opened:
            await opened.optimizer.suggest(
                SuggestProblem(space=PROBLEM.space, data=Data(((0.5, 0.5), (float("nan"), 0.1)), (1.0, 2.0)))
            )

    with pytest.raises(LaboratoryError, match="the optimiser can't answer"):
        asyncio.run(play())


@pytest.mark.ray
def test_optimiser_and_its_twin_propose_the_same_and_a_death_is_asked_again(ray_running, fake):
    async def play():
        async with laboratory(True, fake) as opened:
            twin = await opened.optimizer.suggest(PROBLEM)
        async with laboratory(False, fake) as opened:
            victim = await opened.optimizer.device.pid()
            first = asyncio.create_task(opened.optimizer.suggest(PROBLEM))
            await asyncio.sleep(0.02)
            os.kill(victim, signal.SIGKILL)
            answer = await first
            assert await opened.optimizer.device.pid() != victim
        return twin, answer

    twin, answer = asyncio.run(play())
    assert len(answer.points) == 2
    for ours, theirs in zip(answer.points, twin.points, strict=True):
        assert ours == pytest.approx(theirs, abs=1e-6)
