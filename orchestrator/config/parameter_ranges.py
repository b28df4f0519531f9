"""File sections for simulation parameters, fixed or searched, derived from the declarations in `sim_engine.liquids`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Self

from pydantic import Discriminator, Field, Tag, create_model

from orchestrator.config.action_ranges import EXAMPLES, RangeSection, described, range_model
from orchestrator.strategies.campaign_plan import NormalPrior
from sim_engine.liquids import ParameterInfo, SimulationParameters
from sim_engine.search_space import Axis
from sim_engine.settings.model import MADE, Settings
from sim_engine.settings.quantity import Quantity

SEARCHED_TOLERANCES = 3.0
"""The default range of a measured value, in standard deviations to both sides."""


def parameter_quantity(name: str) -> Quantity:
    """Annotation of a simulation parameter."""
    info = SimulationParameters.info()[name]
    return Quantity(info.unit, EXAMPLES[name], info.lower, info.upper, whole=info.integer)


class ParameterRangeSection(RangeSection):
    """A searched parameter: `[lowest, highest]` for a uniform prior, or `{measured: …, tolerance: …}` for a normal
    prior, which an additional range truncates."""

    required: ClassVar[dict[str, str]] = {}

    measured: Any = None
    """C4: measured or known value."""

    tolerance: Any = None
    """C4: standard deviation of the measured value; without a range, three of them to both sides are searched."""

    info: ClassVar[ParameterInfo]

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


def _parameter_range_model(info: ParameterInfo) -> type[ParameterRangeSection]:
    quantity = parameter_quantity(info.name)
    typical = (info.tolerance or (info.upper - info.lower) / 20.0) / info.factor
    example = f"{typical:.2g}" + ("" if info.shown == "1" else f" {info.shown}")
    spread = Quantity(info.unit, example, 0.0, info.upper - info.lower, positive=True)
    further: Any = {
        key: (Annotated[float, number] | None, Field(default=None, description=described(ParameterRangeSection, key)))
        for key, number in (("measured", quantity), ("tolerance", spread))
    }
    model: Any = range_model(info.name, quantity, ParameterRangeSection, **further)
    model.info = info
    return model  # type: ignore[no-any-return]


def _parameter_form(value: Any) -> str:
    return "searched" if isinstance(value, (list, Mapping)) else "fixed"


class ParametersBase(Settings):
    """Parameters: a value fixes one; a range, or a measured value with a tolerance, makes calibration search it."""

    def fixed(self) -> dict[str, float]:
        """Parameters with a value, SI."""
        return {name: float(v) for name in self.written_keys() if isinstance(v := self.value(name), (int, float))}

    def ranges(self) -> dict[str, ParameterRangeSection]:
        """Searched parameters."""
        given = {name: self.value(name) for name in self.written_keys()}
        return {name: section for name, section in given.items() if isinstance(section, ParameterRangeSection)}

    def searched(self) -> dict[str, Axis]:
        """Axes of the searched parameters."""
        axes = {name: section.searched() for name, section in self.ranges().items()}
        return {name: axis for name, axis in axes.items() if axis is not None}

    def priors(self) -> tuple[NormalPrior, ...]:
        """Searched parameters with a prior that is not uniform."""
        found = (section.normal() for section in self.ranges().values())
        return tuple(prior for prior in found if prior is not None)

    def completed(self) -> Self:
        """A copy with the defaults of parameters that are not given."""
        given = {name: value for name in self.written_keys() if (value := self.value(name)) is not None}
        return self.model_copy(update=SimulationParameters().model_dump() | given)

    def in_force(self) -> dict[str, float]:
        """Values in SI: fixed values; for a range, the measured value or the default, clipped to the range."""
        default = SimulationParameters().model_dump() | {prior.name: prior.mean for prior in self.priors()}
        return self.fixed() | {n: min(max(default[n], axis.lower), axis.upper) for n, axis in self.searched().items()}


def _parameters_model() -> type[ParametersBase]:
    fields: Any = {}
    for name, info in SimulationParameters.info().items():
        quantity = parameter_quantity(name)
        form: Any = Annotated[
            Annotated[float, quantity, Tag("fixed")] | Annotated[_parameter_range_model(info), Tag("searched")],
            Discriminator(_parameter_form),
        ]
        fields[name] = (form | None, Field(default=None, description=info.meaning or None))
    model: type[ParametersBase] = create_model(
        "Parameters", __base__=ParametersBase, __doc__=ParametersBase.__doc__, __cls_kwargs__=MADE, **fields
    )
    return model


Parameters = _parameters_model()
