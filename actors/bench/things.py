"""What stands where on a virtual bench, and what is in it: what its balance carries follows from that. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field

from actors.balance.placement import Placement

POURER, RECEIVER, TRAY = 0.312, 0.186, 0.428
"""Dry masses [kg]: of glass beakers and a steel tray, so that nothing cancels by chance."""


@dataclass
class Things:
    """Pourer, receiver and tray around a balance.

    Attributes:
        placement: where the balance stands.
        on_balance: what of 'pourer', 'receiver', 'tray' stands on it.
        in_pourer, in_receiver, on_tray: liquid [kg].
    """

    placement: Placement
    on_balance: set[str] = field(default_factory=set)
    in_pourer: float = 0.0
    in_receiver: float = 0.0
    on_tray: float = 0.0

    def mass(self, name: str) -> float:
        """Mass of a thing with what is in it [kg]."""
        dry = {"dry pourer": POURER, "pourer": POURER, "receiver": RECEIVER, "tray": TRAY}[name]
        return dry + {"pourer": self.in_pourer, "receiver": self.in_receiver, "tray": self.on_tray}.get(name, 0.0)

    @property
    def carried(self) -> float:
        """By the balance [kg]."""
        return sum(self.mass(name) for name in self.on_balance)

    def receive(self, spilled: float, retained: float) -> None:
        """A pour is over, or was broken off.

        Args:
            spilled: beside the receiver [kg].
            retained: still in the pourer [kg].
        """
        self.in_receiver += self.in_pourer - spilled - retained
        self.on_tray += spilled
        self.in_pourer = retained

    def do(self, about: str, fill: float) -> None:
        """What a question of a pour's weighings asks for; anything else changes nothing.

        Args:
            about: of the question, see `actors.balance.placement`.
            fill: what the pourer is filled with, if it is to be filled [kg].
        """
        under = {"tray"} if self.placement in (Placement.TRAY, Placement.EVERYTHING) else set()
        alone = self.placement in (Placement.TRAY, Placement.TARED)
        match about:
            case "tray_wiped":
                self.on_tray, self.on_balance = 0.0, under
            case "dry_pourer" | "dry_pourer_after":
                self.on_balance = {"dry pourer"}
            case "cleared" | "cleared_after":
                self.on_balance = set()
            case "pourer_empty":
                self.in_pourer, self.on_balance = 0.0, under | {"pourer"}
            case "pourer_full":
                self.in_pourer, self.on_balance = fill, under | {"pourer"}
            case "receiver_empty":
                self.in_receiver, self.on_balance = 0.0, under | {"receiver"}
            case "set_up":
                self.in_receiver, self.on_tray = 0.0, 0.0
                self.on_balance = {"tray"} if alone else under | {"receiver"}
            case "tray_before":
                self.in_receiver, self.on_tray = 0.0, 0.0
            case "receiver_gone":
                self.on_balance = under
            case "pourer_after":
                self.on_balance = under | {"pourer"}

    def typed(self, about: str, step: float) -> str:
        """What somebody reads off another scale and types.

        Args:
            about: a weighing's key.
            step: of that scale [kg].
        """
        mass = self.mass(about.partition("_")[0])
        return f"{1e3 * round(mass / step) * step:.1f} g"
