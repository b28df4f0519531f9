"""The results of a campaign's stages: all kinds of them, their JSON form and its schema.

A result is a value with a `kind`, declared beside the strategy that learns it; here they come together.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pkgutil import resolve_name
from typing import Any, TypeVar, cast

from pydantic import ValidationError

from orchestrator.codec import from_json, to_json
from orchestrator.errors import RunError
from orchestrator.strategies.learnt import Learnt

L = TypeVar("L", bound=Learnt)

Results = Mapping[str, Learnt]
"""What the stages learnt, by their names, in order."""

DECLARED_IN = (
    "orchestrator.strategies.calibration.design",
    "orchestrator.strategies.calibration.base",
    "orchestrator.strategies.calibration.evaluation",
    "orchestrator.strategies.deployment.learnt",
    "orchestrator.strategies.deployment.confirm",
    "orchestrator.strategies.repeats",
    "orchestrator.strategies.one_pour",
    "orchestrator.study.strategies",
)
"""Modules that declare the kinds of results that Decant comes with, named by text: results know no strategy."""


def kinds() -> tuple[type[Learnt], ...]:
    """All kinds: ours, and those of the packages whose strategies are installed."""
    strategies = resolve_name("orchestrator.strategies.doors:STRATEGIES").all.values()  # this loads them
    packages = {settings.__module__.partition(".")[0] for settings in strategies}
    for module in DECLARED_IN:
        import_module(module)
    ours = [found for module in DECLARED_IN for found in Learnt.KINDS.values() if found.__module__ == module]
    theirs = {found for found in Learnt.KINDS.values() if found.__module__.partition(".")[0] in packages}
    return (*ours, *sorted(theirs - set(ours), key=lambda found: found.__name__))


def encode_result(result: Learnt) -> dict[str, Any]:
    """JSON-ready mapping of a result; numbers that are not finite as the journal writes them."""
    return cast("dict[str, Any]", to_json(result.model_dump()))


def decode_result(data: Mapping[str, Any]) -> Learnt:
    """Inverse of `encode_result`.

    Raises:
        RunError: the kind is not known, or the data don't fit it.
    """
    kind = data.get("kind")
    if kind not in Learnt.KINDS:
        kinds()  # perhaps of a package that nobody has asked for yet
    known = Learnt.KINDS.get(str(kind))
    if known is None:
        raise RunError(
            f"a result of the kind '{kind}' is not known; is the package installed whose strategy learnt it? "
            f"Known are: {', '.join(sorted(Learnt.KINDS))}"
        )
    try:
        return known.model_validate(from_json(data))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise RunError(f"a result of the kind '{kind}' can't be read: {place}: {first['msg']}") from None


def decode_results(data: Mapping[str, Mapping[str, Any]]) -> dict[str, Learnt]:
    """Results by their stages' names. Raises RunError as `decode_result` does."""
    return {name: decode_result(result) for name, result in data.items()}


def learnt_by(results: Results, stage: str, kind: type[L]) -> L:
    """What a stage learnt.

    Raises:
        RunError: there is no such stage, or it learnt something of another kind.
    """
    found = results.get(stage)
    if not isinstance(found, kind):
        what = "nothing" if found is None else f"a result of the kind '{found.kind}'"
        raise RunError(f"stage {stage} should have learnt a {kind.__name__}, but there is {what}")
    return found
