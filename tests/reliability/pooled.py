"""Simulators and the optimiser: actors of a real Ray, which is started once for all cases; the program lives on.

What is killed is replaced by the program itself, under way: nobody starts anything again.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from actors.optimizer_actor import DeviceOptimizer, Proposer
from actors.runtime.remote_object import DeviceLostError, RayDevice
from actors.simulators.ray_worker import ray_pool
from tests.reliability import strikes
from tests.reliability.case import CUT, KILLED, STOPPED, Case, Outcome, every, first_and_last, first_of_kind
from tests.reliability.formula import WORK, Formula
from tests.reliability.program import LoggingBench
from tests.reliability.rig import Life, Rig
from tests.support.toy_campaign import ToyLaboratory

SIMULATORS = 2


class PooledRig(Rig):
    """One process for all cases, with simulators and optimiser as `decant run` has them."""

    title = ""
    """Of the processes that are struck."""

    def __init__(self, folder: Path) -> None:
        from actors.runtime.ray_runtime import RayStart, start_ray

        os.environ[WORK] = "0.02"
        start_ray(RayStart(cpus=SIMULATORS))
        self._loop = asyncio.new_event_loop()
        self._pool: Any = None
        self._device: Any = None
        super().__init__(folder)

    def close(self) -> None:
        from actors.runtime.ray_runtime import stop_ray

        self._loop.run_until_complete(self._pool.close())
        self._loop.run_until_complete(self._device.close())
        stop_ray()

    @contextlib.asynccontextmanager
    async def laboratory(self, life: Life) -> AsyncIterator[Any]:
        if self._pool is None:
            self._pool = ray_pool(SIMULATORS, make=Formula)
            self._device = RayDevice("optimiser", Proposer, looked_after=True)
        while len(await self._pool.pids()) < SIMULATORS:
            await asyncio.sleep(0.05)
        with contextlib.suppress(DeviceLostError):  # struck where nobody asked it any more
            await self._device.pid()
        await self._device.revive()
        await self._device.pid()
        yield ToyLaboratory(self._pool, LoggingBench(life), DeviceOptimizer(self._device))  # type: ignore[arg-type]

    def play(self, case: Case) -> Outcome:
        before = self._pool.statistics().deaths
        outcome = super().play(case)
        lost = self._pool.statistics().deaths - before
        return outcome if not lost else _said(outcome, f"went on, {lost} simulator(s) replaced")

    def _live(self, life: Life) -> str:
        """In this process."""
        os.environ["TMPDIR"], kept = str(life.place / "tmp"), os.environ.get("TMPDIR")
        try:
            self._loop.run_until_complete(self.campaign(life, resume=bool(life.directory.exists())))
        except Exception as error:
            life.note("told", f"{type(error).__name__}: {error}")
            return "came to rest"
        finally:
            os.environ["TMPDIR"] = kept or "/tmp"
        return "went on"

    def pids(self) -> list[int]:
        return strikes.descendants(self.title)


def _said(outcome: Outcome, ended: str) -> Outcome:
    from dataclasses import replace

    return replace(outcome, ended=ended)


class SimulatorRig(PooledRig):
    """One of two simulators."""

    target, title = "simulator", "ray::SimulatorProcess"

    def cases(self) -> list[Case]:
        """Killed at the first and the last write of each kind in each stage; stopped and cut at the first of each
        kind."""
        few = first_of_kind(self.up)
        return [
            *every(self.target, KILLED, first_and_last(self.up)),
            *every(self.target, STOPPED, few),
            *every(self.target, CUT, few),
        ]

    def pids(self) -> list[int]:
        return super().pids()[:1]


class OptimiserRig(PooledRig):
    """Its one process."""

    target, title = "optimiser", "ray::Proposer"

    def cases(self) -> list[Case]:
        """Killed at every write; stopped and cut at the first of each kind."""
        few = first_of_kind(self.up)
        return [
            *every(self.target, KILLED, self.up),
            *every(self.target, STOPPED, few),
            *every(self.target, CUT, few),
        ]
