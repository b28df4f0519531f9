"""What the unmodified client library sees: each scenario runs in a process of its own and prints one line of JSON.

    python clients.py SCENARIO ADDRESS '{"argument": 1}'

Not a test; tests judge what is printed. Nothing of this project is imported.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

from dashboard_client import DashboardClient
from rtde_control import Path, PathEntry, RTDEControlInterface
from rtde_io import RTDEIOInterface
from rtde_receive import RTDEReceiveInterface

HOME = [0.0, -1.5707963, 1.5707963, -1.5707963, -1.5707963, 0.0]


_KEPT: list[Any] = []


def keep(interface: Any) -> Any:
    """Keep an interface until the process ends at once: its destructor would sleep for half a second."""
    _KEPT.append(interface)
    return interface


def until(condition: Callable[[], bool], seconds: float = 10.0) -> bool:
    """Wait for something; whether it came."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.005)
    return False


def attempt(call: Callable[[], Any]) -> Any:
    """A call's result, or its error as text."""
    try:
        return call()
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def dashboard(address: str) -> DashboardClient:
    client = keep(DashboardClient(address))
    client.connect()
    return client


def moves(address: str) -> dict[str, Any]:
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    seen: dict[str, Any] = {"home": control.moveJ(HOME, 2.0, 4.0)}
    first = receive.getTimestamp()
    target = [0.5, -1.4, 1.6, -1.7, -1.4, 0.3]
    seen["moveJ"] = control.moveJ(target, 1.05, 1.4)
    seen["moveJ time"] = [first, receive.getTimestamp()]
    until(control.isSteady)
    seen["moveJ target"], seen["moveJ reached"] = target, receive.getActualQ()
    pose = receive.getActualTCPPose()
    pose[2] += 0.1
    first = receive.getTimestamp()
    seen["moveL"] = control.moveL(pose, 0.25, 1.2)
    seen["moveL time"] = [first, receive.getTimestamp()]
    until(control.isSteady)
    seen["moveL target"], seen["moveL reached"] = list(pose), receive.getActualTCPPose()
    pose[1] += 0.05
    seen["moveJ_IK"] = control.moveJ_IK(pose, 1.0, 2.0)
    until(control.isSteady)
    seen["moveJ_IK target"], seen["moveJ_IK reached"] = pose, receive.getActualTCPPose()
    seen["moveL_FK"] = control.moveL_FK(target, 0.5, 1.2)
    until(control.isSteady)
    seen["moveL_FK reached"] = receive.getActualQ()
    return seen


def streams(address: str) -> dict[str, Any]:
    """Servo and speed commands, with their stops."""
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    control.moveJ(HOME, 2.0, 4.0)
    seen: dict[str, Any] = {}
    q = list(HOME)
    for _ in range(200):
        cycle = control.initPeriod()
        q[5] += 0.001
        control.servoJ(q, 0.0, 0.0, 0.002, 0.05, 300)
        control.waitPeriod(cycle)
    until(lambda: abs(receive.getActualQ()[5] - q[5]) < 1e-4, 2.0)
    seen["servoJ target"], seen["servoJ reached"] = q, receive.getActualQ()
    control.servoStop()
    pose = receive.getActualTCPPose()
    for _ in range(100):
        cycle = control.initPeriod()
        pose[1] += 0.0003
        control.servoL(pose, 0.0, 0.0, 0.002, 0.05, 300)
        control.waitPeriod(cycle)
    until(lambda: abs(receive.getActualTCPPose()[1] - pose[1]) < 1e-4, 2.0)
    seen["servoL target"], seen["servoL reached"] = list(pose), receive.getActualTCPPose()
    control.servoStop()
    control.speedJ([0.0, 0.0, 0.0, 0.0, 0.0, -0.4], 2.0, 0.5)
    until(lambda: abs(receive.getActualQd()[5] + 0.4) < 1e-3, 2.0)
    seen["speedJ"] = receive.getActualQd()
    control.speedStop(4.0)
    time.sleep(0.05)  # the receiving connection may be a package behind
    seen["speedJ after"] = receive.getTargetQd()
    control.speedL([0.0, 0.0, 0.05, 0.0, 0.0, 0.0], 0.5, 0.5)
    until(lambda: abs(receive.getActualTCPSpeed()[2] - 0.05) < 1e-4, 2.0)
    seen["speedL"] = receive.getActualTCPSpeed()
    control.speedStop(1.0)
    time.sleep(0.05)
    seen["speedL after"] = receive.getTargetTCPSpeed()
    control.jogStart([0.0, 0.02, 0.0, 0.0, 0.0, 0.0], control.FEATURE_TOOL)
    seen["jog"] = until(lambda: max(map(abs, receive.getActualTCPSpeed()[:3])) > 0.015, 3.0)
    control.jogStop()
    return seen


