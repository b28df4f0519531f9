"""Ranges as written in files, and a right value of everything that may be given one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, GetJsonSchemaHandler, create_model, model_validator
from pydantic_core import CoreSchema, PydanticCustomError

from orchestrator.config.yaml.quantities import Quantity
from orchestrator.config.yaml.sections import MADE, Section
from sim_engine.liquid import SimulationParameters
from sim_engine.space import Axis, Scale

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
    # A parameter's default is a good example of it.
    name: f"{default / info.factor:g}" + ("" if info.shown == "1" else f" {info.shown}")
    for (name, info), default in zip(
        SimulationParameters.info().items(), SimulationParameters().model_dump().values(), strict=True
    )
}
"""A right value of every action dimension and simulation parameter, for messages and schemas."""


class RangeSection(Section):
    """Bounds of a searched quantity: `[lowest, highest]`, or with a scale `{range: [...], scale: log}`."""

    required: ClassVar[dict[str, str]] = {"range": "[lowest, highest]"}

    range: tuple[Any, Any] | None = None
    """[lowest, highest]"""

    scale: Scale = "linear"
    """How the search spreads over the range."""

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
        """The axis of a space."""
        assert self.range is not None
        return Axis(name, float(self.range[0]), float(self.range[1]), self.scale, integer)


def range_model(
    name: str, quantity: Quantity, base: type[RangeSection] = RangeSection, **further: Any
) -> type[RangeSection]:
    """A range of one quantity; `further` fields beside its bounds."""
    end = Annotated[float, quantity]
    fields: Any = {"range": (tuple[end, end] | None, Field(default=None, description="[lowest, highest]")), **further}
    model: type[RangeSection] = create_model(
        f"{title(name)}Range", __base__=base, __doc__=base.__doc__, __cls_kwargs__=MADE, **fields
    )
    return model


def title(name: str) -> str:
    """Name of the models of a quantity."""
    return name.title().replace("_", "")


def described(section: type[Section], field: str) -> str | None:
    """What a field of a section means."""
    return section.model_fields[field].description
