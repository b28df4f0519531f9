"""Outcomes of pours, simulated or weighed, and the deployment loss. Plain values.

- `PourOutcome` and `SimulatedPour` are simulated; `SimulatedPour` also holds particles at some times if requested
  (`RecordedFrames`).
- `PourMeasurement` is weighed.
- `Fractions.spillage` and `Loss` are the quantities that are compared and minimised.

Names: `poured`, `spilled` and `retained` are fractions of the load; masses end in `_g`, or are in kg in a
`PourMeasurement`. The spillage r = spilled / poured is what calibration compares; it is undefined below 5 % poured.
Deployment minimises, by default, (spilled + w·retained) / loaded, so that not pouring is not a solution.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from sim_engine.settings.model import WRITTEN_IF_SET, Problems, Settings
from sim_engine.settings.quantity import Quantity


class ParticleState(IntEnum):
    """Place of a particle. Particles from SPILLED on have left the solver for good."""

    IN_POURER = 0
    IN_FLIGHT = 1
    RECEIVED = 2
    SPILLED = 3
    ESCAPED = 4


ESCAPED_LIMIT = 0.002
"""Largest escaped fraction of a valid simulation: above it the solver has leaked, and its results are invalid."""


MINIMUM_POURED = 0.05
"""Smallest poured fraction at which r = spilled / poured is defined."""


@dataclass(frozen=True)
class Fractions:
    """Final places of the liquid, as fractions of the load.

    Attributes:
        poured: left the pourer (received + spilled + still in flight).
        spilled: ended in neither vessel.
        retained: stayed in the pourer.
    """

    poured: float
    spilled: float
    retained: float

    @property
    def spillage(self) -> float | None:
        """The paper's c = C / k: spilled over poured; None (undefined) below `MINIMUM_POURED`.

        Source: Lopez-Guevara et al., CoRL 2017, section 3.1.
        """
        return None if self.poured < MINIMUM_POURED else self.spilled / self.poured


@dataclass(frozen=True)
class PourOutcome:
    """Result of one simulated pour. Fractions of the particles; they add up to 1.

    Attributes:
        received: inside the receiver.
        spilled: in neither vessel and unable to reach one.
        retained: inside the pourer.
        in_flight: still falling at the end of the simulated time.
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
        dribbled: ran down the outside of the pourer (`sim_engine.dribbling`); part of `received` and `spilled`.
        mirrored: whether half of the particles were simulated, and the others are their mirror images.
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
    dribbled: float = 0.0
    mirrored: bool = field(default=False, metadata=WRITTEN_IF_SET)

    @property
    def fractions(self) -> Fractions:
        """Poured, spilled, retained as fractions of the load."""
        return Fractions(self.received + self.spilled + self.in_flight, self.spilled, self.retained)

    def as_json(self) -> dict[str, Any]:
        """JSON-ready mapping; lengths in millimetres."""
        return {
            "received": self.received,
            "spilled": self.spilled,
            "retained": self.retained,
            "in_flight": self.in_flight,
            "escaped": self.escaped,
            "dribbled": self.dribbled,
            "mirrored": self.mirrored,
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
        spilled: mass next to the receiver [kg].
        retained: mass left in the pourer after [kg].
        notes: details from the bench (tare, settling time, drift …), JSON-ready.
    """

    loaded: float
    spilled: float
    retained: float
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def delivered(self) -> float:
        """Mass in the receiver: neither left in the pourer nor spilled next to the receiver [kg]."""
        return max(self.loaded - self.retained - self.spilled, 0.0)

    @property
    def fractions(self) -> Fractions:
        """Poured, spilled, retained as fractions of the load."""
        return Fractions(1.0 - self.retained / self.loaded, self.spilled / self.loaded, self.retained / self.loaded)


@dataclass(frozen=True)
class RecordedFrames:
    """Particles at some times.

    Attributes:
        times: (F,) [s].
        positions: F arrays (N, 3) float32, world [m].
        states: F arrays (N,) uint8, `sim_engine.outcome.ParticleState`.
        pourer_poses: (F, 7): x y z qw qx qy qz of the pourer.
        receiver_at: x, y, z of the receiver, away from its intended place [m].
    """

    times: NDArray[np.float64]
    positions: list[NDArray[np.float32]]
    states: list[NDArray[np.uint8]]
    pourer_poses: NDArray[np.float64]
    receiver_at: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def joined(self, later: RecordedFrames) -> RecordedFrames:
        """These frames and later ones of the same pour."""
        return RecordedFrames(
            np.concatenate([self.times, later.times]),
            [*self.positions, *later.positions],
            [*self.states, *later.states],
            np.concatenate([self.pourer_poses, later.pourer_poses]),
            self.receiver_at,
        )

    def copied(self) -> RecordedFrames:
        """A copy in its own memory."""
        positions, states = [np.array(p) for p in self.positions], [np.array(s) for s in self.states]
        return RecordedFrames(np.array(self.times), positions, states, np.array(self.pourer_poses), self.receiver_at)


@dataclass(frozen=True)
class SimulatedPour:
    """A simulated pour; `frames` only if the task requested any."""

    outcome: PourOutcome
    frames: RecordedFrames | None = None

    def copied(self) -> SimulatedPour:
        """A copy in its own memory: arrays from a shared store would occupy that as long as they live."""
        return self if self.frames is None else SimulatedPour(self.outcome, self.frames.copied())


LossName = Literal["spilled_and_retained", "normalised", "grams", "particles"]


class Loss(Settings):
    """Loss that deployment minimises."""

    recorded_as_given: ClassVar[bool] = True

    name: LossName = "spilled_and_retained"
    """(spilled + w·retained) / loaded; or the paper's: normalised, grams, particles."""

    retained_weight: Annotated[float, Quantity("1", "1.0", 0.0, 100.0)] = 1.0
    """Weight w of the retained liquid, for spilled_and_retained."""

    def check_values(self, problems: Problems) -> None:
        """Check that a weight belongs to the loss."""
        if "retained_weight" in self.model_fields_set and self.name != "spilled_and_retained":
            problems.add(f"belongs to spilled_and_retained, not to {self.name}", "retained_weight", key=True)

    def __call__(self, fractions: Fractions, *, loaded_mass: float, particles: int) -> float | None:
        """Loss of a pour, to be minimised; None if it is undefined.

        Args:
            fractions: outcome of the pour.
            loaded_mass: [kg], for `grams`.
            particles: number of particles in a simulation of the pour (for a real pour: in the simulator's), for
                `particles`.
        """
        match self.name:
            case "spilled_and_retained":
                return fractions.spilled + self.retained_weight * fractions.retained
            case "normalised":
                return fractions.spillage
            case "grams":
                return fractions.spilled * loaded_mass * 1e3
            case "particles":
                return fractions.spilled * particles
