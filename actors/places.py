"""Places of a laboratory where the arm puts vessels down and takes them from: settings, and what stands where.

- `PlaceSettings` is one entry of a laboratory's section `places`: one place, or a rack of them (`RackSettings`).
  `all_places` has each position of a rack as a place of its own, such as 'rack/A1'.
- `CellVessel` is a vessel by its identity; `Layout` names the places of pourer and receiver in calibration pours.
- `PlaceRecord` is the account of what stands where. The orchestrator keeps it on disk
  (`orchestrator.materials.vessel_account`), so that it outlasts the program.

The ways to the places are planned in `actors.arm.planning.place_ways`, and driven in `actors.bench.vessel_handling`.
"""

from __future__ import annotations

import cmath
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Annotated, Literal, Protocol

from pydantic import AfterValidator, Field, Strict
from pydantic_core import PydanticCustomError

from actors.arm_geometry import Pose
from actors.interfaces import InvalidActionError
from sim_engine.settings.model import Example, PositiveCount, Problems, Settings
from sim_engine.settings.quantity import Quantity
from sim_engine.vessel.shapes import VesselSpec, cylinder

Role = Literal["pourer", "receiver"]

ROLES: tuple[Role, Role] = ("pourer", "receiver")
"""Names of the vessels that the arm handles in calibration pours; in doses, the roles of source and cup."""

PlaceName = Annotated[
    str, Strict(), Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*(/[A-Za-z0-9][A-Za-z0-9._-]*)?$", max_length=60)
]

OUTSIDE = ""
"""Place of a vessel that is not in the cell."""


PITCH = Quantity("m", "90 mm", 5e-3, 0.5)

RESIDUAL = 3e-3
"""Largest distance of a taught corner of a rack from where its pitch puts it [m]."""

LEVEL = math.radians(2.0)
"""Largest slope of a rack."""

TURNED = math.radians(10.0)
"""Largest angle of the tool at a taught corner of a rack from the tool at A1, whose orientation all positions have."""

BESIDE = math.radians(20.0)
"""Angle from the direction in which the tool reaches below which two vessels stand beside each other."""


