"""A plain, blocking object (an arm, a balance, an optimiser) reached from the event loop: in a thread or in a process.

Calls named urgent don't queue behind the one that is running: that is how a moving arm is stopped.

Classes as Ray's actors, each made once: Ray remembers every class that it is given for as long as a program runs.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

from actors.interfaces import BenchLostError, LaboratoryError
from actors.runtime.cluster_nodes import PinnedNode


@functools.cache
def actor_class(cls: Hashable, groups: tuple[tuple[str, int], ...]) -> Any:
    """A class whose objects are actors that Ray neither restarts nor asks twice.

    Args:
        cls: a class that workers can import.
        groups: concurrency groups: name and number of threads.

    Returns:
        What `.options(…).remote(…)` makes actors of.
    """
    import ray

    return ray.remote(max_restarts=0, max_task_retries=0, concurrency_groups=dict(groups))(cls)


LOOK_INTERVAL = 20.0
"""Between looks whether a process that is asked something long is there at all [s]."""

LOOK_DEADLINE = 60.0
"""A process that was there once, and says nothing for so long, is lost [s]."""

START_DEADLINE = 120.0
"""Longest time for a process to start [s]: machines may be busy. Deadlines of calls begin after it."""


class DeviceLostError(LaboratoryError):
    """The device's process died during a call, or doesn't answer: nobody knows how far the call came."""


class MachineLostError(DeviceLostError, BenchLostError):
    """The device's machine is gone, so a new process won't do."""


class Device(Protocol):
    """Calls an object's methods by name, one after the other."""

    @property
    def name(self) -> str:
        """What people call it."""
        ...

    async def call(self, method: str, *args: Any, deadline: float, urgent: bool = False) -> Any:
        """Call a method and await its answer.

        Args:
            method: name of the object's method.
            args: its arguments, values that travel.
            deadline: longest time to wait [s], from the start of its process on.
            urgent: don't queue behind other calls.

        Raises:
            DeviceLostError: its process died, or the deadline passed; MachineLostError: with its machine, or with Ray.
            LaboratoryError: whatever of this kind the method raises.
        """
        ...

    async def revive(self) -> bool:
        """Make a new object in place of a lost one. Returns whether that was needed.

        Raises:
            MachineLostError: where it has to run there is no machine.
        """
        ...

    async def close(self) -> None:
        """End it."""
        ...


class LocalDevice:
    """The object lives in this process; its calls run in threads. The twin of `RayDevice` for tests."""

    def __init__(self, name: str, make: Callable[[], Any]) -> None:
        self.name = name
        self._object = make()
        self._work = ThreadPoolExecutor(1, thread_name_prefix=name)
        self._control = ThreadPoolExecutor(2, thread_name_prefix=f"{name}-control")

    async def call(self, method: str, *args: Any, deadline: float, urgent: bool = False) -> Any:
        """See `Device.call`."""
        executor = self._control if urgent else self._work
        future = asyncio.wrap_future(executor.submit(getattr(self._object, method), *args))
        future.add_done_callback(_seen)
        done, _ = await asyncio.wait({future}, timeout=deadline)
        if not done:
            raise DeviceLostError(f"{self.name}: no answer to '{method}' within {deadline:g} s")
        return future.result()

    async def revive(self) -> bool:
        """Nothing can be lost without the whole process."""
        return False

    async def close(self) -> None:
        """See `Device.close`."""
        for executor in (self._work, self._control):
            executor.shutdown(wait=False, cancel_futures=True)


class RayDevice:
    """The object lives in a Ray actor: one thread for work, two for urgent calls. It is never restarted by Ray.

    Args:
        name: what people call it.
        cls: the object's class, importable by workers.
        args: arguments of its constructor.
        node: the node of a cluster that it must run on.
        looked_after: while a call waits, look now and then whether the process is there at all, and give up sooner than
            at the deadline if not. For objects whose answers take minutes now and then, and seconds as a rule.
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
        made = actor_class(self._class, (("work", 1), ("control", 2)))
        self._actor = made.options(num_cpus=0, **placement).remote(*self._args)
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
        future.add_done_callback(_seen)
        self._calls.add(future)
        future.add_done_callback(self._calls.discard)
        waited = await self._waited(future, deadline)
        if not future.done() or future.cancelled():
            self._check_ray()
            # It may hang for good; a new one is made before the next pour.
            self._lost = True
            with contextlib.suppress(Exception):
                ray.kill(self._actor)
            await self._check_machine(method)
            raise DeviceLostError(f"{self.name}: no answer to '{method}' within {waited:.3g} s")
        try:
            return future.result()
        except ray.exceptions.RayActorError as error:
            self._lost = True
            await self._check_machine(method)
            raise DeviceLostError(f"{self.name}: its process died during '{method}'") from error
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, LaboratoryError | ValueError):
                raise error.cause from None
            raise LaboratoryError(f"{self.name}: '{method}' failed: {error.cause!r}") from error

    async def _waited(self, future: asyncio.Future[Any], deadline: float) -> float:
        """Wait for an answer until it is there, or not to be hoped for; how long that took [s].

        The deadline begins when the process is there: its start has a deadline of its own. A busy machine needs more
        time for it than a driver may take to answer.
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

    async def _answers(self, future: asyncio.Future[Any], patience: float) -> bool:
        """Whether the process answers anything within a time [s], be it the call that is waited for."""
        look = asyncio.wrap_future(self._actor.__ray_call__.remote(_pid).future())
        look.add_done_callback(_seen)
        done, _ = await asyncio.wait({future, look}, timeout=patience, return_when=asyncio.FIRST_COMPLETED)
        return bool(done)

    def abandon(self, reason: str) -> None:
        """Whoever waits for an answer, or will ask, is told that none comes: Ray itself is gone.

        Args:
            reason: what has died, in words for people.
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
        import ray

        self._lost = True
        with contextlib.suppress(Exception):
            ray.kill(self._actor)


def _seen(answer: asyncio.Future[Any]) -> None:
    """Who asked may have been cancelled since, or have given up waiting: an error is then nobody's news."""
    if not answer.cancelled():
        answer.exception()


def _pid(_: Any) -> int:
    import os

    return os.getpid()
