"""`server_process`: a daemon whose Ray has died begins anew: what it finishes before, what it leaves, and when
people have to mend it.
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import logging
import threading
import time
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from actors.laboratory import WarmSimulators
from orchestrator.daemon import server_process
from orchestrator.daemon.rigs import supervisor
from orchestrator.daemon.server_process import MOST, RENEWED, DaemonRestart, RayWatch, log_lines
from tests.support.toy_daemon import held, serving
from tests.support.waiting import wait_async, wait_for


async def test_a_pour_is_finished_before_and_its_campaign_goes_on_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = ["raylet"]
    monkeypatch.setattr(supervisor, "LEAVING", 0.05)
    async with serving(tmp_path, held) as served:
        keys = [await served.submit(), await served.submit()]
        laboratory = await served.pouring()
        monkeypatch.setattr(WarmSimulators, "lost", property(lambda self: lost[0]))
        assert served.supervisor.pouring
        served.supervisor.leave("raylet")
        told = await served.post("/queue/pause")
        told = await served.post(f"/campaigns/{keys[1]}/resume", status=409)
        assert "just beginning anew" in told["detail"]
        (problem,) = (await served.get("/status"))["problems"]
        assert "Ray has lost its raylet" in problem
        await asyncio.sleep(0.2)  # a server that ends would have begun to
        assert not served.supervisor.left.is_set()
        assert laboratory.bench.aborted == []
        laboratory.bench.go.set()
        await served.supervisor.left.wait()
        found = await served.until(keys[0], "paused")
        assert [pour["state"] for pour in found["pours_made"]] == ["weighed"]
        await served.post("/queue/resume")
    lost[0] = ""
    async with serving(tmp_path) as served:
        for key in keys:
            await served.until(key, "finished")


class Daemon:
    lost, pouring = "raylet", False

    def __init__(self) -> None:
        self.shared = self.warm = self
        self.left: list[str] = []
        self.problems: list[str] = []

    def leave(self, lost: str) -> None:
        self.left.append(lost)

    def problem(self, key: str, text: str | None) -> None:
        self.problems.append(str(text))


def watch_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "watch over Ray"]


def watched(monkeypatch: pytest.MonkeyPatch, daemon: Any, *, hangs: bool = True) -> list[float]:
    """When the program was replaced, seconds after Ray was seen to be dead."""
    monkeypatch.setattr(server_process, "COMING_TO_REST", 0.4)
    monkeypatch.setattr(server_process, "POURING", 0.8)
    begun, replaced = time.monotonic(), []

    class Kept(DaemonRestart):
        def begin_anew(self) -> Any:
            replaced.append(time.monotonic() - begun)

    async def work() -> None:
        watch = RayWatch(daemon, Kept(), lambda: False)
        if hangs:
            wait_for(lambda: replaced, "new beginning")  # blocks the loop, as a call to a dead Ray does
            return
        watch.close()
        await wait_async(lambda: not watch_threads())
        await asyncio.sleep(0)

    with contextlib.suppress(TimeoutError):
        asyncio.run(work())
    return replaced


def test_a_loop_that_hangs_keeps_nobody_from_beginning_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = Daemon()
    assert len(watched(monkeypatch, daemon)) == 1
    assert daemon.left == ["raylet"]
    assert not daemon.problems
    assert watched(monkeypatch, Daemon(), hangs=False) == []


def test_a_pour_gets_more_time(monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = Daemon()
    daemon.pouring = True
    (after,) = watched(monkeypatch, daemon)
    assert after > 0.8


def test_people_are_told_where_ray_dies_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = Daemon()
    monkeypatch.setenv(RENEWED, " ".join(str(time.time()) for _ in range(MOST)))
    assert watched(monkeypatch, daemon, hangs=False) == []
    assert daemon.left == []
    assert "start it again" in daemon.problems[0]
    monkeypatch.setenv(RENEWED, " ".join(str(time.time() - server_process.WITHIN) for _ in range(MOST)))
    assert len(watched(monkeypatch, Daemon())) == 1


def test_the_log_has_its_zone() -> None:
    stream = io.StringIO()
    root = logging.getLogger()
    handlers, level = root.handlers, root.level
    with log_lines(stream):
        logging.getLogger("decant").warning("a line")
    assert (root.handlers, root.level) == (handlers, level)
    assert datetime.fromisoformat(json.loads(stream.getvalue())["time"]).utcoffset() == timedelta(0)
