"""Sends the client of a simulated Franka states that it skips, since their number is old: it gives up after a second
without a state.

This is a program of its own, `python -m actors.emulators.franka.client_reminder FD`, because a simulator that works all
the time waits for a processor of a busy host for longer than that. It ends when the other end of its socket is closed.
"""

from __future__ import annotations

import contextlib
import json
import select
import socket
import sys
from typing import Any

from actors.runtime.child_process import ChildProcess, python_module

REMINDER = 0.05
"""Wall time between two reminders of a client [s]."""


class ClientReminder:
    """The running program."""

    def __init__(self) -> None:
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            number = theirs.fileno()
            self._process = ChildProcess(
                python_module(__name__, str(number)),
                input=False,
                output=False,
                errors="shown",
                inherited=(number,),
                dies_with_parent=True,
                prompt=True,
            )

    def remind(self, client: tuple[str, int], size: int, sender: socket.socket) -> None:
        """Remind this client from now on.

        Args:
            client: its address and port.
            size: of a state [bytes].
            sender: socket from which it gets its states.
        """
        socket.send_fds(self._channel, [json.dumps([size, *client]).encode()], [sender.fileno()])

    def forget(self) -> None:
        """Remind nobody."""
        self._channel.send(b"null")

    def close(self) -> None:
        """End the program."""
        self._channel.close()
        self._process.close()


def _remind(channel: socket.socket) -> None:
    client: tuple[socket.socket, bytes, tuple[Any, ...]] | None = None
    while True:
        if not select.select([channel], [], [], REMINDER)[0]:
            if client is not None:
                with contextlib.suppress(OSError):
                    client[0].sendto(*client[1:])
            continue
        text, handles, *_ = socket.recv_fds(channel, 200, 1)
        if not text:
            return
        client = None
        if handles:
            size, *address = json.loads(text)
            client = socket.socket(fileno=handles[0]), bytes(size), tuple(address)


if __name__ == "__main__":
    _remind(socket.socket(fileno=int(sys.argv[1])))
