"""What the orchestrator may ask of a laboratory. Real hardware, the virtual bench and in-process twins implement these.

All are asynchronous; none of them knows what a strategy is.

The person at the bench, as actors know them: questions with answers. Values and a protocol.

One line of what `decant doctor` says about a thing of the laboratory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

from actors.optimizer.questions import Suggestion, SuggestProblem
from sim_engine.errors import DecantError
from sim_engine.outcome import PourMeasurement, RecordedFrames, SimulatedPour
from sim_engine.scene import PourTask, Scene


class LaboratoryError(DecantError):
    """Something in the laboratory can't do what was asked; the text is for the person who can mend it."""


class BenchLostError(LaboratoryError):
    """The bench's machine is gone: no pour can be made until it is back. Nobody knows what came of one under way."""


class NotPouredError(LaboratoryError):
    """The pour did not begin, and nothing was poured: it may be made once a person has seen to what stands here."""


class UnknownPourError(LaboratoryError):
    """A pour had begun and did not go as it should: a person has to say what came of it, and software never pours anew.

    The text says where it stopped, and what could still be weighed.
    """


class PourFailedError(LaboratoryError):
    """A pour came to nothing that could be weighed, and everybody knows why: it counts as failed."""


class InvalidActionError(LaboratoryError):
    """The vessels would touch, or the motion can't be made: refused before anything moved or was simulated."""


class UnreachablePlaceError(InvalidActionError):
    """The arm can't get to where a pour begins, whatever would be poured there."""


class SimulationError(LaboratoryError):
    """A simulation gave no result (diverged, or its worker died more often than it may)."""


class SimulatorPool(Protocol):
    """Several simulators that share a queue. Dead members are replaced and their jobs retried."""

    @property
    def size(self) -> int:
        """Number of simulators."""
        ...

    @property
    def separate(self) -> bool:
        """Whether simulators disturb nobody: they run in processes of their own, and what is cancelled ends at once."""
        ...

    async def simulate(self, task: PourTask) -> SimulatedPour:
        """Run one pour on the next free simulator.

        Cancelling the awaiting task cancels the simulation.

        Raises:
            InvalidActionError: the vessels touch, or the motion is impossible.
            SimulationError: no result after the retries allowed.
        """
        ...


@dataclass(frozen=True)
class PourProgress:
    """Where a pour on the bench stands: for people and the monitor, never for control.

    Attributes:
        checkpoint: one of 'operator', 'tare', 'approach', 'tilt', 'hold', 'return', 'settle', 'weigh', 'record'.
        fraction: 0 … 1 of the whole pour.
        tilt: of the pourer [rad], if known.
        balance: last reading [kg], if known.
        stable: whether the balance says that it is at rest, if known.
        joints: of the arm as last measured [rad]; empty where it doesn't tell.
        pourer: pose of the pourer in the world (x y z [m], qw qx qy qz), from an arm without joints; empty likewise.
        liquid: particles of this pour, told once by a virtual bench. Nobody who learns sees them.
    """

    checkpoint: str
    fraction: float
    tilt: float | None = None
    balance: float | None = None
    stable: bool | None = None
    joints: tuple[float, ...] = ()
    pourer: tuple[float, ...] = ()
    liquid: RecordedFrames | None = None


ProgressCallback = Callable[[PourProgress], None]


class Bench(Protocol):
    """Arm, balance and operator together: it can pour once and weigh what came of it."""

    @property
    def mode(self) -> str:
        """'virtual' or 'hardware'; part of every record."""
        ...

    async def pour(
        self, scene: Scene, action: Any, *, seed: int, progress: ProgressCallback | None = None
    ) -> PourMeasurement:
        """One whole pour: operator ready → tare → start pose → tilt → hold → return → settle → weigh → record.

        Args:
            action: `sim_engine.action.Action`.
            seed: hidden noise of a virtual bench; ignored by hardware.

        Raises:
            InvalidActionError: refused before anything moved.
            NotPouredError: it did not begin; nothing was poured, and it may be asked for again.
            UnknownPourError: it began, and a person has to say what came of it.
            LaboratoryError: it failed after something had moved, and counts as failed.
            BenchLostError: so is the bench; nothing more can be poured.
        """
        ...


