"""What earlier campaigns tell a new one about its parameters: a prior that loses its weight if the pours contradict it.

- `predicted` combines the estimates of earlier campaigns to a prediction for the next one.
- `CampaignMemory` is the resolved prior of a campaign: a part of its plan, and therefore of its journal.
- `unit_memory` converts it for the optimiser; `MemoryFound` is its part of a calibration's result.

Parameters of the liquid, of the vessels' walls and of the placement are three groups. Each keeps or loses its weight
as a whole; as soon as the pours contradict one, no memory is used any more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from actors.optimizer.questions import WRITTEN_IF_SET, Point, Posterior, RememberedGroup, truncated_quantiles
from orchestrator.learning.requests import Decision
from orchestrator.learning.stage_result import ResultPart
from sim_engine.action import Action
from sim_engine.liquids import ParameterInfo, SimulationParameters
from sim_engine.search_space import Axis, Space
from sim_engine.settings.model import NOT_IN_FINGERPRINT

LIQUID, WALLS, PLACEMENT = "liquid", "walls", "placement"

GROUPS: dict[str, tuple[str, ...]] = {
    LIQUID: ("cohesion", "xsph_rate", "viscosity_factor", "smagorinsky_constant"),
    WALLS: ("friction", "wall_distance", "rim_correction", "lip_adhesion"),
    PLACEMENT: tuple(SimulationParameters.nuisances()),
}
"""Parameters by what they describe. The number of particles describes nothing: it is never transferred."""

RELIANCE = 0.8
"""Prior probability that the memory of a group holds in a new campaign."""

CONTRADICTED = 0.7
"""Posterior probability below which the memory of a group is reported as contradicted: the pours make the searched
range at least 1.7 times as likely as the memory. From then on no group is used, because parameters compensate each
other, and a wrong memory costs more than a missing one."""

CONFIRMED = 0.87
"""Posterior probability above which the pours confirm a memory: they make it about 1.7 times as likely as the
searched range. Between the two limits they say little about it."""

SPREAD, OTHER_VESSEL, OF_TOLERANCE = 0.05, 0.15, 0.5
"""Scale of the differences between campaigns before any were observed: fraction of a parameter's whole range, the same
for the walls of another vessel, and fraction of the tolerance of a placement."""

GRID = 121
"""Number of between-campaign deviations that are averaged over, up to six times their scale."""


CHECKS = {
    LIQUID: "is it the same liquid?",
    WALLS: "do these cups have the same surface?",
    PLACEMENT: "was the receiver or the arm moved?",
}
"""What a person should check if the memory of a group does not hold."""


def group_of(name: str) -> str | None:
    """The group of a parameter; None if it is not transferred."""
    return next((group for group, names in GROUPS.items() if name in names), None)


def usual_spread(info: ParameterInfo, *, same_vessel: bool) -> float:
    """Scale of the differences of a parameter between campaigns [its SI unit]."""
    if info.nuisance:
        return OF_TOLERANCE * info.tolerance
    other = info.name in GROUPS[WALLS] and not same_vessel
    return (OTHER_VESSEL if other else SPREAD) * (info.upper - info.lower)


def predicted(estimates: Sequence[tuple[float, float]], spread: float) -> tuple[float, float]:
    """Mean and standard deviation of a parameter in the next campaign.

    A campaign's true value is normal around a common mean with the between-campaign deviation τ. The result averages
    over the posterior of τ, whose prior is half-normal with the scale `spread`. With one earlier campaign that prior
    alone decides; with more, the differences between campaigns do.

    Args:
        estimates: mean and standard deviation from the pours of each earlier campaign, at least one.
        spread: scale of τ before any differences were observed.

    Source: Gelman et al., Bayesian Data Analysis, 3rd ed. 2013, section 5.4 (normal hierarchical model), with a
    half-normal prior of τ: Röver et al., Research Synthesis Methods 12, 2021.
    """
    means, deviations = (np.array(values) for values in zip(*estimates, strict=True))
    taus = 6.0 * spread * (np.arange(GRID) + 0.5) / GRID
    precisions = 1.0 / (deviations**2 + taus[:, None] ** 2)
    variances = 1.0 / precisions.sum(axis=1)
    centres = variances * (precisions * means).sum(axis=1)
    logs = -0.5 * (taus / spread) ** 2 + 0.5 * np.log(variances) + 0.5 * np.log(precisions).sum(axis=1)
    logs -= 0.5 * (precisions * (means - centres[:, None]) ** 2).sum(axis=1)
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    mean = float(weights @ centres)
    return mean, math.sqrt(float(weights @ (taus**2 + variances + (centres - mean) ** 2)))


@dataclass(frozen=True)
class RememberedParameter:
    """Prediction of one parameter.

    Attributes:
        mean, deviation: of a normal distribution, in the parameter's SI unit.
        runs: earlier runs that it comes from.
    """

    name: str
    mean: float
    deviation: float
    runs: tuple[str, ...]

    def __str__(self) -> str:
        """'receiver_x 14.1 ± 2.9 mm'."""
        info = SimulationParameters.info()[self.name]
        unit = "" if info.shown == "1" else f" {info.shown}"
        return f"{self.name} {self.mean / info.factor:.3g} ± {self.deviation / info.factor:.2g}{unit}"


@dataclass(frozen=True)
class WeighedPair:
    """A weighed pour and its simulation by a θ* that was fitted without it.

    Attributes:
        into: the calibration's scene of a pour in the same campaign, or the earlier run and the receiver.
        poured: fraction of the load that left the pourer.
        measured, simulated: spilled / poured.
    """

    into: str
    action: Action
    poured: float
    measured: float
    simulated: float


@dataclass(frozen=True)
class CampaignMemory:
    """The prior of a campaign from earlier ones.

    Attributes:
        parameters: may be empty, if nothing fits.
        left_out: reasons why posteriors, parameters or pours are not used, one text each.
        stale: posteriors that later pours disagree with, one text each.
        pours: weighed pours of these runs, from the campaign's pourer; None if none fits.
    """

    parameters: tuple[RememberedParameter, ...]
    left_out: Annotated[tuple[str, ...], NOT_IN_FINGERPRINT] = ()
    stale: Annotated[tuple[str, ...], NOT_IN_FINGERPRINT] = ()
    pours: tuple[WeighedPair, ...] | None = field(default=None, metadata=WRITTEN_IF_SET)

    @property
    def runs(self) -> tuple[str, ...]:
        """All runs that it comes from."""
        return tuple(dict.fromkeys(run for parameter in self.parameters for run in parameter.runs))

    @property
    def groups(self) -> dict[str, tuple[RememberedParameter, ...]]:
        """The parameters by group."""
        by_group = {group: tuple(p for p in self.parameters if p.name in names) for group, names in GROUPS.items()}
        return {group: parameters for group, parameters in by_group.items() if parameters}

    @property
    def means(self) -> dict[str, float]:
        """Expected values [SI] by name."""
        return {p.name: p.mean for p in self.parameters}

    @property
    def text(self) -> str:
        """'prior from the runs a, b: receiver_x 14.1 ± 2.9 mm (placement)'."""
        if not self.parameters:
            return "no earlier posterior fits this campaign; the prior is uniform, as without a memory"
        parts = [f"{', '.join(map(str, members))} ({group})" for group, members in self.groups.items()]
        return f"prior from the run{'s' * (len(self.runs) > 1)} {', '.join(self.runs)}: {'; '.join(parts)}"

    @property
    def lines(self) -> list[str]:
        """The text, and one line for each posterior that is stale, and for each reason why something is not used."""
        stale = [f"stale, and used: {text}" for text in self.stale]
        return [self.text, *stale, *(f"not used: {reason}" for reason in self.left_out)]

    def thetas(self, base: SimulationParameters, count: int) -> list[SimulationParameters]:
        """Equally likely θ (count) by the memory, evenly spread; other values as in `base`."""
        from scipy.stats import qmc

        infos = [SimulationParameters.info()[p.name] for p in self.parameters]
        rows = qmc.Sobol(len(infos), rng=np.random.default_rng(0)).random(2 ** math.ceil(math.log2(max(count, 2))))
        columns = [
            truncated_quantiles(rows[:count, i], p.mean, p.deviation, info.lower, info.upper)
            for i, (p, info) in enumerate(zip(self.parameters, infos, strict=True))
        ]
        names = [p.name for p in self.parameters]
        return [
            base.model_copy(update=dict(zip(names, map(float, row), strict=True))) for row in zip(*columns, strict=True)
        ]


def unit_memory(memory: CampaignMemory | None, space: Space) -> tuple[RememberedGroup, ...] | None:
    """The memory of the searched parameters in the unit cube; None without any."""
    if memory is None or not memory.parameters:
        return None
    groups = []
    for parameters in memory.groups.values():
        places = [(space.names.index(parameter.name), parameter) for parameter in parameters]
        rows = [_on_axis(space.axes[i], parameter) for i, parameter in places]
        groups.append(
            RememberedGroup(
                tuple(i for i, _ in places), tuple(row[0] for row in rows), tuple(row[1] for row in rows), RELIANCE
            )
        )
    return tuple(groups)


def _on_axis(axis: Axis, parameter: RememberedParameter) -> tuple[float, float]:
    if axis.scale == "log":
        mean = max(parameter.mean, axis.lower)
        return axis.encode(mean), parameter.deviation / mean / math.log(axis.upper / axis.lower)
    return axis.encode(parameter.mean), parameter.deviation / (axis.upper - axis.lower)


def remembered_point(point: Point, groups: Sequence[RememberedGroup]) -> Point:
    """A point (dimension,) of an even design, moved to the same quantiles of the memory."""
    moved = np.array([point])
    for group in groups:
        moved = group.moved(moved)
    return tuple(map(float, moved[0]))


def log_memory(point: Point, groups: Sequence[RememberedGroup]) -> float:
    """Logarithm of the prior density at a point (dimension,) of the unit cube; 0 without a memory."""
    at = np.array([point])
    return sum(math.log(group.weight * float(group.density(at)[0]) + 1.0 - group.weight) for group in groups)


class MemoryGroup(ResultPart):
    """What became of the memory of one group of parameters."""

    group: str
    """'liquid', 'walls' or 'placement'."""

    parameters: dict[str, tuple[float, float]]
    """Prior mean and standard deviation [SI] of each parameter."""

    runs: tuple[str, ...]
    """Earlier runs that the prior comes from."""

    probability: float
    """Probability that the memory holds, given the pours; before them it was 0.8."""

    contradicted: bool
    """Whether the pours contradict the memory."""


class EstimateAlone(ResultPart):
    """A parameter's posterior from the pours of this campaign alone."""

    mean: float
    """Mean [SI]."""

    deviation: float
    """Standard deviation [SI]."""


