"""File sections `arm` and `cell` of a laboratory, and their conversion to the settings of planner and driver.

- `CellSection`: receiver, pouring direction and table around an arm of any kind.
- `ArmSettings`: base class of all kinds of arms; `ARMS` is the registry of installed kinds.
- `UrArmSection`: a UR robot; `resolve_arm` checks it and converts it.
- `NumbersArmSection`: a simulated arm without protocol, for example to test a real balance without a robot.

Units are those of the teach pendant: mm, deg, kg; rotation vectors in rad.
"""

from __future__ import annotations

import ipaddress
import math
import re
from abc import abstractmethod
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from actors.arm.arm_geometry import ArmLimits, Mount, Plane, Pose, RobotCell, Vector
from actors.arm.arm_settings import UrArmSpec
from actors.arm.planning.kinematics import MODELS
from actors.arm.simulated_arm import NumbersSpec
from orchestrator.config.yaml.yaml_source import Place, Report
from sim_engine.settings.model import Number, Settings, Text
from sim_engine.settings.plugin_registry import PluginRegistry
from sim_engine.settings.quantity import Quantity

if TYPE_CHECKING:
    from actors.arm.arm_settings import ArmSpec

Length = Annotated[float, Quantity("m", "100 mm", -3.0, 3.0)]
Angle = Annotated[float, Quantity("rad", "90 deg", -math.radians(363.0), math.radians(363.0))]


class PointSection(Settings):
    """A point in the gravity-aligned base frame. For an arm on a table, this is the base frame of the teach pendant."""

    required: ClassVar[dict[str, str]] = {"x": "650 mm", "y": "0 mm", "z": "80 mm"}

    x: Length | None = None
    """The x in the base frame."""

    y: Length | None = None
    """The y in the base frame."""

    z: Length | None = None
    """Height above the robot's mounting point."""


class CellSection(Settings):
    """Objects around the arm."""

    required: ClassVar[dict[str, str]] = {
        "receiver": "{x: 650 mm, y: 0 mm, z: 80 mm}",
        "direction": "90 deg",
    }

    receiver: PointSection | None = None
    """Position of the middle of the receiver's underside, in the gravity-aligned base frame."""

    direction: Angle | None = None
    """Pouring direction seen from above: 0 along the x axis of the base frame, 90 deg along its y axis."""

    table: Length = 0.0
    """Height of the surface below which nothing may move, in the gravity-aligned base frame."""


class ArmSettings(Settings):
    """Base class of the section `arm`. The field `kind` of a subclass has the name under which it is registered."""

    tag: ClassVar[str] = "kind"
    default_tag: ClassVar[str] = "ur"

    @classmethod
    def unknown_tag(cls, word: str) -> str:
        """The plug-in that provides this kind, if it could not be loaded."""
        return next((str(broken) for broken in ARMS.broken if broken.name == word), "")

    @abstractmethod
    def resolve(self, cell: CellSection | None, place: Place, report: Report, *, mode: str) -> ArmSpec | None:
        """The arm's settings; None after a problem, which is added to the report.

        Args:
            cell: the section `cell`; None if it is missing.
            place: place of the mapping that contains `arm` and `cell`.
            report: receives problems.
            mode: mode of the laboratory, 'virtual' or 'hardware'.
        """


def _arm(loaded: object, name: str) -> type[ArmSettings]:
    if not (isinstance(loaded, type) and issubclass(loaded, ArmSettings)):
        raise TypeError("should be a class derived from decant.plugins.ArmSettings")
    kind = loaded.model_fields.get("kind")
    if kind is None or kind.default != name:
        raise TypeError(f"its field 'kind' should be Literal['{name}'] = '{name}', as it is registered")
    return loaded


ARMS: PluginRegistry[type[ArmSettings]] = PluginRegistry("decant.arms", "arm", _arm)
"""Settings classes of all installed kinds of arms."""


_LIMITS = ArmLimits((0.0,) * 3, (0.0,) * 3)
_ARM = UrArmSpec("ur10e", _LIMITS, RobotCell((0.0,) * 3), (0.0,) * 6)

JOINTS = ("base", "shoulder", "elbow", "wrist1", "wrist2", "wrist3")
"""Names of the joints on the teach pendant."""

