"""What `decant doctor` makes of what a controller says: pure, one line for each thing, with what to do about it."""

from __future__ import annotations

from dataclasses import dataclass

from actors.arm.look import ArmLook, SafetyRecord
from actors.arm.spec import UrArmSpec
from actors.arm.ur.judge_settings import home_check, limit_checks, mount_check, payload_check, tool_check
from actors.arm.ur.look import Findings, look_at
from actors.arm.ur.messages import why_not_ready
from actors.arm.ur.survey import PORTS, SCRIPTS, SLIDER, Exchange, SurveyError
from actors.checks import Check, State

ANSWERS = "is this a UR controller? If it is, and has booted, it hangs: restart it"

GOOD_ROUND_TRIP, GOOD_GAP, LONGEST_GAP = 10e-3, 60e-3, 0.2
"""Limits of RTDE's timing [s]: from there a warning; from `LONGEST_GAP` no pour should be tried."""

KNOWN_SOFTWARE: dict[int, tuple[int, int]] = {3: (14, 15), 5: (6, 17)}
"""Minor versions, by major one, that the client library is tested with by its makers."""


@dataclass(frozen=True)
class UrLook(ArmLook):
    """A UR controller that was looked at.

    Attributes:
        spec: what the laboratory's file says.
        found: what the controller says.
    """

    spec: UrArmSpec | None = None
    found: Findings | None = None

    @classmethod
    def at(cls, spec: UrArmSpec) -> UrLook:
        """Ask the controller everything."""
        found = look_at(spec.address)
        return cls(
            checksum="" if found.state is None else found.state.checksum,
            serial=found.serial,
            model=found.model,
            software=".".join(str(part) for part in found.software[:3]),
            spec=spec,
            found=found,
        )

    def checks(self, record: SafetyRecord | None, *, accept: str, virtual: bool) -> list[Check]:
        """See `ArmLook.checks`."""
        assert self.spec is not None
        assert self.found is not None
        return judge(self.spec, self.found, record, accept=accept, virtual=virtual)

    def at_home(self) -> Check:
        """See `ArmLook.at_home`."""
        assert self.spec is not None
        assert self.found is not None
        if self.found.state is None:
            raise SurveyError("; ".join(self.found.problems) or f"the controller at {self.spec.address} tells nothing")
        return home_check(self.spec, self.found.state)


def judge(
    spec: UrArmSpec, found: Findings, record: SafetyRecord | None, *, accept: str, virtual: bool = False
) -> list[Check]:
    """One line for everything that was found.

    Args:
        spec: what the file says.
        found: what the controller says.
        record: the safety settings that were accepted; None if none were.
        accept: the command that accepts them.
        virtual: nobody has to.
    """
    if not found.address:
        return [
            Check(
                "address",
                "fail",
                f"'{spec.address}' stands for no machine: {found.problems[0]}",
                "write the controller's IP address into the file (teach pendant: Settings, System, Network)",
            )
        ]
    checks = [Check("address", "ok", found.address), *_ports(found)]
    checks += [Check("answers", "fail", text, ANSWERS) for text in found.problems]
    if found.software:
        checks.append(_software(found))
    if found.dashboard is not None:
        checks += _dashboard(spec, found, found.dashboard)
    if found.state is not None:
        checks += [
            _checksum(found, record, accept, virtual=virtual),
            tool_check(spec, found.state),
            home_check(spec, found.state),
        ]
        checks += limit_checks(spec, found.state)
    if found.state is not None and found.exchange is not None:
        checks.append(mount_check(spec, found.state, found.exchange))
    if found.exchange is not None:
        checks += [payload_check(spec, found.exchange), *_motion(found.exchange), _network(found.exchange)]
    return checks


def _ports(found: Findings) -> list[Check]:
    reasons = set(found.ports.values())
    if None not in reasons:
        everything = "all ports that Decant uses are closed" if reasons == {"refused"} else "no port answers"
        advice = (
            "the machine is there, but lets nobody in: on PolyScope 5.10 or later look at Settings, Security, both at "
            "Services and at the inbound access of this computer's network; while booting, wait"
            if reasons == {"refused"}
            else "is it switched on, its cable plugged in, this computer in the same network, no firewall between?"
        )
        return [Check("network", "fail", f"{everything} at {found.address} ({', '.join(map(str, reasons))})", advice)]
    checks = []
    for port, name in PORTS.items():
        reason = found.ports[port]
        advice = (
            f"on PolyScope 5.10 or later enable the service '{name}' under Settings, Security, Services; else look for "
            "a firewall between"
        )
        state: State = "ok" if reason is None else "warn" if port == SCRIPTS else "fail"
        if port == SCRIPTS:
            advice = "programs go to the primary interface; other tools may want this one"
        checks.append(Check(f"port {port}", state, f"{name}: {reason or 'open'}", "" if reason is None else advice))
    return checks


def _software(found: Findings) -> Check:
    version = ".".join(str(part) for part in found.software[:3])
    major, minor = found.software[:2]
    if major not in KNOWN_SOFTWARE:
        return Check(
            "software",
            "fail",
            f"PolyScope {version}",
            "Decant needs PolyScope 3 (CB3) or 5 (e-Series); PolyScope X has no dashboard server",
        )
    low, high = KNOWN_SOFTWARE[major]
    if low <= minor <= high:
        return Check("software", "ok", f"PolyScope {version}")
    return Check(
        "software",
        "warn",
        f"PolyScope {version}",
        f"the client library's makers test {major}.{low} to {major}.{high}; go slowly through the commissioning page",
    )


