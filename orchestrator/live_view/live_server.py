"""The live view of running campaigns: one server for several campaigns and any number of viewers in browsers.

    with LiveView() as live:
        print(live.url)
        monitor = RerunMonitor(path, plan, url=live.stream)   # a subscriber of the campaign

Viewers can't slow a campaign down. Events pass through a bounded queue to a process that writes them (`RerunMonitor`),
and from there to a server in a third process, which viewers connect to.

Limitations: there is no password. Anyone who can reach the ports can watch, and can send to the same server, but can't
change a campaign. By default, the server therefore listens on this machine only.
"""

from __future__ import annotations

import socket
import time
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import quote

from actors.runtime.child_process import START_DEADLINE, ChildProcess, python_module
from orchestrator.learning.run_errors import RunError
from orchestrator.live_view.viewer_server import environment

LOOPBACK = "127.0.0.1"

WEB_PORT = 9090
"""Port of the viewer's page if it is free; otherwise the next free one."""

STREAM_PORT = 9876
"""Port of the stream, likewise; Rerun's default."""

MEMORY = "512MiB"
"""Memory for viewers that connect late; older data are in the recording on disk."""

_TRIED = 100


class LiveError(RunError):
    """The live view can't be served; the message gives the reason."""


class LiveView:
    """A Rerun server with its web viewer.

    Args:
        address: address to listen at; '0.0.0.0' for all addresses of this machine.
        web_port: port of the viewer's page; None: `WEB_PORT`, or the next free one.
        memory: memory limit of the server, such as '512MiB'.
        shown: recordings on disk to show as well.
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
        """Start serving; return `url` as soon as a browser can open it.

        Raises:
            LiveError: the port is in use, or the server does not start.
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
        end = time.monotonic() + START_DEADLINE
        wanted = list(self._ports)
        while wanted:
            if not self._process.alive or time.monotonic() > end:
                reason = self._process.last_error or "it says nothing"
                self.close()
                raise LiveError(f"the live view's server does not start: {reason}")
            if answers(self.host, wanted[0]):
                wanted.pop(0)
            else:
                time.sleep(0.05)

    @property
    def host(self) -> str:
        """Name of this machine for viewers that can reach `address`."""
        return socket.gethostname() if self.address in ("0.0.0.0", "::") else self.address

    @property
    def stream(self) -> str:
        """URL of the stream for Rerun's own viewer (`rerun --connect`) and for campaigns."""
        return f"rerun+http://{self.host}:{self._ports[0]}/proxy"

    @property
    def url(self) -> str:
        """URL of the viewer's page, for a browser."""
        return f"http://{self.host}:{self._ports[1]}/?url={quote(self.stream, safe='')}"

    @property
    def server_pid(self) -> int:
        """Process id of Rerun's server. Read it only once, since it is the first line of the server's output."""
        assert self._process is not None
        return int(self._process.read_line(START_DEADLINE))

    @property
    def alive(self) -> bool:
        """Whether the server is running."""
        return self._process is not None and self._process.alive

    def close(self) -> None:
        """Stop serving. Viewers keep the data they have received. May be called again."""
        process, self._process = self._process, None
        if process is not None:
            process.close(5.0)


def is_free(address: str, port: int) -> bool:
    """Whether a port is free. Rerun itself only logs if it is not."""
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
    """Return the first free port at or after a given one.

    Raises:
        LiveError: no port nearby is free, or the address is not this machine's.
    """
    for port in range(first, first + _TRIED):
        if is_free(address, port):
            return port
    raise LiveError(
        f"no port from {first} to {first + _TRIED - 1} can be listened on at {address}; is that an address of this "
        "machine?"
    )


def answers(host: str, port: int) -> bool:
    """Whether a server accepts connections there."""
    try:
        with socket.create_connection((host, port), timeout=1.0):
            return True
    except OSError:
        return False
