"""What stands behind wires: the arm's worker, the controller, the balance. Real processes, real sockets, a real line.

The liquid is a formula of what the arm executed, and the balance shows no noise, so that two undisturbed runs are the
same; time is scaled. A person mends what is broken: a balance whose process died is another one on the same line.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

from actors.bench import bench_operators
from actors.bench.bench_operators import VirtualOperator
from actors.interfaces import OperatorQuestion, OperatorSettings
from actors.laboratory import InProcessLaboratory
from orchestrator.records.journal import Kind
from tests.end_to_end.test_wired_campaign import write_wired
from tests.reliability import strikes
from tests.reliability.case import CUT, KILLED, STOPPED, Case, Point, every, first_of_kind
from tests.reliability.formula import Formula
from tests.reliability.rig import Life, Rig
from tests.support.wired_bench import wired_spec

PACE = 30.0

ROUTINE = ("tray_wiped", "pourer_empty", "pourer_full", "set_up", "start", "pourer_after")
"""What the person at the bench is asked in every pour."""


class WiredRig(Rig):
    """A campaign on the shipped virtual laboratory, in scaled time."""

    tilts = True
    process = ""
    """What stands on the command line of what is struck."""

    emulators: Any = None
    """Of the laboratory that is open, in the program's process."""

    def write_campaign(self, folder: Path) -> Path:
        write_wired(folder)
        path = folder / "small.yaml"
        path.write_text(path.read_text("utf-8").replace("on_unknown: repeat", "on_unknown: ask"), encoding="utf-8")
        return path

    def cases(self) -> list[Case]:
        """Killed at the first moment of each kind, and in D3's first pour at each; stopped and cut in that."""
        pour = [point for point in during(self.points, "deployment:narrow", 1) if point in self.up and its(point)]
        killed = sorted({*first_of_kind(self.up), *pour}, key=self.points.index)
        return [
            *every(self.target, KILLED, killed),
            *every(self.target, STOPPED, pour),
            *every(self.target, CUT, pour),
        ]

    @contextlib.asynccontextmanager
    async def laboratory(self, life: Life) -> AsyncIterator[Any]:
        spec = wired_spec(
            pace=PACE,
            hurried=True,
            operator=OperatorSettings(answers="virtual", time=2.0, reminder=60.0, deadline=300.0),
        )
        bench_operators.SCATTER = 0.0  # each refilling is one of chance, and after a restart there is one more
        async with InProcessLaboratory(spec, Formula, pours=True) as opened:
            attend(opened, life)
            assert opened.opened is not None
            self.emulators = opened.opened.emulators
            yield _Open(opened)

    def pids(self) -> list[int]:
        return strikes.descendants(self.process)


class _Open:
    """A laboratory that is open already."""

    def __init__(self, laboratory: InProcessLaboratory) -> None:
        self._laboratory = laboratory

    def __getattr__(self, name: str) -> Any:
        return getattr(self._laboratory, name)

    async def __aenter__(self) -> Any:
        return self._laboratory

    async def __aexit__(self, *exc: object) -> None:
        pass


def during(points: Sequence[Point], stage: str, pour: int) -> list[Point]:
    """Writes from the beginning of a stage's pour to its end."""
    begin = points.index((f"{stage}: {Kind.POUR_STARTED}", pour))
    end = points.index((f"{stage}: {Kind.POUR_FINISHED}", pour))
    return list(points[begin : end + 1])


def its(point: Point) -> bool:
    """Whether a write belongs to a pour, and not to what is simulated beside it."""
    return point[0].startswith("campaign: note") or ": pour." in point[0] or point[0].endswith("tilting")


def attend(laboratory: InProcessLaboratory, life: Life) -> None:
    """Stand beside the operator: write down what is not routine, and mend the balance."""
    opened = laboratory.opened
    assert opened is not None
    assert isinstance(opened.operator, VirtualOperator)
    operator, emulators = opened.operator, opened.emulators
    ask = operator.ask

    async def attended(question: OperatorQuestion) -> str:
        if question.problem or question.about not in ROUTINE:
            life.note("heard", question.about)
        if question.problem:
            life.note("told", question.problem)
            await mend(emulators)
        return await ask(question)

    operator.ask = attended  # type: ignore[method-assign]


async def mend(emulators: Any) -> None:
    """What a person does about a balance: plug it in again."""
    with contextlib.suppress(Exception):
        await emulators.order("plug")


class WorkerRig(WiredRig):
    target, process = "worker", "actors.arm.ur.rtde_worker"


class ControllerRig(WiredRig):
    target, process = "controller", "actors.emulators.ur_controller"


class BalanceRig(WiredRig):
    """Its line is a pseudo-terminal, not a socket: cut is unplugged."""

    target, process = "balance", "actors.emulators.serial_balance"

    def strike(self, fault: str, life: Life) -> None:
        if fault != CUT:
            super().strike(fault, life)
            return
        task = asyncio.get_running_loop().create_task(self.emulators.order("unplug"))
        self.unplugging = task  # somebody has to hold it
