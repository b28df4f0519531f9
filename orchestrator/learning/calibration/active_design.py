"""Active design of calibration pours: each pour is chosen by its expected information about deployment.

`ActiveDesign` is the strategy; `joint_contexts` builds the space of its surrogate. The variance reduction is calculated
in `actors.optimizer.theta_posterior`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from actors.optimizer.questions import (
    CalibrationQuery,
    Data,
    DesignQuestion,
    Linear,
    Point,
    PosteriorQuestion,
    Suggestion,
)
from orchestrator.learning.calibration.action_prior import Contexts, actions_of_prior
from orchestrator.learning.calibration.campaign_memory import unit_memory
from orchestrator.learning.calibration.posterior_summary import unit_prior
from orchestrator.learning.calibration.pour_design import DesignResult, SimulatedPoint, StratifiedDesign, Stratum
from orchestrator.learning.campaign_plan import CalibrationPlan, DeploymentPlan, NormalPrior
from orchestrator.learning.requests import Decision, Failed, Outcome, Request, Simulate, Simulated, Slots, Suggest
from orchestrator.learning.strategy import Progress, is_sound
from orchestrator.learning.trials import OptimizerQueries, Trial, Trials
from sim_engine.action import ACTION_DIMENSIONS, Action, described
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import Scene
from sim_engine.search_space import Axis, Space

CANDIDATES, TARGETS = 64, 48
"""Number of actions that a pour is chosen from, and number of actions to be predicted; each in all scenes together."""

DRAWS = 128
"""Number of posterior draws of θ that a choice is based on."""

WEIGHED = 0.02
"""Standard deviation of a weighed pour around the bench's mean, as a fraction of the poured liquid."""

CHECKED = 8
"""Number of simulations of a chosen pour with likely θ, if θ moves the bench. In none of them the cups may touch: in
the pour the vessels stand as they truly do, and it would be lost, or damage them."""

CLOSE = 0.2
"""Distance in the unit cube of actions within which candidates are left out after a failed pour."""

LEAST_SIMULATED = 8
"""Minimum number of usable simulations for a surrogate. With fewer, the pours are taken from the candidates in
order."""


@dataclass(frozen=True)
class ContextPlace:
    """An action in a scene, with its point in the surrogate's space and in the unit cube of actions."""

    scene: Scene
    action: Action
    point: Point
    chosen: Point


