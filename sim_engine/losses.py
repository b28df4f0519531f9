"""What is minimised, written down once.

Calibration compares the normalised spillage r = spilled / poured, which is undefined below 5 % poured.
Deployment minimises, by default, (spilled + w·retained) / loaded, so that not pouring is not a solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sim_engine.outcome import Fractions

MINIMUM_POURED = 0.05
"""Smallest poured fraction at which r = spilled / poured is defined."""

LossName = Literal["spilled_and_retained", "normalised", "grams", "particles"]


def normalised_spillage(fractions: Fractions) -> float | None:
    """The paper's c = C / k: spilled over poured; None (undefined) below `MINIMUM_POURED`.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.1.
    """
    if fractions.poured < MINIMUM_POURED:
        return None
    return fractions.spilled / fractions.poured


@dataclass(frozen=True)
class Loss:
    """A deployment loss.

    Attributes:
        name: `spilled_and_retained` is Decant's default, (spilled + w·retained) / loaded. The paper's own:
            `normalised` (spilled / poured), `grams` (spilled mass), `particles` (number spilled).
        retained_weight: w of the default loss.
    """

    name: LossName = "spilled_and_retained"
    retained_weight: float = 1.0

    def __call__(self, fractions: Fractions, *, loaded_mass: float, particles: int) -> float | None:
        """Loss of a pour, to be minimised; None where it is undefined.

        Args:
            fractions: what came of the pour.
            loaded_mass: [kg], for `grams`.
            particles: number of particles that a simulation of it has (for a real pour: that the simulator would
                have), for `particles`.
        """
        match self.name:
            case "spilled_and_retained":
                return fractions.spilled + self.retained_weight * fractions.retained
            case "normalised":
                return normalised_spillage(fractions)
            case "grams":
                return fractions.spilled * loaded_mass * 1e3
            case "particles":
                return fractions.spilled * particles