def circular(address: str) -> dict[str, Any]:
    """servoC, which the library handles unlike other streams."""
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    control.moveJ(HOME, 2.0, 4.0)
    pose = receive.getActualTCPPose()
    pose[2] += 0.05
    control.servoC(pose, 0.1, 1.0)
    until(lambda: abs(receive.getActualTCPPose()[2] - pose[2]) < 1e-3, 5.0)
    seen: dict[str, Any] = {"target": pose, "reached": receive.getActualTCPPose()}
    # The library doesn't wait for servoC to be done, its script says so nevertheless: the next command is lost.
    seen["stop"] = [control.servoStop(), control.servoStop()]
    return seen


def paths(address: str) -> dict[str, Any]:
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    control.moveJ(HOME, 2.0, 4.0)
    seen: dict[str, Any] = {}
    joints = [[*HOME[:5], 0.1 * k, 1.0, 3.0, 0.02 if k < 5 else 0.0] for k in range(1, 6)]
    seen["moveJ path"] = control.moveJ(joints)
    time.sleep(0.05)  # the receiving connection may be a package behind
    seen["moveJ path end"] = receive.getTargetQ()
    start = receive.getActualTCPPose()
    corners = [(0.0, 0.1, 0.0), (0.0, 0.1, 0.1), (0.0, 0.0, 0.1), (0.0, 0.0, 0.0)]
    square = [[*(a + b for a, b in zip(start, c, strict=False)), *start[3:], 0.25, 1.2, 0.02] for c in corners]
    square[-1][8] = 0.0
    seen["moveL path start"], seen["moveL path began"] = start, receive.getTimestamp()
    seen["moveL path"] = control.moveL(square)
    seen["moveL path ended"] = receive.getTimestamp()
    path = Path()
    path.addEntry(PathEntry(PathEntry.MoveJ, PathEntry.PositionJoints, [*HOME, 1.0, 2.0, 0.0]))
    path.addEntry(PathEntry(PathEntry.MoveL, PathEntry.PositionTcpPose, [*start, 0.25, 1.2, 0.0]))
    control.movePath(path, True)
    progress = set()
    until(lambda: control.getAsyncOperationProgressEx().isAsyncOperationRunning(), 2.0)
    while control.getAsyncOperationProgressEx().isAsyncOperationRunning():
        progress.add(control.getAsyncOperationProgressEx().progress())
        time.sleep(0.002)
    seen["movePath progress"] = sorted(progress)
    time.sleep(0.05)
    seen["movePath end"] = receive.getTargetTCPPose()
    return seen