class ActiveDesign(StratifiedDesign):
    """Weigh the pours that are most informative about deployment: simulate first, then choose pour by pour.

    A surrogate of the simulated spillage over θ, actions and receivers is fitted to `design_simulations` simulations.
    The receivers include those of deployment. θ has its posterior given the pours made so far, or the prior before the
    first pour. It includes the bench's nuisances if they are searched.

    Each pour is the candidate with the largest expected reduction of the variance of the predicted spillage. The
    variance is averaged over the actions and receivers of deployment, or over calibration's own without a deployment.
    If θ moves the bench (`receiver_x`, …), the candidate is first simulated with likely θ, and the next best one is
    taken if the cups touch. Simulations at candidates also serve C4. Pours that are kept for testing follow an even
    design.

    A candidate whose pour fails is removed with those close to it. A failed pour yields no data, and the design loses
    one point.

    Source: as `actors.optimizer.theta_posterior`; Kennedy & O'Hagan 2001 for the model.
    Limitations: between pours, only the simulations that check them improve the surrogate; the order of magnitude of a
    pour's scatter is assumed.
    """

    def __init__(self, plan: CalibrationPlan, deployment: DeploymentPlan | None, seed: int) -> None:
        """Plan the pours and queue the simulations of all scenes."""
        super().__init__(
            plan.scenes,
            plan.actions,
            plan.pour_count,
            plan.holdout,
            seed,
            constraints=plan.constraints,
            tested=plan.tested,
        )
        self._plan = plan
        self._questions, self._trials = OptimizerQueries(self._seeds), Trials()
        pairs = [(scene, plan.actions) for scene in plan.scenes]
        wanted = pairs if deployment is None else [(scene, deployment.actions) for scene in deployment.scenes]
        self._contexts = joint_contexts([*pairs, *wanted])
        self._candidates = self._places(pairs, CANDIDATES, plan.constraints, plan.prior)
        self._targets = self._places(wanted, TARGETS, (deployment or plan).constraints)
        self._aim: ContextPlace | None = None
        self._likely: list[Point] = []
        self._next_best: list[tuple[ContextPlace, Decision]] = []
        self._checks: list[Trial] = []
        self._touching: list[tuple[int, ContextPlace]] = []
        self._moves = not set(plan.parameters.names).isdisjoint(SimulationParameters.nuisances())
        self._simulate()
        receivers = ", ".join(dict.fromkeys(scene.receiver.name for scene, _ in wanted))
        text = f"{len(self._trials)} simulations to see which pours tell most about pours into {receivers}"
        self.decisions.append(Decision(text))

    def _places(
        self,
        where: Sequence[tuple[Scene, Space]],
        count: int,
        constraints: Sequence[Linear],
        prior: Sequence[NormalPrior] = (),
    ) -> list[ContextPlace]:
        """Distribute actions evenly over all scenes, in random order, so that any section is even as well."""
        places: list[ContextPlace] = []
        for scene, actions in where:
            each = max(count // len(where), 1)
            for point in actions_of_prior(actions, each, self._seeds.next(), constraints, prior):
                action = scene.action(actions.decode(point))
                places.append(ContextPlace(scene, action, self._contexts.place(scene, action), point))
        return [places[i] for i in self._seeds.rng.permutation(len(places))]

    def _simulate(self) -> None:
        """Queue the simulations: θ from the whole box, alternately at targets and at candidates."""
        space = self._plan.parameters
        for i, theta in enumerate(actions_of_prior(space, self._plan.design_simulations, self._seeds.next())):
            among = self._candidates if i % 2 else self._targets
            self._try(theta, among[(i // 2) % len(among)])

    def _try(self, theta: Point, place: ContextPlace) -> Trial:
        values = {**self._plan.fixed_parameters, **self._plan.parameters.decode(theta)}
        parameters = SimulationParameters.from_values(values)
        request = Simulate(place.scene.name, place.action, parameters, self._seeds.next(), "design")
        trial = Trial(theta, (request,), place.point)
        self._trials.add(trial)
        return trial

    # -- asking ----------------------------------------------------------------------------------------------------

    def ask(self, slots: Slots) -> list[Request]:
        """Return simulations first, then a query, and then the pour that its answer selects."""
        if not self._trials.idle:
            return list(self._trials.issue(slots.simulations))
        if self._checks and not self._passed():
            return list(self._trials.issue(slots.simulations))
        if self.finished or self._pouring is not None:
            return []
        planned = self._planned[self._current]
        if planned.split == "train" and self._aim is None and not self._questions.out:
            self._ask_for_a_place()
        if self._questions.out:
            return list(self._questions.issue())
        if planned.split == "train" and self._aim is not None:
            planned.scene, planned.stratum = self._aim.scene, Stratum(self._aim.chosen, self._aim.chosen)
        return super().ask(slots)

    def _ask_for_a_place(self) -> None:
        data = self._trials.data(everything=True)
        if len(data) < LEAST_SIMULATED:
            self._aim = self._candidates[self._current % len(self._candidates)]
            self.decisions.append(Decision("too few simulations were usable: this pour is any of the candidates"))
            return
        measured = [pour for pour in self.measured if pour.spillage is not None and pour.split == "train"]
        weighed = PosteriorQuestion(
            tuple(self._contexts.point(pour) for pour in measured),
            tuple(pour.spillage for pour in measured if pour.spillage is not None),
            WEIGHED,
            DRAWS,
            unit_prior(self._plan),
            unit_memory(self._plan.memory, self._plan.parameters),
        )
        query = CalibrationQuery(
            self._plan.parameters,
            Data(data.points, tuple(-cost for cost in data.costs)),  # difference to zero, because no pour belongs to it
            count=0,
            contexts=(self._targets[0].point,),
            posterior=weighed,
            design=DesignQuestion(
                tuple(place.point for place in self._candidates), tuple(place.point for place in self._targets)
            ),
        )
        self._questions.put(query, "design", self._choose)

    def _choose(self, suggestion: Suggestion) -> None:
        before, gains = suggestion.uncertainty or 0.0, suggestion.gains
        self._next_best, self._touching = [], []
        for i in sorted(range(len(gains)), key=lambda i: -gains[i]):
            place, left = self._candidates[i], max(before - gains[i], 0.0)
            text = (
                f"what pours to be deployed spill is known to ± {100 * before**0.5:.1f} % of what is poured, after "
                f"the next pour into {place.scene.receiver.name} to ± {100 * left**0.5:.1f} %"
            )
            self._next_best.append((place, Decision(text, {"variance": before, "gain": gains[i]})))
        draws = () if suggestion.posterior is None else suggestion.posterior.points
        self._likely = [draws[k * len(draws) // CHECKED] for k in range(CHECKED)] if self._moves and draws else []
        self._take_next()

    def _take_next(self) -> None:
        """Take the best candidate that is left, and simulate it with likely θ."""
        self._aim, decision = self._next_best.pop(0)
        self._checks = [self._try(theta, self._aim) for theta in self._likely]
        self.decisions.append(decision)

    def _passed(self) -> bool:
        """Whether the cups stay apart in the pour to be made; otherwise the next candidate is taken. If they touch in
        all, it is the one in which they touch least often."""
        assert self._aim is not None
        touching = sum(trial.refused for trial in self._checks)
        self._checks = []
        if not touching:
            return True
        self._touching.append((touching, self._aim))
        if not self._next_best:
            self._aim = min(self._touching, key=lambda one: one[0])[1]
            return True
        values = {name: getattr(self._aim.action, name) for name in self._plan.actions.names}
        text = (
            f"with likely θ the cups touch in {touching} of {CHECKED} simulations of {described(values)}: another pour"
        )
        self.decisions.append(Decision(text))
        self._take_next()
        return False

    # -- outcomes --------------------------------------------------------------------------------------------------

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a simulation, a query or a pour."""
        if isinstance(request, Suggest):
            self._questions.answer(request, outcome)
        elif isinstance(request, Simulate):
            refused = isinstance(outcome, Failed) and outcome.kind == "invalid_action"
            self._trials.settle(request, _spillage(outcome), refused=refused)
        else:
            super().tell(request, outcome)
            if self._aim is not None and isinstance(outcome, Failed):
                self._leave_out(self._aim)
            self._aim = None

    def _leave_out(self, failed: ContextPlace) -> None:
        """Remove a candidate whose pour failed, and those close to it, while others are left."""
        others = [
            place
            for place in self._candidates
            if place.scene.name != failed.scene.name or math.dist(place.chosen, failed.chosen) > CLOSE
        ]
        self._candidates = others or [place for place in self._candidates if place is not failed] or self._candidates

    def result(self) -> DesignResult:
        """The pours so far in the order made, and the simulations that calibration can also use."""
        poured, names = {scene.name for scene in self._plan.scenes}, self._plan.actions.names
        simulated = []
        for trial in self._trials.all:
            (request,) = trial.requests
            if request.scene in poured and trial.cost is not None:
                simulated.append(
                    SimulatedPoint(
                        theta=self._plan.parameters.decode(trial.point),
                        scene=request.scene,
                        action_si={name: getattr(request.action, name) for name in names},
                        spillage=trial.cost,
                    )
                )
        return super().result().model_copy(update={"simulated": tuple(simulated)})

    def progress(self) -> Progress:
        """Simulations and pours."""
        return super().progress() + Progress(self._trials.answered, len(self._trials))


def joint_contexts(where: Sequence[tuple[Scene, Space]]) -> Contexts:
    """Combine all scenes and all action dimensions that differ within or between them.

    A dimension that is switched off in some scene has no axis; the scene's own coordinate represents its effect.
    """
    axes: list[Axis] = []
    for name in ACTION_DIMENSIONS:
        ends: list[float] = []
        for scene, actions in where:
            axis = next((axis for axis in actions.axes if axis.name == name), None)
            value = getattr(scene.action(actions.decode([0.5] * actions.dimension)), name)
            if axis is None and value is None:
                ends = []
                break
            ends += [float(value or 0.0)] if axis is None else [axis.lower, axis.upper]
        if ends and max(ends) > min(ends):
            axes.append(Axis(name, min(ends), max(ends)))
    return Contexts(Space(tuple(axes)), list({scene.name: scene for scene, _ in where}.values()))


def _spillage(outcome: Outcome) -> float | None:
    """c_s of a valid simulation; otherwise None."""
    if not isinstance(outcome, Simulated) or outcome.outcome.invalid is not None:
        return None
    return outcome.outcome.fractions.spillage if is_sound(outcome.outcome.fractions) else None
