"""The worker as its driver sees it: calls with deadlines, stops that overtake them, and an end that is noticed.

The worker isn't asked to die with the thread that started it, as Linux offers, for that thread may end while the arm
moves. It ends when this process closes its side of the connection, in whatever way that happens.
"""

from __future__ import annotations

import contextlib
import threading
import time
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from typing import Any

from actors.arm.errors import ArmLostError, ArmRefusedError
from actors.arm.ur.messages import Progress, TroubleError
from actors.child_process import ConnectedProcess

SIGN_OF_LIFE = 0.1
"""Between two signs of life to the worker while a call is awaited [s]."""


class WorkerProcess:
    """One worker, from its start to its end; never restarted.

    Attributes:
        progress: what it last told of a motion.
        pid: of the process.
    """

    def __init__(self) -> None:
        self._child = ConnectedProcess("actors.arm.ur.worker")
        self._connection = self._child.connection
        self.pid = self._child.pid
        self._sending = threading.Lock()
        self._pending: dict[int, Future[Any]] = {}
        self._number = 0
        self._gone = threading.Event()
        self.progress: Progress | None = None
        threading.Thread(target=self._hear, name="arm-worker", daemon=True).start()

    @property
    def alive(self) -> bool:
        """Whether it can be asked."""
        return not self._gone.is_set()

    def call(self, method: str, *arguments: Any, deadline: float) -> Any:
        """Have something done.

        Args:
            method: of `worker.Worker`.
            arguments: plain values.
            deadline: longest wait [s]; a worker that misses it is ended.

        Raises:
            ArmRefusedError: refused before anything moved.
            ArmLostError: the controller can't be reached, or the worker died or missed its deadline.
        """
        future: Future[Any] = Future()
        with self._sending:
            self._number += 1
            number = self._number
            self._pending[number] = future
        if not self.alive:
            raise ArmLostError(self._obituary(method))
        self._send(("call", number, method, arguments))
        end = time.monotonic() + deadline
        while time.monotonic() < end:
            try:
                return future.result(timeout=SIGN_OF_LIFE)
            except FutureTimeoutError:
                self._send(("alive",))
            except TroubleError as trouble:
                if trouble.kind == "refused":
                    raise ArmRefusedError(trouble.text) from None
                raise ArmLostError(trouble.text + self._errors()) from None
        self.kill()
        raise ArmLostError(f"the arm's worker did not answer '{method}' within {deadline:g} s{self._errors()}")

    def stop(self, stops: int) -> None:
        """Stop whatever moves; doesn't wait."""
        self._send(("stop", stops))

    def kill(self) -> None:
        """End it: a motion under way ends by its watchdog."""
        self._child.kill()
        self._gone.wait(2.0)

    def _send(self, message: Any) -> None:
        with self._sending, contextlib.suppress(OSError):  # that it is gone is noticed where its answers are read
            self._connection.send(message)

    def _hear(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                message = self._connection.recv()
                if isinstance(message, Progress):
                    self.progress = message
                    continue
                number, good, value = message
                future = self._pending.pop(number, None)
                if future is not None and good:
                    future.set_result(value)
                elif future is not None:
                    future.set_exception(value)
        self._gone.set()
        self._child.wait(5.0)
        with self._sending:
            pending = list(self._pending.values())
            self._pending.clear()
            self._connection.close()
        for future in pending:
            future.set_exception(TroubleError("lost", self._obituary("a request")))

    def _obituary(self, method: str) -> str:
        return f"the arm's worker died during {method} (status {self._child.status}); connect again"

    def _errors(self) -> str:
        kept = self._child.errors_kept
        return f" (it said: {kept})" if kept else ""
