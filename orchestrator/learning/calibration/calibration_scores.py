"""Scores of a calibration: the discrepancy of θ* and of baselines on weighed pours.

- `Evaluation` simulates one or several θ on weighed pours, one simulation per θ and pour.
- `CalibrationEvaluation` compares θ* with the uncalibrated θ, random θ and two predictors without a simulator.
- `calibration_gain` decides whether the weighed pours justify θ*.
- `Scores` is the result.

The module does not fit parameters.
"""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median, stdev
from typing import Literal

import numpy as np
from pydantic import Field

from orchestrator.learning.calibration.action_prior import Contexts
from orchestrator.learning.calibration.pointwise_calibration import LEAST_DEFINED
from orchestrator.learning.calibration.pour_residuals import (
    ResidualPair,
    SpillageResidual,
    WithoutMisfits,
    misfit_sentence,
    pour_residuals,
    without_misfits,
)
from orchestrator.learning.campaign_plan import CalibrationPlan, MeasuredPour
from orchestrator.learning.requests import Decision, Outcome, Request, Simulate, Simulated, Slots
from orchestrator.learning.stage_result import ResultPart, StageResult
from orchestrator.learning.strategy import Progress, is_sound
from orchestrator.learning.trials import SeedStream
from sim_engine.liquids import SimulationParameters
from sim_engine.prediction_band import CalibrationResidual, left_over
from sim_engine.search_space import Space


@dataclass(frozen=True)
class ScoredPour:
    """A weighed pour and the scene in which it was made."""

    scene: str
    pour: MeasuredPour


class ScoredPair(ResultPart):
    """A weighed pour and its simulation with one θ."""

    theta: str
    """Label of the θ."""

    split: str
    """'train', 'test' or 'transfer'."""

    scene: str
    """Name of the scene."""

    measured: float | None
    """Weighed spillage r."""

    simulated: float | None
    """Simulated spillage c_s; None if it is undefined."""

    reason: str
    """Reason why c_s is undefined."""


class CalibrationGain(ResultPart):
    """Gain of the calibrated θ over the uncalibrated one on the weighed pours, and the recommended θ of the two.

    A pair is a weighed pour that both θ were simulated on, with the same seed. Differences are fractions of the liquid
    that was poured.
    """

    pours: int
    """Weighed pours that were compared."""

    pairs: int
    """Pours for which both θ have a simulated spillage."""

    calibrated: float | None
    """Mean |r − c_s| of θ* over the pairs."""

    uncalibrated: float | None
    """Mean |r − c_s| of the uncalibrated θ over the pairs."""

    gain: float | None
    """Mean over the pairs of the uncalibrated θ's |r − c_s| minus that of θ*; positive if θ* is closer."""

    gain_error: float | None
    """Standard error of the mean; None for fewer than two pairs."""

    recommended: Literal["calibrated", "uncalibrated"]
    """The θ to use from now on."""

    text: str
    """Summary in one sentence, without a full stop."""


