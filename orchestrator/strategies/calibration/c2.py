"""C2: O1 on a stratified sample."""

from __future__ import annotations

from collections.abc import Sequence

from actors.optimizer.core.problem import Point
from orchestrator.strategies.calibration.design import stratified
from orchestrator.strategies.calibration.o1 import BestOfDesign


class StratifiedSampling(BestOfDesign):
    """C2: θ* = argmin O1(θ) over a jittered grid, each θ simulated on all training pours.

    θ's box is cut into equal strata with two random θ in each (18 = 3 × 3 × 2 of two parameters, as in the paper), or
    one, where the number of samples allows it; any other number becomes a Latin hypercube.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.3 (C2: 3 × 3 strata, 2 samples each, 504 simulations).
    """

    NAME = "C2"

    @property
    def _thetas(self) -> int:
        return self._plan.thetas

    def _design(self) -> Sequence[Point]:
        strata = stratified(self._thetas, self._plan.parameters.dimension, self._seeds.rng)
        return [stratum.draw(self._seeds.rng) for stratum in strata]
