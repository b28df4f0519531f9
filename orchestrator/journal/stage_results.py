"""The results of a campaign's stages: all kinds, their JSON form and their lookup by stage.

A result is a value with a `kind`, declared next to the strategy that produces it. This module collects the kinds.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pkgutil import resolve_name
from typing import Any, TypeVar, cast

from pydantic import ValidationError

from orchestrator.journal.codec import from_json, to_json
from orchestrator.journal.upgrade import upgraded_result
from orchestrator.run_errors import RunError
from orchestrator.strategies.stage_result import StageResult

L = TypeVar("L", bound=StageResult)

Results = Mapping[str, StageResult]
"""Results of the stages by name, in order."""

DECLARED_IN = (
    "orchestrator.strategies.calibration.pour_design",
    "orchestrator.strategies.calibration.calibration_base",
    "orchestrator.strategies.calibration.calibration_scores",
    "orchestrator.strategies.deployment.deployment_result",
    "orchestrator.strategies.single_action",
    "orchestrator.strategies.single_action",
    "orchestrator.strategies.single_action",
    "orchestrator.study.study_strategies",
)
"""Modules that declare Decant's own kinds of results; named as text, so that results do not import strategies."""


def kinds() -> tuple[type[StageResult], ...]:
    """All kinds: Decant's own, and those of installed packages with strategies."""
    strategies = resolve_name("orchestrator.strategies.strategy_registry:STRATEGIES").all.values()  # this loads them
    packages = {settings.__module__.partition(".")[0] for settings in strategies}
    for module in DECLARED_IN:
        import_module(module)
    ours = [found for module in DECLARED_IN for found in StageResult.KINDS.values() if found.__module__ == module]
    theirs = {found for found in StageResult.KINDS.values() if found.__module__.partition(".")[0] in packages}
    return (*ours, *sorted(theirs - set(ours), key=lambda found: found.__name__))


def encode_result(result: StageResult) -> dict[str, Any]:
    """JSON-ready mapping of a result; numbers that are not finite are encoded as in the journal."""
    return cast("dict[str, Any]", to_json(result.model_dump()))


def decode_result(data: Mapping[str, Any]) -> StageResult:
    """Inverse of `encode_result`.

    Raises:
        RunError: the kind is unknown, or the data don't fit it.
    """
    kind = data.get("kind")
    if kind not in StageResult.KINDS:
        kinds()  # the kind may belong to a package that is not loaded yet
    known = StageResult.KINDS.get(str(kind))
    if known is None:
        raise RunError(
            f"a result of the kind '{kind}' is not known; is the package installed whose strategy learnt it? "
            f"Known are: {', '.join(sorted(StageResult.KINDS))}"
        )
    try:
        return known.model_validate(from_json(upgraded_result(data)))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise RunError(f"a result of the kind '{kind}' can't be read: {place}: {first['msg']}") from None


def decode_results(data: Mapping[str, Mapping[str, Any]]) -> dict[str, StageResult]:
    """Results by the names of their stages. Raises RunError as `decode_result` does."""
    return {name: decode_result(result) for name, result in data.items()}


def result_of(results: Results, stage: str, kind: type[L]) -> L:
    """The result of a stage.

    Raises:
        RunError: there is no such stage, or its result is of another kind.
    """
    found = results.get(stage)
    if not isinstance(found, kind):
        what = "nothing" if found is None else f"a result of the kind '{found.kind}'"
        raise RunError(f"stage {stage} should have learnt a {kind.__name__}, but there is {what}")
    return found