Turn = Annotated[float, Quantity("rad", "1.571 rad", -2.0 * math.pi, 2.0 * math.pi)]
Speed = Annotated[float, Quantity("rad/s", "40 deg/s", 0.0, math.radians(360.0), positive=True)]
Acceleration = Annotated[float, Quantity("rad/s^2", "80 deg/s^2", 0.0, math.radians(2000.0), positive=True)]


class CentreSection(Settings):
    """A point in the flange's frame."""

    x: Length = 0.0
    """The x in the flange's frame."""

    y: Length = 0.0
    """The y in the flange's frame."""

    z: Length = 0.0
    """Distance outwards from the flange."""


class PoseSection(Settings):
    """Pose of a frame in another, as on the teach pendant: position and rotation vector."""

    x: Length = 0.0
    """The x of its origin."""

    y: Length = 0.0
    """The y of its origin."""

    z: Length = 0.0
    """The z of its origin."""

    rx: Turn = 0.0
    """The x of the rotation vector."""

    ry: Turn = 0.0
    """The y of the rotation vector."""

    rz: Turn = 0.0
    """The z of the rotation vector."""


class MountSection(Settings):
    """Mounting of the robot: rotation about its own z axis, then tilt about the x axis of the base frame."""

    tilt: Annotated[float, Quantity("rad", "90 deg", -math.pi, math.pi)] = 0.0
    """0 on a table, 90 deg on a wall, 180 deg on a ceiling."""

    turn: Annotated[float, Quantity("rad", "90 deg", -math.pi, math.pi)] = 0.0
    """Rotation about its own z axis."""


class JointsSection(Settings):
    """The six joints, as named and displayed on the teach pendant."""

    required: ClassVar[dict[str, str]] = dict.fromkeys(JOINTS, "90 deg")

    base: Angle | None = None
    """Joint 1."""

    shoulder: Angle | None = None
    """Joint 2."""

    elbow: Angle | None = None
    """Joint 3."""

    wrist1: Angle | None = None
    """Joint 4."""

    wrist2: Angle | None = None
    """Joint 5."""

    wrist3: Angle | None = None
    """Joint 6."""


class BoxSection(Settings):
    """A box along the axes of the gravity-aligned base frame."""

    required: ClassVar[dict[str, str]] = {
        "low": "{x: 300 mm, y: -500 mm, z: 0 mm}",
        "high": "{x: 1000 mm, y: 500 mm, z: 800 mm}",
    }

    low: PointSection | None = None
    """Corner with the smallest x, y and z."""

    high: PointSection | None = None
    """Corner with the largest x, y and z."""


class PlaneSection(Settings):
    """A plane that must not be crossed."""

    required: ClassVar[dict[str, str]] = {"normal": "[0, 1, 0]", "offset": "-400 mm"}

    normal: tuple[Number, Number, Number] | None = None
    """Direction towards the allowed side, in the gravity-aligned base frame; its length does not matter."""

    offset: Length | None = None
    """Distance of the plane from the base, along the normal."""


class LimitsSection(Settings):
    """Limits of the arm in this cell. Checked before a pour is planned, and again before any motion."""

    required: ClassVar[dict[str, str]] = {"box": "{low: {x: …, y: …, z: …}, high: {x: …, y: …, z: …}}"}

    box: BoxSection | None = None
    """Box that must contain tool and pourer."""

    planes: tuple[PlaneSection, ...] = ()
    """Planes that tool and pourer must not cross."""

    joint_speed: Speed = _LIMITS.joint_speed
    """Maximum speed of any joint; the robot's own limits apply as well."""

    tool_speed: Annotated[float, Quantity("m/s", "1000 mm/s", 0.0, 3.0, positive=True)] = _LIMITS.tool_speed
    """Maximum speed of the tool centre point and of any point of the pourer."""

    tilt: Annotated[float, Quantity("rad", "140 deg", 0.0, math.pi, positive=True)] = _LIMITS.tilt
    """Maximum tilt of the pourer."""

    tilt_speed: Speed = _LIMITS.tilt_speed
    """Maximum angular velocity of the pourer."""

    singularity: Annotated[float, Quantity("1", "0.1", 0.02, 0.9)] = _LIMITS.singularity
    """Minimum distance from singular poses: sine of wrist and elbow, shoulder over reach."""

    clearance: Annotated[float, Quantity("m", "5 mm", 0.0, 0.012)] = _LIMITS.clearance
    """Minimum distance between the pourer and the receiver."""


