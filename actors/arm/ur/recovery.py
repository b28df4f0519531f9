"""The way back from a stop to a robot that could move, and doesn't. A person has seen to the cause before."""

from __future__ import annotations

import time
from collections.abc import Callable

from actors.arm.ur.dashboard import Dashboard, DashboardError
from actors.arm.ur.messages import NORMAL, RUNNING_MODE, STOPPED_PROGRAM, TroubleError
from actors.arm.ur.rtde_client import RtdeClient

UNLOCK_DELAY = 5.5
"""A protective stop can't be unlocked earlier [s of controller time]."""

POWER_TIME = 60.0
"""Longest wait for power and brakes [s of controller time]."""

_PROTECTIVE, _SAFEGUARD, _EMERGENCIES, _FAULTS = 3, 5, (6, 7), (8, 9)
_IDLE = 5


def recover(client: RtdeClient, address: str, scale: float) -> str:
    """Unlock, switch on, release the brakes: whatever is needed.

    Args:
        client: to the controller.
        address: of its dashboard.
        scale: controller seconds per second of the clock.

    Returns:
        What was done, for people.

    Raises:
        TroubleError: what has to be done by hand first.
    """
    done = []
    try:
        mode = client.fresh().safety_mode
        if mode in _EMERGENCIES:
            raise TroubleError("refused", "the emergency stop is still pressed; release its button first")
        if mode == _SAFEGUARD:
            raise TroubleError("refused", "the safeguard stop is still in force; leave the guarded area, then reset it")
        if mode in _FAULTS:
            raise TroubleError(
                "refused", "the safety system reports a fault; restart it at the pendant, after its cause was found"
            )
        with Dashboard(address) as dashboard:
            # A program that is only held would go on, and the next one that is uploaded would be thrown away.
            dashboard.demand("stop", "Stopped")
            dashboard.ask("close popup")
            dashboard.ask("close safety popup")
            if mode == _PROTECTIVE:
                _unlock(dashboard, scale)
                done.append("protective stop unlocked")
                _until(lambda: client.fresh().safety_mode == NORMAL, POWER_TIME / scale, "the safety mode stays")
            if client.fresh().robot_mode < _IDLE:
                dashboard.demand("power on", "Powering on")
                done.append("switched on")
                _until(lambda: client.fresh().robot_mode >= _IDLE, POWER_TIME / scale, "the robot does not switch on")
            if client.fresh().robot_mode != RUNNING_MODE:
                dashboard.demand("brake release", "Brake releasing")
                done.append("brakes released")
                _until(
                    lambda: client.fresh().robot_mode == RUNNING_MODE, POWER_TIME / scale, "the brakes are not released"
                )
        _until(lambda: client.fresh().runtime == STOPPED_PROGRAM, 3.0, "a program still runs on the controller")
    except DashboardError as error:
        raise TroubleError("lost", str(error)) from None
    return ", ".join(done)


def _unlock(dashboard: Dashboard, scale: float) -> None:
    for last in (False, True):
        answer = dashboard.ask("unlock protective stop")
        if answer.lower().startswith("protective stop releasing"):
            return
        if last:
            raise TroubleError("refused", f"the protective stop can't be unlocked: {answer}")
        time.sleep(UNLOCK_DELAY / scale + 0.05)


def _until(condition: Callable[[], bool], seconds: float, otherwise: str) -> None:
    end = time.monotonic() + max(seconds, 3.0)
    while not condition():
        if time.monotonic() > end:
            raise TroubleError("refused", otherwise)
        time.sleep(0.02)
