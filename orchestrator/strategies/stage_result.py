"""What a stage learnt: the base of all results. Each kind is declared beside the strategy that learns it.

Actions and surrogate maps as results show them: units in the keys.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict

from actors.optimizer.questions import SurrogateMap
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.search_space import Space


class ResultPart(BaseModel):
    """A piece of a result: it can't be changed, and its JSON form has exactly the declared fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, defer_build=True)


class StageResult(ResultPart):
    """What a strategy has learnt so far. A subclass declares its own `kind`, a text that no other one bears.

    Journals, the studies' files and `summary.json` hold dumps; `orchestrator.journal.stage_results` reads them back
    by their kind.
    """

    KINDS: ClassVar[dict[str, type[StageResult]]] = {}
    """All that have been declared in the imported modules, by kind."""

    kind: str

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Make the kind known.

        Raises:
            TypeError: another class has it already, or this one names none.
        """
        super().__pydantic_init_subclass__(**kwargs)
        kind = cls.model_fields["kind"].default
        if not isinstance(kind, str):
            raise TypeError(f"{cls.__qualname__} has to declare its kind: kind: Literal['…'] = '…'")
        known = StageResult.KINDS.setdefault(kind, cls)
        if (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise TypeError(f"{cls.__qualname__}: {known.__qualname__} has the kind '{kind}' already; choose another")


class DisplayedMap(ResultPart):
    """A surrogate over two axes: row i of `mean` and `deviation` is the second axis' i-th value."""

    over: tuple[str, ...]
    """Names of the two axes."""

    held: dict[str, float]
    """Values [SI] of the others, at which the surrogate was cut."""

    axes: dict[str, tuple[float, ...]]
    """Values [SI] along each of the two."""

    mean: tuple[tuple[float, ...], ...]
    """Posterior mean, in the cost's own unit."""

    deviation: tuple[tuple[float, ...], ...]
    """Posterior standard deviation, in the cost's own unit."""


_SUFFIX = {"deg/s": "deg_s", "deg/s^2": "deg_s2", "deg": "deg", "mm": "mm", "s": "s"}


def displayed_action(values: Mapping[str, float | None]) -> dict[str, float | None]:
    """Action dimensions [SI] in the units that people read: {'angular_velocity_deg_s': 41.2, …}."""
    shown: dict[str, float | None] = {}
    for name, value in values.items():
        dimension = ACTION_DIMENSIONS[name]
        shown[f"{name}_{_SUFFIX[dimension.display_unit]}"] = None if value is None else value / dimension.factor
    return shown


def displayed_map(surrogate: SurrogateMap | None, space: Space) -> DisplayedMap | None:
    """A surrogate as results show it; None without one."""
    if surrogate is None:
        return None
    size = len(surrogate.mean)
    places = [i / (size - 1) if size > 1 else 0.5 for i in range(size)]
    plane = surrogate.plane(space)
    return DisplayedMap(
        over=plane.names,
        held=surrogate.held(space),
        axes={axis.name: tuple(axis.decode(u) for u in places) for axis in plane.axes},
        mean=surrogate.mean,
        deviation=surrogate.deviation,
    )
