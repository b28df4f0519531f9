"""The queue and the rigs: which campaign runs where and when, and the four ways to stop.

One lane a rig, and one for campaigns that need none: two never hold the same rig, and what one does keeps no other
waiting. The simulators are shared by all.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import shutil
import time
from dataclasses import replace
from typing import Any

from actors.interfaces import LaboratoryError
from actors.simulators.shared_pool import WarmSimulators
from orchestrator.catalogue.run_registry import make_state_directory
from orchestrator.daemon.daemon_settings import DESK, DaemonSettings, Rig
from orchestrator.daemon.daemon_store import AT_REST, ENDED, STOPPED, WITHDRAWN, DesiredState, QueueItem, Store
from orchestrator.daemon.event_feed import Feed
from orchestrator.daemon.notifications import Counts
from orchestrator.daemon.remote_operator import Asking
from orchestrator.daemon.rig_worker import Common, Lane, Running
from orchestrator.daemon.run_readout import Pours
from orchestrator.live_view.live_server import LiveView
from orchestrator.run_errors import RunError

LEAVING = 10.0
"""Time that campaigns have to come to rest where Ray has died [s]; then those that don't pour are given up."""

PAUSED, EMERGENCY = "paused", "emergency"

_log = logging.getLogger(__name__)


def _emergency_of(rig: str) -> str:
    """The flag of the emergency stop of one rig."""
    return f"{EMERGENCY} {rig}"


class RequestRefusedError(RunError):
    """What was asked for can't be done now; the text says why."""


