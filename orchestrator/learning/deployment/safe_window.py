"""The safe window: permitted deviations from the planned action, per dimension, within a tolerated spillage.

- `SafeWindow` determines the window from a surrogate and checks it by simulations.
- `WindowFound` is the result; `WindowSettings` holds the tolerance.

The simulations are requested by the strategy that owns the window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from actors.optimizer.questions import Point
from orchestrator.learning.stage_result import ResultPart, displayed_action
from sim_engine.search_space import Space
from sim_engine.settings.model import Settings
from sim_engine.settings.quantity import Quantity

PLACES = 40
"""Number of places between the action and the end of the box, on either side of every dimension: the resolution."""

ROUNDS = 4
"""Maximum number of simulation rounds: one for the surrogate's outline, the others for bisections."""

Way = Literal["low", "high"]
_WAYS: tuple[Way, Way] = ("low", "high")


class WindowSettings(Settings):
    """Find the permitted deviation from the planned action in each dimension, within a tolerated loss."""

    required: ClassVar[dict[str, str]] = {"tolerance": "2 %"}

    tolerance: Annotated[float, Quantity("1", "2 %", 1e-4, 1.0)] | None = None
    """Largest tolerated loss, as a fraction of the loss of spilling the whole load."""

    @property
    def tolerated(self) -> float:
        """The tolerance; valid settings have one."""
        assert self.tolerance is not None, "required"
        return self.tolerance


class WindowEnds(ResultPart):
    """Permitted interval of one dimension."""

    low: float
    """Lower end [SI]."""

    high: float
    """Upper end [SI]."""

    cut_off: tuple[Way, ...]
    """Ends that coincide with those of the searched box."""


class WindowOutline(ResultPart):
    """Expected loss along one dimension, according to the surrogate."""

    values: tuple[float, ...]
    """Values of the dimension, ascending [SI]."""

    expected: tuple[float, ...]
    """Expected losses at these values."""


class CheckedAction(ResultPart):
    """An action that was simulated to check whether it is inside."""

    axis: str | None
    """The dimension that deviates; None for the action itself."""

    action_si: dict[str, float]
    """Searched dimensions [SI]."""

    loss: float | None
    """Mean loss; None if no simulation is usable."""

    inside: bool
    """Whether the action passed the check."""


class WindowFound(ResultPart):
    """Permitted deviations from the planned action, one dimension at a time."""

    tolerance: float
    """Largest loss inside, in the unit of the loss."""

    axes: dict[str, WindowEnds]
    """Intervals by dimension; empty if the action itself is not inside."""

    outline: dict[str, WindowOutline]
    """Outlines by dimension."""

    display: dict[Way, dict[str, float | None]]
    """The ends in display units."""

    checks: tuple[CheckedAction, ...]
    """All simulated checks."""

    simulations: int
    """Number of simulations of the checks."""


@dataclass(frozen=True)
class WindowCheck:
    """An action to be simulated to check whether it is inside.

    Attributes:
        axis: name of the dimension that deviates; empty for the action itself.
        way: direction of the deviation.
        place: distance, 0 … PLACES.
    """

    point: Point
    axis: str = ""
    way: Way = "low"
    place: int = 0

    @property
    def what(self) -> str:
        """Description for display."""
        return f"the window of {self.axis}" if self.axis else "the action itself"


