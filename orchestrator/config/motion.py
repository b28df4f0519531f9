"""Motions and action spaces as written in files, derived from the declarations in `sim_engine.action`."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Discriminator, Field, Tag, create_model

from orchestrator.config.ranges import EXAMPLES, RangeSection, described, range_model, title
from orchestrator.config.yaml.quantities import Quantity
from orchestrator.config.yaml.sections import MADE, Section, Text
from orchestrator.plan import NormalPrior
from sim_engine.action import ACTION_DIMENSIONS, Dimension
from sim_engine.space import Space
from sim_engine.task import Pivot

DEVIATIONS = {"rad/s": "20 deg/s", "rad": "10 deg", "rad/s^2": "200 deg/s^2", "s": "0.5 s", "m": "15 mm"}
"""A right standard deviation of a dimension in each unit."""


def dimension_quantity(dimension: Dimension, *, words: bool = False) -> Quantity:
    """Annotation of an action dimension; with `words`, those that switch it off are allowed."""
    return Quantity(
        dimension.unit,
        EXAMPLES[dimension.name],
        dimension.lower,
        dimension.upper,
        words=(dimension.switched_off,) if words and dimension.optional else (),
    )


class PriorSection(Section):
    """How likely values of a searched dimension are beforehand: a normal distribution, cut off at the range's ends."""

    mean: Any = None
    """Its mean, within the range."""

    deviation: Any = None
    """Its standard deviation."""


class ActionRangeSection(RangeSection):
    """Bounds of a searched dimension: `[lowest, highest]`, or `{range: [...], scale: log, prior: {...}}`."""

    prior: Any = None
    """C4: how likely its values are beforehand, in place of all alike."""

    def normal(self, name: str) -> NormalPrior | None:
        """The prior of the dimension; None where its values are all alike, or where something is wrong here."""
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


class PivotPoint(Section):
    """A horizontal line, given in the frame of the upright pourer."""

    required: ClassVar[dict[str, str]] = {"x": "0 mm", "z": "50 mm"}

    x: Annotated[float, Quantity("m", "0 mm", -1.0, 1.0)] | None = None
    """From the pourer's axis towards the receiver."""

    z: Annotated[float, Quantity("m", "50 mm", -1.0, 1.0)] | None = None
    """Above the pourer's underside."""


def _pivot_form(value: Any) -> str:
    return "word" if isinstance(value, str) else "point"


class MotionBase(Section):
    """Values of the motion that are not searched."""

    pivot: (
        Annotated[
            Annotated[Literal["lip"], Tag("word")] | Annotated[PivotPoint, Tag("point")], Discriminator(_pivot_form)
        ]
        | None
    ) = None
    """Line about which the pourer turns: 'lip', or {x: ..., z: ...} in the frame of the upright pourer."""

    hold_cap: Annotated[float, Quantity("s", "5 s", 0.0, 60.0)] | None = None
    """Longest hold 'until_flow_ends'."""

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


class ActionsBase(Section):
    """Searched dimensions of the motion, each with its range; any subset."""

    constraints: list[Text] | None = None
    """What must hold between them besides, 'x_offset >= 60 mm + 0.5 * height' for example: sums of one kind."""

    def space(self) -> Space | None:
        """The action space, axes in the order of the declarations; None if nothing is searched."""
        axes = tuple(
            section.axis(name)
            for name in ACTION_DIMENSIONS
            if (section := self.value(name)) is not None and section.range is not None
        )
        return Space(axes) if axes else None

    def prior(self) -> tuple[NormalPrior, ...]:
        """Dimensions whose values are not all alike beforehand."""
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
