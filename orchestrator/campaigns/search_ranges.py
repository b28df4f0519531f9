"""Values and ranges of action dimensions and simulation parameters, as sections of files.

The sections are derived from the declarations in `sim_engine.action` and `sim_engine.liquids`.

- `RangeSettings`: bounds and scale of a searched quantity. `ActionRangeSettings` adds a prior, `ParameterRangeSettings`
  a measured value.
- `MotionBase`: values of the motion that are not searched; `ActionsBase`: searched dimensions and their constraints.
- `ParametersBase`: simulation parameters, each with a value or a range.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Discriminator, Field, GetJsonSchemaHandler, Tag, create_model, model_validator
from pydantic_core import CoreSchema, PydanticCustomError

from orchestrator.learning.campaign_plan import NormalPrior
from sim_engine.action import ACTION_DIMENSIONS, Dimension
from sim_engine.liquids import ParameterInfo, SimulationParameters
from sim_engine.scene import Pivot
from sim_engine.search_space import Axis, Scale, Space
from sim_engine.settings.model import Problems, Settings, Text
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
} | {name: info.example for name, info in SimulationParameters.info().items()}
"""A valid value of every action dimension and simulation parameter, for messages and schemas."""


class RangeSettings(Settings):
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


def _section(
    name: str, base: type[Settings], types: Mapping[str, Any], meanings: Mapping[str, str] | None = None
) -> Any:
    """A section with optional keys of these types; keys that `base` declares keep their descriptions."""
    fields: Any = {
        key: (kind | None, Field(default=None, description=(meanings or {}).get(key))) for key, kind in types.items()
    }
    return create_model(name, __base__=base, __doc__=base.__doc__, **fields)


def _range(quantity: Quantity) -> Any:
    end = Annotated[float, quantity]
    return tuple[end, end]


def _title(name: str) -> str:
    return name.title().replace("_", "")


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


class RangePriorSettings(Settings):
    """Prior of a searched dimension: a normal distribution, truncated at the ends of the range."""

    mean: Any = None
    """Mean, within the range."""

    deviation: Any = None
    """Standard deviation."""


class ActionRangeSettings(RangeSettings):
    """Bounds of a searched dimension: `[lowest, highest]`, or `{range: [...], scale: log, prior: {...}}`."""

    prior: Any = None
    """C4: prior of its values; uniform unless given."""

    def normal(self, name: str) -> NormalPrior | None:
        """The prior of the dimension; None if it is uniform or the section has a problem."""
        prior: RangePriorSettings | None = self.prior
        if self.range is None or prior is None or prior.mean is None or prior.deviation is None:
            return None
        return NormalPrior(name, float(prior.mean), float(prior.deviation))


def _action_range(dimension: Dimension) -> Any:
    title, quantity = _title(dimension.name), dimension_quantity(dimension)
    width = dimension.upper - dimension.lower
    spread = Quantity(dimension.unit, DEVIATIONS[dimension.unit], 0.0, width, positive=True)
    moments = {"mean": Annotated[float, quantity], "deviation": Annotated[float, spread]}
    prior = _section(f"{title}Prior", RangePriorSettings, moments)
    prior.required = {"mean": quantity.example, "deviation": spread.example}
    return _section(f"{title}Range", ActionRangeSettings, {"range": _range(quantity), "prior": prior})


class PivotPoint(Settings):
    """A horizontal line in the frame of the upright pourer."""

    x: Annotated[float, Quantity("m", "0 mm", -1.0, 1.0)]
    """Distance from the pourer's axis towards the receiver."""

    z: Annotated[float, Quantity("m", "50 mm", -1.0, 1.0)]
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

    max_hold_time: Annotated[float, Quantity("s", "5 s", 0.0, 60.0)] | None = None
    """Maximum duration of a hold 'until_flow_ends'."""

    def fixed(self) -> dict[str, float | None]:
        """Dimensions given here, SI; None for those that are switched off."""
        raw = {name: self.value(name) for name in ACTION_DIMENSIONS}
        return {
            name: None if isinstance(value, str) else float(value) for name, value in raw.items() if value is not None
        }

    def pivot_value(self) -> Pivot | None:
        """The pivot given here, if any."""
        if self.pivot is None:
            return None
        if isinstance(self.pivot, str):
            return Pivot()
        return Pivot("point", self.pivot.x, self.pivot.z)


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


_MEANINGS = {name: dimension.meaning for name, dimension in ACTION_DIMENSIONS.items()}

Motion: Any = _section(
    "Motion",
    MotionBase,
    {name: Annotated[float | str, dimension_quantity(one, words=True)] for name, one in ACTION_DIMENSIONS.items()},
    _MEANINGS,
)
Actions: Any = _section(
    "Actions", ActionsBase, {name: _action_range(dimension) for name, dimension in ACTION_DIMENSIONS.items()}, _MEANINGS
)

SEARCHED_TOLERANCES = 3.0
"""The default range of a measured value, in standard deviations to both sides."""


