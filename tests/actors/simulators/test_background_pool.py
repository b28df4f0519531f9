"""The pool of plain functions: order, progress, errors, and calls of several threads."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from actors.interfaces import InvalidActionError
from actors.simulators.background_pool import BackgroundPool
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PourTask
from tests.support.fake_simulator import make_fake, make_scene


@pytest.fixture(scope="module")
def pool() -> Iterator[BackgroundPool]:
    background = BackgroundPool(make_fake(0.02))
    yield background
    background.close()


def task(seed: int, scene: str = "quick") -> PourTask:
    return PourTask(make_scene(scene), Action(1.0, x_offset=0.1, height=0.1), SimulationParameters(particles=200), seed)


def tasks(first: int, count: int) -> list[PourTask]:
    return [task(first + k) for k in range(count)]


def test_results_have_the_order_of_the_tasks_and_progress_counts_each_once(pool: BackgroundPool) -> None:
    told: list[tuple[int, int]] = []
    results = pool.simulate(tasks(0, 7), 2, lambda done, of: told.append((done, of)))
    assert [result.outcome.seed for result in results] == list(range(7))
    assert told[-1] == (7, 7)
    assert [done for done, _ in told] == sorted({done for done, _ in told})


def test_calls_of_several_threads_get_their_own_results(pool: BackgroundPool) -> None:
    with ThreadPoolExecutor(4) as threads:
        answers = list(threads.map(lambda first: pool.simulate(tasks(first, 5), 2), (0, 10, 20, 30)))
    assert [[result.outcome.seed for result in answer] for answer in answers] == [
        list(range(first, first + 5)) for first in (0, 10, 20, 30)
    ]


@pytest.mark.parametrize("progress", [None, lambda done, of: None])
def test_an_impossible_task_ends_the_call_and_the_pool_goes_on(pool: BackgroundPool, progress: object) -> None:
    touching = task(0, "touching")
    with pytest.raises(InvalidActionError, match="cups touch"):
        pool.simulate([*tasks(0, 2), touching, *tasks(2, 2)], 2, progress)  # type: ignore[arg-type]
    assert len(pool.simulate(tasks(0, 3), 2)) == 3
