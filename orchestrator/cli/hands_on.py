"""Access to an arm for one command at the terminal: connection, check of the safety settings, and stop with Ctrl-C."""

from __future__ import annotations

import contextlib
import dataclasses
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
def reached(spec: LaboratorySpec) -> Iterator[LaboratorySpec]:
    """Yield the laboratory with the addresses of its devices; a virtual one is started for the duration of the context.

    Raises:
        LaboratoryError: a required package is not installed, or an emulator does not start.
    """
    from actors.laboratory import check_bench_packages

    check_bench_packages(spec)
    if spec.mode == "hardware":
        yield spec
        return
    from actors.bench.device_emulators import BenchEmulators

    assert spec.arm is not None
    stand_ins = BenchEmulators(spec.arm, None if spec.balance is None else spec.balance.device)
    try:
        where = stand_ins.found()
        stand_ins.install()
        balance = spec.balance
        if balance is not None:
            balance = dataclasses.replace(balance, device=where.balance)
        yield dataclasses.replace(spec, arm=where.arm, balance=balance)
    finally:
        stand_ins.close()


@contextlib.contextmanager
def connected(spec: LaboratorySpec, accepted: str | None) -> Iterator[tuple[Arm, ArmFacts]]:
    """Yield the arm's connected driver and facts; the arm is stopped and released in any case.

    Args:
        spec: settings of a laboratory from `reached`.
        accepted: checksum of the accepted safety settings; not used if the laboratory is virtual.

    Raises:
        RefusalError: the arm isn't ready, or its safety settings differ.
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
    """Return the checksum of the accepted safety settings for a laboratory's file, or None.

    Raises:
        RefusalError: the record can't be read (exit code 2).
    """
    with Refused(SafetyRecordError):
        record = read_record(path)
    return None if record is None else record.checksum


def stoppable(arm: Arm, motion: Callable[[], T]) -> T:
    """Run a motion in a thread; Ctrl-C stops the arm, and the resulting error is raised.

    The motion runs in a thread, since an interrupt must stop the arm instead of ending the driver in the middle of a
    call.
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
    """Read a line from the terminal. Keys pressed before the prompt are discarded.

    Raises:
        EOFError: end of input.
    """
    termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
    print(prompt, end="", file=sys.stderr, flush=True)
    line = sys.stdin.readline()
    if not line:
        raise EOFError
    return line
