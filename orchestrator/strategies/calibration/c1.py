"""C1: O1 on a dense uniform grid."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import ClassVar, Literal, Self

from actors.optimizer.core.problem import Point
from orchestrator.config.yaml.sections import Complaints, PositiveSimulationCount, Text
from orchestrator.plan import CalibrationPlan, MeasuredPour
from orchestrator.strategies.calibration.o1 import BestOfDesign
from orchestrator.strategies.calibration.settings import DesignSettings
from orchestrator.strategies.protocol import Strategy


class C1Settings(DesignSettings):
    """C1: a uniform grid, each θ on all training pours."""

    required: ClassVar[dict[str, str]] = {"strategy": "C1"}
    examples: ClassVar[dict[str, str]] = {"grid": "{particles: 5, cohesion: 6}", "per_axis": "10"}

    strategy: Literal["C1"] = "C1"
    """A uniform grid."""

    grid: dict[Text, PositiveSimulationCount] | None = None
    """Values of every searched parameter: {particles: 5, cohesion: 6}."""

    per_axis: PositiveSimulationCount | None = None
    """Values of each searched parameter, in place of 'grid'."""

    @property
    def cells(self) -> dict[str, int]:
        """Values tried of every searched θ, once settled."""
        assert self.grid is not None, "settled settings have a grid"
        return self.grid

    @property
    def thetas(self) -> int:
        """All places of the grid."""
        return math.prod(self.cells.values())

    def with_thetas(self, searched: tuple[str, ...], train: int, complaints: Complaints) -> Self | None:
        """The grid: as it is written, or the finest with the same number on every axis that the simulations allow."""
        if self.grid is not None:
            for name in self.grid:
                if name not in searched:
                    complaints.add(f"is not searched; searched are {', '.join(searched)}", "grid", name, key=True)
            for name in searched:
                if name not in self.grid:
                    complaints.add(f"has no number of values for {name}, which is searched", "grid", key=True)
            grid = {name: self.grid.get(name, 0) for name in searched}
        elif self.per_axis is not None:
            grid = dict.fromkeys(searched, self.per_axis)
        else:
            per_axis = 1
            while train * (per_axis + 1) ** len(searched) <= (self.simulations or 0):
                per_axis += 1
            if per_axis < 2:
                least = train * 2 ** len(searched)
                text = f"allows no grid: 2 values of each searched parameter on {train} training pours take {least}"
                complaints.add(text, "simulations")
            grid = dict.fromkeys(searched, per_axis)
        return None if complaints.any else self.model_copy(update={"grid": grid, "per_axis": None})

    def build(self, plan: CalibrationPlan, pours: Sequence[MeasuredPour], seed: int) -> Strategy:
        """The strategy itself."""
        return UniformGrid(plan, pours, seed)


class UniformGrid(BestOfDesign[C1Settings]):
    """C1: θ* = argmin O1(θ) over a uniform grid, each θ simulated on all training pours.

    Every axis of θ's box is cut into equal cells (log-equal where its scale is), and θ tried at their middles: no place
    of the box is then farther from the grid than half a cell.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.3 (C1: 10 × 10 over two θ, 2800 simulations).
    Limitations: the price grows with the power of the dimension.
    """

    def _design(self) -> Sequence[Point]:
        cells = [self._settings.cells[name] for name in self._plan.parameters.names]
        middles = [[(i + 0.5) / count for i in range(count)] for count in cells]
        return list(itertools.product(*middles))
