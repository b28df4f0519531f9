"""Ray's own processes, of a private Ray as each program starts one: its scheduler (raylet) and its directory (gcs)."""

from __future__ import annotations

import contextlib
import os
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from actors.laboratory import RayLaboratory
from actors.laboratory_settings import LaboratorySettings
from tests.reliability import strikes
from tests.reliability.case import CUT, FULL, KILLED, STOPPED, Case, every, first_of_kind
from tests.reliability.formula import WORK, Formula
from tests.reliability.program import LoggingBench
from tests.reliability.rig import Life, Rig
from tests.support.toy_campaign import ToyLaboratory


class RayRig(Rig):
    """Both of them at once, as when a machine runs out of memory, or one, by turns."""

    target = "ray"
    names = ("raylet", "gcs_server")

    def cases(self) -> list[Case]:
        """At the first write of each kind."""
        few = [point for point in first_of_kind(self.points) if point in self.up]
        return [
            *every(self.target, KILLED, few),
            *every(self.target, STOPPED, few[::2]),
            *every(self.target, CUT, few[1::2]),
            *every(self.target, FULL, few[::3]),
        ]

    @contextlib.asynccontextmanager
    async def laboratory(self, life: Life) -> AsyncIterator[Any]:
        os.environ[WORK] = "0.02"
        async with RayLaboratory(LaboratorySettings(name="matrix", simulators=1), Formula) as opened:
            pool: Any = opened.simulators
            await pool.pids()
            yield ToyLaboratory(pool, LoggingBench(life), opened.optimizer)  # type: ignore[arg-type]

    def pids(self) -> list[int]:
        return strikes.descendants(*self.names)

    def strike(self, fault: str, life: Life) -> None:
        case = life.case
        assert case is not None
        if fault != FULL:
            at = [point for point in self.points if point in self.up].index((case.at, case.number))
            self.names = (("raylet",), ("gcs_server",), ("raylet", "gcs_server"))[at % 3]
        super().strike(fault, life)

    def full(self, life: Life) -> Path:
        return life.place / "tmp"
