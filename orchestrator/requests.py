"""What strategies ask for and what they are told: values only, no handles, no clock."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from statistics import NormalDist
from typing import Literal

from actors.optimizer.questions import Suggestion, SuggestProblem
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement, PourOutcome
from sim_engine.prediction_band import LEVEL
from sim_engine.scene import PoseError

_NORMAL = NormalDist()


@dataclass(frozen=True)
class Prediction:
    """A predicted loss, in the loss' own unit.

    Attributes:
        mean: expected loss.
        deviation: standard deviation of that expectation: how well it is known.
        scatter: standard deviation of a single pour around it (in simulation: of a single seed); None if unknown.
        band: the shortest interval that a single pour lies in with a probability of
        `sim_engine.prediction_band.LEVEL`; None if
            unknown.
    """

    mean: float
    deviation: float
    scatter: float | None = None
    band: tuple[float, float] | None = None

    def of_a_pour(self) -> tuple[float, float]:
        """Its band; where none was told, that of a normal distribution with these moments. No loss is below 0: where
        one may well be 0 the band begins there, and holds no more for that."""
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
    """Run one simulated pour (idempotent, retried at will).

    Attributes:
        purpose: one word for journal and monitor: 'calibrate', 'prior', 'refine', 'evaluate' …
        pose_error: with which it is executed; None: as intended.
        drawn_shapes: whether vessels have shapes that they may as well have, drawn by `seed`; else those that were
            measured.
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
    """Pour once on the real (or virtual) bench. Never retried by software.

    Attributes:
        number: 1, 2, … within the stage.
        seed: of the virtual bench's hidden noise for this pour; a real bench ignores it.
        predicted: what the strategy expects, for people.
    """

    scene: str
    action: Action
    number: int
    seed: int
    predicted: Prediction | None = None
    purpose: str = "pour"


@dataclass(frozen=True)
class Suggest:
    """Ask the optimiser actor for points. Its answer is journalled and replayed, never recomputed."""

    problem: SuggestProblem
    purpose: str = "suggest"


@dataclass(frozen=True)
class Ask:
    """Ask a person to decide. The run pauses; the answer is given on resume, journalled and replayed.

    Attributes:
        question: with the facts that the answer depends on.
        options: allowed answers.
    """

    question: str
    options: tuple[str, ...]


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
    """Outcome of an `AskOperator`: one of its options."""

    answer: str


@dataclass(frozen=True)
class Failed:
    """The request came to nothing: a simulation that leaked or diverged, a touching pair of vessels, a pour that was
    declared lost by the operator.

    Attributes:
        kind: 'invalid_action', 'simulation', 'pour_unknown' or 'pour_failed'.
        reason: for people.
    """

    kind: str
    reason: str


Outcome = Simulated | Poured | Suggested | Answered | Failed


@dataclass(frozen=True)
class Slots:
    """How many requests of each kind the scheduler could start now."""

    simulations: int
    pours: int = 1


@dataclass(frozen=True)
class Decision:
    """Why a strategy asked for what it asked for; shown, streamed and journalled.

    Attributes:
        urgent: people should read it now, in the terminal too.
    """

    text: str
    values: dict[str, float] = field(default_factory=dict)
    urgent: bool = False


Order = Literal["logical", "completion"]
"""The order in which outcomes are told; see `orchestrator.runs.stage_scheduler`."""
