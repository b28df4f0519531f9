"""Whether the numbers of an outcome are numbers: what enters a surrogate once stays in all it says."""

from __future__ import annotations

import math

from sim_engine.outcome import Fractions


def is_sound(fractions: Fractions) -> bool:
    """No fraction is NaN or infinite, as those of a simulation that diverged or of a balance that lost its mind."""
    return all(math.isfinite(value) for value in (fractions.poured, fractions.spilled, fractions.retained))
