"""Inputs that a client has to write often enough, or its program is paused or stopped."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class _Watch:
    longest: float
    action: str
    waited: float = 0.0


class Watchdogs:
    """All that a program has set up. They watch a network, so they go by wall time, however time is scaled."""

    def __init__(self) -> None:
        self._watches: dict[str, _Watch] = {}

    def set(self, name: str, longest: float, action: str) -> None:
        """Watch an input.

        Args:
            name: of the input.
            longest: between two writes [s of wall time].
            action: 'pause' or 'stop'.
        """
        self._watches[name] = _Watch(longest, action)

    def remove(self, name: str) -> None:
        """Watch it no more."""
        self._watches.pop(name, None)

    def clear(self) -> None:
        """Watch nothing."""
        self._watches.clear()

    def written(self, name: str) -> None:
        """A client wrote this input."""
        watch = self._watches.get(name)
        if watch is not None:
            watch.waited = 0.0

    def step(self, wall: float) -> tuple[str, str] | None:
        """Let wall time pass [s]. Returns the action that is due, and why; None if none is."""
        for name, watch in self._watches.items():
            watch.waited += wall
            if watch.waited > watch.longest:
                watch.waited = 0.0
                return watch.action, f"watchdog: {name} was not written for {watch.longest:g} s"
        return None