def questions(address: str) -> dict[str, Any]:
    """Kinematics, limits, settings that are read back."""
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    control.moveJ([0.3, -1.4, 1.6, -1.7, -1.4, 0.3], 2.0, 4.0)
    until(control.isSteady)
    q, pose = receive.getActualQ(), receive.getActualTCPPose()
    seen: dict[str, Any] = {"q": q, "pose": pose}
    seen["steady"] = control.isSteady()
    seen["forward"] = control.getForwardKinematics()
    seen["forward of q"] = control.getForwardKinematics(q, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    seen["inverse"] = control.getInverseKinematics(pose)
    seen["inverse near"] = control.getInverseKinematics(pose, [0.3, -1.4, 1.6, -1.7, 1.4, 3.4])
    far = [5.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    seen["has solution"] = [control.getInverseKinematicsHasSolution(p) for p in (pose, far)]
    seen["pose within limits"] = [control.isPoseWithinSafetyLimits(p) for p in (pose, far)]
    seen["joints within limits"] = [control.isJointsWithinSafetyLimits(p) for p in (q, [7.0, *q[1:]])]
    seen["pose trans"] = control.poseTrans([1.0, 0.0, 0.0, 0.0, 0.0, 1.5707963], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    seen["tcp before"] = control.getTCPOffset()
    control.setTcp([0.0, 0.02, 0.15, 0.0, 0.0, 0.4])
    seen["tcp"] = control.getTCPOffset()
    seen["pose with tcp"] = receive.getActualTCPPose()
    seen["set payload"] = control.setPayload(0.75, [0.0, 0.0, 0.06])
    until(lambda: receive.getPayload() == 0.75, 1.0)
    seen["payload"] = [receive.getPayload(), *receive.getPayloadCog()]
    control.getActualToolFlangePose()
    time.sleep(0.1)
    seen["flange"] = control.getActualToolFlangePose()
    control.getJointTorques()
    time.sleep(0.1)
    seen["torques"] = control.getJointTorques()
    control.getStepTime()
    time.sleep(0.1)
    seen["step time"] = control.getStepTime()
    seen["waypoint"] = control.getTargetWaypoint()
    control.setTcp([0.0] * 6)
    seen["zero ft"] = control.zeroFtSensor()
    seen["gravity"] = control.setGravity([0.0, 0.0, 9.82])
    seen["robot"] = [receive.getRobotMode(), receive.getSafetyMode(), receive.getRuntimeState()]
    seen["status"] = [receive.getRobotStatus(), receive.getSafetyStatusBits()]
    seen["joint modes"] = receive.getJointMode()
    return seen


def asynchronous(address: str) -> dict[str, Any]:
    """Moves that return at once, and their stop."""
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    control.moveJ(HOME, 2.0, 4.0)
    before = control.getAsyncOperationProgressEx().operationId()
    seen: dict[str, Any] = {"started": control.moveJ([2.0, *HOME[1:]], 1.0, 1.4, True)}
    seen["new operation"] = until(lambda: control.getAsyncOperationProgressEx().operationId() != before, 2.0)
    seen["running"] = control.getAsyncOperationProgressEx().isAsyncOperationRunning()
    until(lambda: receive.getActualQ()[0] > 0.5)
    seen["not steady"] = control.isSteady()
    control.stopJ(2.0)
    seen["stands after stopJ"] = until(lambda: max(map(abs, receive.getTargetQd())) < 1e-9, 0.5)
    seen["stopped at"] = receive.getActualQ()[0]
    seen["finished"] = until(lambda: not control.getAsyncOperationProgressEx().isAsyncOperationRunning(), 2.0)
    pose = receive.getActualTCPPose()
    pose[2] += 0.2
    control.moveL(pose, 0.1, 0.5, True)
    until(lambda: receive.getActualTCPSpeed()[2] > 0.09)
    control.stopL(1.0, True)
    seen["stopL stops"] = until(lambda: max(map(abs, receive.getTargetQd())) < 1e-6, 5.0)
    seen["moveL again"] = control.moveL(pose, 0.25, 1.2)
    return seen


def signals(address: str) -> dict[str, Any]:
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    io = keep(RTDEIOInterface(address))
    seen: dict[str, Any] = {}
    seen["sent"] = [
        io.setStandardDigitalOut(1, True),
        io.setConfigurableDigitalOut(2, True),
        io.setToolDigitalOut(0, True),
        io.setAnalogOutputVoltage(0, 0.25),
        io.setAnalogOutputCurrent(1, 0.5),
        io.setSpeedSlider(0.6),
        io.setInputIntRegister(19, 42),
        io.setInputDoubleRegister(20, 2.5),
    ]
    until(lambda: receive.getTargetSpeedFraction() == 0.6, 2.0)
    seen["bits"] = receive.getActualDigitalOutputBits()
    seen["state"] = [receive.getDigitalOutState(n) for n in (0, 1, 10, 16)]
    seen["analog"] = [receive.getStandardAnalogOutput0(), receive.getStandardAnalogOutput1()]
    seen["slider"] = receive.getTargetSpeedFraction()
    seen["registers"] = control.sendCustomScriptFunction(
        "echo",
        "write_output_integer_register(13, read_input_integer_register(19) + 1)\n"
        "write_output_float_register(14, read_input_float_register(20) * 2)",
    )
    until(lambda: receive.getOutputIntRegister(13) == 43, 2.0)
    seen["echo"] = [receive.getOutputIntRegister(13), receive.getOutputDoubleRegister(14)]
    io.setStandardDigitalOut(1, False)
    io.setSpeedSlider(1.0)
    seen["off"] = until(lambda: not receive.getDigitalOutState(1), 2.0)
    seen["inputs"] = [receive.getDigitalInState(3), receive.getDigitalInState(4), receive.getStandardAnalogInput0()]
    return seen


def scripts(address: str) -> dict[str, Any]:
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    control.moveJ(HOME, 2.0, 4.0)
    seen: dict[str, Any] = {}
    seen["function"] = control.sendCustomScriptFunction(
        "wave",
        "q = get_target_joint_positions()\ni = 0\nwhile i < 3:\n  q[5] = q[5] + 0.1\n  movej(q, a=3, v=2)\n"
        "  i = i + 1\nend\nset_standard_digital_out(4, True)",
    )
    time.sleep(0.05)
    seen["reached"] = receive.getTargetQ()
    seen["output"] = receive.getDigitalOutState(4)
    seen["script"] = control.sendCustomScript(
        "def own():\n  write_output_integer_register(0, 1)\n  movej([0, -1.5, 1.5, -1.5, -1.5, 0.2], a=3, v=2)\n"
        "  write_output_integer_register(0, 2)\nend\n"
    )
    time.sleep(0.05)
    seen["script reached"] = receive.getTargetQ()
    seen["still works"] = control.moveJ(HOME, 2.0, 4.0)
    return seen


def dashboards(address: str) -> dict[str, Any]:
    client = dashboard(address)
    seen: dict[str, Any] = {
        "robotmode": client.robotmode(),
        "safetymode": client.safetymode(),
        "safetystatus": client.safetystatus(),
        "version": client.polyscopeVersion(),
        "serial": attempt(client.getSerialNumber),
        "remote": client.isInRemoteControl(),
        "model": client.getRobotModel(),
        "running": client.running(),
        "program": client.programState(),
        "loaded": client.getLoadedProgram(),
    }
    for name, call in {
        "play": client.play,
        "load": lambda: client.loadURP("pour.urp"),
        "popup": lambda: client.popup("hello"),
        "close popup": client.closePopup,
        "close safety popup": client.closeSafetyPopup,
        "log": lambda: client.addToLog("hello"),
        "unlock": client.unlockProtectiveStop,
    }.items():
        seen[name] = attempt(call)
    client.powerOff()
    seen["off"] = client.robotmode()
    client.powerOn()
    seen["idle"] = until(lambda: client.robotmode() == "Robotmode: IDLE", 10.0)
    client.brakeRelease()
    seen["on"] = until(lambda: client.robotmode() == "Robotmode: RUNNING", 10.0)
    client.quit()
    return seen


def protective_stop(address: str) -> dict[str, Any]:
    """A blocking move is stopped by the controller; queries meanwhile; the way back."""
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    client = dashboard(address)
    control.moveJ(HOME, 2.0, 4.0)
    print("ready", flush=True)
    sys.stdin.readline()
    seen: dict[str, Any] = {"moveJ": control.moveJ([2.0, *HOME[1:]], 0.5, 1.0)}
    seen["protective"] = until(receive.isProtectiveStopped, 0.5)
    until(lambda: max(map(abs, receive.getTargetQd())) < 1e-9, 2.0)
    seen["stopped at"] = receive.getActualQ()[0]
    seen["inverse"] = attempt(lambda: control.getInverseKinematics(receive.getActualTCPPose()))
    seen["within limits"] = attempt(lambda: control.isPoseWithinSafetyLimits(receive.getActualTCPPose()))
    seen["tcp"] = attempt(control.getTCPOffset)
    seen["safetymode"] = client.safetymode()
    seen["too early"] = attempt(client.unlockProtectiveStop)
    seen["unlocked"] = until(lambda: attempt(client.unlockProtectiveStop) is None, 10.0)
    time.sleep(0.3)
    seen["stayed at"] = receive.getActualQ()[0]
    client.stop()
    time.sleep(0.1)
    control.reuploadScript()
    seen["program runs"] = until(control.isProgramRunning, 5.0)
    seen["moves again"] = control.moveJ([*HOME], 2.0, 4.0)
    return seen


def emergency_stop(address: str) -> dict[str, Any]:
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    client = dashboard(address)
    control.moveJ(HOME, 2.0, 4.0)
    print("ready", flush=True)
    sys.stdin.readline()
    seen: dict[str, Any] = {"moveJ": control.moveJ([2.0, *HOME[1:]], 0.5, 1.0)}
    seen["emergency"] = until(receive.isEmergencyStopped, 0.5)
    seen["off"] = until(lambda: receive.getRobotMode() == 3, 3.0)
    seen["stopped at"] = receive.getActualQ()[0]
    print("stopped", flush=True)
    sys.stdin.readline()
    client.closeSafetyPopup()
    client.powerOn()
    until(lambda: client.robotmode() == "Robotmode: IDLE", 10.0)
    client.brakeRelease()
    seen["running"] = until(lambda: client.robotmode() == "Robotmode: RUNNING", 10.0)
    control.reuploadScript()
    seen["program runs"] = until(control.isProgramRunning, 5.0)
    seen["moves again"] = control.moveJ(HOME, 2.0, 4.0)
    return seen


def during(address: str, seconds: float = 0.0) -> dict[str, Any]:
    """An asynchronous move, watched while the test does something to the controller."""
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    control.moveJ(HOME, 2.0, 4.0)
    control.moveJ([2.5, *HOME[1:]], 0.5, 1.0, True)
    until(lambda: receive.getActualQd()[0] > 0.4)
    print("ready", flush=True)
    sys.stdin.readline()
    seen: dict[str, Any] = {"lost after": None}
    began = time.monotonic()
    stamps = set()
    while time.monotonic() - began < seconds:
        stamps.add(receive.getTimestamp())
        if not receive.isConnected() and seen["lost after"] is None:
            seen["lost after"] = time.monotonic() - began
        time.sleep(0.01)
    seen["timestamps"] = len(stamps)
    seen["connected"] = receive.isConnected()
    seen["bits"] = receive.getSafetyStatusBits()
    seen["runtime"] = receive.getRuntimeState()
    seen["q"], seen["qd"] = receive.getActualQ(), receive.getActualQd()
    seen["async running"] = control.getAsyncOperationProgressEx().isAsyncOperationRunning()
    return seen


def listening(address: str, seconds: float = 0.5, anew: bool = True) -> dict[str, Any]:
    """Receive only: a control interface that is cut off reconnects by itself and may crash its process."""
    receive = keep(RTDEReceiveInterface(address))
    print("ready", flush=True)
    sys.stdin.readline()
    began, lost = time.monotonic(), None
    while time.monotonic() - began < seconds and lost is None:
        lost = None if receive.isConnected() else time.monotonic() - began
        time.sleep(0.005)
    seen: dict[str, Any] = {"lost after": lost, "q": receive.getActualQ()}
    seen["stale"] = [receive.getTimestamp() for _ in range(2)]
    if anew:
        seen["reconnects"] = attempt(receive.reconnect)
        seen["fresh"] = receive.getTimestamp()
    return seen


def watched(address: str, kick: bool = False, exits: bool = False) -> dict[str, Any]:
    """A watchdog, kicked or not, around an asynchronous move."""
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    control.moveJ(HOME, 2.0, 4.0)
    control.setWatchdog(5.0)
    control.moveJ([2.0, *HOME[1:]], 0.5, 1.0, True)
    if exits:
        print("ready", flush=True)
        os._exit(0)
    began = time.monotonic()
    while time.monotonic() - began < 0.6:
        if kick:
            control.kickWatchdog()
        time.sleep(0.02)
    return {"running": control.isProgramRunning(), "q": receive.getActualQ()[0]}


def connect(address: str) -> dict[str, Any]:
    """Whether and how long it takes to connect each interface; what they say if not."""
    seen: dict[str, Any] = {}
    for name, make in {
        "receive": lambda: keep(RTDEReceiveInterface(address)),
        "control": lambda: keep(RTDEControlInterface(address)),
        "dashboard": lambda: dashboard(address),
    }.items():
        began = time.monotonic()
        made = attempt(make)
        seen[name] = made if isinstance(made, str) else "connected"
        seen[f"{name} took"] = time.monotonic() - began
    return seen


def second(address: str) -> dict[str, Any]:
    """Two control interfaces at one robot."""
    first = keep(RTDEControlInterface(address))
    seen = {"second": attempt(lambda: keep(RTDEControlInterface(address))) or "connected"}
    seen["first still moves"] = first.moveJ(HOME, 2.0, 4.0)
    return seen


def unreachable(address: str) -> dict[str, Any]:
    control = keep(RTDEControlInterface(address))
    seen: dict[str, Any] = {"moveL": control.moveL([3.0, 0.0, 0.0, 0.0, 0.0, 0.0])}
    seen["program runs"] = control.isProgramRunning()
    control.reuploadScript()
    until(control.isProgramRunning, 5.0)
    seen["inverse"] = attempt(lambda: control.getInverseKinematics([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    control.reuploadScript()
    until(control.isProgramRunning, 5.0)
    seen["moves again"] = control.moveJ(HOME, 2.0, 4.0)
    seen["force mode"] = control.forceMode([0.0] * 6, [0, 0, 1, 0, 0, 0], [0.0] * 6, 2, [0.1] * 6)
    seen["force mode ends program"] = until(lambda: not control.isProgramRunning(), 2.0)
    return seen


def receiving(address: str, seconds: float = 2.0, frequency: float = 500.0) -> dict[str, Any]:
    """How many packages arrive."""
    receive = keep(RTDEReceiveInterface(address, frequency, ["timestamp", "actual_q"]))
    began, stamps = time.monotonic(), set()
    while time.monotonic() - began < seconds:
        stamps.add(receive.getTimestamp())
        time.sleep(0.0002)
    return {"rate": len(stamps) / seconds, "clock": (max(stamps) - min(stamps)) / seconds}


def main() -> None:
    scenario, address, arguments = sys.argv[1:4]
    seen = globals()[scenario](address, **json.loads(arguments))
    print(json.dumps(seen), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
