"""Commissioning checks of a UR controller for `decant robot check`: one line for each fact, with its remedy.

- The checks named `…_check` compare the laboratory's file with the controller: tool, mount, payload, home, limits.
- `judge` makes all lines from the values that `actors.arm.ur.controller_readout` has read; `readiness` makes one.
- `UrDiagnostics` is the `ArmDiagnostics` of UR arms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from actors.arm.arm_settings import ArmDiagnostics, SafetyRecord
from actors.arm.ur import primary_interface as primary
from actors.arm.ur.controller_readout import (
    PORTS,
    SCRIPTS,
    SLIDER,
    Exchange,
    Findings,
    ReadoutError,
    look_at,
    read_status,
    recorded_findings,
)
from actors.arm.ur.primary_interface import RobotState
from actors.arm.ur.robot_comparison import payload_check, robot_checks
from actors.arm.ur.robot_models import same_robot
from actors.arm.ur.worker_messages import SAFETY_MODES, safety_mode, why_not_ready
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import JOINT_NAMES, Pose
from actors.interfaces import DeviceCheck, State

TOOL_TOLERANCE, TURN_TOLERANCE = 1e-3, math.radians(0.5)
"""Largest difference between the controller's TCP and the file's [m], [rad]."""

MOUNT_TOLERANCE, GRAVITY = math.radians(15.0), 9.81
"""Largest angle between the measured and the configured vertical [rad], because the tool's accelerometer is not a
level. Gravity [m/s²].
"""

HOME_TOLERANCE = math.radians(1.0)


def tool_check(spec: UrArmSettings, state: RobotState) -> DeviceCheck:
    """Compare the controller's TCP with the file's."""
    pose = Pose.of(*state.tool)
    away, turned = distance(spec.tool, pose), turn(spec.tool, pose)
    if away <= TOOL_TOLERANCE and turned <= TURN_TOLERANCE:
        return DeviceCheck("tool", "ok", f"TCP {_point(pose)}")
    return DeviceCheck(
        "tool",
        "fail",
        f"TCP on the controller {_point(pose)}, in the file {_point(spec.tool)}: {1e3 * away:.1f} mm and "
        f"{math.degrees(turned):.1f} deg apart",
        "set the TCP in the installation on the teach pendant, or correct 'tool' in the file: they have to agree",
    )


def mount_check(spec: UrArmSettings, state: RobotState, exchange: Exchange) -> DeviceCheck:
    """Compare the vertical that the tool's accelerometer measures with the file's mount."""
    from scipy.spatial.transform import Rotation

    felt = exchange.acceleration
    strength = math.hypot(*felt) if felt is not None else 0.0
    if felt is None or not state.pose or not 0.5 * GRAVITY < strength < 1.5 * GRAVITY:
        return DeviceCheck(
            "mount",
            "warn",
            "the tool does not report which way is up",
            "compare 'mount' with the teach pendant yourself",
        )
    up = Rotation.from_rotvec(state.pose[3:]).apply([a / strength for a in felt])
    away = math.acos(max(-1.0, min(1.0, sum(a * b for a, b in zip(up, spec.mount.up, strict=True)))))
    tilt = math.degrees(math.acos(max(-1.0, min(1.0, float(up[2])))))
    if away <= MOUNT_TOLERANCE:
        return DeviceCheck("mount", "ok", f"tilted by {tilt:.0f} deg, as the file says")
    turn = math.degrees(math.atan2(float(up[0]), float(up[1])))
    return DeviceCheck(
        "mount",
        "fail",
        f"the tool measures up {math.degrees(away):.0f} deg away from where the file has it: tilt {tilt:.0f} deg, turn "
        f"{turn:.0f} deg would agree with it",
        "correct 'mount' in the file and the mounting in the installation on the teach pendant: pours would miss",
    )


def home_check(spec: UrArmSettings, state: RobotState) -> DeviceCheck:
    """Check whether the arm stands at its home pose."""
    away = [abs(a - b) for a, b in zip(state.joints, spec.home.angles, strict=True)]
    worst = max(range(6), key=away.__getitem__)
    if away[worst] <= HOME_TOLERANCE:
        return DeviceCheck("position", "ok", "at home")
    return DeviceCheck(
        "position",
        "warn",
        f"not at home: {JOINT_NAMES[worst]} is {math.degrees(away[worst]):.1f} deg away",
        "bring it home slowly with 'decant robot jog', watching it, before a pour",
    )


def distance(a: Pose, b: Pose) -> float:
    """Distance between two frames' origins [m]."""
    return math.dist((a.x, a.y, a.z), (b.x, b.y, b.z))


