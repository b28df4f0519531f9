"""Motion of an arm from the terminal: approval, connection, and the motions that an operator controls step by step.

- Hardware moves only after the operator has read what will move and has typed the laboratory's name. The arm is
  connected, its safety settings are compared, and Ctrl-C stops it. Virtual laboratories need no approval.
- `Jogging` is the session of `decant robot jog` and `decant robot home`; `parse_step` parses a line, `steps_home`
  computes the steps home.
- `EmptyCycle` is the cycle of `decant pour --empty`.
"""

from __future__ import annotations

import contextlib
import math
import re
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from actors.arm.arm_interface import NotAcceptedError
from actors.interfaces import LaboratoryError
from orchestrator.cli.console import FAILED, RefusalError, Refused, print_message, print_note
from orchestrator.runs.motion_approval import required_checksum
from sim_engine.settings.quantity import QuantityError, typed_number

if TYPE_CHECKING:
    from actors.arm.arm_interface import Arm, ArmFacts, Executed, PathReport, PlannedPour
    from actors.laboratory_settings import LaboratorySettings
    from orchestrator.runs.run_service import RunRequest

T = TypeVar("T")

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


def require_campaign_flag(request: RunRequest, *, enabled: bool, task: str) -> None:
    """Refuse a campaign that would move hardware without `--enable-motion`; note a flag without effect.

    Raises:
        RefusalError: exit code 2.
    """
    laboratory = request.campaign.laboratory
    if not request.pours:
        return
    require_flag(laboratory, enabled=enabled, again=f"decant {task} {request.campaign.source.name} --enable-motion")
    if enabled and laboratory.mode != "hardware":
        print_note(
            f"note: --enable-motion has no effect: laboratory {laboratory.name} is {laboratory.mode}, and moves nothing"
        )


def consent_to_motion(request: RunRequest, count: str = "", path: PathReport | None = None) -> str:
    """The operator's consent to the motion of a run: hardware needs a safety record and a typed name.

    Args:
        request: of the run.
        count: line with the number of pours; the stages' largest number unless given.
        path: of the only pour; None: paths from all over the actions are planned.

    Returns:
        The checksum of the accepted safety settings; '' without hardware.

    Raises:
        RefusalError: motion is not enabled (exit code 2).
    """
    from orchestrator.runs.motion_approval import campaign_pours, envelope, envelope_lines, pour_count, report_lines

    plan, laboratory = request.campaign, request.campaign.laboratory
    if not request.pours or laboratory.mode != "hardware":
        return ""
    lines = [count or f"pours          up to {pour_count(plan, request.stages)}"]
    if laboratory.places:
        names = ", ".join(place.name for place in laboratory.places)
        lines.append(f"vessels        carried between {names}; the gripper opens and closes")
    arm = laboratory.expected_arm
    assert arm is not None, "a laboratory of hardware has an arm"
    checksum = required_checksum(plan)
    if path is not None:
        confirm(laboratory, [*lines, *report_lines(path)])
        return checksum
    print_note(f"planning paths from all over the actions of {plan.name} …")
    paths = envelope(arm, campaign_pours(plan, request.stages))
    if not paths.reports:
        raise RefusalError(
            f"none of {len(paths.refused)} actions could be poured by this arm; the first: {paths.refused[0]}"
        )
    confirm(laboratory, [*lines, *envelope_lines(paths)])
    return checksum


def require_flag(laboratory: LaboratorySettings, *, enabled: bool, again: str) -> None:
    """Refuse to move hardware without `--enable-motion`.

    Raises:
        RefusalError: exit code 2.
    """
    if laboratory.mode == "hardware" and laboratory.arm is not None and not enabled:
        raise RefusalError(
            f"laboratory {laboratory.name} is hardware: {laboratory.arm.title} would move. Try it without moving first "
            f"('decant robot check', 'decant pour --dry-run'); then enable motion for this one run: {again}"
        )


