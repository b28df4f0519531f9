"""How doses are poured: the limits of tilt and flow, and when a dose ends. They belong to a laboratory's file."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

from sim_engine.settings.model import Settings
from sim_engine.settings.quantity import Quantity

TiltSpeed = Annotated[float, Quantity("rad/s", "3 deg/s", 0.0, 3.2, positive=True)]
MassFlow = Annotated[float, Quantity("kg/s", "0.03 kg/s", 0.0, 1.0, positive=True)]
Duration = Annotated[float, Quantity("s", "0.6 s", 0.0, 600.0, positive=True)]


class DosingSettings(Settings):
    """How doses are poured. Values that no laboratory needs otherwise are constants of the class."""

    approach_speed: TiltSpeed = math.radians(50.0)
    """Speed of the tilt up to the earliest plausible onset."""

    latency: Duration = 0.07
    """Delay from a decision to the arm's motion, servo lag included."""

    largest_flow: MassFlow = 0.03
    """Upper bound of the flow at any time."""

    reading_timeout: Duration = 0.7
    """Time without a reading after which the cup is turned back; longer for a balance that sends less often."""

    time_limit: Duration = 60.0
    """Longest duration of a dose."""

    search_speed: ClassVar[float] = math.radians(3.5)
    """Largest speed until the stream is seen."""

    return_speed: ClassVar[float] = math.radians(60.0)
    """Speed of the return; a fast one cuts the film at the lip."""

    acceleration: ClassVar[float] = math.radians(600.0)
    """Acceleration of the return."""

    smallest_flow: ClassVar[float] = 0.004
    """Lower bound of the flow at the end of a dose; it is larger where a slower stream would dribble."""

    largest_fine_flow: ClassVar[float] = 0.008
    """Upper bound of the flow at the end of a dose."""

    smallest_top_up: ClassVar[float] = 1.0e-3
    """Smallest shortage that is poured again; smaller ones cannot be met dependably."""

    most_top_ups: ClassVar[int] = 3
    """Largest number of top-ups."""
