"""Actions: a robot's choices for a pour (the paper's `a`). Plain values in SI units.

`ACTION_DIMENSIONS` declares each `Dimension` once; an `Action` is one complete choice.

Frames and signs (docs/reference/frames.md has the picture). The world frame has its origin on the table below the
receiver, z up, x horizontal from the pourer towards the receiver. The receiver's axis is the z axis and its underside
is at z = 0. A positive tilt turns the pourer about +y, so that it tips towards +x.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

DEG = math.pi / 180.0


@dataclass(frozen=True)
class Dimension:
    """One choice in an action, declared once for forms, schema, plots and checks.

    Attributes:
        name: key in YAML, CSV and code.
        unit: SI unit that code uses.
        display_unit: unit that users read and type.
        lower: smallest sensible value [unit].
        upper: largest sensible value [unit].
        meaning: one line for users.
        switched_off: word for omitting it (None in an `Action`), see `meaning`; empty if it cannot be omitted.
    """

    name: str
    unit: str
    display_unit: str
    lower: float
    upper: float
    meaning: str
    switched_off: str = ""

    @property
    def optional(self) -> bool:
        """Whether it may be switched off."""
        return bool(self.switched_off)

    @property
    def factor(self) -> float:
        """SI value of one display unit."""
        return {"deg": DEG, "deg/s": DEG, "deg/s^2": DEG, "mm": 1e-3, "s": 1.0}[self.display_unit]


ACTION_DIMENSIONS: dict[str, Dimension] = {
    d.name: d
    for d in (
        Dimension("angular_velocity", "rad/s", "deg/s", 1 * DEG, 360 * DEG, "speed at which the pourer tilts"),
        Dimension("max_angle", "rad", "deg", 5 * DEG, 175 * DEG, "tilt from upright at which the pourer stops"),
        Dimension(
            "angular_acceleration",
            "rad/s^2",
            "deg/s^2",
            10 * DEG,
            20_000 * DEG,
            "acceleration into and out of every turn; 'step' starts and stops at once, to replay recorded data only",
            switched_off="step",
        ),
        Dimension(
            "hold_time",
            "s",
            "s",
            0.0,
            60.0,
            "time at the largest tilt; 'until_flow_ends' holds until the predicted end of flow (capped)",
            switched_off="until_flow_ends",
        ),
        Dimension(
            "return_velocity",
            "rad/s",
            "deg/s",
            1 * DEG,
            360 * DEG,
            "speed of the return to upright; 'none' ends the pour at the largest tilt, for recorded data only",
            switched_off="none",
        ),
        Dimension("x_offset", "m", "mm", -0.5, 0.5, "distance of the vessel axes along x while the pourer is upright"),
        Dimension("y_offset", "m", "mm", -0.3, 0.3, "sideways distance of the vessel axes"),
        Dimension(
            "height", "m", "mm", -0.2, 1.0, "the pourer's lip above the receiver's rim while the pourer is upright"
        ),
    )
}


@dataclass(frozen=True)
class Action:
    """One complete choice for a pour. SI units; see `ACTION_DIMENSIONS` for meanings and bounds.

    `None` switches an optional dimension off: `angular_acceleration` (a step), `hold_time` (until the predicted end of
    flow), `return_velocity` (no return).
    """

    angular_velocity: float
    x_offset: float
    height: float
    max_angle: float = 120 * DEG
    angular_acceleration: float | None = 600 * DEG
    hold_time: float | None = None
    return_velocity: float | None = 90 * DEG
    y_offset: float = 0.0

    def __post_init__(self) -> None:
        for name, dimension in ACTION_DIMENSIONS.items():
            value = getattr(self, name)
            if value is None:
                if not dimension.optional:
                    raise ValueError(f"{name} must have a value")
                continue
            if not math.isfinite(value) or not dimension.lower - 1e-12 <= value <= dimension.upper + 1e-12:
                k = dimension.factor
                raise ValueError(
                    f"{name} = {value / k:g} {dimension.display_unit} is outside "
                    f"{dimension.lower / k:g} … {dimension.upper / k:g} {dimension.display_unit}"
                )

    @classmethod
    def compose(cls, fixed: Mapping[str, float | None], chosen: Mapping[str, float]) -> Action:
        """The action of a searched point: the chosen dimensions over the fixed ones.

        Raises:
            ValueError: a dimension is unknown, out of bounds, or has no value at all.
        """
        values = {**fixed, **chosen}
        unknown = set(values) - set(ACTION_DIMENSIONS)
        if unknown:
            raise ValueError(f"unknown action dimension(s): {', '.join(sorted(unknown))}")
        missing = {"angular_velocity", "x_offset", "height"} - set(values)
        if missing:
            raise ValueError(f"action dimension(s) without a value: {', '.join(sorted(missing))}")
        return cls(**values)  # type: ignore[arg-type]

    def values(self) -> dict[str, float | None]:
        """All dimensions by name, SI."""
        return asdict(self)

    def with_values(self, **changes: float | None) -> Action:
        """A copy with some dimensions changed."""
        return replace(self, **changes)  # type: ignore[arg-type]

    def display(self, *names: str) -> str:
        """Named dimensions, or all of them, in display units; see `described`."""
        return described({name: getattr(self, name) for name in names or ACTION_DIMENSIONS})


def described(values: Mapping[str, float | None]) -> str:
    """Action dimensions [SI] in display units: 'angular_velocity 41.2 deg/s  x_offset 104 mm'."""
    parts = []
    for name, value in values.items():
        dimension = ACTION_DIMENSIONS[name]
        shown = dimension.switched_off if value is None else f"{value / dimension.factor:.4g} {dimension.display_unit}"
        parts.append(f"{name} {shown}")
    return "  ".join(parts)
