"""An arm for one command at the terminal: connected, its safety settings compared, stopped when somebody says so."""

from __future__ import annotations

import contextlib
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from actors.arm.arm_interface import NotAcceptedError
from orchestrator.cli.console import RefusalError, Refused, say
from orchestrator.runs.safety_approval import SafetyRecordError, read_record

if TYPE_CHECKING:
    from actors.arm.arm_interface import Arm, ArmFacts
    from actors.laboratory_settings import LaboratorySpec

T = TypeVar("T")


@contextlib.contextmanager
def connected(spec: LaboratorySpec, accepted: str | None) -> Iterator[tuple[Arm, ArmFacts]]:
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


def accepted_for(path: Path) -> str | None:
    """The checksum that people have accepted for a laboratory's file; None if none was.

    Raises:
        RefusalError: the record can't be read (exit code 2).
    """
    with Refused(SafetyRecordError):
        record = read_record(path)
    return None if record is None else record.checksum


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
