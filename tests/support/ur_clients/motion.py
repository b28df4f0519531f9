"""Moves and streams, blocking or not."""

from __future__ import annotations

from typing import Any

from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
from shared import HOME, arrived, keep, until


def moves(address: str) -> dict[str, Any]:
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    seen: dict[str, Any] = {"home": control.moveJ(HOME, 2.0, 4.0)}
    until(control.isSteady)
    arrived(receive.getActualQ, HOME)
    seen["moveJ time"] = receive.getTimestamp()
    target = [0.5, -1.4, 1.6, -1.7, -1.4, 0.3]
    seen["moveJ"] = control.moveJ(target, 1.05, 1.4)
    until(control.isSteady)
    seen["moveJ target"], seen["moveJ reached"] = target, arrived(receive.getActualQ, target)
    return seen


def streams(address: str) -> dict[str, Any]:
    """Servo and speed commands, with their stops."""
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    control.moveJ(HOME, 2.0, 4.0)
    arrived(receive.getActualQ, HOME)
    seen: dict[str, Any] = {}
    q = list(HOME)
    for _ in range(200):
        cycle = control.initPeriod()
        q[5] += 0.001
        control.servoJ(q, 0.0, 0.0, 0.002, 0.05, 300)
        control.waitPeriod(cycle)
    until(lambda: abs(receive.getActualQ()[5] - q[5]) < 1e-4)
    seen["servoJ target"], seen["servoJ reached"] = q, receive.getActualQ()
    control.servoStop()
    control.speedJ([0.0, 0.0, 0.0, 0.0, 0.0, -0.4], 2.0, 0.5)
    until(lambda: abs(receive.getActualQd()[5] + 0.4) < 1e-3)
    seen["speedJ"] = receive.getActualQd()
    control.speedStop(4.0)
    seen["speedJ after"] = arrived(receive.getTargetQd, [0.0] * 6)
    return seen


def asynchronous(address: str) -> dict[str, Any]:
    """Moves that return at once, and their stop."""
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    control.moveJ(HOME, 2.0, 4.0)
    before = control.getAsyncOperationProgressEx().operationId()
    seen: dict[str, Any] = {"started": control.moveJ([2.0, *HOME[1:]], 0.3, 1.4, True)}
    seen["new operation"] = until(lambda: control.getAsyncOperationProgressEx().operationId() != before)
    seen["running"] = control.getAsyncOperationProgressEx().isAsyncOperationRunning()
    until(lambda: receive.getActualQ()[0] > 0.5)
    seen["not steady"] = control.isSteady()
    control.stopJ(2.0)
    seen["stands after stopJ"] = until(lambda: max(map(abs, receive.getTargetQd())) < 1e-9)
    seen["stopped at"] = receive.getActualQ()[0]
    seen["finished"] = until(lambda: not control.getAsyncOperationProgressEx().isAsyncOperationRunning())
    return seen


def unsupported(address: str) -> dict[str, Any]:
    control = keep(RTDEControlInterface(address))
    seen: dict[str, Any] = {"moveL": control.moveL([0.3, 0.3, 0.3, 0.0, 0.0, 0.0])}
    seen["program runs"] = control.isProgramRunning()
    control.reuploadScript()
    until(control.isProgramRunning)
    seen["moves again"] = control.moveJ(HOME, 2.0, 4.0)
    seen["force mode"] = control.forceMode([0.0] * 6, [0, 0, 1, 0, 0, 0], [0.0] * 6, 2, [0.1] * 6)
    seen["force mode ends program"] = until(lambda: not control.isProgramRunning())
    return seen
