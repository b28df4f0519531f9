"""Questions, signals, scripts and the dashboard; connecting, and what arrives."""

from __future__ import annotations

import itertools
import time
from typing import Any

from rtde_control import RTDEControlInterface
from rtde_io import RTDEIOInterface
from rtde_receive import RTDEReceiveInterface
from shared import HOME, arrived, attempt, dashboard, keep, until


def questions(address: str, model: str = "ur10e") -> dict[str, Any]:
    """Settings that are read back."""
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    control.moveJ([0.3, -1.4, 1.6, -1.7, -1.4, 0.3], 2.0, 4.0)
    until(control.isSteady)
    q = arrived(receive.getActualQ, [0.3, -1.4, 1.6, -1.7, -1.4, 0.3], 1e-11)
    pose = receive.getActualTCPPose()
    seen: dict[str, Any] = {"q": q, "pose": pose}
    seen["steady"] = control.isSteady()
    seen["tcp before"] = control.getTCPOffset()
    tool = [0.0, 0.02, 0.15, 0.0, 0.0, 0.4]
    control.setTcp(tool)
    seen["tcp"] = control.getTCPOffset()
    until(lambda: receive.getActualTCPPose() != pose)
    seen["pose with tcp"] = receive.getActualTCPPose()
    seen["set payload"] = control.setPayload(0.75, [0.0, 0.0, 0.06])
    until(lambda: receive.getPayload() == 0.75)
    seen["payload"] = [receive.getPayload(), *receive.getPayloadCog()]
    if model == "ur10e":  # the library's script does not ask CB3 controllers for it
        until(lambda: abs(control.getStepTime() - 0.002) < 1e-6, 5.0)
        seen["step time"] = control.getStepTime()
    control.setTcp([0.0] * 6)
    seen["zero ft"] = control.zeroFtSensor()
    seen["gravity"] = control.setGravity([0.0, 0.0, 9.82])
    seen["robot"] = [receive.getRobotMode(), receive.getSafetyMode(), receive.getRuntimeState()]
    seen["status"] = [receive.getRobotStatus(), receive.getSafetyStatusBits()]
    seen["joint modes"] = receive.getJointMode()
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
    until(lambda: receive.getTargetSpeedFraction() == 0.6)
    seen["bits"] = receive.getActualDigitalOutputBits()
    seen["state"] = [receive.getDigitalOutState(n) for n in (0, 1, 10, 16)]
    seen["analog"] = [receive.getStandardAnalogOutput0(), receive.getStandardAnalogOutput1()]
    seen["slider"] = receive.getTargetSpeedFraction()
    seen["registers"] = control.sendCustomScriptFunction(
        "echo",
        "write_output_integer_register(13, read_input_integer_register(19) + 1)\n"
        "write_output_float_register(14, read_input_float_register(20) * 2)",
    )
    until(lambda: receive.getOutputIntRegister(13) == 43)
    seen["echo"] = [receive.getOutputIntRegister(13), receive.getOutputDoubleRegister(14)]
    io.setStandardDigitalOut(1, False)
    io.setSpeedSlider(1.0)
    seen["off"] = until(lambda: not receive.getDigitalOutState(1))
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
    until(lambda: receive.getDigitalOutState(4))
    seen["reached"] = arrived(receive.getActualQ, [*HOME[:5], 0.3])
    seen["output"] = receive.getDigitalOutState(4)
    seen["script"] = control.sendCustomScript(
        "def own():\n  write_output_integer_register(0, 1)\n  movej([0, -1.5, 1.5, -1.5, -1.5, 0.2], a=3, v=2)\n"
        "  write_output_integer_register(0, 2)\nend\n"
    )
    seen["script reached"] = arrived(receive.getActualQ, [0.0, -1.5, 1.5, -1.5, -1.5, 0.2])
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
    seen["idle"] = until(lambda: client.robotmode() == "Robotmode: IDLE")
    client.brakeRelease()
    seen["on"] = until(lambda: client.robotmode() == "Robotmode: RUNNING")
    client.quit()
    return seen


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


def receiving(address: str, seconds: float = 2.0, frequency: float = 500.0) -> dict[str, Any]:
    """How closely packages follow each other in the controller's time, and how that runs beside ours."""
    receive = keep(RTDEReceiveInterface(address, frequency, ["timestamp", "actual_q"]))
    began, stamps = time.monotonic(), set()
    while time.monotonic() - began < seconds:
        stamps.add(receive.getTimestamp())
        time.sleep(0.0002)
    times = sorted(stamps)
    # A busy machine sees some packages together, but hardly all of them.
    step = min(later - earlier for earlier, later in itertools.pairwise(times))
    return {"step": step, "clock": (times[-1] - times[0]) / seconds}