def announce(laboratory: str, arm: str, lines: Sequence[str], lasting: str = "") -> None:
    """Print what hardware will do, before the laboratory's name is typed."""
    print_message(f"\nHARDWARE: laboratory {laboratory}, {arm}. This will move:\n")
    for line in lines:
        print_message(f"  {line}")
    print_message(
        "\nA software stop is not a safety function: keep the emergency stop within reach, and everybody out of the "
        f"box.\nType the laboratory's name ({laboratory}) to enable its motion{lasting}; anything else ends here."
    )


def confirm(laboratory: LaboratorySettings, lines: Sequence[str]) -> None:
    """Print what hardware will do, and require the laboratory's name to be typed.

    Raises:
        RefusalError: stdin is not a terminal, or another text was typed (exit code 2).
    """
    if not sys.stdin.isatty():
        raise RefusalError(
            f"laboratory {laboratory.name} is hardware: an operator enables its motion, who reads what it will do and "
            "types its name. That needs a terminal, with nothing piped into it"
        )
    assert laboratory.arm is not None, "a laboratory of hardware has an arm"
    announce(laboratory.name, laboratory.arm.title, lines, " for this run")
    termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)  # discard keys that were pressed before this text was shown
    print("> ", end="", file=sys.stderr, flush=True)
    typed = sys.stdin.readline()
    if typed.strip() != laboratory.name:
        raise RefusalError(f"motion is not enabled: '{typed.strip()}' was typed; nothing has moved")
    print_message(f"motion is enabled, for this run only: {laboratory.name}")


@contextlib.contextmanager
def connected(spec: LaboratorySettings, accepted: str | None) -> Iterator[tuple[Arm, ArmFacts]]:
    """The arm's driver, connected and locked; it is stopped and let go of in any case.

    Args:
        spec: of a laboratory that was reached.
        accepted: checksum of the safety settings that people have accepted; not asked for where nothing is hardware.

    Raises:
        RefusalError: the arm isn't ready, or its safety settings are others.
        LaboratoryError: it can't be reached.
    """
    from actors.arm.arm_settings import arm_kind

    assert spec.arm is not None
    cls, arguments = arm_kind(spec.arm).driver((accepted or "") if spec.mode == "hardware" else None)
    arm: Arm = cls(*arguments)
    try:
        with Refused(NotAcceptedError):
            facts = arm.connect()
        if facts.problem:
            raise RefusalError(
                f"{spec.arm.title}: {facts.problem}; 'decant robot check' says what to do about it", FAILED
            )
        yield arm, facts
    finally:
        arm.close()


def stoppable(arm: Arm, motion: Callable[[], T]) -> T:
    """Do something that moves the arm; Ctrl-C stops it, and the error that the stop causes is raised.

    The motion runs in a thread: an interrupt must reach the arm as an order to stop, not tear the driver apart.
    """
    result: list[T] = []
    failure: list[BaseException] = []

    def work() -> None:
        try:
            result.append(motion())
        except BaseException as error:
            failure.append(error)

    thread = threading.Thread(target=work, name="motion", daemon=True)
    thread.start()
    while thread.is_alive():
        try:
            thread.join(0.1)
        except KeyboardInterrupt:
            print_message("\nstopping the arm …")
            arm.stop()
    if failure:
        raise failure[0]
    return result[0]


