"""How well a θ reproduces weighed pours: one simulation for each θ and pour."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Literal

import numpy as np
from pydantic import Field

from orchestrator.plan import MeasuredPour
from orchestrator.requests import Decision, Outcome, Request, Simulate, Simulated, Slots
from orchestrator.strategies.learnt import Learnt, Part
from orchestrator.strategies.progress import Progress
from orchestrator.strategies.seeds import SeedStream
from orchestrator.strategies.sound import is_sound
from sim_engine.liquid import SimulationParameters
from sim_engine.losses import normalised_spillage
from sim_engine.space import Space


@dataclass(frozen=True)
class ScoredPour:
    """A weighed pour and the scene it was made in."""

    scene: str
    pour: MeasuredPour


class ScoredPair(Part):
    """A weighed pour beside its simulation with one θ."""

    theta: str
    """Label of the θ."""

    split: str
    """'train', 'test' or 'transfer'."""

    scene: str
    """Where it was poured."""

    measured: float | None
    """r, as weighed."""

    simulated: float | None
    """c_s; None where it is not defined."""

    reason: str
    """Why it is not."""


class CalibrationGain(Part):
    """How much closer to the weighed pours the calibrated θ is than the uncalibrated one, and which of them to use.

    A pair is a weighed pour that both θ were simulated on, with the same seed. Differences are fractions of the liquid
    that was poured.
    """

    pours: int
    """Weighed pours that were compared."""

    pairs: int
    """Those of them on which both θ have a simulated spillage."""

    calibrated: float | None
    """Mean |r − c_s| of θ* over the pairs."""

    uncalibrated: float | None
    """Mean |r − c_s| of the uncalibrated θ over the pairs."""

    gain: float | None
    """Mean over the pairs of the uncalibrated θ's |r − c_s| minus that of θ*; positive where θ* is closer."""

    gain_error: float | None
    """Standard error of that mean; None for fewer than two pairs."""

    recommended: Literal["calibrated", "uncalibrated"]
    """The θ to use from now on."""

    text: str
    """The same as one sentence, without a full stop."""


class Scores(Learnt):
    """How well one or several θ reproduce weighed pours."""

    kind: Literal["evaluation"] = "evaluation"

    simulations: int
    """Those that were answered."""

    undefined: dict[str, int]
    """Simulations without c_s, by label of θ."""

    discrepancy: dict[str, dict[str, float | None]]
    """Mean |r − c_s| by label of θ and split."""

    random_median: dict[str, float | None]
    """Median of the random θ's, by split."""

    posterior_mean: dict[str, float | None] = Field(default_factory=dict)
    """Mean |r − c̄_s| by split, c̄_s being the mean of the simulations with draws of θ's posterior."""

    thetas: dict[str, SimulationParameters]
    """The θ by label."""

    pairs: tuple[ScoredPair, ...]
    """Every weighed pour with its simulation."""

    mean_predictor: dict[str, float | None] = Field(default_factory=dict)
    """What the mean of the training pours comes to, by split."""

    regression: dict[str, float | None] = Field(default_factory=dict)
    """What a GP regression of the training pours comes to, by split."""

    gain: CalibrationGain | None = None
    """Whether the pours justify θ*; None where it is the uncalibrated θ, or was not compared with it."""


@dataclass
class _Case:
    theta: str
    scored: ScoredPour
    request: Simulate
    simulated: float | None = None
    answered: bool = False
    reason: str = ""


