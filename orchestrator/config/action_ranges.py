"""File sections for motions, action spaces and execution errors, derived from the declarations in `sim_engine.action`.

- `RangeSection` and `ActionRangeSection`: bounds of a searched quantity, with scale and prior.
- `MotionBase`: values of the motion that are not searched; `ActionsBase`: searched dimensions and their constraints.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Discriminator, Field, GetJsonSchemaHandler, Tag, create_model, model_validator
from pydantic_core import CoreSchema, PydanticCustomError

from orchestrator.strategies.campaign_plan import NormalPrior
from sim_engine.action import ACTION_DIMENSIONS, Dimension
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import Pivot
from sim_engine.search_space import Axis, Scale, Space
from sim_engine.settings.model import MADE, Settings, Text
from sim_engine.settings.quantity import Quantity

EXAMPLES = {
    "angular_velocity": "40 deg/s",
    "max_angle": "110 deg",
    "angular_acceleration": "600 deg/s^2",
    "hold_time": "1.5 s",
    "return_velocity": "90 deg/s",
    "x_offset": "90 mm",
    "y_offset": "0 mm",
    "height": "60 mm",
} | {
    # The default of a parameter is a good example of it.
    name: f"{default / info.factor:g}" + ("" if info.shown == "1" else f" {info.shown}")
    for (name, info), default in zip(
        SimulationParameters.info().items(), SimulationParameters().model_dump().values(), strict=True
    )
}
"""A valid value of every action dimension and simulation parameter, for messages and schemas."""


class RangeSection(Settings):
    """Bounds of a searched quantity: `[lowest, highest]`, or with a scale `{range: [...], scale: log}`."""

    required: ClassVar[dict[str, str]] = {"range": "[lowest, highest]"}

    range: tuple[Any, Any] | None = None
    """[lowest, highest]"""

    scale: Scale = "linear"
    """Scale on which the search spreads over the range."""

    @model_validator(mode="before")
    @classmethod
    def _short_form(cls, data: Any) -> Any:
        if isinstance(data, Mapping):
            data = dict(data)
        elif isinstance(data, list):
            data = {"range": data}
        else:
            raise PydanticCustomError("range", "should be a range [lowest, highest]")
        bounds = data.get("range")
        if bounds is not None and not (isinstance(bounds, list) and len(bounds) == 2):
            raise PydanticCustomError("range", "a range has two ends: [lowest, highest]")
        return data

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.range is not None and not self.range[0] < self.range[1]:
            raise PydanticCustomError("range", "bounds should increase: [lowest, highest]")
        if self.range is not None and self.scale == "log" and self.range[0] <= 0.0:
            raise PydanticCustomError("range", "a log scale needs a lowest value above 0")
        return self

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        long_form = handler.resolve_ref_schema(handler(schema))
        return {"anyOf": [long_form["properties"]["range"], dict(long_form)]}

    def axis(self, name: str, *, integer: bool = False) -> Axis:
        """The axis of a search space."""
        assert self.range is not None
        return Axis(name, float(self.range[0]), float(self.range[1]), self.scale, integer)


def range_model(
    name: str, quantity: Quantity, base: type[RangeSection] = RangeSection, **further: Any
) -> type[RangeSection]:
    """A range of one quantity; `further` are additional fields."""
    end = Annotated[float, quantity]
    fields: Any = {"range": (tuple[end, end] | None, Field(default=None, description="[lowest, highest]")), **further}
    model: type[RangeSection] = create_model(
        f"{title(name)}Range", __base__=base, __doc__=base.__doc__, __cls_kwargs__=MADE, **fields
    )
    return model


def title(name: str) -> str:
    """Name of the models of a quantity."""
    return name.title().replace("_", "")


def described(section: type[Settings], field: str) -> str | None:
    """Description of a section's field."""
    return section.model_fields[field].description


DEVIATIONS = {"rad/s": "20 deg/s", "rad": "10 deg", "rad/s^2": "200 deg/s^2", "s": "0.5 s", "m": "15 mm"}
"""A valid standard deviation of a dimension in each unit."""


def dimension_quantity(dimension: Dimension, *, words: bool = False) -> Quantity:
    """Annotation of an action dimension; with `words`, the words that switch it off are allowed."""
    return Quantity(
        dimension.unit,
        EXAMPLES[dimension.name],
        dimension.lower,
        dimension.upper,
        words=(dimension.switched_off,) if words and dimension.optional else (),
    )


class PriorSection(Settings):
    """Prior of a searched dimension: a normal distribution, truncated at the ends of the range."""

    mean: Any = None
    """Mean, within the range."""

    deviation: Any = None
    """Standard deviation."""


