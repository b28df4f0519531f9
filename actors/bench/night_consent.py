"""Consent for a night: one answer for many pours, until something happens that needs a person.

`NightConsent` answers the questions for a motion in place of the operator while it is in force. It ends after the
agreed number of pours, at the agreed time, with any other question, and with any error; it never renews itself. It is
not stored: a restarted program asks for a new one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from typing import Literal

from actors.interfaces import Notice, OperatorQuestion
from actors.places import CellVessel, PlaceSettings, UnattendedSettings

MOTIONS = ("start", "move")
"""Questions for a motion that a consent for a night answers."""


class NightConsent:
    """The consent of one run.

    Args:
        spec: what the campaign asks for.
        safeguard: of the laboratory, as its file states it.
        arm: name of the arm.
        places: between which vessels are carried.
        tell: receives notices.
        now: the local time.
        vessels: of the campaign's doses; empty for pours of a pourer and a receiver.
        elapsed: seconds that no change of the clock affects. A clock that is set back does not lengthen the consent.
    """

    def __init__(
        self,
        spec: UnattendedSettings,
        safeguard: str,
        arm: str,
        places: Sequence[PlaceSettings],
        tell: Callable[[Notice], None],
        now: Callable[[], datetime] = datetime.now,
        elapsed: Callable[[], float] = time.monotonic,
        vessels: Sequence[CellVessel] = (),
    ) -> None:
        self._spec, self._safeguard, self._arm, self._places = spec, safeguard, arm, places
        self._tell, self._now, self._elapsed = tell, now, elapsed
        self._vessels = vessels
        self._left, self._end_elapsed = 0, 0.0
        self._until: datetime | None = None
        self.asked = False
        """Whether it was asked for; it is asked for once."""

    @property
    def in_force(self) -> bool:
        """Whether motions are agreed to now."""
        return self._until is not None

    def question(self) -> OperatorQuestion:
        """Ask for the consent, with everything that may move."""
        self.asked = True
        names = ", ".join(f"'{place.name}'" for place in self._places)
        moves = f"pours over the balance, pouring back, and carrying pourer and receiver between {names}"
        if self._vessels:
            sources = ", ".join(f"{vessel.name} ({vessel.liquid})" for vessel in self._vessels if vessel.liquid)
            cups = ", ".join(vessel.name for vessel in self._vessels if not vessel.liquid)
            moves = f"doses over the balance from the sources {sources}, into the cups {cups}, and carrying them"
            waste = [place.name for place in self._places if place.container is not None]
            moves += f", also to empty cups at {', '.join(waste)}" if waste else ""
        return OperatorQuestion(
            f"Unattended: up to {self._spec.pours} pours until {self._spec.until}, with nobody in the cell. The arm "
            f"({self._arm}) and its gripper will move without further questions: {moves}. Safeguard: "
            f"{self._safeguard}. Is it in force, is the cell empty, and do you agree? Any stop, failed grasp, open "
            "mass or question ends this consent.",
            "yes or no",
            about="unattended",
            hands=False,
            details={"pours": float(self._spec.pours), "until": self._spec.until, "safeguard": self._safeguard},
        )

    def answered(self, answer: str) -> None:
        """Take the operator's answer to `question`."""
        if answer.strip().lower() not in ("yes", "y"):
            self._tell(Notice("info", "unattended: refused; every motion is asked for"))
            return
        now = self._now()
        hour, minute = map(int, self._spec.until.split(":"))
        until = now.replace(hour=hour, minute=minute, second=0, microsecond=0)
        self._until = until if until > now else until + timedelta(days=1)
        self._end_elapsed = self._elapsed() + (self._until - now).total_seconds()
        self._left = self._spec.pours
        text = f"unattended: agreed, up to {self._left} pours until {self._until:%Y-%m-%d %H:%M}"
        self._tell(Notice("info", text, about="consent"))

    def agrees(self, question: OperatorQuestion) -> bool:
        """Whether a question is answered with yes by this consent. Any other question ends it."""
        if self._until is None:
            return False
        if question.about not in MOTIONS:
            self.end(f"a question: {question.problem or question.text}")
        elif self._now() >= self._until or self._elapsed() >= self._end_elapsed:
            self.end(f"it is {self._spec.until}", about="end")
        elif question.about == "start" and self._left == 0:
            self.end(f"{self._spec.pours} pours were made", about="end")
        else:
            self._left -= question.about == "start"
            return True
        return False

    def end(self, reason: str, about: Literal["end", "fault"] = "fault") -> None:
        """End it, as agreed or because of a fault; nothing if it is not in force."""
        if self._until is not None:
            self._until = None
            self._tell(Notice("warning", f"unattended: the consent has ended. {reason}", about=about))
