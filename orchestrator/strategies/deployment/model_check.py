"""Whether the first weighed pours are as good as simulations say of them, and what follows if they are worse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field

from actors.optimizer.questions import Suggestion
from orchestrator.requests import Ask, Decision
from orchestrator.strategies.deployment.real_pours import PourTrial
from orchestrator.strategies.stage_result import ResultPart
from sim_engine.settings.model import Section, word_or
from sim_engine.settings.quantity import Quantity

FEWEST_POURS = 3
"""Pours before which nothing is logged: one or two may be bad luck."""

TOLERANCE = 0.01
"""Share of the worst loss by which a simulator may be wrong without being called so: most people don't care about a
hundredth of the load, and simulated scatter alone can be next to nothing."""

GO_ON = "go on"
OPTIONS: tuple[str, ...] = ("D2", "widen", GO_ON)
"""Answers to the question whether a simulator that is wrong is to be used on."""

_MEANING: dict[str, str] = {
    "D2": "the simulations are forgotten; from now on only pours count (as in D2)",
    "widen": "the simulations are believed less: what they lack is taken for noise of theirs, and much of it",
    GO_ON: "the simulations are used as before",
}


class TrustSettings(Section):
    """D3: when the first pours say that the simulator is wrong, and what follows."""

    pours: Annotated[int, Field(strict=True, ge=FEWEST_POURS, le=10)] = 4
    """Weighed pours that are compared with the simulations, from the third on."""

    limit: Annotated[float, Quantity("1", "2.5", 0.5, 100.0)] = 2.5
    """Mean of max(z, 0) above which the simulator is called wrong."""

    policy: Literal["ask", "D2", "widen"] = "D2"
    """D2: its simulations are forgotten; widen: they are believed less; ask: the campaign pauses with a question."""


TrustOrAlways: Any = word_or("always", TrustSettings)
"""When the simulator is called wrong, or 'always', if it never is."""


@dataclass(frozen=True)
class PourComparison:
    """One weighed pour beside what the simulations alone say of its action, in the loss' own unit.

    Attributes:
        deviation: of a single pour around `simulated`: the surrogate's doubt, scatter, and `TOLERANCE`.
    """

    number: int
    simulated: float
    deviation: float
    weighed: float

    @property
    def z(self) -> float:
        """By how many deviations it was worse (or, below 0, better) than simulated."""
        return (self.weighed - self.simulated) / self.deviation


class Compared(ResultPart):
    """The first pours beside what the simulations alone say of their actions, and what followed."""

    z_scores: tuple[float, ...]
    """By how many deviations each was worse than simulated."""

    alarm: bool
    """The simulator promised too much."""

    better: bool
    """The simulator promised too little, by as much as would be an alarm the other way."""

    mean_z: float
    """Mean of max(z, 0)."""

    limit: float
    """From which mean on it is an alarm."""

    policy: str
    """What the campaign asks for on an alarm."""

    followed: str | None
    """What followed; None without an alarm, or while nobody has said."""

    pours: tuple[PourComparison, ...]
    """The compared pours."""

    text: str
    """All of it in a sentence."""


class TrustCheck:
    """Compares the first pours of a D3 with its simulations, once after each from the third on, and decides once.

    Only pours that are worse than simulated count against the simulator: z below 0 is taken for 0. It chose these
    actions, and where they turn out better than it promised, the choice was a good one: to forget it then costs the
    next pours what the first ones had gained. D3's models make up for an offset or a factor.

    What is compared with is a surrogate of the simulations alone: a surrogate that has seen the first pours already
    believes them.
    """

    def __init__(self, settings: TrustSettings, worst: float) -> None:
        self._settings, self._worst = settings, worst
        self._compared = 0
        self.comparisons: list[PourComparison] = []
        self.policy: str | None = None
        self.decisions: list[Decision] = []

    def due(self, pours: Sequence[PourTrial]) -> list[PourTrial]:
        """The pours to be compared now; empty: nothing new, or it has been decided."""
        weighed = [p for p in pours if p.status == "weighed" and p.cost is not None][: self._settings.pours]
        return self._new(weighed)

    def foreseen(self, pours: Sequence[PourTrial]) -> list[PourTrial]:
        """The pours to be compared once the one that is under way has been weighed (now, if none is)."""
        weighed = [p for p in pours if p.status == "pouring" or (p.status == "weighed" and p.cost is not None)]
        return self._new(weighed[: self._settings.pours])

    def _new(self, pours: list[PourTrial]) -> list[PourTrial]:
        if self.alarm or len(pours) < min(FEWEST_POURS, self._settings.pours) or len(pours) <= self._compared:
            return []
        return pours

    def compare(self, pours: Sequence[PourTrial], simulated: Suggestion) -> None:
        """Enter what a surrogate of the simulations says at the pours (its `predictions`, in their order)."""
        self._compared = len(pours)
        if len(simulated.predictions) != len(pours):
            return  # too few simulations succeeded to say anything
        scatter = (simulated.hyperparameters or {}).get("noise", 0.0)
        self.comparisons = []
        for trial, mean, deviation in zip(pours, simulated.predictions, simulated.prediction_deviations, strict=True):
            assert trial.cost is not None
            spread = math.hypot(deviation, scatter, TOLERANCE * self._worst)
            self.comparisons.append(PourComparison(trial.number, min(max(mean, 0.0), self._worst), spread, trial.cost))
        if self.alarm:
            if self._settings.policy != "ask":
                self.settle(self._settings.policy)
        elif len(pours) == self._settings.pours:
            verdict = "pours are better than simulated" if self.better else "the simulator is borne out"
            self.decisions.append(Decision(f"{verdict}: {self._text}", {"mean_z": self.mean_z}))

    @property
    def mean_z(self) -> float:
        """Mean of max(z, 0); 0 before anything was compared."""
        return sum(max(one.z, 0.0) for one in self.comparisons) / len(self.comparisons) if self.comparisons else 0.0

    @property
    def alarm(self) -> bool:
        """The simulator promised too much here."""
        return self.mean_z > self._settings.limit

    @property
    def better(self) -> bool:
        """The simulator promised too little, by as much as would be an alarm the other way."""
        return sum(max(-one.z, 0.0) for one in self.comparisons) > self._settings.limit * len(self.comparisons) > 0.0

    @property
    def question(self) -> Ask | None:
        """What a person has to decide first."""
        if not self.alarm or self.policy is not None:
            return None
        meaning = "; ".join(f"{option}: {_MEANING[option]}" for option in OPTIONS)
        return Ask(f"The simulator is wrong here: {self._text}. How to go on? {meaning}.", OPTIONS)

    def settle(self, policy: str) -> None:
        """How to go on, by the settings or by an answer to `question`."""
        self.policy = policy
        text = f"trust alarm: {self._text}; {_MEANING[policy]}"
        self.decisions.append(Decision(text, {"mean_z": self.mean_z}, urgent=True))

    @property
    def _text(self) -> str:
        pairs = ", ".join(
            f"{one.weighed:.3g} for {one.simulated:.3g} ± {one.deviation:.2g}" for one in self.comparisons
        )
        worse = f"worse by {self.mean_z:.1f} deviations in the mean, limit {self._settings.limit:g}"
        return f"weighed for simulated {pairs}; {worse}"

    def result(self) -> Compared:
        """Every comparison, whether it is an alarm, and what followed."""
        return Compared(
            z_scores=tuple(one.z for one in self.comparisons),
            alarm=self.alarm,
            better=self.better,
            mean_z=self.mean_z,
            limit=self._settings.limit,
            policy=self._settings.policy,
            followed=self.policy,
            pours=tuple(self.comparisons),
            text=self._text if self.comparisons else "",
        )
