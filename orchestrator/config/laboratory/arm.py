"""A laboratory's arm and its cell: from what is written in its file to what planner and driver need, and back."""

from __future__ import annotations

import ipaddress
import math
import re

from actors.arm.geometry import ArmLimits, Cell, Mount, Plane, Pose, Vector
from actors.arm.path.kinematics import MODELS
from actors.arm.spec import UrArmSpec
from orchestrator.config.laboratory.arm_sections import JOINTS, LimitsSection, PlaneSection, UrArmSection
from orchestrator.config.laboratory.cell import CellSection, PointSection
from orchestrator.config.yaml.source import Place, Report

_LABEL = r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
_HOST = re.compile(rf"(?=.{{1,253}}\Z){_LABEL}(\.{_LABEL})*\.?")


def resolve_arm(
    arm: UrArmSection, cell: CellSection | None, place: Place, report: Report, *, mode: str
) -> UrArmSpec | None:
    """The arm of a laboratory's file; what is wrong goes to the report, and then there is none.

    Args:
        arm: as written under `arm`.
        cell: as written under `cell`; None where there is no such key, which is a problem.
        place: of the mapping in which both keys stand.
        report: takes problems.
        mode: of the laboratory, 'virtual' or 'hardware'.
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
        return None  # reported already, as missing or as wrong
    assert arm.model is not None
    assert arm.tool is not None
    assert arm.payload is not None
    assert arm.grip is not None
    assert limits is not None
    assert receiver is not None
    spec = UrArmSpec(
        model=arm.model,
        limits=limits,
        cell=Cell(receiver=receiver, direction=cell.direction, table=cell.table),
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
    from actors.arm.path.limits import check_limits  # brings scipy along

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
    if re.fullmatch(r"[\d.]+", text):  # all digits and dots can only be meant as an address
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
    # a normal that was normalised once stays as it is to the last bit, so that a written-out file means the same
    length = 1.0 if abs(length - 1.0) < 1e-12 else length
    x, y, z = section.normal
    return Plane((x / length, y / length, z / length), section.offset)


def _point(section: PointSection | None) -> Vector | None:
    if section is None or section.x is None or section.y is None or section.z is None:
        return None
    return (section.x, section.y, section.z)