class MemoryFound(ResultPart):
    """The memory that a calibration used, and its agreement with the pours."""

    groups: tuple[MemoryGroup, ...]
    """One entry for each group of parameters."""

    alone: dict[str, EstimateAlone]
    """Posterior without the memory, by parameter: the form in which later campaigns use this one."""

    left_out: tuple[str, ...]
    """Posteriors and parameters that are not used, with reasons."""

    text: str
    """The runs that the prior comes from, and what the pours say about it."""

    @property
    def contradicted(self) -> bool:
        """Whether the pours contradict the memory of a group."""
        return any(group.contradicted for group in self.groups)

    @property
    def questions(self) -> tuple[str, ...]:
        """What a person should check: contradictions, and a placement that the pours do not confirm, because a moved
        receiver costs most."""
        texts = []
        for group in self.groups:
            runs, check = ", ".join(group.runs), CHECKS[group.group]
            if group.contradicted:
                texts.append(f"The pours contradict what {runs} found about the {group.group}: {check}")
            elif group.group == PLACEMENT and group.probability <= CONFIRMED and not self.contradicted:
                text = f"The pours say little about the placement, which is that of {runs}: {check}"
                texts.append(f"{text} If so, repeat the campaign without 'prior'.")
        return tuple(texts)


def verdicts(memory: CampaignMemory, shares: Mapping[str, float]) -> list[Decision]:
    """The agreement of groups with the pours, as decisions; a contradiction is urgent.

    Args:
        memory: prior of the campaign.
        shares: posterior probability of the memory of each group to be reported.
    """
    decisions = []
    for group, share in shares.items():
        parameters = memory.groups[group]
        runs = ", ".join(dict.fromkeys(run for parameter in parameters for run in parameter.runs))
        if share < CONTRADICTED:
            text = (
                f"the pours contradict the memory of the {group} ({runs}; {', '.join(map(str, parameters))}): its "
                f"probability falls from {100 * RELIANCE:.0f} to {100 * share:.0f} %; no memory is used any more"
            )
        else:
            verdict = "confirm" if share > CONFIRMED else "neither confirm nor contradict"
            text = f"the pours {verdict} the memory of the {group} ({runs}): probability {100 * share:.0f} %"
        decisions.append(Decision(text, {"probability": share}, urgent=share < CONTRADICTED))
    return decisions