class Evaluation:
    """Score one or several θ: mean |r − c_s(a, θ)| over the weighed pours of each split.

    All θ are simulated with the same seeds, so that their differences are not those of the initial positions. Pours
    with less than 5 % poured have no r and are left out; so are simulations without c_s, which are counted.

    Source: Lopez-Guevara et al., CoRL 2017, section 4.1 (test discrepancy).
    """

    def __init__(self, thetas: Mapping[str, SimulationParameters], pours: Sequence[ScoredPour], seed: int) -> None:
        """Plan.

        Args:
            thetas: by label; 'random 1', 'random 2' … are the baseline whose median is reported, 'posterior 1',
                'posterior 2' … draws of which the simulations' mean is scored, too.
        """
        seeds = SeedStream(seed, "evaluation")
        self._cases: list[_Case] = []
        self._thetas = dict(thetas)
        for scored in pours:
            if scored.pour.spillage is None:
                continue
            seed_of_pour = seeds.next()
            for label, theta in thetas.items():
                request = Simulate(scored.scene, scored.pour.action, theta, seed_of_pour, "evaluate")
                self._cases.append(_Case(label, scored, request))
        self._unissued = deque(range(len(self._cases)))
        self._open: dict[Simulate, deque[int]] = {}
        self.decisions: list[Decision] = [
            Decision(f"score {len(thetas)} θ on {len(pours)} weighed pours: {len(self._cases)} simulations")
        ]

    @property
    def finished(self) -> bool:
        """Every simulation has been answered."""
        return not self._unissued and not self._open

    def ask(self, slots: Slots) -> list[Request]:
        """The next simulations."""
        requests: list[Request] = []
        for _ in range(min(slots.simulations, len(self._unissued))):
            index = self._unissued.popleft()
            request = self._cases[index].request
            self._open.setdefault(request, deque()).append(index)
            requests.append(request)
        return requests

    def tell(self, request: Request, outcome: Outcome) -> None:
        """What came of a simulation."""
        waiting = self._open.get(request) if isinstance(request, Simulate) else None
        if not waiting or not isinstance(request, Simulate):
            raise ValueError(f"this simulation was not asked for, or has been answered already: {request}")
        case = self._cases[waiting.popleft()]
        if not waiting:
            del self._open[request]
        case.answered = True
        if isinstance(outcome, Simulated) and outcome.outcome.invalid is None and is_sound(outcome.outcome.fractions):
            case.simulated = normalised_spillage(outcome.outcome.fractions)
            case.reason = "" if case.simulated is not None else "too little poured"
        else:
            case.reason = getattr(outcome, "reason", "") or "invalid outcome"

    def progress(self) -> Progress:
        """Simulations answered, simulations in all."""
        return Progress(sum(case.answered for case in self._cases), len(self._cases))

    def discrepancy(self, theta: str, split: str) -> float | None:
        """Mean |r − c_s| of a θ over a split's pours; None where nothing is defined."""
        differences = [
            abs(r - case.simulated)
            for case in self._cases
            if case.theta == theta and case.scored.pour.split == split
            if case.simulated is not None and (r := case.scored.pour.spillage) is not None
        ]
        return float(np.mean(differences)) if differences else None

    def random_median(self, split: str) -> float | None:
        """Median over the θ labelled 'random …' of the mean discrepancy in a split."""
        scores = [self.discrepancy(label, split) for label in self._thetas if label.startswith("random ")]
        known = [score for score in scores if score is not None]
        return median(known) if known else None

    def posterior_mean(self, split: str) -> float | None:
        """Mean |r − c̄_s| over a split's pours, c̄_s by all θ labelled 'posterior …'; None where nothing is defined."""
        simulated: dict[tuple[float, int], list[float]] = {}
        for case in self._cases:
            if not case.theta.startswith("posterior ") or case.scored.pour.split != split:
                continue
            if case.simulated is not None and (r := case.scored.pour.spillage) is not None:
                simulated.setdefault((r, case.request.seed), []).append(case.simulated)
        differences = [abs(r - float(np.mean(values))) for (r, _), values in simulated.items()]
        return float(np.mean(differences)) if differences else None

    def result(self) -> Scores:
        """Scores by θ and split, and every pair of measured and simulated spillage."""
        splits = list(dict.fromkeys(case.scored.pour.split for case in self._cases))
        answered = [case for case in self._cases if case.answered]
        return Scores(
            simulations=len(answered),
            undefined={
                label: sum(case.theta == label and case.simulated is None for case in answered)
                for label in self._thetas
            },
            discrepancy={label: {split: self.discrepancy(label, split) for split in splits} for label in self._thetas},
            random_median={split: self.random_median(split) for split in splits},
            posterior_mean={split: self.posterior_mean(split) for split in splits},
            thetas=dict(self._thetas),
            pairs=tuple(
                ScoredPair(
                    theta=case.theta,
                    split=case.scored.pour.split,
                    scene=case.scored.scene,
                    measured=case.scored.pour.spillage,
                    simulated=case.simulated,
                    reason=case.reason,
                )
                for case in answered
            ),
        )


def random_parameters(
    space: Space, fixed: Mapping[str, float], count: int, seed: int
) -> dict[str, SimulationParameters]:
    """θ drawn uniformly from the box, labelled 'random 1' … : what no calibration would give."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, *b"random theta"]))
    return {f"random {i + 1}": SimulationParameters.from_values({**fixed, **space.draw(rng)}) for i in range(count)}