class Optimizer(Protocol):
    """Proposes points. Keeps no state: the same question may be asked again after a death."""

    async def suggest(self, problem: SuggestProblem) -> Suggestion:
        """Answer a `SuggestProblem`."""
        ...


@dataclass(frozen=True)
class Notice:
    """Something that happened to a laboratory, in words for people.

    Attributes:
        level: how much it matters; a 'note' is written into the journal and not shown.
        text: whole sentences.
        asked: whether the operator's own screen shows it too, with a question.
    """

    level: Literal["note", "info", "warning", "error"]
    text: str
    asked: bool = False


@runtime_checkable
class Telling(Protocol):
    """A laboratory that tells what happens to it."""

    def listen(self, hear: Callable[[Notice], None]) -> None:
        """Be told from now on, and at once what has happened so far.

        Args:
            hear: called in the event loop; must not raise.
        """
        ...


@runtime_checkable
class Stoppable(Protocol):
    """A laboratory whose arm can be stopped by somebody who does not wait for it."""

    async def stop_arm(self) -> bool:
        """Stop what moves; it stays locked. Returns whether there is an arm.

        Raises:
            LaboratoryError: it can't be reached.
        """
        ...


class Laboratory(Protocol):
    """Everything a campaign needs, opened and closed as one (`async with`)."""

    @property
    def simulators(self) -> SimulatorPool:
        """The pool that all simulations of a campaign share."""
        ...

    @property
    def bench(self) -> Bench | None:
        """None where a campaign needs no pours (recorded data, planning).

        Raises:
            BenchLostError: its machine is gone.
        """
        ...

    @property
    def optimizer(self) -> Optimizer:
        """Proposes points."""
        ...

    async def __aenter__(self) -> Laboratory: ...

    async def __aexit__(self, *exc: object) -> None: ...


OperatorAnswer = Literal["done", "weight", "yes or no"]


@dataclass(frozen=True)
class OperatorQuestion:
    """Something to do and say, for the person at the bench.

    Attributes:
        text: what to do; whole sentences.
        wants: 'done' when it is done, a 'weight' with its unit, or 'yes' or 'no'.
        problem: why it is asked again; '' the first time.
        about: what it is about, for programs: a weighing's key, 'tare', 'start', 'recover' …
        hands: whether it invites hands into the cell; then no program runs on the controller until it is answered.
        details: numbers that belong to it, for screens and records; JSON-ready.
    """

    text: str
    wants: OperatorAnswer
    problem: str = ""
    about: str = ""
    hands: bool = True
    details: Mapping[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True)
class OperatorSpec:
    """Who answers, and how long they may take.

    Attributes:
        answers: 'person', at the terminal; or 'virtual', on a virtual bench only.
        time: refilling, placing, wiping, for a virtual one [s of bench time].
        reminder: after which a person is asked again [s].
        deadline: after which the question is given up [s]; nothing moves then, and nothing is lost.
    """

    answers: Literal["person", "virtual"] = "person"
    time: float = 85.0
    reminder: float = 120.0
    deadline: float = 1800.0


class Operator(Protocol):
    """Answers questions. Nothing moves without them."""

    async def ask(self, question: OperatorQuestion) -> str:
        """Put a question and await the answer: 'done', a weight as typed ('12.3 g'), 'yes' or 'no'.

        Raises:
            LaboratoryError: nobody answered in time, or the pour is given up.
        """
        ...

    async def announce(self, text: str, seconds: float) -> None:
        """Say that something moves in so many seconds [s of the clock]; that needs no answer, and returns at once."""
        ...


State = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class DeviceCheck:
    """One line of the table.

    Attributes:
        name: what was looked at.
        state: 'warn' lets pours be made, 'fail' doesn't.
        found: what was found.
        advice: what to do about it; '' where nothing is to be done.
    """

    name: str
    state: State
    found: str
    advice: str = ""
