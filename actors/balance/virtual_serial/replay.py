"""A recording at the far end of a line: each question gets the answer that it got then."""

from __future__ import annotations

from typing import Any

from actors.balance.recording import Event, Recording


class Replay:
    """See `character.Character`.

    What came before the first question comes by itself. A question is looked for among those recorded, from where the
    last one was found, once around; then follows what followed it then, at its pace. A question that was never asked
    gets no answer.

    Args:
        recording: to play.
        speed: so much faster than it was.
    """

    def __init__(self, recording: Recording, speed: float = 1.0) -> None:
        self._events, self._speed = recording.events, speed
        self._at = 0
        self._heard = b""
        self._queue: list[tuple[float, bytes]] = []
        self._begun = False

    def hear(self, data: bytes, now: float) -> None:
        """See `Character.hear`."""
        self._begin(now)
        self._heard += data
        while (found := self._find()) is not None:
            self._heard = self._heard[len(self._events[found].data) :]
            self._at = found + 1
            self._play(found, now)
        longest = max((len(e.data) for e in self._events if e.direction == "out"), default=0)
        if len(self._heard) >= longest:
            self._heard = b""

    def speak(self, now: float) -> bytes:
        """See `Character.speak`."""
        self._begin(now)
        ready = b"".join(data for at, data in self._queue if at <= now)
        self._queue = [(at, data) for at, data in self._queue if at > now]
        return ready

    def due(self, now: float) -> float | None:
        """See `Character.due`."""
        return min((at for at, _ in self._queue), default=None if self._begun else now)

    def control(self, order: dict[str, Any], now: float) -> dict[str, Any]:
        """See `Character.control`: a recording takes no orders but to tell where it is."""
        if order.get("do") == "state":
            return {"played": self._at, "of": len(self._events)}
        raise ValueError(f"a recording can't do {order.get('do')!r}")

    def _begin(self, now: float) -> None:
        if not self._begun:
            self._begun = True
            self._play(-1, now)

    def _find(self) -> int | None:
        """The next recorded question that was just heard."""
        count = len(self._events)
        for step in range(count):
            index = (self._at + step) % count
            event = self._events[index]
            if event.direction == "out" and event.data and self._heard.startswith(event.data):
                return index
        return None

    def _play(self, question: int, now: float) -> None:
        """Queue what came after a question until the next one."""
        start = self._events[question].time if question >= 0 else 0.0
        following: list[Event] = []
        for event in self._events[question + 1 :]:
            if event.direction == "out":
                break
            following.append(event)
        self._queue = [(now + (event.time - start) / self._speed, event.data) for event in following]
