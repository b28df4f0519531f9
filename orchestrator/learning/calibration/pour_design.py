"""Stratified design of calibration pours, requested one by one.

- `stratified` and `choose_holdout` build the design; `StratifiedDesign` is the strategy that weighs it.
- `DesignResult` is the result.

`active_design` derives pours from this design that are chosen by their information instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.questions import Linear, Point
from orchestrator.learning.calibration.action_prior import region_of
from orchestrator.learning.campaign_plan import MeasuredPour
from orchestrator.learning.requests import Decision, Failed, Outcome, Pour, Poured, Request, Slots
from orchestrator.learning.stage_result import ResultPart, StageResult, displayed_action
from orchestrator.learning.strategy import Progress, is_sound
from orchestrator.learning.trials import SeedStream
from sim_engine.action import Action, described
from sim_engine.scene import Scene
from sim_engine.search_space import Space

if TYPE_CHECKING:
    from actors.optimizer.feasible_region import Region

Array = NDArray[np.float64]

MAX_TRIES = 12
"""Actions tried in one stratum before it is given up as impossible."""

MAX_DRAWS = 100
"""Points of a stratum that may violate the constraints before a point of the whole region is used."""


@dataclass(frozen=True)
class Stratum:
    """A cell of the unit cube: lower and upper corners, (dimension,) each."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def draw(self, rng: np.random.Generator) -> Point:
        """Draw a uniform point of the cell."""
        u = rng.random(len(self.lower))
        return tuple(float(a + (b - a) * x) for a, b, x in zip(self.lower, self.upper, u, strict=True))


def stratified(count: int, dimension: int, rng: np.random.Generator) -> list[Stratum]:
    """Cells of a jittered design of `count` points, in random order.

    As in the paper, there are k^dimension equal cells with two points each (32 = 4×4×2), or with one each if `count` is
    such a power. Any other number yields a Latin hypercube: every axis is divided into `count` slices, each used once.
    """
    if count < 1:
        raise ValueError(f"a design needs at least one pour, got {count}")
    for each in (2, 1):
        k = round((count / each) ** (1.0 / dimension))
        if k >= 2 and each * k**dimension == count:
            cells = np.stack(np.meshgrid(*[np.arange(k)] * dimension, indexing="ij"), axis=-1).reshape(-1, dimension)
            cells = np.repeat(cells, each, axis=0)
            break
    else:
        k = count
        cells = np.stack([rng.permutation(count) for _ in range(dimension)], axis=1)
    order = rng.permutation(count)
    return [Stratum(tuple((c / k).tolist()), tuple(((c + 1) / k).tolist())) for c in cells[order]]


def draw_allowed(stratum: Stratum, region: Region | None, rng: np.random.Generator) -> Point:
    """Draw a point of the stratum that lies in the region; if none is found, draw one from the whole region."""
    point = stratum.draw(rng)
    if region is None:
        return point
    for _ in range(MAX_DRAWS):
        if region.allows(np.array([point]))[0]:
            return point
        point = stratum.draw(rng)
    return tuple(map(float, region.draw(1, rng, even=False)[0]))


def choose_holdout(strata: list[Stratum], count: int, rng: np.random.Generator) -> frozenset[int]:
    """Indices of the strata kept for testing: spread over the first axis, one from each of `count` equal groups."""
    if not 0 <= count < len(strata):
        raise ValueError(f"holdout {count} must be at least 0 and below the number of pours, {len(strata)}")
    order = sorted(range(len(strata)), key=lambda i: strata[i].lower)
    groups = np.array_split(np.array(order), count) if count else []
    return frozenset(int(rng.choice(group)) for group in groups)


class DesignPoint(ResultPart):
    """A pour of the design."""

    number: int
    """Number of the pour, from 1, in the order made."""

    split: str
    """'train', or 'test' for a pour that calibration does not use."""

    scene: str = ""
    """Name of the scene; '' for the calibration's first scene."""


class WeighedPoint(DesignPoint):
    """A pour that was weighed."""

    action: dict[str, float | None]
    """Searched dimensions in display units."""

    action_si: dict[str, float]
    """Searched dimensions in SI units."""

    spillage: float | None
    """r = spilled / poured; None below 5 % poured, where it is undefined."""

    poured: float
    """Fraction of the load that left the pourer."""

    invalid_tries: int
    """Number of actions of the same stratum that were impossible."""


class GivenUpPoint(DesignPoint):
    """A pour that was impossible or was not weighed."""

    given_up: str
    """The reason."""


class SimulatedPoint(ResultPart):
    """A simulation by an active design in a scene of the calibration; C4 learns from it as well."""

    theta: dict[str, float]
    """Searched parameters."""

    scene: str
    """Name of the scene."""

    action_si: dict[str, float]
    """Searched dimensions of the action."""

    spillage: float
    """Simulated spillage c_s = spilled / poured."""


class DesignResult(StageResult):
    """The pours that calibration learns from."""

    kind: Literal["pours"] = "pours"

    pours: tuple[WeighedPoint | GivenUpPoint, ...]
    """The pours in the order made."""

    simulated: tuple[SimulatedPoint, ...] = ()
    """Simulations of an active design in the calibration's scenes."""

    @property
    def measured(self) -> tuple[WeighedPoint, ...]:
        """The pours that were weighed."""
        return tuple(pour for pour in self.pours if isinstance(pour, WeighedPoint))


