"""Moves, streams and paths, blocking or not."""

from __future__ import annotations

import time
from typing import Any

from rtde_control import Path, PathEntry, RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
from shared import HOME, arrived, attempt, keep, until


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
    pose = receive.getActualTCPPose()
    pose[2] += 0.1
    seen["moveL time"] = receive.getTimestamp()
    seen["moveL"] = control.moveL(pose, 0.25, 1.2)
    until(control.isSteady)
    seen["moveL target"], seen["moveL reached"] = list(pose), arrived(receive.getActualTCPPose, pose)
    pose[1] += 0.05
    seen["moveJ_IK"] = control.moveJ_IK(pose, 1.0, 2.0)
    until(control.isSteady)
    seen["moveJ_IK target"], seen["moveJ_IK reached"] = pose, arrived(receive.getActualTCPPose, pose)
    seen["moveL_FK"] = control.moveL_FK(target, 0.5, 1.2)
    until(control.isSteady)
    seen["moveL_FK reached"] = arrived(receive.getActualQ, target)
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
    pose = receive.getActualTCPPose()
    for _ in range(100):
        cycle = control.initPeriod()
        pose[1] += 0.0003
        control.servoL(pose, 0.0, 0.0, 0.002, 0.05, 300)
        control.waitPeriod(cycle)
    until(lambda: abs(receive.getActualTCPPose()[1] - pose[1]) < 1e-4)
    seen["servoL target"], seen["servoL reached"] = list(pose), receive.getActualTCPPose()
    control.servoStop()
    control.speedJ([0.0, 0.0, 0.0, 0.0, 0.0, -0.4], 2.0, 0.5)
    until(lambda: abs(receive.getActualQd()[5] + 0.4) < 1e-3)
    seen["speedJ"] = receive.getActualQd()
    control.speedStop(4.0)
    seen["speedJ after"] = arrived(receive.getTargetQd, [0.0] * 6)
    control.speedL([0.0, 0.0, 0.05, 0.0, 0.0, 0.0], 0.5, 0.5)
    until(lambda: abs(receive.getActualTCPSpeed()[2] - 0.05) < 1e-4)
    seen["speedL"] = receive.getActualTCPSpeed()
    control.speedStop(1.0)
    seen["speedL after"] = arrived(receive.getTargetTCPSpeed, [0.0] * 6)
    control.jogStart([0.0, 0.02, 0.0, 0.0, 0.0, 0.0], control.FEATURE_TOOL)
    seen["jog"] = until(lambda: max(map(abs, receive.getActualTCPSpeed()[:3])) > 0.015)
    control.jogStop()
    return seen


def circular(address: str) -> dict[str, Any]:
    """servoC, which the library handles unlike other streams."""
    control, receive = keep(RTDEControlInterface(address)), keep(RTDEReceiveInterface(address))
    control.moveJ(HOME, 2.0, 4.0)
    pose = receive.getActualTCPPose()
    pose[2] += 0.05
    control.servoC(pose, 0.1, 1.0)
    until(lambda: abs(receive.getActualTCPPose()[2] - pose[2]) < 1e-3)
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
    seen["moveJ path end"] = arrived(receive.getActualQ, joints[-1][:6])
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
    until(lambda: control.getAsyncOperationProgressEx().isAsyncOperationRunning())
    while control.getAsyncOperationProgressEx().isAsyncOperationRunning():
        progress.add(control.getAsyncOperationProgressEx().progress())
        time.sleep(0.002)
    seen["movePath progress"] = sorted(progress)
    # Its place alone: half a turn has two rotation vectors, and rounding decides which one is told.
    seen["movePath end"] = arrived(lambda: receive.getTargetTCPPose()[:3], start[:3])
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
    pose = receive.getActualTCPPose()
    pose[2] += 0.2
    control.moveL(pose, 0.1, 0.5, True)
    until(lambda: receive.getActualTCPSpeed()[2] > 0.09)
    control.stopL(1.0, True)
    seen["stopL stops"] = until(lambda: max(map(abs, receive.getTargetQd())) < 1e-6)
    seen["moveL again"] = control.moveL(pose, 0.25, 1.2)
    return seen


def unreachable(address: str) -> dict[str, Any]:
    control = keep(RTDEControlInterface(address))
    seen: dict[str, Any] = {"moveL": control.moveL([3.0, 0.0, 0.0, 0.0, 0.0, 0.0])}
    seen["program runs"] = control.isProgramRunning()
    control.reuploadScript()
    until(control.isProgramRunning)
    seen["inverse"] = attempt(lambda: control.getInverseKinematics([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    control.reuploadScript()
    until(control.isProgramRunning)
    seen["moves again"] = control.moveJ(HOME, 2.0, 4.0)
    seen["force mode"] = control.forceMode([0.0] * 6, [0, 0, 1, 0, 0, 0], [0.0] * 6, 2, [0.1] * 6)
    seen["force mode ends program"] = until(lambda: not control.isProgramRunning())
    return seen
