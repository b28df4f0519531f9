"""A plain, blocking object (an arm, a balance, an optimiser) used from the event loop.

- `LocalDevice` runs the object's methods in threads of this process, `RayDevice` in a Ray actor.
- Urgent calls do not wait for the running call: this is how a moving arm is stopped.
- `actor_class`, `kill_actor` and `mark_retrieved` are for all who use Ray actors.

Lost devices are not restarted by themselves: the caller does that with `revive`.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import re
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Protocol

from actors.interfaces import BenchLostError, LaboratoryError
from actors.runtime.child_process import START_DEADLINE, last_lines

if TYPE_CHECKING:
    from actors.runtime.ray_cluster import PinnedNode


@functools.cache
def actor_class(cls: Hashable, groups: tuple[tuple[str, int], ...]) -> Any:
    """Make a Ray actor class whose actors and calls Ray does not retry.

    Each class is made only once, because Ray keeps every class for the life of the program.

    Args:
        cls: a class that workers can import.
        groups: concurrency groups: name and number of threads.

    Returns:
        The actor class; `.options(…).remote(…)` creates an actor.
    """
    import ray

    return ray.remote(max_restarts=0, max_task_retries=0, concurrency_groups=dict(groups))(cls)


def kill_actor(actor: Any) -> None:
    """End an actor's process at once. May be called again, and after Ray has ended."""
    import ray

    with contextlib.suppress(Exception):
        ray.kill(actor)


def mark_retrieved(reply: asyncio.Future[Any]) -> None:
    """Mark a result as retrieved: if the caller was cancelled or gave up, asyncio does not log a late error."""
    if not reply.cancelled():
        reply.exception()


LOOK_INTERVAL = 20.0
"""Time between two checks, during a long call, whether the process is still alive [s]."""

LOOK_DEADLINE = 60.0
"""A process that has replied before counts as lost if it does not reply for this time [s]."""


class DeviceLostError(LaboratoryError):
    """The device's process died during a call, or does not reply. It is unknown how far the call got."""


class MachineLostError(DeviceLostError, BenchLostError):
    """The device's machine is lost, so a new process cannot replace the old one."""


class Device(Protocol):
    """Calls an object's methods by name, one after another."""

    @property
    def name(self) -> str:
        """The name used in messages."""
        ...

    async def call(self, method: str, *args: Any, deadline: float, urgent: bool = False) -> Any:
        """Call a method and await its result.

        Args:
            method: name of the object's method.
            args: its arguments; they must be serializable.
            deadline: longest wait [s], counted from the start of the device's process.
            urgent: do not queue behind other calls.

        Raises:
            DeviceLostError: the process died, or the deadline passed.
            MachineLostError: the process's machine, or Ray, is lost.
            LaboratoryError: raised by the method itself.
        """
        ...

    async def revive(self) -> bool:
        """Replace a lost object by a new one. Returns whether this was necessary.

        Raises:
            MachineLostError: the machine on which it has to run is lost.
        """
        ...

    async def close(self) -> None:
        """End the object."""
        ...


class LocalDevice:
    """The object lives in this process; its calls run in threads. Replaces `RayDevice` in tests."""

    def __init__(self, name: str, make: Callable[[], Any]) -> None:
        self.name = name
        self._object = make()
        self._work = ThreadPoolExecutor(1, thread_name_prefix=name)
        self._control = ThreadPoolExecutor(2, thread_name_prefix=f"{name}-control")

    async def call(self, method: str, *args: Any, deadline: float, urgent: bool = False) -> Any:
        """See `Device.call`."""
        executor = self._control if urgent else self._work
        future = asyncio.wrap_future(executor.submit(getattr(self._object, method), *args))
        future.add_done_callback(mark_retrieved)
        done, _ = await asyncio.wait({future}, timeout=deadline)
        if not done:
            raise DeviceLostError(f"{self.name}: no answer to '{method}' within {deadline:g} s")
        return future.result()

    async def revive(self) -> bool:
        """Return False: the object cannot be lost without the whole process."""
        return False

    async def close(self) -> None:
        """See `Device.close`."""
        for executor in (self._work, self._control):
            executor.shutdown(wait=False, cancel_futures=True)