class Supervisor:
    """Runs what was submitted.

    Args:
        settings: in force.
        live: view that runs are shown in, open already.
    """

    def __init__(self, settings: DaemonSettings, live: LiveView | None = None) -> None:
        make_state_directory(settings.state)
        settings.runs.mkdir(parents=True, exist_ok=True)
        settings.snapshots.mkdir(parents=True, exist_ok=True)
        self.settings = settings
        self.store = Store(settings.state / "daemon.sqlite")
        self.feed = Feed(settings.state / "events.sqlite", settings.events, self._feed_broken)
        self.asking = Asking(self.store, self.feed.tell)
        self.warm = WarmSimulators(settings.simulators, in_process=settings.in_process, tell=self._warn)
        self._common = Common(settings, self.store, self.feed, self.asking, self.warm, live)
        self.lanes: dict[str, Lane] = {rig.name: Lane(self, rig, self._common) for rig in (*settings.rigs, Rig(DESK))}
        self.problems: dict[str, str] = {}
        self.words: dict[str, Counts] = {}
        self.pours = Pours()
        self.stopping = False
        self.suspect = False
        """Whether the simulators may be past mending: they are started anew when nobody uses them."""
        self.left = asyncio.Event()
        self._tasks: list[asyncio.Task[None]] = []
        self.began = time.time()

    async def start(self) -> None:
        """Take up what was left, and begin."""
        await asyncio.to_thread(self._forget_half_submitted, {item.id for item in self.store.items(limit=1_000_000)})
        for item in self.store.items():
            if item.state not in AT_REST:
                found = f"found {item.state} after the daemon had ended without a word"
                self.store.change(item.id, state="paused", reason=found)
                self.feed.tell("CampaignFound", {"state": item.state, "text": found}, item.id)
        self._tasks = [asyncio.create_task(self.feed.flushing(), name="feed")]
        self._tasks += [asyncio.create_task(lane.work(), name=f"rig {lane.rig.name}") for lane in self.lanes.values()]
        if self.settings.quick_start:
            self._tasks.append(asyncio.create_task(self._warm_up(), name="simulators"))
        self.feed.tell("DaemonStarted", {"rigs": [rig.name for rig in self.settings.rigs]})

    def _forget_half_submitted(self, known: set[str]) -> None:
        """Snapshots of campaigns that were being checked when the daemon died: nobody was told that they are queued."""
        for folder in self.settings.snapshots.iterdir():
            if folder.name not in known:
                shutil.rmtree(folder, ignore_errors=True)

    async def _warm_up(self) -> None:
        try:
            await self.warm.open()
        except LaboratoryError as error:
            self._warn(f"the simulators don't start: {error}")
        else:
            self.feed.tell("SimulatorsReady", {"simulators": self.warm.size})

    # ---- beginning anew, where Ray has died: what runs on it comes to no end by itself

    @property
    def lost(self) -> str:
        """Which of Ray's own processes has died; '' while all is well."""
        return self.warm.lost

    @property
    def pouring(self) -> bool:
        """Whether a pour is under way somewhere."""
        return any(lane.running is not None and lane.running.pouring for lane in self.lanes.values())

    def leave(self, lost: str) -> None:
        """Come to rest as far as that is possible, to begin anew; `left` is set then."""
        if not self.stopping:
            self.stopping = True
            self.problem(
                "ray", f"Ray has lost its {lost}: the daemon begins anew, and what ran goes on from its journal"
            )
            self._tasks.append(asyncio.create_task(self._leave(), name="leaving"))

    async def _leave(self) -> None:
        resting = [asyncio.ensure_future(lane.close()) for lane in self.lanes.values()]
        await asyncio.wait(resting, timeout=LEAVING)
        for lane in self.lanes.values():
            if lane.running is not None and not lane.running.pouring:
                lane.background(lane.running.give_up())
        await asyncio.wait(resting)
        self.feed.flush()
        self.left.set()

    async def close(self) -> None:
        """Come to rest at the next safe point; cancelled or told again, at once."""
        self.stopping = True
        await asyncio.gather(*(lane.close() for lane in self.lanes.values()))
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if not self.left.is_set():  # a Ray that has died may hang on for good
            await self.warm.close()
        self.feed.tell("DaemonStopped", {})
        self.feed.close()
        self.store.close()

    def hurry(self) -> None:
        """Told to end a second time: everything is given up."""
        for lane in self.lanes.values():
            if lane.running is not None:
                lane.background(lane.running.give_up())

    # ---- the queue

    def new_key(self) -> str:
        """Letters that nothing else is called by."""
        while True:
            key = secrets.token_hex(3)
            if not any(item.id.endswith(key) for item in self.store.items()):
                return key

    def submit(self, item: QueueItem) -> QueueItem:
        """Queue a campaign whose snapshot has been checked.

        Raises:
            RefusedError: nothing new is taken.
        """
        self.refuse_new_work(item.rig)
        item = replace(item, rank=self.store.last_rank() + 1.0, created=time.time())
        self.store.add(item)
        self.note(item.by, "submit", item.id)
        self.wake()
        return item

    def refuse_new_work(self, rig: str = "") -> None:
        """Raises RefusedError where nothing new is taken, by the daemon or by one rig."""
        if self.emergency is not None:
            raise RequestRefusedError("the emergency stop is latched; nothing is taken before somebody has cleared it")
        if rig in self.emergencies:
            raise RequestRefusedError(
                f"the emergency stop of rig {rig} is latched; it takes nothing before somebody has cleared it"
            )
        if self.stopping:
            again = "ray" in self.problems
            raise RequestRefusedError(
                "the daemon is just beginning anew; try again" if again else "the daemon is ending"
            )

    def item(self, key: str) -> QueueItem:
        """A campaign by its id, or by the beginning of one. Raises KeyError."""
        found = self.store.item(key)
        if found is None and len(key) >= 3:
            similar = [one for one in self.store.items() if one.id.startswith(key)]
            found = similar[0] if len(similar) == 1 else None
        if found is None:
            raise KeyError(key)
        return found

    def move(self, key: str, by: str, *, before: str | None = None, priority: int | None = None) -> QueueItem:
        """Give a queued campaign another place: in front of another one, at the head (''), or by its priority.

        Raises:
            KeyError: there is no such campaign.
            RefusedError: it is not queued.
        """
        item = self.item(key)
        if item.state != "queued":
            raise RequestRefusedError(f"{item.id} is {item.state}; only a queued campaign has a place in the queue")
        if priority is not None:
            self.store.change(item.id, priority=priority)
        if before is not None:
            queue = [one for one in self.store.items(["queued"]) if one.id != item.id]
            at = 0 if before == "" else next((i for i, one in enumerate(queue) if one.id == self.item(before).id), None)
            if at is None:
                raise RequestRefusedError(f"{before} is not in the queue")
            level = queue[at].priority if queue else item.priority
            behind = queue[at].rank if queue else 1.0
            ahead = queue[at - 1].rank if at > 0 and queue[at - 1].priority == level else behind - 2.0
            self.store.change(item.id, priority=level, rank=0.5 * (ahead + behind))
        self.note(by, "move", item.id)
        self.wake()
        return self.item(item.id)

    def pause_queue(self, paused: bool, by: str) -> None:
        """Begin no campaign from now on, or begin them again. What runs goes on."""
        self.store.set_flag(PAUSED, {"by": by, "time": time.time()} if paused else None)
        self.note(by, "pause queue" if paused else "resume queue")
        self.wake()

    @property
    def queue_paused(self) -> bool:
        """Whether no campaign is begun."""
        return self.store.flag(PAUSED) is not None

    @property
    def emergency(self) -> dict[str, Any] | None:
        """The emergency stop of all rigs that is latched: by, time, reason; None: there is none."""
        found: dict[str, Any] | None = self.store.flag(EMERGENCY)
        return found

    @property
    def emergencies(self) -> dict[str, dict[str, Any]]:
        """The emergency stops of single rigs that are latched, by the rig's name."""
        stops = {rig.name: self.store.flag(_emergency_of(rig.name)) for rig in self.settings.rigs}
        return {name: stop for name, stop in stops.items() if stop is not None}

    def is_stopped(self, rig: str) -> bool:
        """Whether a rig may not begin anything: its own emergency stop is latched, or that of all rigs."""
        return self.emergency is not None or rig in self.emergencies

    # ---- one campaign

    def pause(self, key: str, by: str) -> QueueItem:
        """At the next checkpoint."""
        return self._end(key, by, DesiredState.PAUSE)

    def stop(self, key: str, by: str) -> QueueItem:
        """Finish the pour, publish what there is, and leave it at that."""
        return self._end(key, by, DesiredState.STOP)

    def _end(self, key: str, by: str, wish: DesiredState) -> QueueItem:
        item = self.item(key)
        running = self._running(item)
        if running is None and item.state in ENDED:
            raise RequestRefusedError(f"{item.id} is {item.state} already")
        if running is not None:
            running.pause()
        self.store.change(item.id, wish=str(wish))
        self.note(by, str(wish), item.id)
        if running is None:
            if item.state == "queued":
                self.store.change(
                    item.id, state=WITHDRAWN if wish is DesiredState.STOP else "paused", reason=f"by {by}"
                )
            elif wish is DesiredState.STOP:
                self.store.change(item.id, state=STOPPED, ended=time.time(), reason=f"by {by}")
        self.wake()
        return self.item(item.id)

    async def abort(self, key: str, by: str) -> QueueItem:
        """Stop the motion; see `Running.abort`."""
        item = self.item(key)
        running = self._running(item)
        if running is None:
            raise RequestRefusedError(f"{item.id} is {item.state}: nothing of it moves")
        stopping = asyncio.create_task(running.abort())
        await asyncio.sleep(0)
        self.store.change(item.id, wish=str(DesiredState.ABORT))
        self.note(by, "abort", item.id)
        await stopping
        return self.item(item.id)

    def resume(self, key: str, by: str) -> QueueItem:
        """Go on with a campaign that rests.

        Raises:
            RefusedError: it does not rest, or nothing new may begin.
        """
        item = self.item(key)
        self.refuse_new_work(item.rig)
        if item.state in (STOPPED, WITHDRAWN) and item.run is None:
            self.store.change(item.id, state="queued", wish=str(DesiredState.RUN), reason="")
        elif self._running(item) is not None or item.state in ("queued", "finished"):
            raise RequestRefusedError(f"{item.id} is {item.state}; only what rests can be resumed")
        else:
            state = "queued" if item.run is None else "paused" if item.state == STOPPED else item.state
            self.store.change(item.id, state=state, wish=str(DesiredState.RUN), ended=None)
        self.note(by, "resume", item.id)
        self.wake()
        return self.item(item.id)

    def _running(self, item: QueueItem) -> Running | None:
        lane = self.lanes.get(item.rig)
        return lane.running if lane is not None and lane.running is not None and lane.holds(item.id) else None

    def progress(self, item: QueueItem) -> dict[str, Any] | None:
        """Where a running campaign stands."""
        running = self._running(item)
        return None if running is None else running.progress()

    # ---- all of them

    async def emergency_stop(self, by: str, reason: str, rig: str = "") -> None:
        """Stop every arm, give up everything, and take nothing new until `clear`. The arms come first.

        Args:
            by: who presses it.
            reason: why, if they say so.
            rig: stop only this one; '' for all. A stop of all rigs and that of one are latched and cleared separately.

        Raises:
            KeyError: there is no such rig.
        """
        flag, lanes = self._stops(rig)
        stops = [asyncio.create_task(lane.running.emergency()) for lane in lanes if lane.running]
        for lane in lanes:
            lane.latched = True
        await asyncio.sleep(0)
        with contextlib.suppress(RunError):  # a full disk is no reason not to stop
            self.store.set_flag(flag, {"by": by, "time": time.time(), "reason": reason})
            for lane in lanes:
                if lane.running is not None:
                    self.store.change(lane.running.item.id, wish=str(DesiredState.ABORT))
            where = f"rig {rig}" if rig else ""
            self.note(by, "emergency stop", detail=": ".join(filter(None, (where, reason))))
        await asyncio.gather(*stops, return_exceptions=True)

    def clear(self, by: str, rig: str = "") -> None:
        """Take work again. What was given up rests until somebody resumes it.

        Args:
            by: who clears it.
            rig: whose own emergency stop is cleared; '' for the one of all rigs.

        Raises:
            KeyError: there is no such rig.
        """
        flag, lanes = self._stops(rig)
        self.store.set_flag(flag, None)
        for lane in lanes:
            lane.latched = self.is_stopped(lane.rig.name)
        self.note(by, "clear emergency stop", detail=f"rig {rig}" if rig else "")
        self.wake()

    def _stops(self, rig: str) -> tuple[str, list[Lane]]:
        """The flag of an emergency stop, and the lanes that it stops. Raises KeyError."""
        if not rig:
            return EMERGENCY, list(self.lanes.values())
        if rig not in {one.name for one in self.settings.rigs}:
            raise KeyError(rig)
        return _emergency_of(rig), [self.lanes[rig]]

    # ---- small things

    def wake(self) -> None:
        """Something has changed that lanes should look at."""
        for lane in self.lanes.values():
            lane.wake.set()

    def note(self, by: str, what: str, campaign: str = "", detail: str = "") -> None:
        """Somebody did something."""
        self.store.note(by, what, campaign, detail)
        self.feed.tell("Deed", {"by": by, "what": what, "detail": detail}, campaign)
        _log.info("%s: %s %s", by, what, campaign, extra={"by": by, "what": what, "campaign": campaign})

    def problem(self, key: str, text: str | None) -> None:
        """Something that people should mend, or that is mended."""
        if text is None:
            self.problems.pop(key, None)
        elif self.problems.get(key) != text:
            self.problems[key] = text
            self._warn(text)

    def _warn(self, text: str) -> None:
        _log.warning(text)
        self.feed.tell("LogLine", {"level": "warning", "text": text, "stage": ""})

    def _feed_broken(self, text: str) -> None:
        self.problems["events"] = text
        _log.error(text)
