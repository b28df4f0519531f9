"""Stops, watchdogs and lost connections, while something moves."""

from __future__ import annotations

import os
import sys
import time
from typing import Any

from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
from shared import HOME, attempt, dashboard, keep, until


def protective_stop(address: str) -> dict[str, Any]:
    """A blocking move is stopped by the controller; queries meanwhile; the way back."""
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    client = dashboard(address)
    control.moveJ(HOME, 2.0, 4.0)
    print("ready", flush=True)
    sys.stdin.readline()
    seen: dict[str, Any] = {"moveJ": control.moveJ([2.0, *HOME[1:]], 0.5, 1.0)}
    seen["protective"] = until(receive.isProtectiveStopped)
    until(lambda: max(map(abs, receive.getTargetQd())) < 1e-9)
    seen["stopped at"] = receive.getActualQ()[0]
    seen["inverse"] = attempt(lambda: control.getInverseKinematics(receive.getActualTCPPose()))
    seen["within limits"] = attempt(lambda: control.isPoseWithinSafetyLimits(receive.getActualTCPPose()))
    seen["tcp"] = attempt(control.getTCPOffset)
    seen["safetymode"] = client.safetymode()
    seen["too early"] = attempt(client.unlockProtectiveStop)
    seen["unlocked"] = until(lambda: attempt(client.unlockProtectiveStop) is None)
    time.sleep(0.3)  # a robot that moves on would be seen to
    seen["stayed at"] = receive.getActualQ()[0]
    client.stop()
    time.sleep(0.1)  # the client's script has ended
    control.reuploadScript()
    seen["program runs"] = until(control.isProgramRunning)
    seen["moves again"] = control.moveJ([*HOME], 2.0, 4.0)
    return seen


def emergency_stop(address: str) -> dict[str, Any]:
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    client = dashboard(address)
    control.moveJ(HOME, 2.0, 4.0)
    print("ready", flush=True)
    sys.stdin.readline()
    seen: dict[str, Any] = {"moveJ": control.moveJ([2.0, *HOME[1:]], 0.5, 1.0)}
    seen["emergency"] = until(receive.isEmergencyStopped)
    seen["off"] = until(lambda: receive.getRobotMode() == 3)
    seen["stopped at"] = receive.getActualQ()[0]
    print("stopped", flush=True)
    sys.stdin.readline()
    client.closeSafetyPopup()
    client.powerOn()
    until(lambda: client.robotmode() == "Robotmode: IDLE")
    client.brakeRelease()
    seen["running"] = until(lambda: client.robotmode() == "Robotmode: RUNNING")
    control.reuploadScript()
    seen["program runs"] = until(control.isProgramRunning)
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


def listening(address: str, seconds: float = 30.0, anew: bool = True) -> dict[str, Any]:
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