def memory_found(
    memory: CampaignMemory | None, shares: Mapping[str, float], alone: Posterior | None, space: Space
) -> MemoryFound | None:
    """The memory's part of a result; None without a memory or before its end.

    Args:
        memory: prior of the campaign.
        shares: posterior probability of the memory of each group.
        alone: posterior without the memory.
        space: searched θ.
    """
    if memory is None:
        return None
    if not memory.parameters:
        return MemoryFound(groups=(), alone={}, left_out=memory.left_out, text=memory.text)
    if alone is None:
        return None
    groups = tuple(
        MemoryGroup(
            group=group,
            parameters={p.name: (p.mean, p.deviation) for p in parameters},
            runs=tuple(dict.fromkeys(run for parameter in parameters for run in parameter.runs)),
            probability=shares[group],
            contradicted=shares[group] < CONTRADICTED,
        )
        for group, parameters in memory.groups.items()
    )
    rows = [space.decode(point) for point in alone.points]
    parts = [memory.text, *(verdict.text for verdict in verdicts(memory, {g: shares[g] for g in memory.groups}))]
    if not any(group.contradicted for group in groups):
        parts.append("the uncalibrated parameters are those of this prior")
    text = "; ".join(parts)
    return MemoryFound(groups=groups, alone=estimates(rows), left_out=memory.left_out, text=text)


def estimates(rows: Sequence[Mapping[str, float]]) -> dict[str, EstimateAlone]:
    """Mean and standard deviation of each parameter over equally likely draws."""
    names = list(rows[0]) if rows else []
    values = {name: np.array([row[name] for row in rows]) for name in names}
    return {name: EstimateAlone(mean=float(x.mean()), deviation=float(x.std())) for name, x in values.items()}
