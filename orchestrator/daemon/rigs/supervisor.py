"""The life of the daemon: it recovers the stored state, starts all parts, and comes to rest.

`Supervisor` composes one rig worker (`rig_worker`) per rig and one for campaigns without a rig, the queue
(`campaign_queue`), and the emergency stops (`emergency_stop`). Two campaigns never lease the same rig, and rigs do not
wait for each other. All campaigns share the simulators. HTTP, access control and the restart of the process are in
other modules.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import shutil

from actors.interfaces import LaboratoryError
from orchestrator.daemon.rigs.campaign_queue import CampaignQueue
from orchestrator.daemon.rigs.emergency_stop import EmergencyStops
from orchestrator.daemon.rigs.materials import Materials
from orchestrator.daemon.rigs.pour_orders import OrderBook
from orchestrator.daemon.rigs.rig_worker import SharedServices
from orchestrator.daemon.state.daemon_settings import DaemonSettings
from orchestrator.daemon.state.daemon_store import AT_REST, CHECKING
from orchestrator.daemon.state.run_readout import verdict_at, violated_charts
from orchestrator.live_view.live_server import LiveView

LEAVING = 10.0
"""Time for campaigns to stop after Ray has died [s]; then campaigns that don't pour are given up."""

CHARTS_INTERVAL, REPORTED = 3600.0, "charts"
"""Interval at which control charts are read [s], and the flag with the times of the violations that were reported."""

_log = logging.getLogger(__name__)


class Supervisor:
    """Runs submitted campaigns.

    Args:
        settings: settings in force.
        live: open live view for the runs.

    Attributes:
        shared: what the parts share.
        stops: emergency stops.
        queue: submitted campaigns.
        left: set when all work has stopped after Ray has died.
    """

    def __init__(self, settings: DaemonSettings, live: LiveView | None = None) -> None:
        self.shared = SharedServices(settings, live)
        self.stops = EmergencyStops(self.shared)
        self.queue = CampaignQueue(self.shared, self.stops)
        self.left = asyncio.Event()
        self._tasks: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        """Recover the stored state and start all tasks.

        Raises:
            StoreError: the account of vessels can't be used.
        """
        shared = self.shared
        Materials(shared.store, shared.settings.laboratories).move_positions()
        acknowledged = {row["id"] for row in shared.store.rows("select id from campaign")}
        await asyncio.to_thread(self._remove_unacknowledged, acknowledged)
        for item in shared.store.active():
            reason = f"found {item.state} after the daemon had ended without a word"
            # without a run nothing has begun: it is in the queue again
            shared.store.change(item.id, state="paused" if item.run is not None else "queued", reason=reason)
            shared.feed.publish("CampaignFound", {"state": item.state, "text": reason}, item.id)
        for item in shared.store.items([CHECKING]):
            self.queue.check(item)
        for key in OrderBook(shared.store).begun():
            item = self.queue.item(key)
            if (worker := shared.workers.get(item.rig)) is not None:
                await worker.settle(item, ended=False)
        self._tasks = [asyncio.create_task(shared.feed.flushing(), name="feed")]
        for name, worker in shared.workers.items():
            self._tasks.append(asyncio.create_task(worker.work(), name=f"rig {name}"))
            self._tasks.append(asyncio.create_task(worker.watch_arm(), name=f"arm of {name}"))
        self._tasks.append(asyncio.create_task(self._watch_charts(), name="charts"))
        self._tasks.append(asyncio.create_task(self._judge(), name="verdicts"))
        if shared.settings.quick_start:
            self._tasks.append(asyncio.create_task(self._warm_up(), name="simulators"))
        shared.feed.publish("DaemonStarted", {"rigs": [rig.name for rig in shared.settings.rigs]})

    def _remove_unacknowledged(self, acknowledged: set[str]) -> None:
        """Delete snapshots of submissions that were not yet acknowledged when the daemon died."""
        for folder in self.shared.settings.snapshots.iterdir():
            if folder.name not in acknowledged:
                shutil.rmtree(folder, ignore_errors=True)

    async def _watch_charts(self) -> None:
        """Read the control charts whenever a campaign has ended, and every hour during long ones."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CHARTS_INTERVAL):
                    await self.shared.rested.wait()
            self.shared.rested.clear()
            try:
                await self.report_charts()
            except Exception:  # the next campaign's charts are read again, whatever was wrong with these
                _log.exception("the control charts can't be read")

    async def report_charts(self) -> None:
        """Publish each violation of a control chart once.

        Raises:
            RunError, OSError: the catalogue can't be read.
        """
        charts = await asyncio.to_thread(violated_charts, self.shared.settings.state)
        reported = self.shared.store.flag(REPORTED) or {}
        for chart in charts:
            key = f"{chart.laboratory} {chart.mode} {chart.quantity}"
            if chart.lasting is not None and chart.lasting.noticed > reported.get(key, 0.0):
                reported[key] = chart.lasting.noticed
                body = {"laboratory": chart.laboratory, "mode": chart.mode, "quantity": chart.quantity}
                self.shared.feed.publish("ChartViolated", {**body, "text": chart.text})
        self.shared.store.set_flag(REPORTED, reported)

    async def _judge(self) -> None:
        """Read the verdicts of campaigns at rest that have none: after a crash, or from earlier versions."""
        store = self.shared.store
        for item in store.items(AT_REST):
            if item.run is None or item.verdict is not None:
                continue
            verdict = await asyncio.to_thread(verdict_at, self.shared.settings.runs / item.run)
            if verdict is not None and self.shared.running(item) is None:
                store.change(item.id, verdict=verdict)

    async def _warm_up(self) -> None:
        shared = self.shared
        try:
            await shared.warm.open()
        except LaboratoryError as error:
            shared.warn(f"the simulators don't start: {error}")
        else:
            shared.feed.publish("SimulatorsReady", {"simulators": shared.warm.size})

    @property
    def pouring(self) -> bool:
        """Whether a pour is in progress on any rig."""
        return any(worker.running is not None and worker.running.pouring for worker in self.shared.workers.values())

    def leave(self, lost: str) -> None:
        """Stop as much work as possible in order to restart; sets `left` at the end."""
        shared = self.shared
        if not shared.stopping:
            shared.stopping = True
            shared.problem(
                "ray", f"Ray has lost its {lost}: the daemon begins anew, and what ran goes on from its journal"
            )
            self._tasks.append(asyncio.create_task(self._stop_for_restart(), name="leaving"))

    async def _stop_for_restart(self) -> None:
        shared = self.shared
        resting = [asyncio.ensure_future(worker.close()) for worker in shared.workers.values()]
        await asyncio.wait(resting, timeout=LEAVING)
        for worker in shared.workers.values():
            if worker.running is not None and not worker.running.pouring:
                worker.background(worker.running.give_up())
        await asyncio.wait(resting)
        shared.feed.flush()
        self.left.set()

    async def close(self) -> None:
        """Stop all work at the next safe point, or at once after `hurry`."""
        shared = self.shared
        shared.stopping = True
        await asyncio.gather(*(worker.close() for worker in shared.workers.values()))
        await self.queue.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if not self.left.is_set():  # closing would block if Ray has died
            await shared.warm.close()
        shared.feed.publish("DaemonStopped", {})
        shared.feed.close()
        shared.store.close()

    def hurry(self) -> None:
        """Give all work up, after a second request to end."""
        for worker in self.shared.workers.values():
            if worker.running is not None:
                worker.background(worker.running.give_up())