class ParameterRangeSettings(RangeSettings):
    """A searched parameter: `[lowest, highest]` for a uniform prior, or `{measured: …, tolerance: …}` for a normal
    prior, which an additional range truncates."""

    required: ClassVar[dict[str, str]] = {}

    measured: Any = None
    """C4: measured or known value."""

    tolerance: Any = None
    """C4: standard deviation of the measured value; without a range, three of them to both sides are searched."""

    info: ClassVar[ParameterInfo]

    def check_values(self, problems: Problems) -> None:
        """Check that a measured value has a tolerance and lies in the range."""
        if problems.any:
            return
        info, value, tolerance = self.info, self.measured, self.tolerance
        unit = "" if info.shown == "1" else f" {info.shown}"
        if self.range is None and value is None and tolerance is None:
            text = "names nothing to search; add a 'range', or what was 'measured' with its 'tolerance'"
            problems.add(text, key=True)
        elif value is None and tolerance is not None:
            text = f"has a tolerance of nothing; add for example 'measured: {EXAMPLES[info.name]}'"
            problems.add(text, key=True)
        elif value is not None and tolerance is None:
            usual = f"{(info.tolerance or (info.upper - info.lower) / 20.0) / info.factor:.2g}{unit}"
            text = f"has no 'tolerance'; add for example 'tolerance: {usual}', or write the value alone to fix it"
            problems.add(text, key=True)
        elif self.scale == "log" and tolerance is not None:
            problems.add("a tolerance is the same to both sides, and needs the scale 'linear'", "scale")
        elif value is not None and self.range is not None and not self.range[0] <= value <= self.range[1]:
            low, high = (f"{end / info.factor:g}" for end in self.range)
            text = f"{value / info.factor:g}{unit} is outside the range beside it, {low} … {high}{unit}"
            problems.add(text, "measured")

    def searched(self) -> Axis | None:
        """The searched axis; None after a problem."""
        info = self.info
        if self.range is not None:
            return self.axis(info.name, integer=info.integer)
        if self.measured is None or self.tolerance is None:
            return None
        low, high = (self.measured + sign * SEARCHED_TOLERANCES * self.tolerance for sign in (-1.0, 1.0))
        return Axis(info.name, max(low, info.lower), min(high, info.upper), self.scale, info.integer)

    def normal(self) -> NormalPrior | None:
        """The prior; None if it is uniform, or after a problem."""
        if self.measured is None or self.tolerance is None:
            return None
        return NormalPrior(self.info.name, float(self.measured), float(self.tolerance))


def _parameter_range(info: ParameterInfo) -> Any:
    quantity = info.quantity
    typical = (info.tolerance or (info.upper - info.lower) / 20.0) / info.factor
    example = f"{typical:.2g}" + ("" if info.shown == "1" else f" {info.shown}")
    spread = Quantity(info.unit, example, 0.0, info.upper - info.lower, positive=True)
    types = {
        "range": _range(quantity),
        "measured": Annotated[float, quantity],
        "tolerance": Annotated[float, spread],
    }
    model = _section(f"{_title(info.name)}Range", ParameterRangeSettings, types)
    model.info = info
    return model


def _parameter_form(value: Any) -> str:
    return "searched" if isinstance(value, (list, Mapping)) else "fixed"


class ParametersBase(Settings):
    """Parameters: a value fixes one; a range, or a measured value with a tolerance, makes calibration search it."""

    def fixed(self) -> dict[str, float]:
        """Parameters with a value, SI."""
        return {name: float(v) for name in self.written_keys() if isinstance(v := self.value(name), (int, float))}

    def ranges(self) -> dict[str, ParameterRangeSettings]:
        """Searched parameters."""
        values = {name: self.value(name) for name in self.written_keys()}
        return {name: section for name, section in values.items() if isinstance(section, ParameterRangeSettings)}

    def searched(self) -> dict[str, Axis]:
        """Axes of the searched parameters."""
        axes = {name: section.searched() for name, section in self.ranges().items()}
        return {name: axis for name, axis in axes.items() if axis is not None}

    def priors(self) -> tuple[NormalPrior, ...]:
        """Searched parameters with a prior that is not uniform."""
        normals = (section.normal() for section in self.ranges().values())
        return tuple(prior for prior in normals if prior is not None)

    def completed(self) -> Self:
        """A copy with the defaults of parameters that are not given."""
        values = {name: value for name in self.written_keys() if (value := self.value(name)) is not None}
        return self.model_copy(update=SimulationParameters().model_dump() | values)

    def in_force(self) -> dict[str, float]:
        """Values in SI: fixed values; for a range, the measured value or the default, clipped to the range."""
        default = SimulationParameters().model_dump() | {prior.name: prior.mean for prior in self.priors()}
        return self.fixed() | {n: min(max(default[n], axis.lower), axis.upper) for n, axis in self.searched().items()}


def _parameter(info: ParameterInfo) -> Any:
    return Annotated[
        Annotated[float, info.quantity, Tag("fixed")] | Annotated[_parameter_range(info), Tag("searched")],
        Discriminator(_parameter_form),
    ]


_PARAMETERS = SimulationParameters.info()

Parameters: Any = _section(
    "Parameters",
    ParametersBase,
    {name: _parameter(info) for name, info in _PARAMETERS.items()},
    {name: info.meaning for name, info in _PARAMETERS.items()},
)
