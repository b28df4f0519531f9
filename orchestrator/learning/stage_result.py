"""Base of all stage results, and the form in which results show actions and surrogates.

- `StageResult` is the base class. Each kind is defined in the module of its strategy.
- `WeighedMasses` are the masses of a pour with its spillage; every form of a weighed pour has these fields.
- `displayed_action` and `displayed_map` convert actions and surrogates for display; the units are part of the keys.

Reading and writing of results is in `orchestrator.records.codec`, the list of all kinds in `strategy_registry`.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, model_validator

from actors.optimizer.questions import SurrogateMap
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.outcome import PourMeasurement
from sim_engine.search_space import Space

DOSE = "dose"
"""Purpose of the pours of wanted amounts, and the key of their notes."""


ENTERED = "source"
"""Key of a measurement's note that says how a person entered the masses; a bench writes none."""


class ResultPart(BaseModel):
    """Part of a result. It is immutable, and its JSON form has exactly the declared fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    @model_validator(mode="before")
    @classmethod
    def _of_earlier_version(cls, data: Any) -> Any:
        return without_empty_extras(data, cls.model_fields) if isinstance(data, Mapping) else data


def without_empty_extras(data: Mapping[str, Any], names: Container[str]) -> dict[str, Any]:
    """Written fields without the empty ones that have no name here: an earlier version had them."""
    return {key: value for key, value in data.items() if key in names or value not in (None, [], (), {})}


class StageResult(ResultPart):
    """Result of a strategy so far. Each subclass declares its own unique `kind`.

    Journals, study files and `summary.json` hold dumps; `orchestrator.records.codec` reads them back by their
    kind.
    """

    KINDS: ClassVar[dict[str, type[StageResult]]] = {}
    """All kinds that are declared in the imported modules."""

    kind: str

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Register the kind.

        Raises:
            TypeError: another class has this kind already, or this class declares none.
        """
        super().__pydantic_init_subclass__(**kwargs)
        kind = cls.model_fields["kind"].default
        if not isinstance(kind, str):
            raise TypeError(f"{cls.__qualname__} has to declare its kind: kind: Literal['…'] = '…'")
        registered = StageResult.KINDS.setdefault(kind, cls)
        if (registered.__module__, registered.__qualname__) != (cls.__module__, cls.__qualname__):
            raise TypeError(
                f"{cls.__qualname__}: {registered.__qualname__} has the kind '{kind}' already; choose another"
            )


class DisplayedMap(ResultPart):
    """A surrogate over two axes: row i of `mean` and `deviation` belongs to the i-th value of the second axis."""

    over: tuple[str, ...]
    """Names of the two axes."""

    held: dict[str, float]
    """Values [SI] of the other dimensions at which the surrogate is evaluated."""

    axes: dict[str, tuple[float, ...]]
    """Values [SI] along each of the two axes."""

    mean: tuple[tuple[float, ...], ...]
    """Posterior mean, in the unit of the cost."""

    deviation: tuple[tuple[float, ...], ...]
    """Posterior standard deviation, in the unit of the cost."""


class WeighedMasses(ResultPart):
    """Masses of a pour, and its spillage; None if nothing was weighed."""

    loaded_g: float | None = None
    """Mass in the pourer before the pour [g]."""

    spilled_g: float | None = None
    """Mass outside the receiver [g]; None also after a dose on a bench that does not weigh it."""

    retained_g: float | None = None
    """Mass left in the pourer [g]."""

    delivered_g: float | None = None
    """Mass in the receiver [g]: neither spilled nor left in the pourer."""

    spillage: float | None = None
    """r = spilled / poured; None below 5 % poured, where it is undefined."""


def weighed_masses(measured: PourMeasurement | None) -> WeighedMasses:
    """The masses of a measurement; all None without one."""
    if measured is None:
        return WeighedMasses()
    about: dict[str, Any] = measured.notes.get(DOSE, {})
    spilled: float | None = about.get("spilled", measured.spilled)
    return WeighedMasses(
        loaded_g=1e3 * measured.loaded,
        spilled_g=None if spilled is None else 1e3 * spilled,
        retained_g=1e3 * measured.retained,
        delivered_g=1e3 * float(about.get("received", measured.delivered)),
        spillage=None if spilled is None else measured.fractions.spillage,
    )


def entered_by_hand(measured: PourMeasurement) -> bool:
    """Whether a person weighed a pour and entered its masses, instead of the bench."""
    return ENTERED in measured.notes


UNIT_SUFFIXES = {"deg/s": "deg_s", "deg/s^2": "deg_s2", "deg": "deg", "mm": "mm", "s": "s"}
"""How the names of columns end, by display unit of an action dimension."""


def displayed_action(values: Mapping[str, float | None]) -> dict[str, float | None]:
    """Convert action dimensions from SI to display units: {'angular_velocity_deg_s': 41.2, …}."""
    shown: dict[str, float | None] = {}
    for name, value in values.items():
        dimension = ACTION_DIMENSIONS[name]
        shown[f"{name}_{UNIT_SUFFIXES[dimension.display_unit]}"] = None if value is None else value / dimension.factor
    return shown


def displayed_map(surrogate: SurrogateMap | None, space: Space) -> DisplayedMap | None:
    """Convert a surrogate to its form in results; None if there is none."""
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
