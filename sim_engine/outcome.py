"""What came of a pour, simulated or weighed: plain values."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any


class ParticleState(IntEnum):
    """Where a particle is. Those from SPILLED on have left the solver for good."""

    IN_POURER = 0
    IN_FLIGHT = 1
    RECEIVED = 2
    SPILLED = 3
    ESCAPED = 4


ESCAPED_LIMIT = 0.002
"""Largest escaped fraction of a valid simulation: above it the solver has leaked, and nothing it says counts."""


@dataclass(frozen=True)
class Fractions:
    """Where the liquid is at the end, as fractions of the load.

    Attributes:
        poured: left the pourer (received + spilled + still in flight).
        spilled: ended in neither vessel.
        retained: stayed in the pourer.
    """

    poured: float
    spilled: float
    retained: float


@dataclass(frozen=True)
class PourOutcome:
    """Result of one simulated pour. Fractions of the particles; they add up to 1.

    Attributes:
        received: inside the receiver.
        spilled: in neither vessel and past any chance to get there.
        retained: inside the pourer.
        in_flight: still falling when the simulated time was over.
        escaped: crossed solid vessel wall in a step; more than `ESCAPED_LIMIT` makes the outcome invalid.
        particles: number of particles.
        spacing: d = (V/N)^(1/3) [m].
        density_error: mean over the pour of the interior particles' relative compression, max(ρ/ρ₀ − 1, 0).
        simulated_time: [s].
        steps: time steps.
        cpu_s: CPU seconds of the solver (kernels compiled).
        seed: of the initial positions.
        curve_times: of the outflow curve [s].
        curve_poured: fraction that has left the pourer at those times.
        curve_spilled: fraction spilled at those times.
        invalid: why the outcome must not be used; None for a valid one.
    """

    received: float
    spilled: float
    retained: float
    in_flight: float
    escaped: float
    particles: int
    spacing: float
    density_error: float
    simulated_time: float
    steps: int
    cpu_s: float
    seed: int
    curve_times: tuple[float, ...] = ()
    curve_poured: tuple[float, ...] = ()
    curve_spilled: tuple[float, ...] = ()
    invalid: str | None = None

    @property
    def fractions(self) -> Fractions:
        """Poured, spilled, retained as fractions of the load."""
        return Fractions(self.received + self.spilled + self.in_flight, self.spilled, self.retained)

    def as_json(self) -> dict[str, Any]:
        """JSON-ready mapping; lengths in millimetres as people read them."""
        return {
            "received": self.received,
            "spilled": self.spilled,
            "retained": self.retained,
            "in_flight": self.in_flight,
            "escaped": self.escaped,
            "particles": self.particles,
            "spacing_mm": self.spacing * 1e3,
            "density_error": self.density_error,
            "simulated_time_s": self.simulated_time,
            "steps": self.steps,
            "cpu_s": self.cpu_s,
            "seed": self.seed,
            "curve": {
                "time_s": list(self.curve_times),
                "poured": list(self.curve_poured),
                "spilled": list(self.curve_spilled),
            },
            "invalid": self.invalid,
        }


@dataclass(frozen=True)
class PourMeasurement:
    """Result of one real (or virtual-bench) pour, as weighed.

    Attributes:
        loaded: mass in the pourer before [kg].
        spilled: mass beside the receiver [kg].
        retained: mass left in the pourer after [kg].
        notes: what the bench has to say about it (tare, settling time, drift …), JSON-ready.
    """

    loaded: float
    spilled: float
    retained: float
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def delivered(self) -> float:
        """Mass that must be in the receiver: what is neither left in the pourer nor beside the receiver [kg]."""
        return max(self.loaded - self.retained - self.spilled, 0.0)

    @property
    def fractions(self) -> Fractions:
        """Poured, spilled, retained as fractions of the load."""
        return Fractions(1.0 - self.retained / self.loaded, self.spilled / self.loaded, self.retained / self.loaded)
