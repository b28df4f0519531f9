"""C1: O1 on a dense uniform grid."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from actors.optimizer.core.problem import Point
from orchestrator.strategies.calibration.o1 import BestOfDesign


class UniformGrid(BestOfDesign):
    """C1: θ* = argmin O1(θ) over a uniform grid, each θ simulated on all training pours.

    Every axis of θ's box is cut into equal cells (log-equal where its scale is), and θ tried at their middles: no place
    of the box is then farther from the grid than half a cell.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.3 (C1: 10 × 10 over two θ, 2800 simulations).
    Limitations: the price grows with the power of the dimension.
    """

    NAME = "C1"

    @property
    def _thetas(self) -> int:
        return math.prod(self._plan.grid.values())

    def _design(self) -> Sequence[Point]:
        cells = [self._plan.grid[name] for name in self._plan.parameters.names]
        middles = [[(i + 0.5) / count for i in range(count)] for count in cells]
        return list(itertools.product(*middles))
