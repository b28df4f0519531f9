"""Errors of execution as written in files: what a bench hides, and what a plan under risk has to bear."""

from __future__ import annotations

from typing import Annotated

from sim_engine.settings.model import Section
from sim_engine.settings.quantity import Quantity

Offset = Annotated[float, Quantity("m", "1 mm", -0.05, 0.05)]
Tilt = Annotated[float, Quantity("rad", "1 deg", -0.2, 0.2)]
Factor = Annotated[float, Quantity("1", "1.02", 0.5, 1.5)]
Spread = Annotated[float, Quantity("1", "0.01", 0.0, 0.5)]


class PoseErrorSection(Section):
    """How the real placement differs from the intended one."""

    x: Offset = 0.0
    """The receiver stands that much further from the pourer."""

    y: Offset = 0.0
    """… and that much sideways."""

    z: Offset = 0.0
    """… and that much higher."""

    tilt: Tilt = 0.0
    """The pourer is held that much more tilted than commanded."""

    speed_factor: Factor = 1.0
    """Executed over commanded angular velocity."""


class PoseNoiseSection(Section):
    """Standard deviations of the same from pour to pour."""

    x: Annotated[float, Quantity("m", "0.5 mm", 0.0, 0.05)] = 0.0
    """Standard deviation of the distance."""

    y: Annotated[float, Quantity("m", "0.5 mm", 0.0, 0.05)] = 0.0
    """Standard deviation of the sideways placement."""

    z: Annotated[float, Quantity("m", "0.5 mm", 0.0, 0.05)] = 0.0
    """Standard deviation of the receiver's height."""

    tilt: Annotated[float, Quantity("rad", "0.3 deg", 0.0, 0.2)] = 0.0
    """Standard deviation of the tilt."""

    speed_factor: Spread = 0.0
    """Standard deviation of executed over commanded angular velocity."""