def turn(a: Pose, b: Pose) -> float:
    """Angle between two frames' orientations [rad]."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_rotvec([a.rx, a.ry, a.rz]).inv() * Rotation.from_rotvec([b.rx, b.ry, b.rz])
    return float(turned.magnitude())


def _point(pose: Pose) -> str:
    return f"({1e3 * pose.x:.1f}, {1e3 * pose.y:.1f}, {1e3 * pose.z:.1f}) mm"


ANSWERS = "is this a UR controller? If it is, and has booted, it hangs: restart it"

GOOD_ROUND_TRIP, GOOD_GAP, LONGEST_GAP = 10e-3, 60e-3, 0.2
"""Limits of RTDE's timing [s]. Above them the check warns; above `LONGEST_GAP` pours should not be attempted."""

KNOWN_SOFTWARE: dict[int, tuple[int, int]] = {3: (14, 15), 5: (6, 17)}
"""Minor versions, by major version, with which the authors of the client library have tested it."""

POLYSCOPE_X, FIRST_X = 10, 14
"""Major version of PolyScope X, and the first minor one whose Robot API reports model and serial number."""


@dataclass(frozen=True)
class UrDiagnostics(ArmDiagnostics):
    """Diagnostics of a UR controller.

    Attributes:
        spec: settings of the laboratory's file.
        found: values of the controller.
    """

    spec: UrArmSettings | None = None
    found: Findings | None = None

    @classmethod
    def at(cls, spec: UrArmSettings) -> UrDiagnostics:
        """Read everything from the controller."""
        return cls._of(spec, look_at(spec.address))

    def recorded(self) -> dict[str, Any]:
        """See `ArmDiagnostics.recorded`."""
        return {} if self.found is None else recorded_findings(self.found)

    @classmethod
    def _of(cls, spec: UrArmSettings, findings: Findings) -> UrDiagnostics:
        return cls(
            checksum="" if findings.state is None else findings.state.checksum,
            serial=findings.serial,
            model=findings.model,
            software=".".join(str(number) for number in findings.software[:3]),
            spec=spec,
            found=findings,
        )

    def checks(self, record: SafetyRecord | None, *, accept: str, virtual: bool) -> list[DeviceCheck]:
        """See `ArmDiagnostics.checks`."""
        assert self.spec is not None
        assert self.found is not None
        return judge(self.spec, self.found, record, accept=accept, virtual=virtual)

    def at_home(self) -> DeviceCheck:
        """See `ArmDiagnostics.at_home`."""
        assert self.spec is not None
        assert self.found is not None
        if self.found.state is None:
            raise ReadoutError("; ".join(self.found.problems) or f"{self.spec.address} reports nothing")
        return home_check(self.spec, self.found.state)


