"""Campaigns watched while they run: one server for several campaigns, and any number of viewers in browsers.

    with LiveView() as live:
        print(live.url)
        monitor = live.watcher_for(plan, directory)   # a watcher of the campaign, as any

Nobody who watches can hold anything up: a campaign's events go through a bounded queue to a process that writes them
(`monitor.RerunMonitor`), and from there to a server in a third process, which viewers are connected to.

Limitations: there is no password. Who reaches the ports can look, and can send to the same server; nothing of a
campaign can be changed through it. So it listens on this machine only, unless told otherwise.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import quote

from actors.runtime.child_process import ChildProcess, python_module
from orchestrator.live_view.rerun_subscriber import CAPACITY, RerunMonitor
from orchestrator.live_view.viewer_server import environment
from orchestrator.run_errors import RunError
from orchestrator.strategies.campaign_plan import CampaignPlan
from sim_engine.resources import installed

LOOPBACK = "127.0.0.1"

WEB_PORT = 9090
"""The port of the viewer's page, where it is free; else the next free one."""

STREAM_PORT = 9876
"""The port of the stream, likewise; Rerun's own default."""

MEMORY = "512MiB"
"""Kept for those who come late; what is older is in the recording on disk."""

RECORDING = "campaign.rrd"
"""Name of a run's recording."""

_START_TIME = 40.0
_TRIED = 100


class LiveError(RunError):
    """The live view can't be served; the text says why."""


class LiveView:
    """A Rerun server and its web viewer.

    Args:
        address: to listen on; '0.0.0.0' for all of this machine's.
        web_port: of the viewer's page; None: `WEB_PORT`, or the next free one.
        memory: that the server may keep, as '512MiB'.
        shown: recordings on disk to be shown as well.
    """

    def __init__(
        self,
        *,
        address: str = LOOPBACK,
        web_port: int | None = None,
        memory: str = MEMORY,
        shown: tuple[Path, ...] = (),
    ) -> None:
        self.address, self._web_port, self._memory, self._shown = address, web_port, memory, shown
        self._process: ChildProcess | None = None
        self._ports = (0, 0)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def open(self) -> str:
        """Start serving; returns when a browser may be pointed to `url`, which is also what it returns.

        Raises:
            LiveError: the port is taken, or the server does not start.
        """
        if self._web_port is not None and not is_free(self.address, self._web_port):
            raise LiveError(
                f"port {self._web_port} of {self.address} is taken, by another live view perhaps, or can't be used; "
                "name another one, or none: then a free one is found"
            )
        web_port = self._web_port or free_port(self.address, WEB_PORT)
        port = free_port(self.address, STREAM_PORT)
        shown = [str(path.absolute()) for path in self._shown]
        values = (self.address, str(port), str(web_port), self._memory, *shown)
        self._process = ChildProcess(
            python_module("orchestrator.live_view.viewer_server", *values), environment=environment()
        )
        self._ports = (port, web_port)
        self._await_ports()
        return self.url

    def _await_ports(self) -> None:
        assert self._process is not None
        end = time.monotonic() + _START_TIME
        wanted = list(self._ports)
        while wanted:
            if not self._process.alive or time.monotonic() > end:
                said = self._process.last_error or "it says nothing"
                self.close()
                raise LiveError(f"the live view's server does not start: {said}")
            if answers(self.host, wanted[0]):
                wanted.pop(0)
            else:
                time.sleep(0.05)

    @property
    def host(self) -> str:
        """Name of this machine for those who look from where they may: see `address`."""
        return socket.gethostname() if self.address in ("0.0.0.0", "::") else self.address

    @property
    def stream(self) -> str:
        """Where Rerun's own viewer connects to (`rerun --connect`), and campaigns send to."""
        return f"rerun+http://{self.host}:{self._ports[0]}/proxy"

    @property
    def url(self) -> str:
        """The address of the viewer's page, for a browser."""
        return f"http://{self.host}:{self._ports[1]}/?url={quote(self.stream, safe='')}"

    @property
    def server_pid(self) -> int:
        """The process id of Rerun's server; asked for once, since it is the first line of its output."""
        assert self._process is not None
        return int(self._process.read_line(_START_TIME))

    @property
    def alive(self) -> bool:
        """Whether it still serves."""
        return self._process is not None and self._process.alive

    def watcher_for(self, plan: CampaignPlan, run: Path, *, capacity: int = CAPACITY) -> RerunMonitor:
        """A watcher that writes a run's recording and shows the same here. To be closed when the run has ended.

        Args:
            plan: of the campaign.
            run: its folder.
            capacity: events that may wait.

        Raises:
            OSError: the recording can't be written.
        """
        return RerunMonitor(run / RECORDING, plan, url=self.stream, capacity=capacity)

    def close(self) -> None:
        """Stop serving. Viewers keep what they have. May be called again."""
        process, self._process = self._process, None
        if process is not None:
            process.close(5.0)


def is_free(address: str, port: int) -> bool:
    """Whether a port can be listened on. Rerun only logs that it can't."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((address, port))
            probe.listen()
        except (OSError, OverflowError):
            return False
    return True


def free_port(address: str, first: int) -> int:
    """The first free port from one on.

    Raises:
        LiveError: there is none near by, or the address is not this machine's.
    """
    for port in range(first, first + _TRIED):
        if is_free(address, port):
            return port
    raise LiveError(
        f"no port from {first} to {first + _TRIED - 1} can be listened on at {address}; is that an address of this "
        "machine?"
    )


def answers(host: str, port: int) -> bool:
    """Whether somebody listens there."""
    try:
        with socket.create_connection((host, port), timeout=1.0):
            return True
    except OSError:
        return False


def can_record(plan: CampaignPlan) -> bool:
    """Whether a run of a campaign is recorded: the campaign wants it, and Rerun is installed."""
    return plan.outputs.rrd and installed("rerun")


def recorder_of(
    plan: CampaignPlan, run: Path, tell: Callable[[str], object], live: LiveView | None = None
) -> RerunMonitor | None:
    """The watcher that writes a run's recording; None if the campaign wants none, or Rerun is not installed.

    Args:
        plan: of the campaign.
        run: its folder.
        tell: called with the reason if a recording is wanted, but can't be made.
        live: view that shows the same, if it is alive.

    Raises:
        OSError: the recording can't be written.
    """
    if not can_record(plan):
        if plan.outputs.rrd:
            tell("no recording: it needs Rerun, which is not installed (pip install 'decant[live]')")
        return None
    return RerunMonitor(run / RECORDING, plan) if live is None else live.watcher_for(plan, run)