class Scores(StageResult):
    """Scores of one or several θ on weighed pours."""

    kind: Literal["evaluation"] = "evaluation"

    simulations: int
    """Number of simulations with an answer."""

    undefined: dict[str, int]
    """Number of simulations without c_s, by label of θ."""

    discrepancy: dict[str, dict[str, float | None]]
    """Mean |r − c_s| by label of θ and split."""

    random_median: dict[str, float | None]
    """Median over the random θ, by split."""

    posterior_mean: dict[str, float | None] = Field(default_factory=dict)
    """Mean |r − c̄_s| by split; c̄_s is the mean of the simulations with draws from θ's posterior."""

    thetas: dict[str, SimulationParameters]
    """The θ by label."""

    pairs: tuple[ScoredPair, ...]
    """Every weighed pour with its simulation."""

    mean_predictor: dict[str, float | None] = Field(default_factory=dict)
    """Mean |r − r̄| by split; r̄ is the mean of the training pours."""

    regression: dict[str, float | None] = Field(default_factory=dict)
    """Mean |r − m| by split; m is a GP regression of the training pours."""

    gain: CalibrationGain | None = None
    """Comparison with the uncalibrated θ; None if θ* was not compared with it."""

    pours: tuple[SpillageResidual, ...] = ()
    """Every weighed pour with its residual, once all are simulated."""

    without: WithoutMisfits | None = None
    """θ* without the pours that do not fit; None if all fit, or if no θ was simulated on all others."""


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

    All θ are simulated with the same seeds, so that initial particle positions do not cause differences between them.
    Pours with less than 5 % poured have no r and are left out. Simulations without c_s are left out as well, but
    counted.

    Source: Lopez-Guevara et al., CoRL 2017, section 4.1 (test discrepancy).
    """

    def __init__(
        self,
        thetas: Mapping[str, SimulationParameters],
        pours: Sequence[ScoredPour],
        seed: int,
        *,
        train_seeds: Sequence[int] = (),
    ) -> None:
        """Plan the simulations.

        Args:
            thetas: θ by label. 'random 1', 'random 2' … form the baseline; their median is reported. 'posterior 1',
                'posterior 2' … are draws; the mean of their simulations is scored as well.
            train_seeds: seeds on the usable training pours; empty: new ones.
        """
        seeds, training_seeds = SeedStream(seed, "evaluation"), iter(train_seeds)
        self._cases: list[_Case] = []
        self._thetas = dict(thetas)
        for scored in pours:
            if scored.pour.spillage is None:
                continue
            seed_of_pour = next(training_seeds) if train_seeds and scored.pour.split == "train" else seeds.next()
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
        """Return the next simulations."""
        requests: list[Request] = []
        for _ in range(min(slots.simulations, len(self._unissued))):
            index = self._unissued.popleft()
            request = self._cases[index].request
            self._open.setdefault(request, deque()).append(index)
            requests.append(request)
        return requests

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a simulation."""
        waiting = self._open.get(request) if isinstance(request, Simulate) else None
        if not waiting or not isinstance(request, Simulate):
            raise ValueError(f"this simulation was not asked for, or has been answered already: {request}")
        case = self._cases[waiting.popleft()]
        if not waiting:
            del self._open[request]
        case.answered = True
        if isinstance(outcome, Simulated) and outcome.outcome.invalid is None and is_sound(outcome.outcome.fractions):
            case.simulated = outcome.outcome.fractions.spillage
            case.reason = "" if case.simulated is not None else "too little poured"
        else:
            case.reason = getattr(outcome, "reason", "") or "invalid outcome"

    def progress(self) -> Progress:
        """Simulations answered, and their total number."""
        return Progress(sum(case.answered for case in self._cases), len(self._cases))

    def discrepancy(self, theta: str, split: str) -> float | None:
        """Mean |r − c_s| of a θ over the pours of a split; None if no pair is defined."""
        differences = [
            abs(r - case.simulated)
            for case in self._cases
            if case.theta == theta and case.scored.pour.split == split
            if case.simulated is not None and (r := case.scored.pour.spillage) is not None
        ]
        return float(np.mean(differences)) if differences else None

    def simulated(self) -> dict[int, float | None]:
        """c_s of the only θ, by the identity of the scored pour."""
        return {id(case.scored): case.simulated for case in self._cases}

    def random_median(self, split: str) -> float | None:
        """Median of the mean discrepancies of the θ with labels 'random …' in a split."""
        scores = [self.discrepancy(label, split) for label in self._thetas if label.startswith("random ")]
        defined = [score for score in scores if score is not None]
        return median(defined) if defined else None

    def posterior_mean(self, split: str) -> float | None:
        """Mean |r − c̄_s| over a split's pours; c̄_s averages all θ labelled 'posterior …'. None if nothing is
        defined."""
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
    """Draw θ uniformly from the box, labelled 'random 1' …, as a baseline without calibration."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, *b"random theta"]))
    return {f"random {i + 1}": SimulationParameters.from_values({**fixed, **space.draw(rng)}) for i in range(count)}


def mean_predictor_discrepancy(train: Sequence[MeasuredPour], test: Sequence[MeasuredPour]) -> float | None:
    """Mean |r − r̄| over the test pours, where r̄ is the mean of the training pours; None if either set is empty."""
    trained, wanted = _spillages(train), _spillages(test)
    if not trained or not wanted:
        return None
    mean = sum(trained) / len(trained)
    return sum(abs(r - mean) for r in wanted) / len(wanted)


def regression_discrepancy(
    contexts: Contexts, train: Sequence[MeasuredPour], test: Sequence[MeasuredPour]
) -> float | None:
    """Mean |r − m(a)| over the test pours, where m is a GP regression of the training pours, clipped to [0, 1].

    The regression is scikit-learn's instead of Decant's own, so that the comparison is independent of the calibration
    code. It has a Matérn 5/2 kernel with one lengthscale per dimension and fitted noise. It is a strong baseline within
    the fitted scene, and gives no answer for another vessel. The result is None for fewer than two training pours, or
    without test pours.
    """
    usable = [pour for pour in train if pour.spillage is not None]
    wanted = [pour for pour in test if pour.spillage is not None and contexts.knows(pour)]
    if len(usable) < 2 or not wanted:
        return None
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    points = [contexts.point(pour) for pour in usable]
    lengths = Matern(length_scale=[0.5] * len(points[0]), length_scale_bounds=(0.03, 10.0), nu=2.5)
    kernel = ConstantKernel(1.0, (0.05, 50.0)) * lengths + WhiteKernel(0.01, (1e-6, 1.0))
    model = GaussianProcessRegressor(kernel, normalize_y=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the length of an irrelevant dimension reaches its bound
        model.fit(points, _spillages(usable))
    predictions = model.predict([contexts.point(pour) for pour in wanted])
    errors = [abs(r - min(max(float(p), 0.0), 1.0)) for r, p in zip(_spillages(wanted), predictions, strict=True)]
    return sum(errors) / len(errors)


def _spillages(pours: Sequence[MeasuredPour]) -> list[float]:
    return [pour.spillage for pour in pours if pour.spillage is not None]


BySplit = dict[str, float | None]

CALIBRATED = "theta"
"""Label of θ* in the results."""

DRAWS = 5
"""Number of posterior draws of θ whose mean simulation is scored in addition to θ*."""

UNCALIBRATED = "uncalibrated"
"""Label of the θ that is used without a calibration."""

JUSTIFIED = "the weighed pours justify θ*"
NOT_JUSTIFIED = "the weighed pours do not justify a change of parameters; the uncalibrated ones are recommended"
"""Beginnings of the sentence about the gain of a calibration."""


STANDARD_ERRORS = 1.0
"""Number of standard errors of the mean paired difference that the gain must exceed for θ* to be recommended."""


def calibration_gain(calibrated: Sequence[ScoredPair], uncalibrated: Sequence[ScoredPair]) -> CalibrationGain:
    """Decide whether weighed pours justify θ* instead of the uncalibrated θ.

    θ* is recommended if its mean |r − c_s| is smaller by more than one standard error of the paired difference. A θ
    that is defined on fewer than half of the pours is never recommended if the other one is defined on enough of them.

    Args:
        calibrated: pairs of θ*, one for each pour.
        uncalibrated: pairs of the uncalibrated θ for the same pours in the same order, with the same seeds.

    Source: the one-standard-error rule of Breiman, Friedman, Olshen and Stone, Classification and Regression Trees,
    1984, section 3.4.3: of models whose errors differ by less than a standard error the simplest one is chosen.
    Limitations: θ* was fitted to the training pours, which favours it; pours of similar actions count as independent.
    """
    both = [
        (abs(a.measured - a.simulated), abs(a.measured - b.simulated))
        for a, b in zip(calibrated, uncalibrated, strict=True)
        if a.measured is not None and a.simulated is not None and b.simulated is not None
    ]
    gains = [plain - fitted for fitted, plain in both]
    gain = fmean(gains) if gains else None
    error = stdev(gains) / math.sqrt(len(gains)) if len(gains) > 1 else None
    fitted, plain = (fmean(values) if both else None for values in (zip(*both, strict=True) if both else ((), ())))
    count, least = len(calibrated), LEAST_DEFINED * len(calibrated)
    counts = [sum(pair.simulated is not None for pair in pairs) for pairs in (calibrated, uncalibrated)]
    if min(counts) < least <= max(counts):
        justified = counts[0] >= least
        name = "the uncalibrated parameters" if justified else "θ*"
        why = f"with {name} only {min(counts)} of {count} pours have a simulated spillage"
    elif fitted is None or plain is None or gain is None or error is None:
        justified, why = False, "fewer than two pours could be compared"
    else:
        justified = gain > STANDARD_ERRORS * error
        why = (
            f"mean |Δ| of {len(both)} pours {100 * fitted:.2f} % with θ*, {100 * plain:.2f} % with the uncalibrated "
            f"parameters; gain {100 * gain:.2f} ± {100 * error:.2f} points (± standard error)"
        )
    return CalibrationGain(
        pours=count,
        pairs=len(both),
        calibrated=fitted,
        uncalibrated=plain,
        gain=gain,
        gain_error=error,
        recommended="calibrated" if justified else "uncalibrated",
        text=f"{JUSTIFIED if justified else NOT_JUSTIFIED}: {why}",
    )


def recommended_theta(theta: SimulationParameters, scores: Scores | None) -> SimulationParameters:
    """θ for further simulations: θ*, or the uncalibrated θ if the weighed pours do not justify θ*.

    Args:
        theta: θ*.
        scores: result of an evaluation. With None, or a result of an older version without a comparison, θ* is
            returned.
    """
    plain = scores is not None and scores.gain is not None and scores.gain.recommended == UNCALIBRATED
    return scores.thetas.get(UNCALIBRATED, theta) if plain and scores is not None else theta


def calibration_residual(plan: CalibrationPlan | None, scores: Scores, fitted: int) -> CalibrationResidual | None:
    """Residual of the recommended θ on the training pours, all scenes together; None if there are too few pours.

    Args:
        plan: of the calibration; None: the scenes of the pours are unknown.
        scores: result of an evaluation.
        fitted: number of parameters that were searched.
    """
    plain = scores.gain is not None and scores.gain.recommended == UNCALIBRATED
    used = UNCALIBRATED if plain and UNCALIBRATED in scores.thetas else CALIBRATED
    train = [pair for pair in scores.pairs if pair.theta == used and pair.split == "train"]
    both = [
        (pair.scene, (pair.measured, pair.simulated))
        for pair in train
        if pair.measured is not None and pair.simulated is not None
    ]
    shift = left_over([pair for _, pair in both], 0 if plain else fitted)
    if shift is None:
        return None
    poured = () if plan is None else (*plan.poured, *([plan.records.scene] if plan.records else ()))
    return CalibrationResidual.of(shift, [scene for scene in poured if scene.name in {name for name, _ in both}])


class CalibrationEvaluation:
    """Score θ* on all weighed pours, and the baselines on the pours that were not used for training.

    The baselines are the uncalibrated θ, random θ from the same box (their median), the mean of the training pours and
    a GP regression of the training pours.

    - The regression is evaluated in the calibration's scenes only, because it has no data about other vessels.
    - Random θ are not simulated on training pours.
    - The uncalibrated θ is simulated on the training pours too, because it was fitted to none of them. Its comparison
      with θ* on training and test pours decides which one is recommended (`calibration_gain`).
    - If θ has a posterior, the mean of the simulations over its draws is scored as well. Prediction intervals are based
      on these draws.
    """

    def __init__(
        self,
        theta: SimulationParameters,
        random_thetas: Mapping[str, SimulationParameters],
        pours: Sequence[ScoredPour],
        contexts: Contexts,
        seed: int,
        *,
        uncalibrated: SimulationParameters | None = None,
        sampled: Sequence[SimulationParameters] = (),
        train_seeds: Sequence[int] = (),
        trials: Sequence[tuple[Mapping[str, float], Sequence[float | None]]] = (),
    ) -> None:
        """Plan the simulations.

        Args:
            random_thetas: θ by label, 'random 1' … .
            pours: pours of the splits 'train', 'test' and 'transfer'.
            contexts: contexts of the regression.
            uncalibrated: θ that is used without a calibration; it is not scored if it is None. If θ* equals it, no
                change is recommended.
            sampled: draws from θ's posterior.
            train_seeds: seeds of simulations on the usable training pours; empty: new ones.
            trials: θ of the calibration with their |r − c_s| on the usable training pours.
        """
        self._theta, self._scored, self._trials = theta, list(pours), trials
        unseen = [scored for scored in pours if scored.pour.split != "train"]
        train = [scored for scored in pours if scored.pour.split == "train"]
        # Unseen pours come first in both, so that θ* and random θ have the same seeds on them.
        self._calibrated = Evaluation({CALIBRATED: theta}, [*unseen, *train], seed, train_seeds=train_seeds)
        self._parts = [self._calibrated, Evaluation(random_thetas, unseen, seed)]
        self._plain: Evaluation | None = self._calibrated if uncalibrated == theta else None
        if uncalibrated is not None and uncalibrated != theta:
            plain = {UNCALIBRATED: uncalibrated}
            self._plain = Evaluation(plain, [*unseen, *train], seed, train_seeds=train_seeds)
            self._parts.append(self._plain)
        if sampled:  # with other seeds: a draw can be θ* itself
            draws = {f"posterior {k}": theta for k, theta in enumerate(sampled, 1)}
            self._parts.append(Evaluation(draws, unseen, seed + 1))
        self._owner: dict[Simulate, Evaluation] = {}
        self._contexts = contexts
        self._pours: dict[str, list[MeasuredPour]] = {}
        for scored in pours:
            self._pours.setdefault(scored.pour.split, []).append(scored.pour)
        self._baselines: tuple[BySplit, BySplit] | None = None
        self._gain: CalibrationGain | None = None
        self._residuals: tuple[SpillageResidual, ...] = ()
        self._without: WithoutMisfits | None = None

    @property
    def finished(self) -> bool:
        """Every simulation has been answered."""
        return all(scorer.finished for scorer in self._parts)

    @property
    def decisions(self) -> list[Decision]:
        """Reasons for the simulations and, at the end, the recommended θ."""
        decisions = [decision for scorer in self._parts for decision in scorer.decisions]
        if self._gain is not None:
            numbers = {"gain": self._gain.gain, "gain_error": self._gain.gain_error}
            defined = {name: value for name, value in numbers.items() if value is not None}
            decisions.append(Decision(self._gain.text, defined))
        return decisions

    def ask(self, slots: Slots) -> list[Request]:
        """Return the next simulations, θ* first."""
        requests: list[Request] = []
        for scorer in self._parts:
            issued = scorer.ask(Slots(slots.simulations - len(requests), 0))
            self._owner.update({request: scorer for request in issued if isinstance(request, Simulate)})
            requests += issued
        return requests

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a simulation. Raises ValueError if it was not requested."""
        owner = self._owner.get(request) if isinstance(request, Simulate) else None
        if owner is None:
            raise ValueError(f"this simulation was not asked for: {request}")
        owner.tell(request, outcome)
        if not self.finished:
            return
        simulated = self._calibrated.simulated()
        self._residuals = pour_residuals(
            [ResidualPair(scored.pour, scored.scene, simulated.get(id(scored))) for scored in self._scored],
            self._theta.particles,
        )
        self._without = without_misfits(self._residuals, self._trials)
        if self._plain is not None:
            compared = [
                [pair for pair in scorer.result().pairs if pair.split != "transfer"]
                for scorer in (self._calibrated, self._plain)
            ]
            gain, misfits = calibration_gain(*compared), misfit_sentence(self._residuals, self._without)
            self._gain = gain.model_copy(update={"text": f"{gain.text}; but {misfits}"}) if misfits else gain

    def progress(self) -> Progress:
        """Simulations answered, and their total number."""
        return sum((scorer.progress() for scorer in self._parts), Progress())

    def result(self) -> Scores:
        """Mean |r − c_s| by label and split, the random θ's median by split, and the baselines without a simulator."""
        parts = [scorer.result() for scorer in self._parts]
        mean_predictor, regression = self._without_simulator() if self.finished else ({}, {})
        return Scores(
            simulations=sum(result.simulations for result in parts),
            undefined={label: count for result in parts for label, count in result.undefined.items()},
            discrepancy={label: scores for result in parts for label, scores in result.discrepancy.items()},
            random_median=parts[1].random_median,
            posterior_mean=parts[-1].posterior_mean,
            thetas={label: theta for result in parts for label, theta in result.thetas.items()},
            pairs=tuple(pair for result in parts for pair in result.pairs),
            mean_predictor=mean_predictor,
            regression=regression,
            gain=self._gain,
            pours=self._residuals,
            without=self._without,
        )

    def _without_simulator(self) -> tuple[BySplit, BySplit]:
        """Scores of the mean predictor and of the regression, calculated once."""
        if self._baselines is None:
            train = self._pours.get("train", [])
            unseen = {split: pours for split, pours in self._pours.items() if split != "train"}
            test = {split: pours for split, pours in unseen.items() if split == "test"}
            self._baselines = (
                {split: mean_predictor_discrepancy(train, pours) for split, pours in unseen.items()},
                {split: regression_discrepancy(self._contexts, train, pours) for split, pours in test.items()},
            )
        return self._baselines