def judge(
    spec: UrArmSettings, findings: Findings, record: SafetyRecord | None, *, accept: str, virtual: bool = False
) -> list[DeviceCheck]:
    """One line for each fact that was read.

    Args:
        spec: settings of the laboratory's file.
        findings: values of the controller.
        record: the accepted safety settings; None if there are none.
        accept: the command that accepts them.
        virtual: whether the arm is virtual: it needs no acceptance, and no fast connection.
    """
    checks = _connection(spec, findings)
    if findings.software:
        checks.append(_software(findings))
    if findings.dashboard is not None:
        checks += _dashboard(spec, findings, findings.dashboard)
    name = (findings.dashboard or {}).get("get robot model", "")
    if findings.state is not None and findings.software and name:
        rests = findings.exchange is not None and findings.exchange.rests
        checks += robot_checks(spec, name, findings.software, findings.state, rests=rests)
    if findings.state is not None:
        checks += [
            _checksum(findings, record, accept, virtual=virtual),
            tool_check(spec, findings.state),
            home_check(spec, findings.state),
        ]
    if (
        findings.state is not None
        and spec.calibration_file is not None
        and findings.state.calibration != spec.calibration
    ):
        checks.append(
            DeviceCheck(
                "stored calibration",
                "warn",
                f"{spec.calibration_file} records another calibration than this robot has",
                "record it again: decant robot check --record; pours are planned with the robot's own in any case",
            )
        )
    if findings.state is not None and findings.exchange is not None:
        checks.append(mount_check(spec, findings.state, findings.exchange))
    if findings.exchange is not None:
        exchange = findings.exchange
        payload = payload_check(spec, exchange.payload, exchange.payload_centre)
        checks += [payload, _unless_blocked(_motion(exchange), checks), _network(exchange, virtual=virtual)]
    return checks


def readiness(spec: UrArmSettings) -> DeviceCheck:
    """Read whether a motion could begin now, with the remedy if it could not.

    The text is that of `why_not_ready`, as in a run. The reading changes nothing and does not upload a program.
    """
    status = read_status(spec.address)
    unreached = [check for check in _connection(spec, status) if check.state == "fail"]
    if unreached or status.exchange is None:
        return replace(unreached[0], name="motion") if unreached else DeviceCheck("motion", "warn", "not reported")
    motion = _motion(status.exchange)
    states = {check.name: check for check in _dashboard(spec, status, status.dashboard or {})}
    if motion.state == "fail":
        remedies = (states[name].advice for name in ("safety", "arm", "program"))
        return replace(motion, advice=next(filter(None, remedies), "set the slider on the teach pendant"))
    remote = states["remote control"]
    if remote.state == "fail":
        return replace(remote, name="motion", found=f"remote control is {remote.found}")
    if not same_robot(status.model, spec.model):
        text = f"the controller says {status.model or 'nothing'}, the file {spec.model}"
        return DeviceCheck("motion", "fail", text, "correct 'model' or 'address' in the file")
    return motion


def _connection(spec: UrArmSettings, findings: Findings) -> list[DeviceCheck]:
    """Whether the controller could be reached and read."""
    if not findings.address:
        return [
            DeviceCheck(
                "address",
                "fail",
                f"'{spec.address}' is the name of no machine: {findings.problems[0]}",
                "write the controller's IP address into the file (teach pendant: Settings, System, Network)",
            )
        ]
    checks = [DeviceCheck("address", "ok", findings.address), *_ports(findings)]
    return checks + [DeviceCheck("answers", "fail", text, ANSWERS) for text in findings.problems]


def _ports(findings: Findings) -> list[DeviceCheck]:
    reasons = set(findings.ports.values())
    if None not in reasons:
        everything = "all ports that Decant uses are closed" if reasons == {"refused"} else "no port answers"
        advice = (
            "the machine is there, but refuses connections: on PolyScope 5.10 or later look at Settings, Security, "
            "both at Services and at the inbound access of this computer's network; while booting, wait"
            if reasons == {"refused"}
            else "is it switched on, its cable plugged in, this computer in the same network, no firewall between?"
        )
        return [
            DeviceCheck(
                "network", "fail", f"{everything} at {findings.address} ({', '.join(map(str, reasons))})", advice
            )
        ]
    checks = []
    for port, reason in findings.ports.items():
        name = PORTS[port]
        advice = (
            f"on PolyScope 5.10 or later enable the service '{name}' under Settings, Security, Services; else look for "
            "a firewall between"
        )
        state: State = "ok" if reason is None else "warn" if port == SCRIPTS else "fail"
        if port == SCRIPTS:
            advice = "programs go to the primary interface; other tools may want this one"
        checks.append(
            DeviceCheck(f"port {port}", state, f"{name}: {reason or 'open'}", "" if reason is None else advice)
        )
    return checks


