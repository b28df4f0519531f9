"""Approval and control of an arm's motion for one command at the terminal.

Hardware moves only after the operator has read what will move and has typed the laboratory's name. The arm is
connected, its safety settings are compared, and Ctrl-C stops it. Virtual laboratories need no approval.
"""

from __future__ import annotations

import contextlib
import sys
import termios
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, TypeVar

from actors.arm.arm_interface import NotAcceptedError
from orchestrator.cli.console import BAD_INPUT, RefusalError, Refused, mention, say
from orchestrator.runs.safety_approval import SafetyRecordError, required_checksum

if TYPE_CHECKING:
    from actors.arm.arm_interface import Arm, ArmFacts
    from actors.laboratory_settings import LaboratorySettings
    from orchestrator.runs.stages import StageDefinition
    from orchestrator.strategies.campaign_plan import CampaignPlan

T = TypeVar("T")


def arm_campaign(plan: CampaignPlan, stages: Sequence[StageDefinition], *, armed: bool, verb: str) -> str | None:
    """Check the approval of motion before a campaign: hardware needs the flag, a safety record, and a typed name.

    Args:
        plan: campaign with its laboratory.
        stages: stages to run.
        armed: whether `--arm` was given.
        verb: name of the command, for messages.

    Returns:
        The checksum of the accepted safety settings; None without hardware.

    Raises:
        RefusalError: motion is not enabled (exit code 2).
    """
    from orchestrator.runs.motion_envelope import campaign_pours, envelope, envelope_lines, pour_count

    laboratory = plan.laboratory
    if not any(stage.pours for stage in stages):
        return None
    if laboratory.mode != "hardware":
        if armed:
            mention(
                f"note: --arm has nothing to arm: laboratory {laboratory.name} is {laboratory.mode}, and moves nothing"
            )
        return None
    require_flag(laboratory, armed=armed, again=f"decant {verb} {plan.source.name} --arm")
    assert laboratory.arm is not None
    with Refused(SafetyRecordError):
        checksum = required_checksum(plan)
    mention(f"planning paths from all over the actions of {plan.name} …")
    found = envelope(laboratory.arm, campaign_pours(plan, stages))
    if not found.reports:
        raise RefusalError(
            f"none of {len(found.refused)} actions could be poured by this arm; the first: {found.refused[0]}",
            BAD_INPUT,
        )
    confirm(laboratory, [f"pours          up to {pour_count(plan, stages)}", *envelope_lines(found)])
    return checksum


def require_flag(laboratory: LaboratorySettings, *, armed: bool, again: str) -> None:
    """Refuse to move hardware without `--arm`.

    Raises:
        RefusalError: exit code 2.
    """
    if laboratory.mode == "hardware" and not armed:
        raise RefusalError(
            f"laboratory {laboratory.name} is hardware: an arm would move. Try it without moving first "
            f"('decant doctor', 'decant pour --dry-run'); then arm this one run: {again}",
            BAD_INPUT,
        )


def announce(laboratory: str, arm: str, lines: Sequence[str], lasting: str = "") -> None:
    """Print what hardware will do, before the laboratory's name is typed."""
    say(f"\nHARDWARE: laboratory {laboratory}, {arm}. This will move:\n")
    for line in lines:
        say(f"  {line}")
    say(
        "\nA software stop is not a safety function: keep the emergency stop within reach, and everybody out of the "
        f"box.\nType the laboratory's name ({laboratory}) to arm it{lasting}; anything else ends here."
    )


def confirm(laboratory: LaboratorySettings, lines: Sequence[str]) -> None:
    """Print what hardware will do, and require the laboratory's name to be typed.

    Raises:
        RefusalError: stdin is not a terminal, or another text was typed (exit code 2).
    """
    assert laboratory.arm is not None
    if not sys.stdin.isatty():
        raise RefusalError(
            f"laboratory {laboratory.name} is hardware, and is armed by somebody who reads what it will do and types "
            "its name: that needs a terminal, with nothing piped into it",
            BAD_INPUT,
        )
    announce(laboratory.name, laboratory.arm.title, lines, " for this run")
    termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)  # discard keys that were pressed before this text was shown
    print("> ", end="", file=sys.stderr, flush=True)
    typed = sys.stdin.readline()
    if typed.strip() != laboratory.name:
        raise RefusalError(f"not armed: '{typed.strip()}' was typed; nothing has moved", BAD_INPUT)
    say(f"armed, for this run only: {laboratory.name}")


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
    assert spec.arm is not None
    cls, arguments = spec.arm.driver((accepted or "") if spec.mode == "hardware" else None)
    arm: Arm = cls(*arguments)
    try:
        with Refused(NotAcceptedError):
            facts = arm.connect()
        if facts.problem:
            raise RefusalError(f"{spec.arm.title}: {facts.problem}; 'decant doctor' says what to do about it")
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
            say("\nstopping the arm …")
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
