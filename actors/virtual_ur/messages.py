"""What a controller tells people and the clients of its primary interface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Message:
    """One message.

    Attributes:
        kind: 'text' (a program's), 'key' (the controller's), 'exception' (a program can't go on), 'safety', 'popup'.
        text: what it says.
        line: of the program, for an exception.
        time: of the controller [s].
    """

    kind: str
    text: str
    line: int = 0
    time: float = 0.0


Listener = Callable[[Message], None]
