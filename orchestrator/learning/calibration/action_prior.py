"""Actions of calibration pours: the prior g over them, the surrogate's contexts, and draws of θ for uncertain worlds.

- `actions_of_prior` draws actions from g: a scrambled Sobol sequence, restricted by the constraints. g is uniform,
  except along dimensions with a normal prior.
- `actions_all_over` selects actions from the whole space for checks.
- `Contexts` maps actions in several scenes to points of one context space, and back.
- `drawn_worlds` draws complete θ with nuisances, from a calibration's posterior or from declared tolerances.

The module is loaded whenever a campaign file is read. It therefore imports scipy only inside the functions that draw.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.questions import Linear, Point, truncated_quantiles
from orchestrator.learning.campaign_plan import CalibrationPlan, MeasuredPour, NormalPrior
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import Scene
from sim_engine.search_space import Axis, Space

if TYPE_CHECKING:
    from actors.optimizer.feasible_region import Region


Array = NDArray[np.float64]

FINENESS = 2.0**30
"""Number of values per axis of a draw, as for a Sobol number. Logarithms may differ between machines in their last
bits; rounding to this grid yields the same action."""


def actions_of_prior(
    actions: Space, count: int, seed: int, constraints: Sequence[Linear] = (), prior: Sequence[NormalPrior] = ()
) -> tuple[Point, ...]:
    """Draw actions from g: a scrambled Sobol sequence over the unit cube, any section of which covers g evenly.

    Its numbers are binary fractions from integer arithmetic and thus equal on every machine. Along dimensions with a
    normal prior they are transformed by the inverse distribution function and rounded to such fractions again.

    Args:
        prior: dimensions of `actions` along which g is not uniform.

    Raises:
        ValueError: constraints and prior exclude almost all actions.

    Source: sampling by inversion: Devroye, Non-uniform random variate generation, 1986, chapter 2.
    """
    region = region_of(actions, constraints)
    law = partial(_distributed, actions=actions, prior=prior) if prior else None
    if region is not None:
        draws = region.draw(count, np.random.default_rng(seed), even=True, law=law)
        return tuple(tuple(map(float, row)) for row in draws)
    from scipy.stats import qmc

    sampler = qmc.Sobol(actions.dimension, scramble=True, rng=np.random.default_rng(seed))
    exponent = max(1, int(np.ceil(np.log2(max(count, 1)))))
    uniform = sampler.random_base2(exponent)[:count]
    return tuple(tuple(map(float, row)) for row in (uniform if law is None else law(uniform)))


def actions_all_over(
    actions: Space, constraints: Sequence[Linear], *, corners: int, drawn: int
) -> list[dict[str, float]]:
    """Select allowed actions from the whole space for checks: the centre, corners and random ones. Always the same.

    Args:
        corners: maximum number of corners of the box.
        drawn: number of random actions.

    Returns:
        Values of the searched dimensions [SI].
    """
    rng, region = np.random.default_rng(0), region_of(actions, constraints)
    ends = itertools.islice(itertools.product((0.0, 1.0), repeat=actions.dimension), corners)
    points = np.array([[0.5] * actions.dimension, *ends])
    if region is None:
        between = rng.random((drawn, actions.dimension))
    else:
        points, between = points[region.allows(points)], region.draw(drawn, rng, even=False)
    return [actions.decode(point) for point in (*points, *between)]


def region_of(actions: Space, constraints: Sequence[Linear]) -> Region | None:
    """Region of the space that meets the constraints; None without constraints, which avoids a slow import."""
    if not constraints:
        return None
    from actors.optimizer.feasible_region import Region

    return Region(actions, constraints)


def _distributed(uniform: Array, actions: Space, prior: Sequence[NormalPrior]) -> Array:
    """Transform uniform points (m, dimension) of the unit cube to the distribution g."""
    points = uniform.copy()
    for normal in prior:
        i = actions.names.index(normal.name)
        axis = actions.axes[i]
        values = truncated_quantiles(uniform[:, i], normal.mean, normal.deviation, axis.lower, axis.upper)
        places = [axis.encode(value) for value in values]
        points[:, i] = np.rint(np.array(places) * FINENESS) / FINENESS
    return points


FARTHEST = 3.0
"""Limit of drawn nuisances, in standard deviations."""


def drawn_worlds(
    best: SimulationParameters,
    count: int,
    seed: int,
    *,
    posterior: Sequence[SimulationParameters] = (),
    known: Collection[str] = (),
) -> tuple[SimulationParameters, ...]:
    """Draw equally likely θ of the bench to be used, including its nuisances. Pure.

    The posterior's draws are selected at equal steps; they repeat if there are fewer than `count`. Nuisances that the
    calibration did not search vary around their values in these draws, with their declared tolerances. They are
    normally distributed, independent, limited to their bounds and drawn from a scrambled Sobol sequence.

    Args:
        best: θ*, or the θ in use. Without a posterior, all draws equal it except for their nuisances.
        count: number of draws, at least 1.
        seed: the same seed yields the same draws.
        posterior: complete θ, equally likely.
        known: nuisances that are not drawn, because the calibration searched them or the user declares them known.

    Returns:
        `count` complete θ.
    """
    from scipy.special import ndtri
    from scipy.stats import qmc

    if count < 1:
        raise ValueError(f"at least one draw is needed, got {count}")
    nuisances = [info for name, info in SimulationParameters.nuisances().items() if name not in known]
    rows = [posterior[(i * len(posterior)) // count] if count <= len(posterior) else posterior[i % len(posterior)]
            for i in range(count)] if posterior else [best] * count  # fmt: skip
    if not nuisances:
        return tuple(rows)
    sampler = qmc.Sobol(len(nuisances), scramble=True, rng=np.random.default_rng([seed % 2**64, *b"bench"]))
    uniform = sampler.random_base2(math.ceil(math.log2(count)) if count > 1 else 0)[:count]
    z = np.clip(ndtri(uniform), -FARTHEST, FARTHEST)
    worlds = []
    for row, theta in zip(z, rows, strict=True):
        moved = {
            info.name: min(max(getattr(theta, info.name) + info.tolerance * float(u), info.lower), info.upper)
            for info, u in zip(nuisances, row, strict=True)
        }
        worlds.append(theta.model_copy(update=moved))
    return tuple(worlds)


class Contexts:
    """Maps actions and scenes to the inputs of a surrogate: the actions' unit cube, extended by scene coordinates.

    A single scene needs no coordinate. Two scenes are the ends of one additional axis. With three or more, each scene
    has its own axis, which is 1 for this scene and 0 for the others. The fitted lengthscales of these axes determine
    how much data from one receiver contributes to predictions for another.
    """

    def __init__(self, actions: Space, scenes: Sequence[Scene]) -> None:
        self._actions, self._scenes = actions, tuple(scenes)
        self._names = {scene.name: i for i, scene in enumerate(self._scenes)}
        count = len(self._scenes)
        extra = 0 if count == 1 else 1 if count == 2 else count
        self._marks = [
            tuple(float(i) for _ in range(extra)) if count == 2 else tuple(float(i == j) for j in range(extra))
            for i in range(count)
        ]
        self.space = Space((*actions.axes, *(Axis(f"scene{j + 1}", 0.0, 1.0) for j in range(extra))))

    @classmethod
    def of(cls, plan: CalibrationPlan) -> Contexts:
        """The contexts of a calibration."""
        return cls(plan.actions, plan.scenes)

    def knows(self, pour: MeasuredPour) -> bool:
        """Whether a pour was made in one of the scenes."""
        return not pour.scene or pour.scene in self._names

    def point(self, pour: MeasuredPour) -> Point:
        """Point of a weighed pour.

        Raises:
            ValueError: a searched dimension is switched off in the pour.
        """
        return self.at(self._encoded(pour.action), self._names.get(pour.scene, 0))

    def place(self, scene: Scene, action: Action) -> Point:
        """Point of an action in one of the scenes; raises as `point`."""
        return self.at(self._encoded(action), self._names[scene.name])

    def _encoded(self, action: Action) -> Point:
        values = {name: _number(action, name) for name in self._actions.names}
        return tuple(map(float, self._actions.encode(values)))

    def at(self, action: Point, scene: int) -> Point:
        """Point of an action of the unit cube in the scene with this index."""
        return (*action, *self._marks[scene])

    def request(self, point: Point) -> tuple[Scene, Action]:
        """Scene and action of a point."""
        dimension = self._actions.dimension
        scene = self._scenes[self._marks.index(tuple(point[dimension:]))]
        return scene, scene.action(self._actions.decode(point[:dimension]))

    def sequence(self, plan: CalibrationPlan, count: int, seed: int) -> tuple[Point, ...]:
        """Actions of the prior g along an even sequence, alternating between the scenes."""
        actions = actions_of_prior(plan.actions, count, seed, plan.constraints, plan.prior)
        return tuple(self.at(action, i % len(self._scenes)) for i, action in enumerate(actions))


def _number(action: Action, name: str) -> float:
    value = getattr(action, name)
    if value is None:
        raise ValueError(f"{name} is searched, but switched off in a measured pour")
    return float(value)
