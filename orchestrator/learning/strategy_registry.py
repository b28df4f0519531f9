"""Plug-in registries of strategies and objectives, built-in and third-party, and the kinds of their results."""

from __future__ import annotations

import typing

from orchestrator.learning.campaign_plan import CalibrationSettings, DeploymentSettings, StrategySettings
from orchestrator.learning.deployment.objectives import Objective
from orchestrator.learning.stage_result import StageResult
from sim_engine.settings.plugin_registry import PluginRegistry, own_extras


def _strategy(loaded: object, name: str) -> type[StrategySettings]:
    if not (isinstance(loaded, type) and issubclass(loaded, CalibrationSettings | DeploymentSettings)):
        raise TypeError("should be a class derived from CalibrationSettings or DeploymentSettings")
    _check_tag(loaded.model_fields[loaded.tag].annotation, loaded.tag, name)
    return loaded


def _objective(loaded: object, name: str) -> type[Objective]:
    if not (isinstance(loaded, type) and issubclass(loaded, Objective)):
        raise TypeError("should be a class derived from Objective")
    _check_tag(loaded.model_fields[loaded.tag].annotation, loaded.tag, name)
    return loaded


def _check_tag(annotation: object, tag: str, name: str) -> None:
    if typing.get_args(annotation) != (name,) or typing.get_origin(annotation) is not typing.Literal:
        raise TypeError(
            f"its field '{tag}' should be Literal['{name}'] = '{name}', the name that it is registered under"
        )


STRATEGIES: PluginRegistry[type[StrategySettings]] = PluginRegistry("decant.strategies", "strategy", _strategy)
"""Settings classes of all installed strategies, calibrations and deployments."""


OBJECTIVES: PluginRegistry[type[Objective]] = PluginRegistry("decant.objectives", "objective", _objective)
"""All installed objectives."""


def calibrations() -> dict[str, type[CalibrationSettings]]:
    """Settings classes of the calibrations, by name."""
    return {name: kind for name, kind in STRATEGIES.all.items() if issubclass(kind, CalibrationSettings)}


def deployments() -> dict[str, type[DeploymentSettings]]:
    """Settings classes of the deployments, by name."""
    return {name: kind for name, kind in STRATEGIES.all.items() if issubclass(kind, DeploymentSettings)}


def result_kinds() -> tuple[type[StageResult], ...]:
    """All kinds of results: Decant's own, and those of installed packages with strategies. Loads all strategies."""
    from orchestrator.learning import dispense, single_action
    from orchestrator.learning.calibration import calibration_base, calibration_scores, pour_design
    from orchestrator.learning.deployment import deployment_result

    modules = (
        *(pour_design, calibration_base, calibration_scores, deployment_result),
        *(single_action, dispense, *own_extras("decant.stage_results").values()),
    )
    packages = {settings.__module__.partition(".")[0] for settings in STRATEGIES.all.values()}
    kinds = StageResult.KINDS.values()
    ours = [kind for module in modules for kind in kinds if kind.__module__ == module.__name__]
    theirs = {kind for kind in kinds if kind.__module__.partition(".")[0] in packages}
    return (*ours, *sorted(theirs - set(ours), key=lambda kind: kind.__name__))