@dataclass
class _Planned:
    stratum: Stratum
    split: str
    scene: Scene
    tries: int = 0
    action: Action | None = None
    measured: MeasuredPour | None = None
    given_up: str | None = None
    notes: list[str] = field(default_factory=list)

    def settle(self, outcome: Outcome) -> None:
        """Take the outcome; it replaces an earlier one."""
        self.measured = self.given_up = None
        match outcome:
            case Poured(measurement) if not is_sound(measurement.fractions):
                self.given_up = "weighing: the balance gave no numbers"
            case Poured(measurement):
                fractions = measurement.fractions
                assert self.action is not None
                self.measured = MeasuredPour(
                    self.action, fractions.spillage, fractions.poured, self.split, self.scene.name
                )
            case Failed(kind, reason):
                self.given_up = f"{kind}: {reason}"
            case _:
                raise ValueError(f"a pour can't be answered by {type(outcome).__name__}")


class StratifiedDesign:
    """Weigh a stratified set of pours: two actions from each of 4×4 strata, as in the paper, or a Latin hypercube.

    An invalid action (touching vessels) is replaced by another one of its stratum. A stratum without a possible action
    is given up after `MAX_TRIES` tries. A failed pour is not repeated, because its liquid is lost; the design loses one
    point.

    Source: Lopez-Guevara et al., CoRL 2017, section 4.1 (32 actions, stratified; 28 train, 4 test).
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        actions: Space,
        count: int,
        holdout: int,
        seed: int,
        *,
        points: Sequence[Point] | None = None,
        constraints: Sequence[Linear] = (),
        tested: Sequence[Scene] = (),
    ) -> None:
        """Plan the pours.

        Args:
            scenes: scenes between which the pours alternate, train and test separately; at least one.
            points: actions in the unit cube to repeat instead of drawing new ones.
            constraints: constraints on drawn actions.
            tested: scenes between which the pours kept for testing alternate; empty: `scenes`.
        """
        self._actions = actions
        self._seeds = SeedStream(seed, "design")
        if points is None:
            strata = stratified(count, actions.dimension, self._seeds.rng)
        else:
            strata = [Stratum(point, point) for point in points]
        test_set = choose_holdout(strata, holdout, self._seeds.rng)
        turns, where = {"train": 0, "test": 0}, {"train": scenes, "test": tested or scenes}
        self._planned: list[_Planned] = []
        for i, stratum in enumerate(strata):
            split = "test" if i in test_set else "train"
            self._planned.append(_Planned(stratum, split, where[split][turns[split] % len(where[split])]))
            turns[split] += 1
        self._region = region_of(actions, constraints if points is None else ())
        self._current = 0
        self._pouring: Pour | None = None
        self.decisions: list[Decision] = []

    @property
    def finished(self) -> bool:
        """Every stratum has been poured or given up."""
        return self._current >= len(self._planned)

    @property
    def measured(self) -> tuple[MeasuredPour, ...]:
        """The pours weighed so far."""
        return tuple(p.measured for p in self._planned if p.measured is not None)

    def ask(self, slots: Slots) -> list[Request]:
        """Return the next pour, if none is running."""
        if self.finished or self._pouring is not None or slots.pours < 1:
            return []
        planned = self._planned[self._current]
        values = self._actions.decode(draw_allowed(planned.stratum, self._region, self._seeds.rng))
        planned.tries += 1
        planned.action = planned.scene.action(values)
        self._pouring = Pour(
            planned.scene.name, planned.action, self._current + 1, self._seeds.next(), purpose="calibration"
        )
        self.decisions.append(
            Decision(
                f"calibration pour {self._current + 1}/{len(self._planned)} ({planned.split}): {described(values)}"
            )
        )
        return [self._pouring]

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the weights of a pour, or the reason of its failure."""
        if self._pouring is None or request != self._pouring:
            raise ValueError(f"this pour was not asked for: {request}")
        self._pouring = None
        planned = self._planned[self._current]
        if isinstance(outcome, Failed) and outcome.kind == "invalid_action" and planned.tries < MAX_TRIES:
            planned.notes.append(outcome.reason)
            return  # another draw of the same stratum
        planned.settle(outcome)
        self._current += 1

    def correct(self, request: Request, outcome: Outcome) -> None:
        """Replace the outcome of a pour that was told wrongly.

        Raises:
            ValueError: there is no outcome of this request.
        """
        number = request.number if isinstance(request, Pour) else 0
        planned = self._planned[number - 1] if 0 < number <= self._current else None
        if planned is None or not isinstance(request, Pour) or planned.action != request.action:
            raise ValueError("the strategy has no outcome of this pour")
        planned.settle(outcome)
        self.decisions.append(Decision(f"calibration pour {number} is corrected"))

    def progress(self) -> Progress:
        """Pours done, and their total number."""
        return Progress(pours=self._current, of_pours=len(self._planned))

    def result(self) -> DesignResult:
        """The pours so far, in the order made."""
        rows: list[WeighedPoint | GivenUpPoint] = []
        for number, planned in enumerate(self._planned[: self._current], start=1):
            if planned.measured is None:
                rows.append(
                    GivenUpPoint(
                        number=number, split=planned.split, scene=planned.scene.name, given_up=planned.given_up or ""
                    )
                )
                continue
            action = planned.measured.action
            values = {name: getattr(action, name) for name in self._actions.names}
            rows.append(
                WeighedPoint(
                    number=number,
                    split=planned.split,
                    scene=planned.scene.name,
                    action=displayed_action(values),
                    action_si=values,
                    spillage=planned.measured.spillage,
                    poured=planned.measured.poured,
                    invalid_tries=len(planned.notes),
                )
            )
        return DesignResult(pours=tuple(rows))
