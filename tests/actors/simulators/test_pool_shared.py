"""`pool`: simulators that several laboratories share: turns for all, none lost, none left behind."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from actors.simulators.pool import Greeting, WorkerPool, WorkerReply


class HeldWorker:
    """A worker whose jobs take as long as the test wants; their result is the task."""

    def __init__(self) -> None:
        self.begun: list[Any] = []
        self.gates: dict[Any, asyncio.Event] = {}
        self._line = asyncio.Lock()

    async def start(self) -> Greeting:
        return Greeting(1)

    async def run(self, number: int, task: Any) -> Any:
        async with self._line:
            self.begun.append(task)
            await self.gates.setdefault(task, asyncio.Event()).wait()
        return WorkerReply(task, 0.0)

    def cancel(self, number: int) -> None:
        """Go on: the pool discards the result."""

    async def close(self, patience: float) -> None:
        """Nothing to end."""

    def end(self, task: Any) -> None:
        self.gates.setdefault(task, asyncio.Event()).set()


async def settled() -> None:
    for _ in range(10):
        await asyncio.sleep(0)


async def test_one_that_asks_for_much_leaves_every_second_turn_to_the_other() -> None:
    worker = HeldWorker()
    pool = WorkerPool(1, lambda: worker, ahead=1)
    await pool.pids()
    greedy, modest = pool.share(), pool.share()
    jobs = [asyncio.create_task(greedy.simulate(f"g{i}")) for i in range(8)]  # type: ignore[arg-type]
    await settled()
    jobs += [asyncio.create_task(modest.simulate(f"m{i}")) for i in range(3)]  # type: ignore[arg-type]
    await settled()
    for i in range(11):
        worker.end(worker.begun[i])
        await settled()
    assert sorted(await asyncio.gather(*jobs)) == sorted([f"g{i}" for i in range(8)] + [f"m{i}" for i in range(3)])  # type: ignore[type-var]
    assert worker.begun[:8] == ["g0", "g1", "g2", "m0", "g3", "m1", "g4", "m2"]


@pytest.mark.parametrize("when", ["waiting", "sent", "under way"])
async def test_whoever_gives_up_takes_nobody_elses_turn(when: str) -> None:
    worker = HeldWorker()
    share = WorkerPool(1, lambda: worker, ahead=1).share()
    jobs = [asyncio.create_task(share.simulate(i)) for i in range(4)]  # type: ignore[arg-type]
    await settled()
    jobs[{"waiting": 2, "sent": 1, "under way": 0}[when]].cancel()
    for i in range(4):
        await settled()
        worker.end(i)
    done = await asyncio.gather(*jobs, return_exceptions=True)
    assert [isinstance(one, asyncio.CancelledError) for one in done].count(True) == 1
    assert worker.begun == ([0, 1, 3] if when == "waiting" else [0, 1, 2, 3])
    assert await asyncio.wait_for(share.simulate(0), 5.0) == 0  # type: ignore[arg-type, comparison-overlap]