class ActionRangeSection(RangeSection):
    """Bounds of a searched dimension: `[lowest, highest]`, or `{range: [...], scale: log, prior: {...}}`."""

    prior: Any = None
    """C4: prior of its values; uniform unless given."""

    def normal(self, name: str) -> NormalPrior | None:
        """The prior of the dimension; None if it is uniform or the section has a problem."""
        prior: PriorSection | None = self.prior
        if self.range is None or prior is None or prior.mean is None or prior.deviation is None:
            return None
        return NormalPrior(name, float(prior.mean), float(prior.deviation))


def _action_range_model(dimension: Dimension) -> type[RangeSection]:
    name, quantity = dimension.name, dimension_quantity(dimension)
    width = dimension.upper - dimension.lower
    spread = Quantity(dimension.unit, DEVIATIONS[dimension.unit], 0.0, width, positive=True)
    fields: Any = {
        key: (Annotated[float, number] | None, Field(default=None, description=described(PriorSection, key)))
        for key, number in (("mean", quantity), ("deviation", spread))
    }
    prior: Any = create_model(
        f"{title(name)}Prior", __base__=PriorSection, __doc__=PriorSection.__doc__, __cls_kwargs__=MADE, **fields
    )
    prior.required = {"mean": quantity.example, "deviation": spread.example}
    field = (prior | None, Field(default=None, description=described(ActionRangeSection, "prior")))
    return range_model(name, quantity, ActionRangeSection, prior=field)


class PivotPoint(Settings):
    """A horizontal line in the frame of the upright pourer."""

    required: ClassVar[dict[str, str]] = {"x": "0 mm", "z": "50 mm"}

    x: Annotated[float, Quantity("m", "0 mm", -1.0, 1.0)] | None = None
    """Distance from the pourer's axis towards the receiver."""

    z: Annotated[float, Quantity("m", "50 mm", -1.0, 1.0)] | None = None
    """Height above the pourer's underside."""


def _pivot_form(value: Any) -> str:
    return "word" if isinstance(value, str) else "point"


class MotionBase(Settings):
    """Values of the motion that are not searched."""

    pivot: (
        Annotated[
            Annotated[Literal["lip"], Tag("word")] | Annotated[PivotPoint, Tag("point")], Discriminator(_pivot_form)
        ]
        | None
    ) = None
    """Line about which the pourer turns: 'lip', or {x: ..., z: ...} in the frame of the upright pourer."""

    hold_cap: Annotated[float, Quantity("s", "5 s", 0.0, 60.0)] | None = None
    """Maximum duration of a hold 'until_flow_ends'."""

    def fixed(self) -> dict[str, float | None]:
        """Dimensions given here, SI; None for those that are switched off."""
        given = {name: self.value(name) for name in ACTION_DIMENSIONS}
        return {
            name: None if isinstance(value, str) else float(value) for name, value in given.items() if value is not None
        }

    def pivot_value(self) -> Pivot | None:
        """The pivot given here, if any."""
        if self.pivot is None:
            return None
        if isinstance(self.pivot, str):
            return Pivot()
        if self.pivot.x is None or self.pivot.z is None:
            return None
        return Pivot("point", self.pivot.x, self.pivot.z)


def _motion_model() -> type[MotionBase]:
    fields: Any = {
        name: (
            Annotated[float | str, dimension_quantity(dimension, words=True)] | None,
            Field(default=None, description=dimension.meaning),
        )
        for name, dimension in ACTION_DIMENSIONS.items()
    }
    model: type[MotionBase] = create_model(
        "Motion", __base__=MotionBase, __doc__=MotionBase.__doc__, __cls_kwargs__=MADE, **fields
    )
    return model


class ActionsBase(Settings):
    """Searched dimensions of the motion, each with its range; any subset."""

    constraints: list[Text] | None = None
    """Constraints between the dimensions, for example 'x_offset >= 60 mm + 0.5 * height': sums of one kind."""

    def space(self) -> Space | None:
        """The action space, axes in the order of the declarations; None if nothing is searched."""
        axes = tuple(
            section.axis(name)
            for name in ACTION_DIMENSIONS
            if (section := self.value(name)) is not None and section.range is not None
        )
        return Space(axes) if axes else None

    def prior(self) -> tuple[NormalPrior, ...]:
        """Dimensions with a prior that is not uniform."""
        ranges = ((name, self.value(name)) for name in ACTION_DIMENSIONS)
        normals = (section.normal(name) for name, section in ranges if section is not None)
        return tuple(normal for normal in normals if normal is not None)


def _actions_model() -> type[ActionsBase]:
    fields: Any = {
        name: (
            _action_range_model(dimension) | None,
            Field(default=None, description=dimension.meaning),
        )
        for name, dimension in ACTION_DIMENSIONS.items()
    }
    model: type[ActionsBase] = create_model(
        "Actions", __base__=ActionsBase, __doc__=ActionsBase.__doc__, __cls_kwargs__=MADE, **fields
    )
    return model


Motion = _motion_model()
Actions = _actions_model()
