"""C4: Bayesian optimisation of the objective O2 with one simulation per iteration.

`C4Settings` holds the settings, `ContinuousBayesianCalibration` is the strategy. O1 and its strategies C1 to C3 are in
`pointwise_calibration`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self

from actors.optimizer.questions import (
    CalibrationQuery,
    Data,
    MinimumQuery,
    Point,
    PosteriorQuestion,
    RegressionQuery,
    RememberedGroup,
    SpaceFillingQuery,
    Suggestion,
)
from orchestrator.learning.calibration.action_prior import Contexts
from orchestrator.learning.calibration.automatic_calibration import AutomaticCalibration, simulation_limit
from orchestrator.learning.calibration.calibration_base import (
    THETA_MAP_RESOLUTION,
    Calibration,
    Kappa,
    TriedOnce,
    check_initial,
    described,
)
from orchestrator.learning.calibration.posterior_summary import (
    central,
    left_open,
    unit_prior,
)
from orchestrator.learning.campaign_plan import CalibrationPlan, CalibrationSettings, MeasuredPour
from orchestrator.learning.requests import Decision, Simulate
from orchestrator.learning.run_errors import LearningError
from orchestrator.learning.strategy import Strategy
from orchestrator.learning.trials import Trial
from sim_engine.outcome import MINIMUM_POURED
from sim_engine.settings.model import CountOrAuto, PositiveSimulationCount, Problems

CONTEXT_SIZE = 24
"""Number of actions over which the surrogate is averaged."""

LIVE_MAP_EVERY = 10
"""Number of simulations between two maps for the live view; one map takes about 20 ms."""

LIVE_MAP_RESOLUTION = 20


class C4Settings(CalibrationSettings):
    """C4: Bayesian optimisation of the mean discrepancy over the actions, one simulation per iteration."""

    has_prior: ClassVar[bool] = True

    strategy: Literal["C4"] = "C4"
    """Bayesian optimisation of the mean discrepancy over the actions, one simulation per iteration."""

    simulations: CountOrAuto = "auto"
    """Single simulated pours; 'auto': as many as still change the posterior of the parameters."""

    initial_samples: PositiveSimulationCount = 8
    """Random parameters before the surrogate is used."""

    kappa: Kappa = 2.0
    """κ of the lower confidence bound."""

    averaging: Literal["context", "noise"] = "context"
    """context: the simulated action is an input of the surrogate; noise: its influence is noise, as in the paper."""

    @property
    def budget(self) -> int:
        """Number of simulations that is given."""
        assert self.simulations != "auto", "only a given number is a budget"
        return self.simulations

    @property
    def makes_posterior(self) -> bool:
        """Whether there is a posterior; it requires a surrogate with actions as inputs."""
        return self.averaging == "context"

    def settled(self, searched: tuple[str, ...], train: int, complaints: Problems) -> Self | None:
        """Check the settings; they are returned unchanged."""
        if self.simulations != "auto":
            check_initial(self, self.initial_samples, self.simulations, "simulations", "simulations", complaints)
        elif not self.makes_posterior:
            text = "'noise' has no posterior, so 'simulations' needs a number; add for example 'simulations: 108'"
            complaints.add(text, "averaging")
        return None if complaints.any else self

    def simulations_on(self, train: int) -> int:
        """Number of simulations: one per iteration, independent of the number of pours; with 'auto' the largest
        number."""
        return simulation_limit(train) if self.simulations == "auto" else self.simulations

    def build(self, plan: CalibrationPlan, pours: Sequence[MeasuredPour], seed: int) -> Strategy:
        """Build the strategy."""
        if self.simulations == "auto":
            return AutomaticCalibration(plan, pours, seed, kappa=self.kappa)
        return ContinuousBayesianCalibration(plan, pours, seed)


class ContinuousBayesianCalibration(Calibration[C4Settings]):
    """C4: minimise O2(θ) = E_{a~g} |c_r(a) − c_s(a, θ)| with one simulation per iteration.

    The measured spillage is first regressed by a GP, so that a discrepancy can be formed at any action. Every iteration
    simulates one θ at one action of the prior g; the surrogate averages over actions. Two details differ from the
    paper, because both lower the variance at the same cost:

    - The actions are a scrambled Sobol sequence instead of independent draws. Any run of consecutive iterations covers
      g evenly.
    - The discrepancy varies far more over actions than over θ, and |·| removes its sign. The surrogate is therefore a
      GP of the signed difference c_r − c_s over (θ, a). The minimised quantity is the mean over g of the absolute value
      that it predicts (the setting `averaging`: 'context'). With 'noise', as in the paper, the surrogate models |c_r −
      c_s| over θ alone and treats the action's influence as noise. κ is a constant in that case, too.

    g is uniform over the box of actions unless they have a `prior`. It is limited to actions at which c_r is defined:
    actions at which less than 5 % is expected to be poured are left out. A simulation that failed, or that poured too
    little to define c_s, carries no information about its neighbours and is dropped.

    θ* is the most central of the θ that fit the weighed pours: the posterior draw with the smallest distance to all
    others. Where O2 is flat, its minimiser is arbitrary: it mostly lies at an edge of the box, and the weighed pours
    often exclude it. With 'noise', θ* minimises the surrogate's mean over the whole box, as in the paper; the lowest
    observation would be biased by noise.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.3 (C4); a surrogate over both arguments of an expected cost:
    Toscano-Palmerin & Frazier, Bayesian optimization with expensive integrands, 2018.
    Limitations: a θ with which some simulated pours stop short is evaluated only at the actions at which it does pour.
    With `averaging` 'noise' the optimiser sees heteroscedastic noise, large where the discrepancy varies over g. There
    is no posterior of θ in that case.
    """

    def __init__(self, plan: CalibrationPlan, measured: Sequence[MeasuredPour], seed: int) -> None:
        """Plan the calibration; only pours of the split 'train' are used.

        Raises:
            LearningError: fewer than two usable pours.
        """
        super().__init__(plan, measured, seed)
        self._contexts = Contexts.of(plan)
        self._knows_actions = self._settings.averaging == "context"
        self._started = False
        self._mapped = 0
        self._actions: tuple[Point, ...] = ()
        self._measured_at: tuple[float, ...] = ()
        self._expected_at: dict[Simulate, float] = {}
        self._before = Data()
        self._weighed: PosteriorQuestion | None = None

    # -- asking ----------------------------------------------------------------------------------------------------

    def _next(self) -> None:
        """Regress c_r once, then choose θ one by one with one simulation each, and finally determine θ*."""
        if not self._started:
            self._started = True
            self._ask_regression()
        elif self._actions:
            self._ask_parameters()

    def _ask_regression(self) -> None:
        """Predict c_r(a), and whether it is defined, along the prior's sequence of actions."""
        contexts = self._contexts
        sequence = contexts.sequence(self._plan, 2 * self._settings.budget, self._seeds.next())
        scenes = {scene.name: scene for scene in self._plan.scenes}
        places = tuple(contexts.place(scenes[pair.scene], pair.action) for pair in self._plan.known)
        everywhere = (*sequence, *places)
        spillage, poured = Data(), Data()
        for pour in self._train:
            point = contexts.point(pour)
            poured = poured.added(point, pour.poured)
            if pour.spillage is not None:
                spillage = spillage.added(point, pour.spillage)
        query = RegressionQuery(contexts.space, spillage, predict_at=everywhere)

        def with_poured(regression: Suggestion, likely: Suggestion | None) -> None:
            keep = [
                i
                for i in range(len(sequence))
                if likely is None or likely.predictions[i] - likely.prediction_deviations[i] >= MINIMUM_POURED
            ][: self._settings.budget]
            if not keep:
                raise LearningError(
                    f"at no action of the calibration's space would {MINIMUM_POURED:.0%} of the liquid be poured, as "
                    "far as the weighed pours tell; let it tilt farther (max_angle)"
                )
            # c_r may be defined at a few places only: they are used repeatedly
            order = [keep[i % len(keep)] for i in range(self._settings.budget)]
            self._actions = tuple(sequence[i] for i in order)
            self._measured_at = tuple(min(max(regression.predictions[i], 0.0), 1.0) for i in order)
            expected = regression.predictions[len(sequence) :]
            for simulation, place, measured in zip(self._plan.known, places, expected, strict=True):
                theta = tuple(map(float, self._plan.parameters.encode(simulation.theta)))
                self._before = self._before.added((*theta, *place), min(max(measured, 0.0), 1.0) - simulation.spillage)
            self.decisions.append(
                Decision(f"c_r(a) regressed from {len(self._usable)} pours", dict(regression.hyperparameters or {}))
            )

        def with_spillage(regression: Suggestion) -> None:
            if len(self._usable) == len(self._train):
                with_poured(regression, None)
            else:
                where_defined = RegressionQuery(contexts.space, poured, predict_at=sequence)
                self._questions.put(where_defined, "regress", lambda likely: with_poured(regression, likely))

        self._questions.put(query, "regress", with_spillage)

    def _ask_parameters(self) -> None:
        """Query the next θ, or θ* once the budget is spent."""
        remaining = self._settings.budget - len(self._trials)
        if remaining <= 0:
            if self._trials.idle and self._knows_actions:
                self._ask_posterior()
            elif self._trials.idle:
                query = self._query(
                    everything=True, acquisition="posterior_minimum", map_resolution=THETA_MAP_RESOLUTION
                )
                self._questions.put(query, "conclude", self._settle_at_minimum)
            return
        if len(self._trials) == 0:
            count = min(max(self._settings.initial_samples, 1), remaining)
            self._questions.put(SpaceFillingQuery(self._plan.parameters, count=count), "start", self._queue)
        elif self._trials.ready:
            self._questions.put(self._query(map_resolution=self._live_resolution()), "calibrate", self._queue)

    def _ask_posterior(self) -> None:
        """Query draws of θ given the training pours; first predict the regression at them, which the differences
        contain."""
        places = tuple(self._contexts.point(pour) for pour in self._usable)
        weighed = tuple(pour.spillage for pour in self._usable if pour.spillage is not None)

        def drawn(suggestion: Suggestion) -> None:
            self._posterior = suggestion.posterior
            if self._posterior is None:
                raise self._no_discrepancies()
            if self._contradicts(self._posterior):
                ask(self._memory)
                return
            self.decisions += [Decision(text) for text in left_open(self._posterior, self._plan.parameters.names)]
            self._ask_expected(central(self._posterior))

        def regressed(regression: Suggestion) -> None:
            offsets = tuple(
                spillage - min(max(expected, 0.0), 1.0)
                for spillage, expected in zip(weighed, regression.predictions, strict=True)
            )
            noise = (regression.hyperparameters or {}).get("noise", 0.0)
            self._weighed = PosteriorQuestion(places, offsets, noise, prior=unit_prior(self._plan))
            ask(self._memory)

        def ask(memory: tuple[RememberedGroup, ...] | None) -> None:
            assert self._weighed is not None
            query = self._query(everything=True, count=0, posterior=replace(self._weighed, memory=memory))
            self._questions.put(query, "posterior", drawn)

        data = Data(places, weighed)
        self._questions.put(RegressionQuery(self._contexts.space, data, predict_at=places), "regress", regressed)

    def _ask_expected(self, point: Point) -> None:
        """Query the expected discrepancy of θ* and the map through it."""

        def settle(suggestion: Suggestion) -> None:
            self._final = suggestion
            self._remember(suggestion.posterior)
            self._settle(point, suggestion.predictions[0], suggestion.prediction_deviations[0])

        alone = None if self._memory is None else self._weighed
        query = self._query(
            everything=True,
            count=0,
            predict_at=(point,),
            map_at=point,
            map_resolution=THETA_MAP_RESOLUTION,
            posterior=alone,
        )
        self._questions.put(query, "conclude", settle)

    def _live_resolution(self) -> int:
        """Resolution of the map that the next answer carries for the live view; mostly 0, for no map."""
        if len(self._trials) - self._mapped < LIVE_MAP_EVERY:
            return 0
        self._mapped = len(self._trials)
        return LIVE_MAP_RESOLUTION

    def _query(self, *, everything: bool = False, **parts: Any) -> CalibrationQuery | MinimumQuery:
        """A query about O2, with further parts of it; `everything` uses all closed trials and no pending ones."""
        data = self._trials.data(everything=everything)
        parts |= {"kappa": self._settings.kappa, "pending": () if everything else self._trials.pending()}
        if not self._knows_actions:
            return MinimumQuery(self._plan.parameters, data, plain=True, **parts)
        data = Data(self._before.points + data.points, self._before.costs + data.costs)
        return CalibrationQuery(self._plan.parameters, data, contexts=self._actions[:CONTEXT_SIZE], **parts)

    # -- outcomes --------------------------------------------------------------------------------------------------

    def _queue(self, suggestion: Suggestion) -> None:
        for i, point in enumerate(suggestion.points):
            index = len(self._trials)
            theta = self.parameters_at(point)
            scene, action = self._contexts.request(self._actions[index])
            request = Simulate(scene.name, action, theta, self._seeds.next(), "calibrate")
            context = self._actions[index] if self._knows_actions else ()
            self._expected_at[request] = self._measured_at[index]
            self._trials.add(Trial(point, (request,), context))
            if suggestion.means:
                text = f"θ {described(self._values(point))}: expected |Δ| {max(suggestion.means[i], 0.0):.3f}"
                self.decisions.append(Decision(text, {"mean": suggestion.means[i], "sd": suggestion.deviations[i]}))

    def _discrepancy(self, request: Simulate, simulated: float) -> float:
        """c_r(a) − c_s(a, θ); its absolute value if the surrogate treats actions as noise."""
        difference = self._expected_at[request] - simulated
        return difference if self._knows_actions else abs(difference)

    # -- results ---------------------------------------------------------------------------------------------------

    @property
    def _budget(self) -> int:
        return self._settings.budget

    def _row(self, number: int, trial: Trial) -> TriedOnce:
        action = trial.requests[0].action
        return TriedOnce(
            theta=self._values(trial.point),
            action_si={name: getattr(action, name) for name in self._plan.actions.names},
            measured=self._measured_at[number],
            discrepancy=None if trial.cost is None else abs(trial.cost),
            difference=trial.cost if self._knows_actions else None,
        )