class UrArmSection(ArmSettings):
    """A UR arm that holds the pourer."""

    required: ClassVar[dict[str, str]] = {
        "model": "ur10e",
        "tool": "{z: 180 mm}",
        "payload": "1.5 kg",
        "grip": "{x: 60 mm, rx: 1.571 rad}",
        "home": "{base: 0 deg, shoulder: -90 deg, elbow: 90 deg, wrist1: 0 deg, wrist2: -90 deg, wrist3: 0 deg}",
        "limits": "{box: {low: {x: …, y: …, z: …}, high: {x: …, y: …, z: …}}}",
    }

    kind: Literal["ur"] = "ur"
    """A UR robot; the default kind."""

    model: Literal["ur10", "ur10e"] | None = None
    """Model of the robot."""

    address: Text | None = None
    """Network address of its controller; a virtual laboratory starts its own controller."""

    mount: MountSection = MountSection()
    """Mounting of the robot; on a table unless given."""

    tool: PoseSection | None = None
    """Tool centre point in the flange's frame, as set on the teach pendant."""

    payload: Annotated[float, Quantity("kg", "1.5 kg", 0.0, 12.5)] | None = None
    """Mass of gripper and filled pourer, as set on the teach pendant."""

    payload_centre: CentreSection = CentreSection()
    """Centre of gravity of gripper and pourer in the flange's frame."""

    grip: PoseSection | None = None
    """Pose of the pourer in the frame of the tool centre point: origin in the middle of its underside, z out of its opening, x towards the side where liquid leaves."""  # noqa: E501

    home: JointsSection | None = None
    """Waiting pose of the arm, with the pourer upright."""

    limits: LimitsSection | None = None
    """Limits of the arm in this cell."""

    approach_speed: Speed = _ARM.approach_speed
    """Speed of the fastest joint between home and pour."""

    approach_acceleration: Acceleration = _ARM.approach_acceleration
    """Acceleration of the fastest joint between home and pour."""

    untilt_speed: Speed = _ARM.untilt_speed
    """Speed at which a stopped, tilted pourer is brought upright."""

    announcement: Annotated[float, Quantity("s", "3 s", 0.0, 60.0)] = _ARM.announcement
    """Time from the operator's consent to the first movement."""

    rate: Annotated[float, Quantity("1/s", "125 Hz", 100.0, 500.0)] = _ARM.rate
    """Rate at which the joints are read back."""

    def resolve(self, cell: CellSection | None, place: Place, report: Report, *, mode: str) -> UrArmSpec | None:
        """See `ArmSettings.resolve`."""

        return resolve_arm(self, cell, place, report, mode=mode)


_LABEL = r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
_HOST = re.compile(rf"(?=.{{1,253}}\Z){_LABEL}(\.{_LABEL})*\.?")


def resolve_arm(
    arm: UrArmSection, cell: CellSection | None, place: Place, report: Report, *, mode: str
) -> UrArmSpec | None:
    """The arm of a laboratory's file; None after a problem, which is added to the report.

    Args:
        arm: the section `arm`.
        cell: the section `cell`; None if it is missing, which is a problem.
        place: place of the mapping that contains both keys.
        report: receives problems.
        mode: mode of the laboratory, 'virtual' or 'hardware'.
    """
    before = len(report.problems)
    at = place.at("arm")
    _check_address(arm, at, report, mode)
    if arm.model is not None and arm.rate > MODELS[arm.model].frequency:
        fastest = MODELS[arm.model].frequency
        report.add(at.at("rate"), f"a {arm.model} answers at most {fastest} times a second; write '{fastest} Hz'")
    if cell is None and not report.is_broken(place.at("cell")):
        report.add(at, "an arm needs to know what stands where; add 'cell: {receiver: …, direction: …}' beside it")
    home = None if arm.home is None else [arm.home.value(name) for name in JOINTS]
    limits = None if arm.limits is None else _limits(arm.limits, at.at("limits"), report)
    receiver = None if cell is None else _point(cell.receiver)
    needed = (arm.model, arm.tool, arm.payload, arm.grip, limits, receiver)
    if None in needed or home is None or None in home or cell is None or cell.direction is None:
        return None  # reported already, as missing or invalid
    assert arm.model is not None
    assert arm.tool is not None
    assert arm.payload is not None
    assert arm.grip is not None
    assert limits is not None
    assert receiver is not None
    spec = UrArmSpec(
        model=arm.model,
        limits=limits,
        cell=RobotCell(receiver=receiver, direction=cell.direction, table=cell.table),
        home=(home[0], home[1], home[2], home[3], home[4], home[5]),
        address=arm.address or "",
        mount=Mount(arm.mount.tilt, arm.mount.turn),
        tool=Pose(**arm.tool.model_dump()),
        payload=arm.payload,
        payload_centre=(arm.payload_centre.x, arm.payload_centre.y, arm.payload_centre.z),
        grip=Pose(**arm.grip.model_dump()),
        approach_speed=arm.approach_speed,
        approach_acceleration=arm.approach_acceleration,
        untilt_speed=arm.untilt_speed,
        announcement=arm.announcement,
        rate=arm.rate,
    )
    if len(report.problems) > before:
        return None
    from actors.arm.planning.path_checks import check_limits  # imports scipy

    for problem in check_limits(spec):
        key, _, text = problem.partition(": ")
        owner = place if key.startswith("cell.") else at
        report.add(owner.at(*key.split(".")), text)
    return spec if len(report.problems) == before else None


