"""One line of what `decant doctor` says about a thing of the laboratory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class Check:
    """One line of the table.

    Attributes:
        name: what was looked at.
        state: 'warn' lets pours be made, 'fail' doesn't.
        found: what was found.
        advice: what to do about it; '' where nothing is to be done.
    """

    name: str
    state: State
    found: str
    advice: str = ""