@dataclass
class _Side:
    """One end of the interval of a dimension: places outwards from the action.

    Attributes:
        edge: farthest place that is still assumed to be inside.
        passed, failed: simulated places.
    """

    edge: int = 0
    passed: set[int] = field(default_factory=lambda: {0})
    failed: set[int] = field(default_factory=set)

    @property
    def inside(self) -> int:
        """Farthest place that passed, with no failed place before it."""
        nearest = min(self.failed, default=PLACES + 1)
        return max(place for place in self.passed if place < nearest)

    def wanted(self, *, first: bool) -> list[int]:
        """Places to simulate next."""
        if not first:
            nearest = min(self.failed, default=PLACES + 1)
            if self.inside == self.edge and self.edge < nearest:
                return []
            self.edge = min(self.edge, (self.inside + nearest) // 2)
            return [self.edge] if self.edge not in self.passed else []
        return sorted({self.edge, self.edge // 2} - self.passed)


class SafeWindow:
    """Intervals around an action, one for each dimension with the others as planned.

    The surrogate provides the outline: from the action outwards, as far as its expected loss is within the tolerance.
    Then the action, both ends and the places halfway to them are simulated. An end that fails is moved halfway to the
    farthest place that passed, until it passes or the rounds are used up. The reported ends are always simulated
    places.

    Limitations: dimensions deviate one at a time; several deviations at once, each within its interval, may spill more.
    An interval ends at the searched box. Between the simulated places, the window relies on the surrogate.
    """

    def __init__(self, actions: Space, centre: Point, tolerance: float) -> None:
        """Plan the window.

        Args:
            actions: searched box.
            centre: the action, in its unit cube.
            tolerance: largest loss, in the unit of the loss.
        """
        self._actions, self._centre, self._tolerance = actions, centre, tolerance
        self._sides: dict[tuple[str, Way], _Side] = {(name, way): _Side() for name in actions.names for way in _WAYS}
        self._worst: dict[Point, tuple[int, ...]] = {}
        self._rest: dict[Point, float] = {}
        self._losses: dict[WindowCheck, float | None] = {}
        self._expected: dict[tuple[str, Way], tuple[float, ...]] = {}
        self._round = 0
        self.waiting: list[WindowCheck] = []
        self.closed = False

    @property
    def places(self) -> tuple[Point, ...]:
        """Points at which the surrogate is evaluated: the action, then outwards on all sides in turn."""
        return (self._centre, *(self._at(*side, place) for side in self._sides for place in range(1, PLACES + 1)))

    def outline(self, predictions: Sequence[float], worst: Sequence[tuple[int, ...]] = ()) -> None:
        """Read the surrogate's answer for `places`: the expected losses, and the indices of the worst disturbances."""
        self._worst = dict(zip(self.places, worst, strict=True)) if worst else {}
        for number, (key, side) in enumerate(self._sides.items()):
            expected = predictions[1 + number * PLACES : 1 + (number + 1) * PLACES]
            self._expected[key] = (predictions[0], *expected)
            if self._at(*key, PLACES) == self._centre:  # the action lies at the end of the box
                side.edge, side.passed = PLACES, {0, PLACES, PLACES // 2}
                continue
            side.edge = next((i for i, value in enumerate(expected) if value > self._tolerance), PLACES)

    def allow_for(self, expected: Sequence[float], of_few: Sequence[float]) -> None:
        """Correct for checks that use few disturbances: expected losses over all, and over these few, at `places`.

        The evaluated value is simulated + expected − expected of the few. This removes the sampling error of the few
        disturbances as far as the surrogate predicts it; the simulation covers the rest.

        Source: control variates: Glasserman, Monte Carlo methods in financial engineering, 2003, chapter 4.
        """
        others = (all_of_them - few for all_of_them, few in zip(expected, of_few, strict=True))
        self._rest = dict(zip(self.places, others, strict=True))

    def worst(self, check: WindowCheck) -> tuple[int, ...]:
        """Indices of the worst disturbances at the place; empty without a tail."""
        return self._worst.get(check.point, ())

    def next_checks(self) -> list[WindowCheck]:
        """Return the actions to simulate next. If there are none, the window is closed."""
        assert not self.waiting, "every check has to be judged first"
        centre = WindowCheck(self._centre)
        if self._round < ROUNDS and not self._fails(centre):
            first = self._round == 0
            checks = [centre] if first else []
            for (axis, way), side in self._sides.items():
                checks += [WindowCheck(self._at(axis, way, i), axis, way, i) for i in side.wanted(first=first)]
            self.waiting = checks
        self._round += 1
        self.closed = not self.waiting
        return list(self.waiting)

    def judge(self, check: WindowCheck, loss: float | None) -> None:
        """Record the mean loss of a check's simulations; None (no usable simulation) does not pass."""
        self.waiting.remove(check)
        self._losses[check] = None if loss is None else max(loss + self._rest.get(check.point, 0.0), 0.0)
        if check.axis:
            side = self._sides[check.axis, check.way]
            (side.failed if self._fails(check) else side.passed).add(check.place)

    def _fails(self, check: WindowCheck) -> bool:
        loss = self._losses.get(check, 0.0)
        return loss is None or loss > self._tolerance

    def _at(self, axis: str, way: Way, place: int) -> Point:
        index = self._actions.names.index(axis)
        u = self._centre[index]
        end = 0.0 if way == "low" else 1.0
        return (*self._centre[:index], u + (end - u) * place / PLACES, *self._centre[index + 1 :])

    def result(self, simulations: int) -> WindowFound:
        """The window, found with this number of simulations."""
        ends: dict[Way, dict[str, float]] = {"low": {}, "high": {}}
        cut_off: dict[str, list[Way]] = {}
        if not self._fails(WindowCheck(self._centre)):
            for (name, way), side in self._sides.items():
                ends[way][name] = self._actions.decode(self._at(name, way, side.inside))[name]
                cut_off.setdefault(name, []).extend([way] if side.inside == PLACES else [])
        return WindowFound(
            tolerance=self._tolerance,
            axes={
                name: WindowEnds(low=ends["low"][name], high=ends["high"][name], cut_off=tuple(cut_off[name]))
                for name in cut_off
            },
            outline={name: self._profile(name) for name in self._actions.names},
            display={way: displayed_action(values) for way, values in ends.items()},
            checks=tuple(
                CheckedAction(
                    axis=check.axis or None,
                    action_si=self._actions.decode(check.point),
                    loss=loss,
                    inside=not self._fails(check),
                )
                for check, loss in self._losses.items()
            ),
            simulations=simulations,
        )

    def _profile(self, name: str) -> WindowOutline:
        """Expected loss along one dimension, ascending: values [SI] and losses."""
        down, up = (list(enumerate(self._expected[name, way])) for way in _WAYS)
        low: list[tuple[Way, int, float]] = [("low", *row) for row in reversed(down[1:])]
        high: list[tuple[Way, int, float]] = [("high", *row) for row in up]
        along = low + high
        values = [self._actions.decode(self._at(name, way, place))[name] for way, place, _ in along]
        return WindowOutline(values=tuple(values), expected=tuple(loss for _, _, loss in along))
