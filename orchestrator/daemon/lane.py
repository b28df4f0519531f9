"""What happens at one rig: it takes a campaign from the queue, keeps it until it rests, and takes the next."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from typing import Any, Protocol

from actors.protocols import LaboratoryError
from orchestrator.config.yaml.errors import ConfigError
from orchestrator.daemon.retention import prune_recordings
from orchestrator.daemon.running import Common, Running
from orchestrator.daemon.settings import Rig
from orchestrator.daemon.store import AT_REST, ENDED, STOPPED, Item, Wish
from orchestrator.errors import RunError
from orchestrator.lanes import LaneError, PourUnknownError
from orchestrator.reserve import MB, free_space
from orchestrator.run_result import CampaignResult
from orchestrator.unknown import OperatorNeededError

RETRY = 30.0
"""Before a lane that was kept from beginning looks again [s]."""

_log = logging.getLogger(__name__)


class Whole(Protocol):
    """What a lane needs of the daemon that it is a part of.

    Attributes:
        lanes: all of them, by their rigs' names.
        stopping: nothing is begun any more.
        suspect: the simulators may be gone.
    """

    lanes: dict[str, Lane]
    stopping: bool
    suspect: bool

    def is_stopped(self, rig: str) -> bool:
        """Whether an emergency stop is latched that holds for a rig."""
        ...

    @property
    def queue_paused(self) -> bool:
        """Whether nothing is begun from the queue."""
        ...

    def problem(self, key: str, text: str | None) -> None:
        """Something is wrong, or (None) is no longer."""
        ...


class Lane:
    """What happens at one rig: one campaign after the other.

    Args:
        daemon: whose queue it serves.
        rig: that campaigns lease here.
        common: what all of them share.
    """

    def __init__(self, daemon: Whole, rig: Rig, common: Common) -> None:
        self._daemon, self.rig, self._common = daemon, rig, common
        self.running: Running | None = None
        self.wake = asyncio.Event()
        self.latched = daemon.is_stopped(rig.name)
        self._background: set[asyncio.Task[None]] = set()
        self._resting = asyncio.Event()
        self._resting.set()

    def holds(self, key: str) -> bool:
        """Whether that campaign has the rig."""
        return self.running is not None and self.running.item.id == key

    async def work(self) -> None:
        """Until cancelled."""
        while True:
            self.wake.clear()
            item = self._next()
            if item is None:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(RETRY):
                        await self.wake.wait()
                continue
            self._resting.clear()
            try:
                await self._run(item)
            finally:
                self.running = None
                self._resting.set()

    async def close(self) -> None:
        """Come to rest."""
        if self.running is not None:
            self.running.pause()
        await self._resting.wait()

    def background(self, work: Any) -> None:
        """Do something beside."""
        task = asyncio.ensure_future(work)
        self._background.add(task)
        task.add_done_callback(self._background.discard)

    def _next(self) -> Item | None:
        if self.latched or self._daemon.stopping or self._common.warm.lost:
            return None
        store = self._common.store
        mine = [one for one in store.items([*AT_REST]) if one.rig == self.rig.name and one.wish == Wish.RUN]
        begun = sorted(
            (one for one in mine if one.run is not None and one.state not in ENDED), key=lambda one: one.begun or 0.0
        )
        queued = [one for one in mine if one.state == "queued"]
        if self._daemon.queue_paused:
            queued = []
        found = next((one for one in (*begun, *queued) if one.mode != "hardware" or one.armed), None)
        return found if found is not None and self._has_room() else None

    def _has_room(self) -> bool:
        settings = self._common.settings
        free = free_space(settings.state)
        text = (
            f"{free / MB:.0f} MB are free on the disk of {settings.state}, and no campaign is begun below "
            f"{settings.keep_free / MB:.0f} MB (keep_free): make room"
        )
        self._daemon.problem("disk", text if free < settings.keep_free else None)
        return free >= settings.keep_free

    async def _run(self, item: Item) -> None:
        store, feed = self._common.store, self._common.feed
        self.running = running = Running(self._common, item, self.rig)
        store.change(item.id, state="preparing", reason="", begun=item.begun or time.time(), armed=False)
        feed.tell("CampaignLeased", {"rig": self.rig.name}, item.id)
        if self._daemon.suspect and not any(one.running for one in self._daemon.lanes.values() if one is not self):
            self._daemon.suspect = False
            await self._common.warm.close()
        state, reason, wish = "failed", "", Wish.PAUSE
        result: CampaignResult | None = None
        try:
            result = await running.run(self._checksum(item))
            state, reason = "finished", ""
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                raise
            state, reason, wish = self._ended_by_people(item)
        except OperatorNeededError as error:
            state, reason, wish = "paused", str(error), self._kept_wish(item)
        except PourUnknownError as error:
            state, reason, wish = "unknown", str(error), self._kept_wish(item)
        except (RunError, LaboratoryError, ConfigError, OSError) as error:
            needs_person = getattr(error, "exit_code", 1) == 3
            self._daemon.suspect |= isinstance(error, LaboratoryError | LaneError)
            state, reason = ("paused" if needs_person else "failed"), str(error)
        except Exception as error:
            state, reason = "failed", f"{type(error).__name__}: {error}"
            _log.exception("campaign %s failed", item.id)
        if state in ("failed", "paused") and (lost := self._common.warm.lost):
            # No fault of the campaign's, and nobody's wish: it goes on when there is a Ray again.
            state, reason, wish = "paused", f"Ray had lost its {lost}", self._kept_wish(item)
        await self._leave(running, state, reason, wish)
        if result is None and state != "finished":
            _log.warning("campaign %s: %s: %s", item.id, state, reason, extra={"campaign": item.id})

    def _checksum(self, item: Item) -> str:
        if self.rig.source is None or self.rig.mode != "hardware":
            return ""
        from orchestrator.safety import accepted_checksum

        return accepted_checksum(self.rig.source) or ""

    def _kept_wish(self, item: Item) -> Wish:
        """Somebody has to answer before it goes on: it goes on to ask, unless people want something else of it."""
        found = self._common.store.item(item.id)
        return Wish.RUN if found is None else Wish(found.wish)

    def _ended_by_people(self, item: Item) -> tuple[str, str, Wish]:
        found = self._common.store.item(item.id)
        wish = Wish.PAUSE if found is None else Wish(found.wish)
        state = "unknown" if found is not None and found.state == "unknown" else "paused"
        reason = found.reason if found is not None else ""
        return state, reason, wish

    async def _leave(self, running: Running, state: str, reason: str, wish: Wish) -> None:
        store, key = self._common.store, running.item.id
        if wish is Wish.STOP and state != "finished":
            state = STOPPED
            try:
                await running.tidy()
            except Exception as error:  # what is in the journal is safe
                reason = f"what came of it could not be published: {error}"
                _log.exception("campaign %s: not published", key)
        ended = time.time() if state in ENDED else None
        store.change(key, state=state, reason=reason, wish=str(wish), ended=ended)
        self.running = None  # whoever hears that it rests may have it go on
        self._common.feed.tell("CampaignRests", {"state": state, "reason": reason, "rig": self.rig.name}, key)
        with contextlib.suppress(OSError):
            busy = {one.running.item.run for one in self._daemon.lanes.values() if one.running is not None}
            await asyncio.to_thread(prune_recordings, self._common.settings, {name for name in busy if name})
            await self._common.warm.tidy()
