"""C2: O1 on a stratified sample."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal, Self

from actors.optimizer.core.problem import Point
from orchestrator.config.yaml.sections import Complaints, PositiveSimulationCount
from orchestrator.plan import CalibrationPlan, MeasuredPour
from orchestrator.strategies.calibration.design import stratified
from orchestrator.strategies.calibration.o1 import BestOfDesign
from orchestrator.strategies.calibration.settings import DesignSettings
from orchestrator.strategies.protocol import Strategy


class C2Settings(DesignSettings):
    """C2: stratified sampling, each θ on all training pours."""

    required: ClassVar[dict[str, str]] = {"strategy": "C2"}
    examples: ClassVar[dict[str, str]] = {"samples": "18"}

    strategy: Literal["C2"] = "C2"
    """Stratified sampling."""

    samples: PositiveSimulationCount | None = None
    """θ in all, in equal strata where the number fits, else a Latin hypercube."""

    @property
    def thetas(self) -> int:
        """All samples."""
        return self.samples or 0

    def with_thetas(self, searched: tuple[str, ...], train: int, complaints: Complaints) -> Self | None:
        """As many samples as are given, or as the simulations allow."""
        samples = self._counted(self.samples, train, complaints)
        return None if samples is None else self.model_copy(update={"samples": samples})

    def build(self, plan: CalibrationPlan, pours: Sequence[MeasuredPour], seed: int) -> Strategy:
        """The strategy itself."""
        return StratifiedSampling(plan, pours, seed)


class StratifiedSampling(BestOfDesign[C2Settings]):
    """C2: θ* = argmin O1(θ) over a jittered grid, each θ simulated on all training pours.

    θ's box is cut into equal strata with two random θ in each (18 = 3 × 3 × 2 of two parameters, as in the paper), or
    one, where the number of samples allows it; any other number becomes a Latin hypercube.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.3 (C2: 3 × 3 strata, 2 samples each, 504 simulations).
    """

    def _design(self) -> Sequence[Point]:
        strata = stratified(self._settings.thetas, self._plan.parameters.dimension, self._seeds.rng)
        return [stratum.draw(self._seeds.rng) for stratum in strata]