def _check_address(arm: UrArmSection, at: Place, report: Report, mode: str) -> None:
    if mode != "hardware":
        if arm.address is not None:
            report.add(at.at("address"), "a virtual arm has no address: remove it, or write 'mode: hardware'")
    elif arm.address is None:
        if not report.is_broken(at.at("address")):
            report.add(at, "an arm of hardware needs its controller's 'address', for example 'address: 192.168.0.10'")
    elif not _is_address(arm.address):
        report.add(
            at.at("address"),
            f"{arm.address!r} is neither an IPv4 address nor a host name; write for example '192.168.0.10', no port",
        )


def _is_address(text: str) -> bool:
    if re.fullmatch(r"[\d.]+", text):  # a text of digits and dots can only be meant as an address
        try:
            ipaddress.IPv4Address(text)
        except ValueError:
            return False
        return True
    return _HOST.fullmatch(text) is not None


def _limits(section: LimitsSection, place: Place, report: Report) -> ArmLimits | None:
    low = None if section.box is None else _point(section.box.low)
    high = None if section.box is None else _point(section.box.high)
    planes = [_plane(p, place.at("planes", i), report) for i, p in enumerate(section.planes)]
    if low is None or high is None or None in planes:
        return None
    return ArmLimits(
        box_low=low,
        box_high=high,
        planes=tuple(plane for plane in planes if plane is not None),
        joint_speed=section.joint_speed,
        tool_speed=section.tool_speed,
        tilt=section.tilt,
        tilt_speed=section.tilt_speed,
        singularity=section.singularity,
        clearance=section.clearance,
    )


def _plane(section: PlaneSection, place: Place, report: Report) -> Plane | None:
    if section.normal is None or section.offset is None:
        return None
    length = math.sqrt(sum(v * v for v in section.normal))
    if length < 1e-6:
        report.add(place.at("normal"), "has no direction; write for example [0, 1, 0]")
        return None
    # A normalised normal keeps its last bit, so that a written file gives the same arm.
    length = 1.0 if abs(length - 1.0) < 1e-12 else length
    x, y, z = section.normal
    return Plane((x / length, y / length, z / length), section.offset)


def _point(section: PointSection | None) -> Vector | None:
    if section is None or section.x is None or section.y is None or section.z is None:
        return None
    return (section.x, section.y, section.z)


class NumbersArmSection(ArmSettings):
    """A simulated arm without protocol: it makes every motion and has no geometry."""

    kind: Literal["numbers"] = "numbers"
    """A simulated arm without protocol."""

    def resolve(self, cell: CellSection | None, place: Place, report: Report, *, mode: str) -> NumbersSpec | None:
        """See `ArmSettings.resolve`."""
        before = len(report.problems)
        if mode == "hardware":
            report.add(place.at("arm"), "an arm of numbers moves nothing; write 'mode: virtual'")
        if cell is not None:
            report.add(place.at("cell"), "an arm of numbers stands nowhere; remove the section")
        return NumbersSpec() if len(report.problems) == before else None
