"""A process of our own that talks over one connection; from its end it learns that its owner is gone, however."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
from multiprocessing.connection import Connection

_NOISE_KEPT = 2000


class Child:
    """`python -m MODULE FD`, in a session of its own: an interrupt at the keyboard is for its owner.

    Attributes:
        process: to wait for, or to kill.
        connection: to it; FD is the other end.
    """

    def __init__(self, module: str) -> None:
        ours, theirs = socket.socketpair()
        self._noise = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the process
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-m", module, str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=self._noise,
                stderr=self._noise,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
            )
        self.connection = Connection(ours.detach())

    def said(self) -> str:
        """What it has printed last: ' (it said: …)', or nothing."""
        with contextlib.suppress(OSError, ValueError):
            size = os.fstat(self._noise.fileno()).st_size
            data = os.pread(self._noise.fileno(), _NOISE_KEPT, max(0, size - _NOISE_KEPT))
            if text := data.decode("utf-8", "replace").strip():
                return f" (it said: {text})"
        return ""
