"""From switched off to running: modes and how long they take."""

from __future__ import annotations

from enum import IntEnum


class RobotMode(IntEnum):
    """As RTDE and the dashboard report it."""

    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7
    UPDATING_FIRMWARE = 8


BOOT_TIME = 4.0
"""From 'power on' until the joints answer [s]. Plausible, not measured."""

POWER_ON_TIME = 1.0
"""From there to idle [s]."""

BRAKE_TIME = 3.0
"""From 'brake release' to running [s]."""


class Power:
    """Modes over controller time.

    Args:
        mode: to begin with.
    """

    def __init__(self, mode: RobotMode = RobotMode.RUNNING) -> None:
        self.mode = mode
        self._plan: list[tuple[float, RobotMode]] = []

    @property
    def powered(self) -> bool:
        """Whether the joints have power."""
        return self.mode in (RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.BACKDRIVE, RobotMode.RUNNING)

    @property
    def running(self) -> bool:
        """Whether the brakes are off and the arm may move."""
        return self.mode is RobotMode.RUNNING

    def on(self, now: float) -> None:
        """Switch on; idle after some seconds."""
        if self.mode is RobotMode.POWER_OFF and not self._plan:
            self.mode = RobotMode.BOOTING
            self._plan = [(now + BOOT_TIME, RobotMode.POWER_ON), (now + BOOT_TIME + POWER_ON_TIME, RobotMode.IDLE)]

    def release_brakes(self, now: float) -> None:
        """Release the brakes, switching on first if need be."""
        self.on(now)
        if self.mode is RobotMode.RUNNING or (self._plan and self._plan[-1][1] is RobotMode.RUNNING):
            return
        idle = self._plan[-1][0] if self._plan else now
        self._plan.append((idle + BRAKE_TIME, RobotMode.RUNNING))

    def off(self) -> None:
        """Switch off: brakes close."""
        self.mode, self._plan = RobotMode.POWER_OFF, []

    def step(self, now: float) -> None:
        """Let time pass."""
        while self._plan and now >= self._plan[0][0]:
            self.mode = self._plan.pop(0)[1]
