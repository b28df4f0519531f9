"""A deployment: pour a Latin hypercube, then recommend what a surrogate of all pours says."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from decant.plugins import (
    MAP_RESOLUTION,
    Deployment,
    DeploymentPlan,
    DeploymentSettings,
    RegressionQuery,
    Scene,
    SimulationParameters,
    Strategy,
    Switch,
)


class HypercubeSettings(DeploymentSettings):
    """Hypercube: pour everywhere once, then use what was best."""

    simulates: ClassVar[bool] = False

    strategy: Literal["hypercube"] = "hypercube"
    """Pour everywhere once, then use what was best."""

    centred: Switch = False
    """Pour at the middles of the slices, and not anywhere in them."""

    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """The strategy itself."""
        return Hypercube(plan, scene, parameters, seed)


class Hypercube(Deployment[HypercubeSettings]):
    """As many slices of every dimension as there are pours, each poured from once.

    Source: McKay, Beckman and Conover, A comparison of three methods for selecting values of input variables in the
        analysis of output from a computer code, Technometrics 21, 1979.
    Limitations: no pour learns from another one.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> None:
        super().__init__(plan, scene, parameters, seed)
        rng, count = self._seeds.rng, plan.pours
        slices = np.stack([rng.permutation(count) for _ in plan.actions.axes], axis=1)
        inside = np.full(slices.shape, 0.5) if self._settings.centred else rng.random(slices.shape)
        self._points = [tuple(map(float, row)) for row in (slices + inside) / count]

    def _next(self) -> None:
        if self._pouring is not None:
            return
        if self._points and self._ledger.pours_left:
            self._pour(self._points.pop(0))
        else:
            query = self._requests.query(RegressionQuery, self._ledger.real(), map_resolution=MAP_RESOLUTION)
            self._questions.put(query, "conclude", self._conclude)