class RackSettings(Settings):
    """Rows A, B … and columns 1, 2 … of a rack, seen from above with A1 at the top left."""

    rows: Annotated[PositiveCount, Field(le=26)]
    """Number of rows."""

    columns: Annotated[PositiveCount, Field(le=99)]
    """Number of columns."""

    row_pitch: Annotated[float, PITCH]
    """Distance of two rows."""

    column_pitch: Annotated[float, PITCH]
    """Distance of two columns."""

    row_rise: Annotated[float, Quantity("m", "0 mm", -0.5, 0.5)] = 0.0
    """Height of each row above the one before, as on stairs. A gripper that reaches for the cups from the side passes over the rows behind them."""  # noqa: E501

    direction: Annotated[float, Quantity("rad", "0 deg", -math.pi, math.pi)] = 0.0
    """Direction from A1 to A2 around the base's z, from its x; used while only A1 is taught."""

    last_row: Pose | None = None
    """Tool centre point at the first position of the last row, such as D1."""

    last_column: Pose | None = None
    """Tool centre point at the last position of row A, such as A6."""

    @property
    def corners(self) -> dict[str, tuple[int, int]]:
        """Positions at which it is taught, A1 first: their row and column from 0."""
        last = {position_name(self.rows - 1, 0): (self.rows - 1, 0)} if self.rows > 1 else {}
        if self.columns > 1:
            last[position_name(0, self.columns - 1)] = (0, self.columns - 1)
        return {"A1": (0, 0), **last}

    @property
    def taught_corners(self) -> list[Pose | None]:
        """Poses of the `corners` after A1; None where it is still to be taught."""
        last_row = [self.last_row] if self.rows > 1 else []
        return last_row + ([self.last_column] if self.columns > 1 else [])

    def positions(self, first: Pose) -> tuple[dict[str, Pose], float]:
        """The poses of all positions by name, and the residual of the taught ones.

        Horizontally the grid is turned and shifted for the smallest sum of squares; the height follows the plane of
        the taught positions. All have the orientation of A1.

        Args:
            first: pose of A1.

        Returns:
            The poses, and the largest distance of a taught position from its place in the grid [m].
        """
        taught = {(0, 0): first}
        if self.last_row is not None:
            taught[self.rows - 1, 0] = self.last_row
        if self.last_column is not None:
            taught[0, self.columns - 1] = self.last_column
        grid = {key: complex(key[1] * self.column_pitch, -key[0] * self.row_pitch) for key in taught}
        measured = {key: complex(*pose.as_list[:2]) for key, pose in taught.items()}
        middle, centre = (sum(points.values()) / len(taught) for points in (grid, measured))
        # the rotation e^{iφ} that minimises Σ |m_k − m̄ − e^{iφ} (g_k − ḡ)|² has the angle of Σ (m_k − m̄) (g_k − ḡ)*
        aligned = sum((measured[key] - centre) * (grid[key] - middle).conjugate() for key in taught)
        turn = aligned / abs(aligned) if abs(aligned) > 0.0 else cmath.rect(1.0, self.direction)
        residual = max(abs(measured[key] - centre - turn * (grid[key] - middle)) for key in taught)
        down, across = self.slopes(first)
        poses = {}
        for row, column in product(range(self.rows), range(self.columns)):
            right, below = column * self.column_pitch, row * self.row_pitch
            at = centre + turn * (complex(right, -below) - middle)
            z = first.as_list[2] + row * self.row_rise + down * below + across * right
            poses[position_name(row, column)] = Pose.of(at.real, at.imag, z, *first.as_list[3:])
        return poses, residual

    def slopes(self, first: Pose) -> tuple[float, float]:
        """Rise per length beyond `row_rise`, from row to row and from column to column; 0 where it is not taught."""
        ends = (
            (self.last_row, self.rows, self.row_pitch, self.row_rise),
            (self.last_column, self.columns, self.column_pitch, 0.0),
        )
        down, across = (
            0.0 if end is None or count < 2 else ((end.as_list[2] - first.as_list[2]) / (count - 1) - rise) / pitch
            for end, count, pitch, rise in ends
        )
        return down, across


def position_name(row: int, column: int) -> str:
    """The usual name of a position: 'A1' for row 0 and column 0."""
    return f"{chr(ord('A') + row)}{column + 1}"


class ContainerSettings(Settings):
    """A round, open container for waste."""

    diameter: Annotated[float, Quantity("m", "200 mm", 0.05, 0.6)]
    """Outer diameter."""

    height: Annotated[float, Quantity("m", "120 mm", 0.02, 0.6)]
    """Outer height."""

    @property
    def vessel(self) -> VesselSpec:
        """Its shape."""
        inside = 0.5 * self.diameter - 2e-3
        return cylinder("waste", inner_radius=inside, inner_height=self.height - 2e-3, wall=2e-3, floor=2e-3)


class PlaceSettings(Settings):
    """A place where a vessel stands, taught by hand with 'decant robot teach'."""

    name: Annotated[PlaceName, Example("left")]
    """Name of the place, and of the vessel that belongs there; a slash may group some, such as 'source/water'."""

    pose: Annotated[Pose, Example("{x: 600 mm, y: -300 mm, z: 120 mm, rx: 1.571 rad}")]
    """Tool centre point in the base's frame, with the fingers at a vessel that stands there."""

    tool: Annotated[Pose, Example("{z: 170 mm}")]
    """Tool centre point in the flange's frame when the pose was taught; it has to be that of the arm."""

    use: Literal["stand", "balance", "source", "waste"] = "stand"
    """'balance': on the balance, where the receiver stands in a pour. 'source': under the outlet of the refill pump. 'waste': a container into which cups are emptied. 'stand': any other."""  # noqa: E501

    container: ContainerSettings | None = None
    """The container at a place with 'use: waste', which is taught with a cup that stands where it stands."""

    holds: tuple[Role, ...] = ROLES
    """Vessels that may stand there."""

    approach: Annotated[float, Quantity("m", "120 mm", 20e-3, 0.5)] = 0.12
    """Height above the pose from which the tool comes straight down, and to which it rises again; more than the depth to which a vessel stands in a rack."""  # noqa: E501

    clearance: Annotated[float, Quantity("m", "15 mm", 5e-3, 0.2)] = 15e-3
    """Gap that arm, gripper and carried vessel keep from a vessel that stands there."""

    tray: Annotated[float, Quantity("m^3", "500 mL", 1e-6, 0.1)] | None = None
    """Liquid that the spill tray around the balance holds. What is spilled is added up; before it may overflow, the operator is asked to empty it. Not watched unless given."""  # noqa: E501

    rack: RackSettings | None = None
    """It is a rack: its pose is that of A1, and each position is a place, such as 'rack/A1'."""

    @property
    def each(self) -> tuple[PlaceSettings, ...]:
        """The places: of a rack, one for each position."""
        if self.rack is None:
            return (self,)
        poses, _ = self.rack.positions(self.pose)
        return tuple(self.with_values(name=f"{self.name}/{name}", pose=pose, rack=None) for name, pose in poses.items())


