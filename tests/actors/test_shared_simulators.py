"""Simulators that several laboratories share: turns for all, none lost, none left behind."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from actors.simulators.shared_pool import AHEAD, FairPool


class Pool:
    """Takes as long as the test wants."""

    size = 1
    separate = True

    def __init__(self) -> None:
        self.begun: list[Any] = []
        self.most = self.now = 0
        self.gates: dict[Any, asyncio.Event] = {}

    async def simulate(self, task: Any) -> Any:
        self.begun.append(task)
        self.now += 1
        self.most = max(self.most, self.now)
        try:
            await self.gates.setdefault(task, asyncio.Event()).wait()
        finally:
            self.now -= 1
        return task

    def end(self, task: Any) -> None:
        self.gates.setdefault(task, asyncio.Event()).set()


async def settled() -> None:
    for _ in range(10):
        await asyncio.sleep(0)


def test_one_that_asks_for_much_leaves_every_second_turn_to_the_other() -> None:
    async def work() -> None:
        pool = Pool()
        fair = FairPool(pool)  # type: ignore[arg-type]
        greedy, modest = fair.share(), fair.share()
        jobs = [asyncio.create_task(greedy.simulate(f"g{i}")) for i in range(8)]  # type: ignore[arg-type]
        await settled()
        jobs += [asyncio.create_task(modest.simulate(f"m{i}")) for i in range(3)]  # type: ignore[arg-type]
        await settled()
        for _ in range(11):
            pool.end(pool.begun[len([j for j in jobs if j.done()])])
            await settled()
        assert sorted(await asyncio.gather(*jobs)) == sorted([f"g{i}" for i in range(8)] + [f"m{i}" for i in range(3)])  # type: ignore[type-var]
        assert pool.most == AHEAD
        assert pool.begun[:8] == ["g0", "g1", "g2", "m0", "g3", "m1", "g4", "m2"]

    asyncio.run(work())


@pytest.mark.parametrize("when", ["waiting", "turn come", "under way"])
def test_whoever_gives_up_takes_nobody_elses_turn(when: str) -> None:
    async def work() -> None:
        pool = Pool()
        share = FairPool(pool).share()  # type: ignore[arg-type]
        jobs = [asyncio.create_task(share.simulate(i)) for i in range(4)]  # type: ignore[arg-type]
        await settled()
        if when == "waiting":
            jobs[2].cancel()
        elif when == "under way":
            jobs[0].cancel()
        else:
            pool.end(0)
            while not jobs[0].done():
                await asyncio.sleep(0)
            jobs[2].cancel()
        for i in range(4):
            await settled()
            pool.end(i)
        done = await asyncio.gather(*jobs, return_exceptions=True)
        assert [isinstance(one, asyncio.CancelledError) for one in done].count(True) == 1
        assert await asyncio.wait_for(share.simulate(0), 5.0) == 0  # type: ignore[arg-type, comparison-overlap]

    asyncio.run(work())
