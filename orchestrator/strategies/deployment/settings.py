"""What the settings of deployments share that look for the best action by a surrogate."""

from __future__ import annotations

from orchestrator.config.yaml.sections import PositiveSimulationCount
from orchestrator.strategies.calibration.settings import Kappa
from orchestrator.strategies.settings import DeploymentSettings


class SearchSettings(DeploymentSettings):
    """Settings of D1, D2 and D3: Bayesian optimisation."""

    kappa: Kappa = 2.0
    """κ of the lower confidence bound."""

    initial: PositiveSimulationCount = 3
    """Random actions before the surrogate takes over."""
