"""The process that writes the recording, while a live view's server gets the same."""

from __future__ import annotations

import contextlib
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.live_view.live_server import LiveView
from orchestrator.live_view.rerun_subscriber import RerunMonitor
from orchestrator.records.events import Subscriber
from tests.reliability import clock, strikes
from tests.reliability.case import AHEAD, BACK, CUT, FULL, KILLED, STOPPED, Case, every, first_of_kind
from tests.reliability.program import ProgramRig
from tests.reliability.rig import Life

WRITER = "orchestrator.live_view.rerun_subscriber"


class RecordingRig(ProgramRig):
    """The campaign is that of the program's rig, watched by a recording with a live view."""

    target = "recording"

    def __init__(self, folder: Path) -> None:
        self._live_view = LiveView()
        self._live_view.open()
        super().__init__(folder)

    def close(self) -> None:
        self._live_view.close()

    def cases(self) -> list[Case]:
        """At the first write of each kind."""
        few = [point for point in first_of_kind(self.points) if point in self.up]
        faults = (KILLED, STOPPED, CUT, FULL, *((AHEAD, BACK) if clock.library() else ()))
        return [case for fault in faults for case in every(self.target, fault, few)]

    @contextlib.contextmanager
    def subscribers(self, life: Life, plan: CampaignPlan) -> Iterator[list[Subscriber]]:
        folder = life.place / "disk" if life.case is not None and life.case.fault == FULL else life.directory
        with clock.adjustable(life.place / "clock"):
            monitor = RerunMonitor(folder / "campaign.rrd", plan, url=self._live_view.stream)
        end = time.monotonic() + 60.0
        while not strikes.connections(monitor.pid) and time.monotonic() < end:
            time.sleep(0.05)  # these campaigns are quicker than its start
        try:
            yield [monitor]
        finally:
            whole = monitor.close(timeout=60.0)
            life.note("recording", "whole" if whole else "not whole")

    @contextlib.asynccontextmanager
    async def laboratory(self, life: Life) -> AsyncIterator[Any]:
        async with super().laboratory(life) as laboratory:
            yield laboratory

    def pids(self) -> list[int]:
        return strikes.descendants(WRITER)

    def strike(self, fault: str, life: Life) -> None:
        if fault in (AHEAD, BACK):
            clock.shift(life.place / "clock", strikes.DAY if fault == AHEAD else -strikes.HOUR)
        else:
            super().strike(fault, life)

    def check(self, life: Life) -> Iterator[str]:
        whole = life.noted("recording")[0]
        if life.case is not None and life.case.fault not in (KILLED, FULL) and whole != "whole":
            yield "its recording is not whole"
