"""Stops that were asked for, from any thread, and whether the arm was seen to stand."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from actors.arm.ur.messages import Outcome


@dataclass(frozen=True)
class StopTimes:
    """How soon a stop took effect, from the call on.

    Attributes:
        answered: until the program was seen to have taken the order [s]; None if other means stopped it.
        standing: until the arm was seen to stand [s].
    """

    answered: float | None
    standing: float


class Stops:
    """Shared by the thread that moves the arm and those that stop it.

    Attributes:
        count: of stops so far.
        unseen: the last motion ended without the arm being seen to stand.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._under_way = False
        self._outcome: Outcome | None = None
        self.count = 0
        self.unseen = False

    # ---- who moves

    def begin(self) -> None:
        """A motion begins."""
        with self._changed:
            self._under_way, self._outcome, self.unseen = True, None, False

    def came_to(self, outcome: Outcome) -> None:
        """What the motion came to."""
        with self._changed:
            self._outcome = outcome
            self.unseen = outcome.moved and outcome.standing is None

    def lost(self) -> None:
        """Nobody knows what the motion came to."""
        self.unseen = True

    def end(self) -> None:
        """The motion is over."""
        with self._changed:
            self._under_way = False
            self._changed.notify_all()

    def wait_for_one(self, since: int, seconds: float) -> bool:
        """Wait, unless another stop is asked for. Returns whether one was."""
        with self._changed:
            return self._changed.wait_for(lambda: self.count != since, max(seconds, 0.0))

    # ---- who stops

    @property
    def under_way(self) -> bool:
        """A motion is under way, or announced."""
        return self._under_way

    def ask(self) -> int:
        """A stop is asked for. Returns how many that makes."""
        with self._changed:
            self.count += 1
            self._changed.notify_all()
            return self.count

    def wait_for_end(self, seconds: float) -> bool:
        """Wait for the motion to be over. Returns whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._under_way, seconds)

    def times(self, asked: float) -> StopTimes | None:
        """How soon the last motion ended after a moment [s of `time.monotonic`]; None if nothing had moved."""
        outcome = self._outcome
        if outcome is None or outcome.standing is None:
            return None
        answered = None if outcome.answered is None else max(0.0, outcome.answered - asked)
        return StopTimes(answered, max(0.0, outcome.standing - asked))
