"""How far a strategy is: pours and simulations apart, for one takes a hundred times as long as the other."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """Requests that count.

    Attributes:
        simulations, of_simulations: answered, and in all.
        pours, of_pours: made, and in all.
    """

    simulations: int = 0
    of_simulations: int = 0
    pours: int = 0
    of_pours: int = 0

    @property
    def simulations_left(self) -> int:
        """Simulations that are still to be answered."""
        return max(self.of_simulations - self.simulations, 0)

    @property
    def pours_left(self) -> int:
        """Pours that are still to be made."""
        return max(self.of_pours - self.pours, 0)

    @property
    def done(self) -> int:
        """Requests answered, of either kind, for bars."""
        return self.simulations + self.pours

    @property
    def total(self) -> int:
        """Requests in all, of either kind, for bars."""
        return self.of_simulations + self.of_pours

    def __add__(self, other: Progress) -> Progress:
        return Progress(
            self.simulations + other.simulations,
            self.of_simulations + other.of_simulations,
            self.pours + other.pours,
            self.of_pours + other.of_pours,
        )

    def __str__(self) -> str:
        """'3/6 pours · 20/40 simulations', without what there is none of."""
        parts = []
        if self.of_pours:
            parts.append(f"{self.pours}/{self.of_pours} pours")
        if self.of_simulations:
            parts.append(f"{self.simulations}/{self.of_simulations} simulations")
        return " · ".join(parts)