def typed_line(prompt: str) -> str:
    """A line from the terminal; keys pressed before it was asked for are thrown away: they meant something else.

    Raises:
        EOFError: there are no more.
    """
    termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
    print(prompt, end="", file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        raise EOFError
    return line


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
    try:
        amount = float(typed_number(match["amount"], unit, largest=FARTHEST[unit]))
    except QuantityError as error:
        raise JogError(f"not a small step: {error}") from None
    if not amount:
        raise JogError("0 is not a step; it should be above or below 0")
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

    def __init__(self, arm: Arm, read: Callable[[str], str], tell: Callable[[str], None] = print_message) -> None:
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
        position = self._arm.where()
        if position.joints:
            joints = "  ".join(f"{i}: {math.degrees(q):7.2f}" for i, q in enumerate(position.joints, start=1))
            self._print(f"joints  {joints} deg")
        numbers = position.tool.as_list
        place = "  ".join(f"{name} {1e3 * value:7.1f}" for name, value in zip("xyz", numbers[:3], strict=True))
        turn = "  ".join(f"r{name} {value:6.3f}" for name, value in zip("xyz", numbers[3:], strict=True))
        self._print(f"tool    {place} mm   {turn} rad")

    def step(self, step: JogStep) -> None:
        """Move one step; the first step along each axis and direction is confirmed."""
        direction = (step.axis, step.amount > 0.0)
        if direction not in self._known:
            if self._read(f"{step}: Enter moves, anything else doesn't > ").strip():
                self._print("not moved")
                return
            self._known.add(direction)
        self._move(step)
        self.where()

    def home(self) -> bool:
        """Bring all joints home by small steps, after a confirmation.

        Returns:
            Whether the arm is at home; False if the operator did not confirm the motion.

        Raises:
            JogError: the arm does not report its joints or its home position.
            LaboratoryError: the motion is refused or stopped.
        """
        position = self._arm.where()
        if len(position.home) != len(position.joints) or not position.home:
            raise JogError("this arm does not report its joints or its home configuration; bring it home by steps")
        steps = steps_home(position.joints, position.home)
        if not steps:
            self._print("at home")
            return True
        self._print(
            f"{len(steps)} small steps, one joint after the other, in nearly a straight line in joint space. "
            "Obstacles are not checked: watch the arm. Ctrl-C stops it."
        )
        if self._read("type 'home' to begin > ").strip() != "home":
            self._print("not moved")
            return False
        for number, step in enumerate(steps, start=1):
            self._print(f"{number}/{len(steps)}  {step}")
            self._move(step)
        self.where()
        return True

    def _move(self, step: JogStep) -> None:
        amount, speed = step.si
        self._arm.release()
        stoppable(self._arm, lambda: self._arm.jog(step.axis, amount, speed))


class EmptyCycle:
    """One cycle of a pour with an empty pourer, with a person's consent to each movement of hardware."""

    def __init__(self, arm: Arm, path: PlannedPour, announcement: float, *, ask: bool) -> None:
        self._arm, self._path, self._announcement, self._ask = arm, path, announcement, ask

    def run(self) -> Executed:
        """Raises LaboratoryError where it is refused, or stopped."""
        self._arm.hands_in()
        self._consent(
            "Put the EMPTY pourer into the gripper, and take hands and tools out of the cell. Emergency stop in hand?"
        )
        self._moving("approach", lambda: self._arm.move_to_start(self._path))
        try:
            executed: Executed = self._moving("pour", lambda: self._arm.execute(self._path))
        except LaboratoryError as error:
            self._upright(error)
            raise
        self._moving("retreat", lambda: self._arm.retreat(self._path))
        return executed

    def _moving(self, name: str, motion: Callable[[], Any]) -> Any:
        print_message(f"{name} …")
        return stoppable(self._arm, motion)

    def _upright(self, error: LaboratoryError) -> None:
        """After a stop with the pourer tilted: upright and home, if somebody says so."""
        print_message(str(error))
        if not self._ask:
            return
        if not _yes("Find the cause and fix it. Shall the arm bring the pourer upright, slowly, and go home?"):
            return
        with contextlib.suppress(LaboratoryError):
            self._arm.release()
            print_message(f"ready again: {self._arm.recover() or 'nothing had to be done'}")
        self._released()
        self._moving("upright", self._arm.untilt)
        self._released()
        self._moving("retreat", lambda: self._arm.retreat(self._path))

    def _consent(self, text: str) -> None:
        if self._ask and not _yes(text):
            raise LaboratoryError("not confirmed; nothing has moved")
        self._released()

    def _released(self) -> None:
        left = self._announcement
        while left > 0.0:
            print_message(f"the arm moves in {left:.0f} s; Ctrl-C stops it" if left >= 0.5 else "the arm moves")
            time.sleep(min(left, 1.0))
            left -= 1.0
        self._arm.release()


def _yes(text: str) -> bool:
    print_message(f"\n{text}")
    return typed_line("type 'yes' to continue > ").strip().lower() == "yes"
