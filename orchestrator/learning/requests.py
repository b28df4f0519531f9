"""Requests of strategies and their outcomes: immutable values without handles and without a clock.

A strategy returns `Simulate`, `Pour`, `Suggest` or `Ask` and receives `Simulated`, `Poured`, `Suggested`, `Answered` or
`Failed`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from statistics import NormalDist

from actors.interfaces import DoseTarget
from actors.optimizer.questions import WRITTEN_IF_SET, Suggestion, SuggestionQuery
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement, PourOutcome
from sim_engine.prediction_band import LEVEL
from sim_engine.scene import PoseError

_NORMAL = NormalDist()

ADDED = "added"
"""Purpose of a pour that somebody made and weighed without being asked."""

NOT_WRITTEN = {"written": False}
"""Metadata of a field that the journal leaves out."""


@dataclass(frozen=True)
class Prediction:
    """A predicted loss, in the loss's own unit.

    Attributes:
        mean: expected loss.
        deviation: standard deviation of the expected loss.
        scatter: standard deviation of a single pour around it (in simulation: of a single seed); None if unknown.
        band: the shortest interval that contains a single pour with a probability of
            `sim_engine.prediction_band.LEVEL`; None if unknown.
    """

    mean: float
    deviation: float
    scatter: float | None = None
    band: tuple[float, float] | None = None

    def of_a_pour(self) -> tuple[float, float]:
        """The prediction interval of a single pour.

        Without `band`, it is that of a normal distribution with these moments. Losses are not negative: if 0 is a
        likely value, the interval begins at 0 and is one-sided.
        """
        if self.band is not None:
            return self.band
        spread = math.hypot(self.deviation, self.scatter or 0.0)
        half = _NORMAL.inv_cdf(0.5 * (1.0 + LEVEL)) * spread
        from_nothing = max(self.mean + _NORMAL.inv_cdf(LEVEL) * spread, 0.0)
        if self.mean < half or from_nothing < 2.0 * half:
            return 0.0, from_nothing
        return self.mean - half, self.mean + half


@dataclass(frozen=True)
class Simulate:
    """Run one simulated pour (idempotent, can be repeated).

    Attributes:
        purpose: one word for journal and live view: 'calibrate', 'prior', 'refine', 'evaluate' …
        pose_error: execution error; None: executed as intended.
        drawn_shapes: whether vessel shapes are drawn from their uncertainty by `seed`; otherwise the measured shapes
            are used.
    """

    scene: str
    action: Action
    parameters: SimulationParameters
    seed: int
    purpose: str = "simulate"
    pose_error: PoseError | None = None
    drawn_shapes: bool = False


@dataclass(frozen=True)
class Pour:
    """Pour once on the real (or virtual) bench. Never repeated by software.

    Attributes:
        number: 1, 2, … within the stage; 0 for an added pour.
        seed: seed of the virtual bench's hidden noise for this pour; a real bench ignores it.
        predicted: the strategy's prediction, for display.
        dose: wanted amount in the receiver; its controller then decides the tilt, and the action gives the place only.
    """

    scene: str
    action: Action
    number: int
    seed: int
    predicted: Prediction | None = None
    purpose: str = "pour"
    dose: DoseTarget | None = field(default=None, metadata=WRITTEN_IF_SET)

    def calibrates(self, deployed: Iterable[str]) -> bool:
        """Whether it serves calibration: it is compared with simulations, not minimised.

        Args:
            deployed: scenes that a deployment pours into.
        """
        return self.dose is None and (self.purpose == "calibration" or self.scene not in deployed)


@dataclass(frozen=True)
class Suggest:
    """Query the optimiser actor for points. Its answer is recorded and replayed, never recomputed."""

    query: SuggestionQuery
    purpose: str = "suggest"


@dataclass(frozen=True)
class Ask:
    """Ask the operator at the bench for a decision. The answer is recorded; without one, a resumed run asks again.

    Attributes:
        question: includes the facts that the answer depends on.
        options: the possible answers.
        proposals: the program or person who started the run is asked instead, for at most so many mixtures.
    """

    question: str
    options: tuple[str, ...]
    proposals: int | None = field(default=None, metadata=WRITTEN_IF_SET)


Request = Simulate | Pour | Suggest | Ask


@dataclass(frozen=True)
class Simulated:
    """Outcome of a `Simulate`."""

    outcome: PourOutcome


@dataclass(frozen=True)
class Poured:
    """Outcome of a `Pour`."""

    measurement: PourMeasurement


@dataclass(frozen=True)
class Suggested:
    """Outcome of a `Suggest`."""

    suggestion: Suggestion


@dataclass(frozen=True)
class Answered:
    """Outcome of an `Ask`: one of its options."""

    answer: str


@dataclass(frozen=True)
class Failed:
    """A failed request.

    Examples are a simulation that leaked or diverged, a pair of touching vessels, or a pour that the operator declared
    lost.

    Attributes:
        kind: 'invalid_action', 'simulation', 'pour_unknown' or 'pour_failed'.
        reason: text for the operator.
    """

    kind: str
    reason: str


Outcome = Simulated | Poured | Suggested | Answered | Failed


@dataclass(frozen=True)
class Slots:
    """Number of requests of each kind that the scheduler could start now."""

    simulations: int
    pours: int = 1


@dataclass(frozen=True)
class Decision:
    """The reason for a strategy's requests; displayed, streamed and recorded.

    Attributes:
        urgent: whether it is also displayed in the terminal immediately.
    """

    text: str
    values: dict[str, float] = field(default_factory=dict)
    urgent: bool = False
