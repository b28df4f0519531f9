"""The command `decant jog`: moves the arm by small, slow steps that are typed one by one, or brings it home.

`Jogging` is the interactive session; `parse_step` parses a line, and `steps_home` computes the steps of the way home.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from actors.interfaces import LaboratoryError
from actors.laboratory import reached
from orchestrator.cli.console import BAD_INPUT, FAILED, RefusalError, Refused, say
from orchestrator.cli.doctor import read_laboratory, without_arm
from orchestrator.cli.motion_approval import confirm, connected, require_flag, stoppable, typed_line
from orchestrator.runs.safety_approval import SafetyRecordError, accepted_checksum

if TYPE_CHECKING:
    from actors.arm.arm_interface import Arm

FARTHEST = {"deg": 10.0, "mm": 50.0}
SPEEDS = {"deg": 5.0, "mm": 20.0}
"""Speed of every step [deg/s], [mm/s]."""

WARNING_TIME = 1.0
"""Time between the confirmation of a step and its motion [s]."""

_STEP = re.compile(r"(?P<axis>j[1-6]|[xyz]|r[xyz])\s*(?P<amount>[+−-]?\s*\d+(?:[.,]\d+)?)")
_HELP = """\
  j5 +2        joint 5 (1 base … 6 wrist 3) by 2 deg; at most 10 deg a step, 5 deg/s
  z -5         the tool by -5 mm along the base's z (x, y likewise); at most 50 mm a step, 20 mm/s
  rx 3         the tool about the base's x by 3 deg (ry, rz likewise)
  where        joints and tool
  home         all joints to 'home', after a confirmation
  quit"""


class JogError(ValueError):
    """The typed line is not a step; the message shows a valid one."""


@dataclass(frozen=True)
class JogStep:
    """One small movement.

    Attributes:
        axis: 'joint 1' … 'joint 6', 'x', 'y', 'z', 'rx', 'ry', 'rz'.
        amount: [deg] or [mm].
        unit: 'deg' or 'mm'.
    """

    axis: str
    amount: float
    unit: str

    def __str__(self) -> str:
        return f"{self.axis} by {self.amount:+g} {self.unit} at {SPEEDS[self.unit]:g} {self.unit}/s"

    @property
    def si(self) -> tuple[float, float]:
        """Amount and speed: [rad], [rad/s]; or [m], [m/s]."""
        factor = math.radians(1.0) if self.unit == "deg" else 1e-3
        return self.amount * factor, SPEEDS[self.unit] * factor


def parse_step(text: str) -> JogStep:
    """Parse a step such as 'j5 +2'.

    Raises:
        JogError: the text is not a step, or the step is too large.
    """
    match = _STEP.fullmatch(" ".join(text.lower().split()))
    if match is None:
        raise JogError(f"'{text.strip()}' is not a step; for example 'j5 +2' (deg) or 'z -5' (mm); 'help' shows all")
    axis = match["axis"]
    unit = "mm" if axis in ("x", "y", "z") else "deg"
    amount = float(match["amount"].replace(",", ".").replace("−", "-").replace(" ", ""))
    if not 0.0 < abs(amount) <= FARTHEST[unit]:
        raise JogError(f"{amount:g} {unit} is not a small step; at most {FARTHEST[unit]:g} {unit}, and not 0")
    return JogStep(f"joint {axis[1]}" if axis[0] == "j" else axis, amount, unit)


def steps_home(joints: tuple[float, ...], home: tuple[float, ...]) -> list[JogStep]:
    """Return small single-joint steps that lead home along a nearly straight line in joint space.

    Args:
        joints, home: six each [rad].
    """
    ways = [math.degrees(b - a) for a, b in zip(joints, home, strict=True)]
    rounds = math.ceil(max(abs(way) for way in ways) / FARTHEST["deg"])
    each = [JogStep(f"joint {i}", way / rounds, "deg") for i, way in enumerate(ways, start=1) if abs(way) > 0.01]
    return each * rounds


class Jogging:
    """An interactive session.

    Args:
        arm: connected driver.
        read: returns the next line, after a prompt; raises EOFError.
        tell: prints a line.
    """

    def __init__(self, arm: Arm, read: Callable[[str], str], tell: Callable[[str], None] = say) -> None:
        self._arm, self._read, self._print = arm, read, tell
        self._known: set[tuple[str, bool]] = set()

    def run(self) -> None:
        """Run until 'quit' or the end of input."""
        self._print(_HELP)
        self.where()
        while True:
            try:
                typed = self._read("jog> ").strip()
            except (EOFError, KeyboardInterrupt):
                return
            if typed in ("quit", "q", "exit"):
                return
            try:
                self.do(typed)
            except (JogError, LaboratoryError) as error:
                self._print(str(error))

    def do(self, typed: str) -> None:
        """Execute one line.

        Raises:
            JogError: it is not a step.
            LaboratoryError: the motion is refused or stopped.
        """
        if typed in ("help", "?", "h"):
            self._print(_HELP)
        elif typed == "home":
            self.home()
        elif typed == "where":
            self.where()
        elif typed:
            self.step(parse_step(typed))

    def where(self) -> None:
        """Print the positions of joints and tool."""
        here = self._arm.where()
        if here.joints:
            joints = "  ".join(f"{i}: {math.degrees(q):7.2f}" for i, q in enumerate(here.joints, start=1))
            self._print(f"joints  {joints} deg")
        numbers = here.tool.as_list
        place = "  ".join(f"{name} {1e3 * value:7.1f}" for name, value in zip("xyz", numbers[:3], strict=True))
        turn = "  ".join(f"r{name} {value:6.3f}" for name, value in zip("xyz", numbers[3:], strict=True))
        self._print(f"tool    {place} mm   {turn} rad")

    def step(self, step: JogStep) -> None:
        """Move one step; the first step along each axis and direction is confirmed."""
        known = (step.axis, step.amount > 0.0)
        if known not in self._known:
            if self._read(f"{step}: Enter moves, anything else doesn't > ").strip():
                self._print("not moved")
                return
            self._known.add(known)
        self._move(step)
        self.where()

    def home(self) -> None:
        """Bring all joints home by small steps, after a confirmation.

        Raises:
            JogError: the arm does not report its joints or its home position.
        """
        here = self._arm.where()
        if len(here.home) != len(here.joints) or not here.home:
            raise JogError("this arm doesn't tell its joints, or where home is; bring it home by steps")
        steps = steps_home(here.joints, here.home)
        if not steps:
            self._print("at home")
            return
        self._print(
            f"{len(steps)} small steps, one joint after the other, in nearly a straight line in the joints. Nothing "
            "knows what stands in the way: watch it, Ctrl-C stops it."
        )
        if self._read("type 'home' to begin > ").strip() != "home":
            self._print("not moved")
            return
        for number, step in enumerate(steps, start=1):
            self._print(f"{number}/{len(steps)}  {step}")
            self._move(step)
        self.where()

    def _move(self, step: JogStep) -> None:
        amount, speed = step.si
        self._arm.release()
        stoppable(self._arm, lambda: self._arm.jog(step.axis, amount, speed))


def jog(path: Path, *, armed: bool) -> None:
    """Move the arm by steps that are typed at the terminal.

    Args:
        path: laboratory file.
        armed: whether `--arm` was given.

    Raises:
        RefusalError: the arm can't be moved, or motion is not enabled.
    """
    spec = read_laboratory(path)
    if spec.arm is None:
        raise without_arm(path, spec, "steps are typed for an arm that a driver moves")
    require_flag(spec, armed=armed, again=f"decant jog {path} --arm")
    if not sys.stdin.isatty():
        raise RefusalError("jogging is typed at a terminal, step by step, with nothing piped into it", BAD_INPUT)
    with Refused(SafetyRecordError):
        accepted = accepted_checksum(path) if spec.mode == "hardware" else None
    if spec.mode == "hardware":
        confirm(spec, ["steps          one at a time, as typed: at most 10 deg at 5 deg/s, or 50 mm at 20 mm/s"])
    else:
        say(f"laboratory {spec.name}, virtual: nothing moves but numbers")
    with Refused(LaboratoryError, code=FAILED), reached(spec) as ready:
        assert ready.arm is not None
        soon = ready.with_values(arm=ready.arm.with_values(warning_time=WARNING_TIME))
        with connected(soon, accepted) as (arm, facts):
            say(f"{facts.model} {facts.serial}, {spec.mode}; nothing moves before a step is typed and confirmed")
            Jogging(arm, typed_line).run()