class RayDevice:
    """The object lives in a Ray actor with one thread for work and two for urgent calls. Ray never restarts it.

    Args:
        name: the name used in messages.
        cls: the object's class; workers must be able to import it.
        args: arguments of its constructor.
        node: the node of a cluster on which it must run.
        looked_after: while a call waits, check from time to time whether the process responds; if not, give up before
            the deadline. For objects that usually reply within seconds, but sometimes need minutes.
    """

    def __init__(
        self, name: str, cls: type[Any], *args: Any, node: PinnedNode | None = None, looked_after: bool = False
    ) -> None:
        self.name, self._looked_after = name, looked_after
        self._class: Any = cls
        self._args, self._node = args, node
        self._actor: Any = None
        self._lost = self._met = False
        self._abandoned = ""
        self._calls: set[asyncio.Future[Any]] = set()
        self._start()

    def _start(self) -> None:
        placement = {} if self._node is None else self._node.options
        remote_class = actor_class(self._class, (("work", 1), ("control", 2)))
        self._actor = remote_class.options(num_cpus=0, **placement).remote(*self._args)
        self._lost = self._met = False

    async def call(self, method: str, *args: Any, deadline: float, urgent: bool = False) -> Any:
        """See `Device.call`."""
        import ray

        self._check_ray()
        if self._lost:
            raise DeviceLostError(f"{self.name}: its process has died")
        group = "control" if urgent else "work"
        ref = getattr(self._actor, method).options(concurrency_group=group).remote(*args)
        future = asyncio.wrap_future(ref.future())
        future.add_done_callback(mark_retrieved)
        self._calls.add(future)
        future.add_done_callback(self._calls.discard)
        waited = await self._waited(future, deadline)
        if not future.done() or future.cancelled():
            self._check_ray()
            # It may be blocked for ever; a new one is created before the next pour.
            self._lost = True
            kill_actor(self._actor)
            await self._check_machine(method)
            raise DeviceLostError(f"{self.name}: no answer to '{method}' within {waited:.3g} s")
        try:
            return future.result()
        except ray.exceptions.RayActorError as error:
            self._lost = True
            await self._check_machine(method)
            if error.actor_init_failed:  # its text is a traceback, whose end has our errors as 'module.Error: why'
                reason = re.sub(r"^[\w.]+\.\w+Error: ", "", last_lines(str(error), 1))
                raise DeviceLostError(f"{self.name}: did not start: {reason}") from error
            raise DeviceLostError(f"{self.name}: its process died during '{method}'") from error
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, LaboratoryError | ValueError):
                raise error.cause from None
            raise LaboratoryError(f"{self.name}: '{method}' failed: {error.cause!r}") from error

    async def _waited(self, future: asyncio.Future[Any], deadline: float) -> float:
        """Wait until a reply has arrived or cannot be expected any more. Returns the time that this took [s].

        The deadline begins when the process has started; its start has a separate deadline. A busy machine may need
        more time for the start than a driver may take to reply.
        """
        clock = asyncio.get_running_loop().time
        started = clock()
        if not self._met and not await self._answers(future, START_DEADLINE):
            return clock() - started
        self._met = True
        begin = clock()
        while not future.done() and (left := begin + deadline - clock()) > 0.0:
            await asyncio.wait({future}, timeout=min(left, LOOK_INTERVAL) if self._looked_after else left)
            if future.done() or not self._looked_after or clock() - begin >= deadline:
                break
            if not await self._answers(future, LOOK_DEADLINE):
                break
        return clock() - started

    async def _answers(self, future: asyncio.Future[Any], timeout: float) -> bool:
        """Whether the process replies to any call, including the pending one, within a time [s]."""
        look = asyncio.wrap_future(self._actor.__ray_call__.remote(_pid).future())
        look.add_done_callback(mark_retrieved)
        done, _ = await asyncio.wait({future, look}, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
        return bool(done)

    def abandon(self, reason: str) -> None:
        """Fail all pending and future calls, because Ray itself is lost.

        Args:
            reason: the lost part, for messages.
        """
        self._abandoned = self._abandoned or reason
        for call in self._calls:
            call.cancel()

    def _check_ray(self) -> None:
        if self._abandoned:
            raise MachineLostError(f"{self.name}: {self._abandoned}")

    async def _check_machine(self, method: str) -> None:
        self._check_ray()
        if self._node is not None and await self._node.is_gone():
            raise MachineLostError(f"{self.name}: its machine {self._node.node.host} was lost during '{method}'")

    async def revive(self) -> bool:
        """See `Device.revive`."""
        if not self._lost:
            return False
        await self._check_machine("revive")
        self._start()
        return True

    async def pid(self) -> int:
        """Process id of the actor.

        Raises:
            DeviceLostError: it has died.
        """
        import ray

        try:
            pid: int = await asyncio.wrap_future(self._actor.__ray_call__.remote(_pid).future())
        except ray.exceptions.RayActorError as error:
            self._lost = True
            raise DeviceLostError(f"{self.name}: its process has died") from error
        return pid

    async def close(self) -> None:
        """See `Device.close`."""
        self._lost = True
        kill_actor(self._actor)


def _pid(_: Any) -> int:
    import os

    return os.getpid()