def _software(findings: Findings) -> DeviceCheck:
    version = ".".join(str(number) for number in findings.software[:3])
    major, minor = findings.software[:2]
    if major == POLYSCOPE_X and minor >= FIRST_X:
        return DeviceCheck(
            "software",
            "warn",
            f"PolyScope X {version}",
            "Decant's support of PolyScope X follows public documents and was tried on none; go slowly through the "
            "commissioning page",
        )
    if major not in KNOWN_SOFTWARE:
        return DeviceCheck(
            "software",
            "fail",
            f"PolyScope {version}",
            f"Decant needs PolyScope 3 (CB3), 5 (e-Series), or PolyScope X from {POLYSCOPE_X}.{FIRST_X}",
        )
    low, high = KNOWN_SOFTWARE[major]
    if low <= minor <= high:
        return DeviceCheck("software", "ok", f"PolyScope {version}")
    return DeviceCheck(
        "software",
        "warn",
        f"PolyScope {version}",
        f"the client library's makers test {major}.{low} to {major}.{high}; go slowly through the commissioning page",
    )


def _dashboard(spec: UrArmSettings, findings: Findings, responses: dict[str, str]) -> list[DeviceCheck]:
    checks = []
    remote = responses.get("is in remote control", "").lower()
    if findings.software and findings.software[0] < 5:
        checks.append(DeviceCheck("remote control", "ok", "a CB3 controller always takes programs"))
    elif remote == "true":
        checks.append(DeviceCheck("remote control", "ok", "on"))
    else:
        checks.append(
            DeviceCheck(
                "remote control",
                "fail",
                "off: the controller refuses programs",
                "switch from Local to Remote at the top right of the teach pendant (allow it first under Settings, "
                "System, Remote Control)",
            )
        )
    checks += [_robot_mode(_value(responses, "robotmode")), _safety_mode(_value(responses, "safetystatus"))]
    program = responses.get("programState", "").split(" ")[0]
    idle = program in ("STOPPED", "")
    advice = "" if idle else "stop it on the teach pendant, unless Decant runs there now"
    checks.append(DeviceCheck("program", "ok" if idle else "fail", f"{program.lower() or 'not reported'}", advice))
    return checks


def _value(responses: dict[str, str], question: str) -> str:
    return responses.get(question, "").partition(":")[2].strip()


def _robot_mode(mode: str) -> DeviceCheck:
    advice = {
        "RUNNING": "",
        "IDLE": "power is on and the brakes hold: press START (release the brakes) on the teach pendant",
        "POWER_OFF": "switch the arm on and release the brakes on the teach pendant",
        "BOOTING": "wait until it has booted",
        "CONFIRM_SAFETY": "look at the safety settings on the teach pendant and confirm them",
        "BACKDRIVE": "free drive is on: end it on the teach pendant",
    }.get(mode, "look at the teach pendant; the arm has to be in normal operation")
    return DeviceCheck(
        "arm", "ok" if mode == "RUNNING" else "fail", mode.lower().replace("_", " ") or "not reported", advice
    )


def _safety_mode(word: str) -> DeviceCheck:
    mode = next((mode for mode in SAFETY_MODES.values() if mode.word == word), safety_mode(0))
    state: State = "ok" if word == "NORMAL" else "fail"
    return DeviceCheck("safety", state, word.lower().replace("_", " ") or "not reported", mode.advice)


