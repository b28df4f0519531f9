"""The daemon in a process of its own, submitted to and answered over HTTP, struck, and started again.

Simulators are formulas, the bench is Decant's own bench of numbers.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from actors.bench.bench_factory import PouringBench
from actors.laboratory import WarmSimulators
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.daemon.api.daemon_client import Client, DaemonError
from orchestrator.daemon.rigs.submissions import pack
from orchestrator.daemon.server_process import serve
from orchestrator.daemon.state.daemon_settings import load_settings
from tests.reliability import strikes
from tests.reliability.case import (
    AHEAD,
    BACK,
    CUT,
    FULL,
    KILLED,
    KILLED_AFTER,
    STOPPED,
    Case,
    every,
    first_in_stages,
    first_of_kind,
)
from tests.reliability.formula import LOG, Formula
from tests.reliability.rig import PATIENCE, Life, Rig
from tests.support.small_campaign import CAMPAIGN, write_campaign

TEXT = CAMPAIGN.replace("directory: runs", "directory: runs, figures: false, recording: false").replace(
    "on_unknown: repeat", "on_unknown: ask"
)

WAITING = 0.1

SUBMITTED = "struck"
"""Id of the submission, which is sent again after a kill."""


@dataclass
class ServedLife(Life):
    """What a daemon has to work with: a state directory, with the run in it."""

    @property
    def disk(self) -> Path:
        """Of the state directory."""
        return self.place / "disk"

    @property
    def state(self) -> Path:
        """The daemon's."""
        return self.disk / "state"

    @property
    def directory(self) -> Path:
        """Of the only run."""
        return next((self.state / "runs").glob("*"), self.place / "none")


class DaemonRig(Rig):
    """A daemon, and people at other terminals."""

    target = "daemon"

    def write_campaign(self, folder: Path) -> Path:
        return write_campaign(folder, TEXT)

    def cases(self) -> list[Case]:
        """Killed at the first write of each kind in each stage; everything else at the first of each kind."""
        few = first_of_kind(self.points)
        others = (KILLED_AFTER, STOPPED, CUT, FULL, AHEAD, BACK)
        return [
            *every(self.target, KILLED, first_in_stages(self.points)),
            *(case for fault in others for case in every(self.target, fault, few)),
        ]

    def life(self, place: Path, case: Case | None = None) -> Life:
        return ServedLife(place, case)

    def full(self, life: Life) -> Path:
        return life.place / "disk"

    def strike(self, fault: str, life: Life) -> None:
        if fault == STOPPED:
            strikes.stop([os.getpid()])
        else:
            super().strike(fault, life)

    def run(self, life: Life, *, resume: bool) -> None:
        """In the daemon's process: serve until told to end."""
        assert isinstance(life, ServedLife)
        WarmSimulators.__init__.__kwdefaults__["make"] = Formula
        pour = PouringBench.pour

        async def logged(bench: Any, *arguments: Any, **named: Any) -> Any:
            measured = await pour(bench, *arguments, **named)
            with Path(os.environ[LOG]).open("a", encoding="utf-8") as file:
                file.write(f"{named['seed']}\n")
            return measured

        PouringBench.pour = logged  # type: ignore[method-assign]
        settings = replace(load_settings(None, state=life.state, port=0, in_process=True), keep_free=0)
        with self.moments(life).noted():
            serve(settings)

    def _live(self, life: Life) -> str:
        assert isinstance(life, ServedLife)
        life.disk.mkdir(exist_ok=True)
        (life.state / "url").unlink(missing_ok=True)
        child = os.fork()
        if child == 0:
            self._in_child(life, resume=False)
        return _People(self, life, child).attend()

    def check(self, life: Life) -> Iterator[str]:
        if life.case is None or life.case.fault != CUT:
            return
        numbers = [int(text) for text in life.noted("events")]
        if numbers != list(range(1, len(numbers) + 1)) or "CampaignRests" not in life.noted("event kinds"):
            yield f"somebody who follows the events has missed some: {numbers} {life.noted('event kinds')[-1:]}"


class _People:
    """Those who submit, look, answer, make room, and end it.

    Args:
        child: the daemon's process.
    """

    def __init__(self, rig: DaemonRig, life: ServedLife, child: int) -> None:
        self._rig, self._life, self._child = rig, life, child
        self._status: int | None = None
        self._rested = ""
        self._answered: set[int] = set()

    def attend(self) -> str:
        """Until the campaign is finished and the daemon has ended; how that was."""
        following: threading.Thread | None = None
        end = time.monotonic() + PATIENCE
        while self._running() and time.monotonic() < end:
            time.sleep(WAITING)
            if not (self._life.state / "url").exists():
                continue
            with contextlib.suppress(DaemonError, OSError), Client(state=self._life.state) as client:
                if self._life.case is not None and self._life.case.fault == CUT and following is None:
                    following = threading.Thread(target=self._follow)
                    following.start()
                    while not self._life.noted("events") and following.is_alive():
                        time.sleep(0.01)
                if self._look(client):
                    os.kill(self._child, signal.SIGTERM)
                    break
        while self._running() and time.monotonic() < end + 30.0:
            time.sleep(0.05)
        if self._running():
            os.kill(self._child, signal.SIGKILL)
            self._status = os.waitpid(self._child, 0)[1]
            self._life.note("hung", f"the daemon did not end within {PATIENCE:g} s")
        if following is not None:
            following.join(30.0)
        assert self._status is not None
        if os.WIFSIGNALED(self._status):
            return f"ended by {signal.Signals(os.WTERMSIG(self._status)).name}"
        return f"came to rest: {self._rested}" if self._rested else "went on"

    def _running(self) -> bool:
        if self._status is None:
            pid, status = os.waitpid(self._child, os.WNOHANG)
            if pid:
                self._status = status
        return self._status is None

    def _look(self, client: Client) -> bool:
        """Look, and do what there is to do; whether the campaign is finished."""
        items = client.get("/campaigns")
        if not items:
            text, files = pack(load_campaign(self._rig.folder / "small.yaml"))
            client.post("/campaigns", {"text": text, "files": files, "id": SUBMITTED})
            return False
        (item,) = items
        for question in client.get("/questions"):
            if question["id"] not in self._answered:
                self._answered.add(question["id"])
                self._life.note("asked", question["text"])
                client.post(f"/questions/{question['id']}/answer", {"answer": self._rig.answer(question["text"])})
        if item["state"] in ("failed", "paused", "unknown") and not item["progress"] and self._life.noted("struck"):
            if "daemon had ended" not in item["reason"]:
                self._rested = item["state"]
                self._life.note("told", item["reason"])
            strikes.tidy(self._life.disk)  # somebody makes room, and resumes
            client.post(f"/campaigns/{item['id']}/resume")
        return bool(item["state"] == "finished")

    def _follow(self) -> None:
        """Somebody who follows the events as they come, whatever happens to the connection."""
        with Client(state=self._life.state) as client:
            for told in client.events(0):
                self._life.note("events", str(told.id))
                self._life.note("event kinds", told.type)
                if told.type == "CampaignRests":
                    return