def all_places(places: Sequence[PlaceSettings]) -> tuple[PlaceSettings, ...]:
    """The places of a laboratory, with each position of a rack as a place of its own."""
    return tuple(position for place in places for position in place.each)


@dataclass(frozen=True)
class CellVessel:
    """A vessel of a series of doses.

    Attributes:
        name: its identity: the name of the place where it belongs.
        spec: its shape, with `grip: {mass: …}`.
        liquid: of a source, its liquid; '' for a cup.
        mass, volume: largest load with which it is carried [kg], [m³].
        filled: the operator fills a source with this load when the vessels are laid out.
        home: the place where it belongs, if its name is another one.
    """

    name: str
    spec: VesselSpec
    liquid: str
    mass: float
    volume: float
    filled: bool = True
    home: str = ""

    @property
    def place(self) -> str:
        """Name of the place where it belongs."""
        return self.home or self.name


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
        others = [place for place in places if place.use not in ("balance", "waste")]
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
        places: as in the file.
        tool: tool centre point of the arm; None if the arm has none.
    """
    names: set[str] = set()
    for number, place in enumerate(places):
        if twice := names.intersection(position.name for position in place.each):
            problems.add(f"two places are named '{min(twice)}'", "places", number, "name")
        names.update(position.name for position in place.each)
        if place.rack is not None:
            _check_rack(problems, place, number)
        if (place.use == "waste") != (place.container is not None):
            text = "'use: waste' and a 'container: {diameter: 200 mm, height: 120 mm}' belong together"
            problems.add(text, "places", number, "container" if place.container is not None else "use")
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


def _check_rack(problems: Problems, place: PlaceSettings, number: int) -> None:
    rack = place.rack
    assert rack is not None
    if place.use != "stand":
        problems.add("a rack is a place with 'use: stand'; teach the other one by itself", "places", number, "use")
    for key, count in (("last_row", rack.rows), ("last_column", rack.columns)):
        if getattr(rack, key) is not None and count == 1:
            problems.add("is A1 itself, as there is only one; remove it", "places", number, "rack", key)
    if text := rack_problem(place):
        problems.add(text, "places", number, "rack")


def rack_problem(place: PlaceSettings) -> str:
    """Why the taught positions of a rack do not fit its pitch or each other; '' if they do."""
    assert place.rack is not None
    rack, corners = place.rack, [*place.rack.corners][1:]
    for name, pose in zip(corners, rack.taught_corners, strict=True):
        if pose is not None and (turned := _angle_between(pose, place.pose)) > TURNED:
            return (
                f"at {name} of '{place.name}' the tool was turned by {math.degrees(turned):.0f} deg from where it was "
                f"at A1, and {math.degrees(TURNED):.0f} deg are allowed: all positions are reached as A1 is. Teach "
                f"{name} again with the tool as at A1"
            )
    _, residual = place.rack.positions(place.pose)
    if residual > RESIDUAL:
        return (
            f"the taught positions of '{place.name}' are up to {1e3 * residual:.1f} mm away from a grid with its "
            f"pitch, and {1e3 * RESIDUAL:.0f} mm are allowed; teach A1 and the corners again, and check rows, columns "
            "and pitch. Seen from above, rows go down from A and columns to the right"
        )
    if (slope := math.atan(math.hypot(*place.rack.slopes(place.pose)))) > LEVEL:
        beyond = f"by {math.degrees(slope):.1f} deg besides its 'row_rise'"
        return f"'{place.name}' slopes {beyond}; level it, and teach it again"
    return ""


def rows_behind_others(place: PlaceSettings) -> str:
    """Which vessels of a flat rack the tool reaches only over others, for the person who teaches it; '' if none.

    A tool that reaches from the side passes over the rows, or columns, that stand before the one it reaches for.
    """
    rack = place.rack
    w, x, y, z = _quaternion(place.pose)
    reach = complex(2.0 * (x * z + w * y), 2.0 * (y * z - w * x))  # the tool's z axis, seen from above
    if rack is None or abs(reach) < math.sin(BESIDE):
        return ""
    poses, _ = rack.positions(place.pose)
    names = ([chr(ord("A") + row) for row in range(rack.rows)], [str(1 + column) for column in range(rack.columns)])
    texts = []
    for kind, every, step in (("row", names[0], (1, 0)), ("column", names[1], (0, 1))):
        if len(every) < 2 or (kind == "row" and rack.row_rise):
            continue
        first, second = (complex(*poses[position_name(*at)].as_list[:2]) for at in ((0, 0), step))
        along = ((second - first) * reach.conjugate()).real / (abs(second - first) * abs(reach))
        if abs(along) > math.sin(BESIDE):
            before, *behind = every if along > 0.0 else every[::-1]
            texts.append(
                f"the {kind}s of '{place.name}' stand at one height, and the tool reaches from the side: with vessels "
                f"everywhere only {kind} {before} can be used, since the tool would pass through the vessels before "
                f"{', '.join(behind)}. Put vessels into one {kind} at a time"
                + (
                    ", or let the rows rise as on stairs, each by a vessel's height (row_rise)"
                    if kind == "row"
                    else ", or turn the rack so that the tool reaches along its rows, with 'row_rise'"
                )
            )
    return "; ".join(texts)


def _differ(first_pose: Pose, other: Pose) -> bool:
    """Whether two poses differ by more than 0.1 mm or 0.1 mrad. Near half a turn, a controller shows either of two
    opposite rotation vectors for the same pose."""
    apart = math.dist(first_pose.as_list[:3], other.as_list[:3])
    return apart > 1e-4 or _angle_between(first_pose, other) > 1e-4


def _angle_between(pose: Pose, other: Pose) -> float:
    """Angle of the rotation from one orientation to another [rad], 0 … π."""
    first, second = (_quaternion(each) for each in (pose, other))
    chord = min(math.dist(first, second), math.dist(first, tuple(-component for component in second)))
    return 4.0 * math.asin(min(0.5 * chord, 1.0))


def _quaternion(pose: Pose) -> tuple[float, ...]:
    angle = math.hypot(*(vector := pose.as_list[3:]))
    share = math.sin(0.5 * angle) / angle if angle > 0.0 else 0.0
    return (math.cos(0.5 * angle), *(share * component for component in vector))


class PlaceRecord(Protocol):
    """What stands where, kept on disk before anything moves."""

    def stands(self) -> dict[str, str | None]:
        """The place of every vessel that was entered: its name, or `OUTSIDE`; None if it is UNKNOWN."""
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

    def unknown(self, vessel: str) -> bool:
        """Whether the content of a vessel was entered, and is unknown now."""
        ...

    def composition(self, vessel: str) -> dict[str, tuple[float | None, float]]:
        """Liquids in a vessel by name, mass and deviation [kg]; '' is the empty vessel itself. A mass of None is
        UNKNOWN."""
        ...

    def add_component(self, vessel: str, liquid: str, mass: float | None, deviation: float, source: str = "") -> None:
        """Enter a liquid that is poured into a vessel [kg], or begins to be (None); '': the vessel is empty, and weighs
        this itself."""
        ...
