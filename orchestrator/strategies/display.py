"""Actions and surrogate maps as results show them: units in the keys."""

from __future__ import annotations

from collections.abc import Mapping

from actors.optimizer.core.problem import SurrogateMap
from orchestrator.strategies.learnt import Part
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.space import Space


class DisplayedMap(Part):
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
