"""Places of a laboratory where the arm puts vessels down and takes them from: settings, and what stands where.

- `PlaceSettings` is one entry of a laboratory's section `places`; `Layout` names the places that a pour uses.
- `PlaceRecord` is the account of what stands where. The orchestrator keeps it on disk
  (`orchestrator.materials.vessel_account`), so that it outlasts the program.

The ways to the places are planned in `actors.arm.planning.place_ways`, and driven in `actors.bench.vessel_handling`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, Protocol

from pydantic import AfterValidator, Field, Strict
from pydantic_core import PydanticCustomError

from actors.arm_geometry import Pose
from actors.interfaces import InvalidActionError
from sim_engine.settings.model import Example, Name, PositiveCount, Problems, Settings
from sim_engine.settings.quantity import Quantity

Role = Literal["pourer", "receiver"]

ROLES: tuple[Role, Role] = ("pourer", "receiver")
"""Names of the vessels that the arm handles."""


class PlaceSettings(Settings):
    """A place where a vessel stands, taught by hand with 'decant robot teach'."""

    name: Annotated[Name, Example("left")]
    """Name of the place."""

    pose: Annotated[Pose, Example("{x: 600 mm, y: -300 mm, z: 120 mm, rx: 1.571 rad}")]
    """Tool centre point in the base's frame, with the fingers at a vessel that stands there."""

    tool: Annotated[Pose, Example("{z: 170 mm}")]
    """Tool centre point in the flange's frame when the pose was taught; it has to be that of the arm."""

    use: Literal["stand", "balance", "source"] = "stand"
    """'balance': on the balance, where the receiver stands in a pour. 'source': under the outlet of the refill pump. 'stand': any other."""  # noqa: E501

    holds: tuple[Role, ...] = ROLES
    """Vessels that may stand there."""

    approach: Annotated[float, Quantity("m", "120 mm", 20e-3, 0.5)] = 0.12
    """Height above the pose from which the tool comes straight down, and to which it rises again."""

    clearance: Annotated[float, Quantity("m", "15 mm", 5e-3, 0.2)] = 15e-3
    """Gap that arm, gripper and carried vessel keep from a vessel that stands there."""

    tray: Annotated[float, Quantity("m^3", "500 mL", 1e-6, 0.1)] | None = None
    """Liquid that the spill tray around the balance holds. What is spilled is added up; before it may overflow, the operator is asked to empty it. Not watched unless given."""  # noqa: E501


TIME_OF_DAY = r"^([01]\d|2[0-3]):[0-5]\d$"


def _time_of_day(value: str) -> str:
    if not re.fullmatch(TIME_OF_DAY, value):
        text = f"{value!r} should be a time of day from 00:00 to 23:59, such as '07:00'"
        raise PydanticCustomError("time_of_day", "{text}", {"text": text})
    return value


class UnattendedSettings(Settings):
    """Pours without a person, after one consent."""

    pours: Annotated[PositiveCount, Field(le=10_000)] = 200
    """Largest number of pours of one consent."""

    until: Annotated[str, Strict(), AfterValidator(_time_of_day), Field(json_schema_extra={"pattern": TIME_OF_DAY})] = (
        "07:00"
    )
    """Local time at which the consent ends, at the latest a day after it was given."""


@dataclass(frozen=True)
class Layout:
    """The places of a laboratory, as pours use them.

    Attributes:
        balance: where the receiver stands in a pour.
        rest: place of each vessel while the other one stands on the balance.
    """

    balance: PlaceSettings
    rest: Mapping[Role, PlaceSettings]

    @classmethod
    def of(cls, places: Sequence[PlaceSettings]) -> Layout:
        """The layout of a laboratory's places.

        Raises:
            InvalidActionError: they do not suffice for a pour.
        """
        balance = [place for place in places if place.use == "balance" and set(ROLES) <= set(place.holds)]
        others = [place for place in places if place.use != "balance"]
        # the pourer stands where it can be filled up; the receiver anywhere else
        pourer = next((p for p in sorted(others, key=lambda p: p.use != "source") if "pourer" in p.holds), None)
        receiver = next((p for p in others if "receiver" in p.holds and p is not pourer), None)
        if len(balance) == 1 and pourer is not None and receiver is not None:
            return cls(balance[0], {"pourer": pourer, "receiver": receiver})
        raise InvalidActionError(
            "these places do not suffice for a pour: it needs one with 'use: balance' for both vessels, one more for "
            "the pourer, and another one for the receiver"
        )


def check_places(problems: Problems, places: Sequence[PlaceSettings], tool: Pose | None) -> None:
    """Add a problem for each place that does not fit the others or the arm.

    Args:
        problems: of the laboratory, whose key `places` is.
        places: all places.
        tool: tool centre point of the arm; None if the arm has none.
    """
    names: set[str] = set()
    for number, place in enumerate(places):
        if place.name in names:
            problems.add(f"two places are named '{place.name}'", "places", number, "name")
        names.add(place.name)
        if place.tray is not None and place.use != "balance":
            problems.add("belongs to the place with 'use: balance', over which is poured", "places", number, "tray")
        if tool is not None and _differ(place.tool, tool):
            problems.add(
                f"place '{place.name}' was taught with another tool than the arm's: teach it again with 'decant robot "
                f"teach FILE {place.name}', where FILE is this file",
                "places",
                number,
                "tool",
            )


def _differ(first_pose: Pose, other: Pose) -> bool:
    """Whether two poses differ by more than 0.1 mm or 0.1 mrad. Near half a turn, a controller shows either of two
    opposite rotation vectors for the same pose."""
    apart = math.dist(first_pose.as_list[:3], other.as_list[:3])
    first, second = (_quaternion(pose) for pose in (first_pose, other))
    turned = min(math.dist(first, second), math.dist(first, tuple(-component for component in second)))
    return apart > 1e-4 or 2.0 * turned > 1e-4


def _quaternion(pose: Pose) -> tuple[float, ...]:
    angle = math.hypot(*(vector := pose.as_list[3:]))
    share = math.sin(0.5 * angle) / angle if angle > 0.0 else 0.0
    return (math.cos(0.5 * angle), *(share * component for component in vector))


class PlaceRecord(Protocol):
    """What stands where, kept on disk before anything moves."""

    def stands(self) -> dict[str, str | None]:
        """The place of every vessel that was entered: its name; None if it is UNKNOWN."""
        ...

    def put(self, vessel: str, place: str | None, note: str = "") -> None:
        """Enter the place of a vessel; None before it is moved: it is UNKNOWN until it has arrived.

        Raises:
            LaboratoryError: another vessel stands there, or it can't be written.
        """
        ...

    def content(self, vessel: str, mass: float | None, deviation: float, liquid: str) -> None:
        """Enter the weighed content of a vessel [kg]; None: unknown until it is weighed again."""
        ...

    def held(self, vessel: str) -> tuple[float, float] | None:
        """The content of a vessel and its deviation [kg]; None if it was never entered, or is unknown."""
        ...