def _dashboard(spec: UrArmSpec, found: Findings, said: dict[str, str]) -> list[Check]:
    checks = [
        Check("model", "ok", f"{found.model.upper()}, serial number {found.serial}")
        if found.model == spec.model
        else Check(
            "model",
            "fail",
            f"the controller says {found.model or said.get('get robot model', 'nothing')}, the file {spec.model}",
            "is this the right controller? Lengths and limits differ between models: correct 'model' or 'address'",
        )
    ]
    remote = said.get("is in remote control", "").lower()
    if found.software and found.software[0] < 5:
        checks.append(Check("remote control", "ok", "a CB3 controller always takes programs"))
    elif remote == "true":
        checks.append(Check("remote control", "ok", "on"))
    else:
        checks.append(
            Check(
                "remote control",
                "fail",
                "off: the controller refuses programs",
                "switch from Local to Remote at the top right of the teach pendant (allow it first under Settings, "
                "System, Remote Control)",
            )
        )
    checks += [_robot_mode(_value(said, "robotmode")), _safety_mode(_value(said, "safetystatus"))]
    program = said.get("programState", "").split(" ")[0]
    idle = program in ("STOPPED", "")
    advice = "" if idle else "stop it on the teach pendant, unless Decant runs there now"
    checks.append(Check("program", "ok" if idle else "fail", f"{program.lower() or 'not told'}", advice))
    return checks


def _value(said: dict[str, str], question: str) -> str:
    return said.get(question, "").partition(":")[2].strip()


def _robot_mode(mode: str) -> Check:
    advice = {
        "RUNNING": "",
        "IDLE": "power is on and the brakes hold: press START (release the brakes) on the teach pendant",
        "POWER_OFF": "switch the arm on and release the brakes on the teach pendant",
        "BOOTING": "wait until it has booted",
        "CONFIRM_SAFETY": "somebody has to look at the safety settings on the teach pendant and confirm them",
        "BACKDRIVE": "free drive is on: end it on the teach pendant",
    }.get(mode, "look at the teach pendant; the arm has to be in normal operation")
    return Check("arm", "ok" if mode == "RUNNING" else "fail", mode.lower().replace("_", " ") or "not told", advice)


def _safety_mode(mode: str) -> Check:
    advice = {
        "NORMAL": "",
        "REDUCED": "pours are planned within the normal limits: end the reduced mode, at the pendant or its input",
        "PROTECTIVE_STOP": "find the cause, then unlock it on the teach pendant; Decant never does so by itself",
        "RECOVERY": "the arm is outside its limits: bring it back by hand in the recovery mode of the teach pendant",
        "SAFEGUARD_STOP": "a door, mat or light curtain holds it: close it",
        "SYSTEM_EMERGENCY_STOP": "release the emergency stop, once you know why it was pressed",
        "ROBOT_EMERGENCY_STOP": "release the emergency stop, once you know why it was pressed",
    }.get(mode, "look at the teach pendant; a fault of the safety system needs a restart, or the maker's service")
    state: State = "ok" if mode == "NORMAL" else "fail"
    return Check("safety", state, mode.lower().replace("_", " ") or "not told", advice)


def _checksum(found: Findings, record: SafetyRecord | None, accept: str, *, virtual: bool) -> Check:
    assert found.state is not None
    checksum = found.state.checksum
    if not checksum:
        return Check(
            "safety checksum",
            "fail",
            "the controller tells none",
            "no safety configuration is applied: set and confirm one on the teach pendant",
        )
    if virtual:
        return Check("safety checksum", "ok", f"{checksum}; of a virtual controller, nobody has to accept it")
    if record is None:
        return Check(
            "safety checksum",
            "fail",
            f"{checksum}, accepted by nobody",
            f"compare it with the teach pendant, read the safety settings there, then: {accept}",
        )
    if record.serial != found.serial:
        return Check(
            "safety checksum",
            "fail",
            f"{record.checksum} was accepted for robot {record.serial}, this is {found.serial or 'unknown'}",
            f"is this the right controller? If so, read its safety settings, then: {accept}",
        )
    if record.checksum.upper() != checksum:
        return Check(
            "safety checksum",
            "fail",
            f"{checksum}, but {record.checksum.upper()} was accepted on {record.date} by {record.accepted_by}",
            f"find out who changed what on the teach pendant; when the settings are right: {accept}",
        )
    return Check("safety checksum", "ok", f"{checksum}, accepted on {record.date} by {record.accepted_by}")


def _motion(exchange: Exchange) -> list[Check]:
    """Whether a motion could begin now: the decision of the driver itself."""
    values = [exchange.values.get(name) for name in ("robot_mode", "safety_mode", "runtime_state", SLIDER)]
    if any(value is None for value in values):
        return [Check("motion", "warn", "not told", "look at the teach pendant whether the arm is ready")]
    robot, safety, runtime, slider = (value[0] for value in values if value is not None)
    why = why_not_ready(int(robot), int(safety), int(runtime), slider)
    if not why:
        return [Check("motion", "ok", "the arm is ready to move")]
    return [Check("motion", "fail", why, "mend that first: no motion begins before")]


def _network(exchange: Exchange) -> Check:
    text = (
        f"{1e3 * exchange.round_trip:.1f} ms there and back (slowest {1e3 * exchange.slowest:.1f} ms), "
        f"{exchange.rate:.0f} of {exchange.wanted:.0f} packages a second, longest gap {1e3 * exchange.gap:.0f} ms"
    )
    if exchange.gap >= LONGEST_GAP or exchange.rate < 0.8 * exchange.wanted:
        return Check(
            "connection", "fail", text, "connect by cable, without wireless or VPN; is this computer overloaded?"
        )
    if exchange.gap >= GOOD_GAP or exchange.round_trip >= GOOD_ROUND_TRIP:
        return Check("connection", "warn", text, "a cable straight to the controller would be better")
    return Check("connection", "ok", text)