def _checksum(findings: Findings, record: SafetyRecord | None, accept: str, *, virtual: bool) -> DeviceCheck:
    assert findings.state is not None
    checksum = findings.state.checksum
    if not checksum:
        return DeviceCheck(
            "safety checksum",
            "fail",
            "the controller reports none",
            "no safety configuration is applied: set and confirm one on the teach pendant",
        )
    if virtual:
        return DeviceCheck("safety checksum", "ok", f"{checksum}; of a virtual controller, which needs no acceptance")
    if record is None:
        return DeviceCheck(
            "safety checksum",
            "fail",
            f"{checksum}, not accepted yet",
            f"compare it with the teach pendant, read the safety settings there, then: {accept}",
        )
    if record.serial != findings.serial:
        return DeviceCheck(
            "safety checksum",
            "fail",
            f"{record.checksum} was accepted for robot {record.serial}, this is {findings.serial or 'unknown'}",
            f"is this the right controller? If so, read its safety settings, then: {accept}",
        )
    if record.checksum.upper() != checksum:
        return DeviceCheck(
            "safety checksum",
            "fail",
            f"{checksum}, but {record.checksum.upper()} was accepted on {record.date} by {record.accepted_by}",
            f"find out who changed what on the teach pendant; when the settings are right: {accept}",
        )
    return DeviceCheck("safety checksum", "ok", f"{checksum}, accepted on {record.date} by {record.accepted_by}")


BLOCKING = ("answers", f"port {primary.PORT}", "software", "remote control", "arm", "safety", "program", "model")
"""Checks without which the controller accepts no program, or the driver sends none. Safety settings that nobody has
accepted prevent motions, too, but are a property of the laboratory and not of the arm's state."""


def _unless_blocked(motion: DeviceCheck, checks: Sequence[DeviceCheck]) -> DeviceCheck:
    """The check of the motion, which RTDE's values alone do not decide: they say nothing about remote control."""
    blocking = next((check for check in checks if check.state == "fail" and check.name in BLOCKING), None)
    if motion.state == "fail" or blocking is None:
        return motion
    advice = blocking.advice or f"solve '{blocking.name}' first"
    return DeviceCheck("motion", "fail", f"nothing would move: {blocking.name}: {blocking.found}", advice)


def _motion(exchange: Exchange) -> DeviceCheck:
    """Whether a motion could begin now, by the driver's own decision."""
    values = [exchange.values.get(name) for name in ("robot_mode", "safety_mode", "runtime_state", SLIDER)]
    if any(value is None for value in values):
        return DeviceCheck("motion", "warn", "not reported", "look at the teach pendant whether the arm is ready")
    robot, safety, runtime, slider = (value[0] for value in values if value is not None)
    (status,) = exchange.values.get("robot_status_bits", (0,))
    why = why_not_ready(int(robot), int(safety), int(runtime), slider, int(status))
    if not why:
        return DeviceCheck("motion", "ok", "the arm is ready to move")
    return DeviceCheck("motion", "fail", why, "fix that first: no motion begins before")


def _network(exchange: Exchange, *, virtual: bool) -> DeviceCheck:
    text = (
        f"{1e3 * exchange.round_trip:.1f} ms there and back (slowest {1e3 * exchange.slowest:.1f} ms), "
        f"{exchange.rate:.0f} of {exchange.wanted:.0f} packages a second, longest gap {1e3 * exchange.gap:.0f} ms"
    )
    poor = exchange.gap >= LONGEST_GAP or exchange.rate < 0.8 * exchange.wanted
    if poor and virtual:
        return DeviceCheck("connection", "warn", text, "this computer is busy; a virtual bench waits for it")
    if poor:
        return DeviceCheck(
            "connection", "fail", text, "connect by cable, without wireless or VPN; is this computer overloaded?"
        )
    if exchange.gap >= GOOD_GAP or exchange.round_trip >= GOOD_ROUND_TRIP:
        return DeviceCheck("connection", "warn", text, "a cable straight to the controller would be better")
    return DeviceCheck("connection", "ok", text)
