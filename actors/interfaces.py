"""Interfaces between the orchestrator and a laboratory, and their errors.

- `SimulatorPool`, `Bench` and `Optimizer` are the parts of a `Laboratory`. Hardware, the virtual bench and in-process
  replacements for tests implement them. All are asynchronous.
- `Operator` answers an `OperatorQuestion` at the bench; `OperatorSettings` are its settings.
- `RaySettings` name an existing Ray cluster.
- `Notice` is a message from a laboratory, `DeviceCheck` one line of `decant robot check`.

None of these depends on strategies.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

from pydantic import AfterValidator, Strict
from pydantic_core import PydanticCustomError

from actors.optimizer.questions import Suggestion, SuggestionQuery
from sim_engine.errors import DecantError
from sim_engine.outcome import PourMeasurement, RecordedFrames, SimulatedPour
from sim_engine.scene import PourTask, Scene
from sim_engine.settings.model import Example, Name, Problems, Settings
from sim_engine.settings.quantity import Quantity


class LaboratoryError(DecantError):
    """The laboratory cannot do what was requested; the text is for the person who can fix it."""

    exit_code = 1


class BenchLostError(LaboratoryError):
    """The bench's machine is lost: no pour is possible until it is back. The outcome of a running pour is unknown."""


class NotPouredError(LaboratoryError):
    """The pour did not begin, and nothing was poured.

    It can be repeated once the operator has removed the stated cause.
    """


class LinkLostError(NotPouredError):
    """As stated, on a virtual bench, whose host was too slow for the arm's heartbeat, or which lost a connection.

    A restarted bench can repeat it.
    """


class UnknownPourError(LaboratoryError):
    """A pour began and did not end as planned. A person has to state its outcome; software never repeats the pour.

    The text gives the point where it stopped, and the weights that could still be measured.
    """


class PourFailedError(LaboratoryError):
    """A pour gave nothing that could be weighed, and the reason is known: it counts as failed."""


class InvalidActionError(LaboratoryError):
    """The vessels would touch, or the motion is impossible: refused before anything moved or was simulated.

    Args:
        text: the reason.
        problems: all reasons, each with the name of the vessel that it is about, or ''; by default the text.
    """

    def __init__(self, text: str = "", problems: Mapping[str, str] = {}) -> None:
        super().__init__(text)
        self.problems = dict(problems) or {text: ""}


class UnreachablePlaceError(InvalidActionError):
    """The arm cannot reach the place where a pour begins, whatever is poured there."""


class SimulationError(LaboratoryError):
    """A simulation gave no result: it diverged, or its worker died more often than allowed."""


class SimulatorPool(Protocol):
    """Several simulators that share a queue. Dead workers are replaced and their jobs retried."""

    @property
    def size(self) -> int:
        """Number of simulators."""
        ...

    @property
    def separate(self) -> bool:
        """Whether simulators run in separate processes: they then do not disturb others, and a cancelled job ends at
        once.
        """
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
class DoseProgress:
    """Progress of a wanted amount.

    Attributes:
        phase: 'check', 'approach', 'pour', 'return', 'settle' or 'done'.
        target: wanted amount [kg].
        amount, deviation: estimated amount past the lip, and its standard deviation [kg].
        flow: estimated [kg/s].
        reading: of the balance, without the receiver [kg]; None before the first one.
    """

    phase: str
    target: float
    amount: float
    deviation: float
    flow: float
    reading: float | None


@dataclass(frozen=True)
class PourProgress:
    """Progress of a pour on the bench, for display only, never for control.

    Attributes:
        checkpoint: one of 'operator', 'tare', 'approach', 'tilt', 'hold', 'return', 'settle', 'weigh', 'record'.
        fraction: 0 … 1 of the whole pour.
        tilt: of the pourer [rad], if known.
        balance: last reading [kg], if known.
        stable: whether the balance reports a stable value, if known.
        joints: of the arm as last measured [rad]; empty if the arm does not report them.
        pourer: pose of the pourer in the world (x y z [m], qw qx qy qz), from an arm without joints; else empty.
        liquid: particles of this pour, reported by a virtual bench: once, or in a dose those since the last report.
            Hidden from the learning algorithms.
        dose: of a wanted amount; None in other pours.
    """

    checkpoint: str
    fraction: float
    tilt: float | None = None
    balance: float | None = None
    stable: bool | None = None
    joints: tuple[float, ...] = ()
    pourer: tuple[float, ...] = ()
    liquid: RecordedFrames | None = None
    dose: DoseProgress | None = field(default=None, metadata={"written": "if set"})


ProgressCallback = Callable[[PourProgress], None]


@dataclass(frozen=True)
class DoseKnowledge:
    """What earlier doses have shown about a source vessel and a balance; see `actors.dosing.dose_estimator`.

    Before the first dose it may be what a calibration has shown; then `doses` is 0.

    Attributes:
        onset_flow: means of the onset bias [rad] and of the logarithm of the flow factor.
        covariance: of these two, (2, 2) by rows.
        lag: mean and standard deviation of the logarithm of the balance's lag, and of the shape of its filter; None if
            the lag is to be measured again.
        aim: mass that arrives after the predicted end of the flow [kg].
        doses: number of doses.
        display: numbers of `actors.dosing.display_belief.DisplayBelief`; empty if nothing is known.
    """

    onset_flow: tuple[float, ...]
    covariance: tuple[float, ...]
    lag: tuple[float, ...] | None
    aim: float
    doses: int
    display: tuple[float, ...] = ()


@dataclass(frozen=True)
class DoseSource:
    """The vessel that a dose is poured from.

    Attributes:
        name: under which its content is tracked.
        mass: expected content before the dose [kg].
        deviation: standard deviation of the content [kg].
        fill: it is filled to this content before the dose, by the operator or a refill device.
        constants: number from which a simulated bench draws what stays the same over a series.
        knowledge: of earlier doses, or of a calibration; None if there is none.
        before: content before this filling [kg]; None if it is not known, or nothing is filled.
        vessel: its identity in a laboratory with places: the name of the place where it belongs ('source/ethanol').
            '': the only vessel from which that laboratory pours.
    """

    name: str
    mass: float
    deviation: float
    fill: bool
    constants: int
    knowledge: DoseKnowledge | None = None
    before: float | None = field(default=None, metadata={"written": "if set"})
    vessel: str = field(default="", metadata={"written": "if set"})

    @property
    def unused(self) -> bool:
        """Whether no dose was poured from it before: its lip is dry."""
        return self.knowledge is None or self.knowledge.doses == 0


@dataclass(frozen=True)
class DoseTarget:
    """A wanted amount in the receiver; the tilt is then decided while the liquid flows.

    In a laboratory with places the arm carries the vessels of the dose. A vessel's identity is the name of the place
    where it belongs; all vessels of a series are in `LaboratorySettings.vessels`. The arm puts the cup on the balance
    unless it stands there, weighs it, takes the source, doses, puts the source back and weighs the cup again. What is
    in the cup already belongs to its tare. A cup that has some of this liquid already is refused, and so is one whose
    content is UNKNOWN. Without places the identities are not used.

    Attributes:
        amount: [kg].
        limit: excess that may be exceeded with a probability of 1 % only [kg].
        position: name of the receiver's place, for the operator.
        source: of the dose; None: a full pourer, about which nothing is known.
        cup: identity of the receiver ('rack/A1'); '': the only one, exchanged for an empty one before each dose.
        stays: the next dose is poured into this cup, too: it stays on the balance.
        emptied: the cup is emptied first, at the waste place or by the operator.
        held: what earlier doses of the same mixture have left in the receiver [kg]; None: it is empty.
    """

    amount: float
    limit: float = 1e-3
    position: str = ""
    source: DoseSource | None = None
    cup: str = field(default="", metadata={"written": "if set"})
    stays: bool = field(default=False, metadata={"written": "if set"})
    emptied: bool = field(default=False, metadata={"written": "if set"})
    held: float | None = field(default=None, metadata={"written": "if set"})

    def is_met_by(self, amount: float) -> bool:
        """Whether a weighed amount [kg] lies within the tolerance."""
        return abs(amount - self.amount) <= self.limit + 1e-9


class DoseEnd(StrEnum):
    """How a dose ended; written into its measurement's notes."""

    REACHED = "reached"
    """Weighed within its tolerance; only then."""
    MISSED = "missed"
    """Weighed beyond its tolerance, although nothing else stopped it."""
    SHORT = "short"
    """More than the smallest dependable amount is missing, and no further top-up is allowed."""
    SOURCE_EMPTY = "source empty"
    STREAM_MISSED = "stream misses the receiver"
    UNSTABLE = "balance unstable"
    RECEIVER_MISSING = "receiver missing or different"
    CONNECTION_LOST = "connection to the balance lost"
    TIME_LIMIT = "time limit"


class Bench(Protocol):
    """Arm, balance and operator together: it makes one pour and weighs its outcome."""

    @property
    def mode(self) -> str:
        """'virtual' or 'hardware'; part of every record."""
        ...

    async def pour(
        self,
        scene: Scene,
        action: Any,
        *,
        seed: int,
        progress: ProgressCallback | None = None,
        dose: DoseTarget | None = None,
    ) -> PourMeasurement:
        """One whole pour: operator ready → tare → start pose → tilt → hold → return → settle → weigh → record.

        Args:
            action: `sim_engine.action.Action`.
            seed: of the hidden noise of a virtual bench; ignored by hardware.
            dose: wanted amount; None: the action is the whole motion.

        Raises:
            InvalidActionError: refused before anything moved.
            NotPouredError: it did not begin; nothing was poured, and it may be requested again.
            UnknownPourError: it began, and a person has to state its outcome.
            LaboratoryError: it failed after something had moved, and counts as failed.
            BenchLostError: the bench is lost; no further pour is possible.
        """
        ...


@runtime_checkable
class Answering(Protocol):
    """A bench with an operator who decides how a campaign goes on."""

    async def ask(self, question: OperatorQuestion) -> str:
        """Ask the operator. A consent for unattended pours ends with it.

        Raises:
            LaboratoryError: no answer came.
        """
        ...


class Optimizer(Protocol):
    """Proposes points. It is stateless: after a worker's death the same request may be made again."""

    async def suggest(self, query: SuggestionQuery) -> Suggestion:
        """Compute the suggestion for a `SuggestionQuery`."""
        ...


@dataclass(frozen=True)
class Notice:
    """A message from a laboratory to the user.

    Attributes:
        level: importance; a 'note' is written into the journal and not displayed.
        text: whole sentences.
        asked: whether the operator's own screen shows it too, with a question.
        about: what it records of a night, see `orchestrator.records.events.LogLine`; None for all else.
    """

    level: Literal["note", "info", "warning", "error"]
    text: str
    asked: bool = False
    about: str | None = None


@runtime_checkable
class Telling(Protocol):
    """A laboratory that publishes notices."""

    def listen(self, hear: Callable[[Notice], None]) -> None:
        """Subscribe to future notices, and receive the previous ones at once.

        Args:
            hear: called in the event loop; must not raise.
        """
        ...


@runtime_checkable
class Restartable(Protocol):
    """A laboratory whose virtual bench can be restarted after the connection to one of its devices was lost."""

    async def restart_bench(self) -> None:
        """End the devices of the bench and their emulators, and start new ones.

        Raises:
            LaboratoryError: they do not start.
        """
        ...


@runtime_checkable
class Stoppable(Protocol):
    """A laboratory whose arm can be stopped by a task that does not own the pour."""

    async def stop_arm(self) -> bool:
        """Stop any motion; the arm stays locked. Returns whether there is an arm.

        Raises:
            LaboratoryError: it cannot be reached.
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
        """None if the campaign needs no pours (recorded data, planning).

        Raises:
            BenchLostError: the bench's machine is lost.
        """
        ...

    @property
    def optimizer(self) -> Optimizer:
        """The optimiser, which proposes points."""
        ...

    async def __aenter__(self) -> Laboratory: ...

    async def __aexit__(self, *exc: object) -> None: ...


OperatorAnswer = Literal["done", "weight", "yes or no", "option"]


@dataclass(frozen=True)
class OperatorQuestion:
    """An instruction or question for the operator at the bench.

    Attributes:
        text: what to do; whole sentences.
        wants: 'done' when it is done, a 'weight' with its unit, 'yes' or 'no', or an 'option'.
        problem: why the question is repeated; '' the first time.
        about: its subject, for programs: a weighing's key, 'tare', 'start', 'recover' …
        hands: whether the operator reaches into the cell; then no program runs on the controller until the answer.
        details: numbers for screens and records; JSON-ready.
        options: the possible answers, if it wants one of them.
    """

    text: str
    wants: OperatorAnswer
    problem: str = ""
    about: str = ""
    hands: bool = True
    details: Mapping[str, float | str] = field(default_factory=dict)
    options: tuple[str, ...] = ()


AnswerTime = Annotated[float, Quantity("s", "30 min", 0.0, 7 * 86400.0, positive=True)]


class OperatorSettings(Settings):
    """The operator, who refills, wipes and places the vessels, and confirms each step."""

    answers: Literal["person", "virtual"] | None = None
    """A 'person' at the terminal, or a 'virtual' operator; unless given, it follows from the laboratory's mode."""

    time: Annotated[float, Quantity("s", "85 s", 0.0, 3600.0)] = 85.0
    """Total time of a virtual operator for one pour, in bench time."""

    reminder: AnswerTime = 120.0
    """Time after which an open question is repeated."""

    deadline: AnswerTime = 1800.0
    """Time after which an open question is abandoned: nothing moves then, and the campaign pauses."""

    def check_values(self, problems: Problems) -> None:
        """See `Settings.check_values`."""
        if self.reminder > self.deadline:
            problems.add("comes after the deadline; it should be shorter", "reminder")

    def check_hardware(self, problems: Problems) -> None:
        """Add a problem for each key of a virtual operator, who cannot stand next to a real arm."""
        if self.answers == "virtual":
            problems.add(
                "where an arm moves, a person has to say that no hand is in its way; write 'person', or remove the key",
                "answers",
            )
        if "time" in self.model_fields_set:
            problems.add("is a virtual operator's; a person takes the time that it takes; remove the key", "time")


def _address(text: str) -> str:
    host, colon, port = text.rpartition(":")
    if colon and re.fullmatch(r"[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]", host) and port.isdigit() and 0 < int(port) < 65536:
        return text
    raise PydanticCustomError(
        "ray_address",
        "{text} should be host:port of the cluster's head as 'ray start --head' prints it, e.g. 10.0.0.1:6379",
        {"text": repr(text)},
    )


RayAddress = Annotated[str, Strict(), AfterValidator(_address), Example("10.0.0.1:6379")]


class RaySettings(Settings):
    """An existing Ray cluster; Decant connects to it and does not stop it."""

    address: RayAddress
    """Address of its head node, host:port."""

    bench_resource: Name = "decant_bench"
    """Custom resource of the node that runs arm, balance and bench; set it with 'ray start --resources'."""


class Operator(Protocol):
    """Answers questions. Nothing moves without them."""

    async def ask(self, question: OperatorQuestion) -> str:
        """Put a question and await the answer: 'done', a weight as typed ('12.3 g'), 'yes' or 'no'.

        Raises:
            LaboratoryError: there was no answer in time, or the pour was given up.
        """
        ...

    async def announce(self, text: str, seconds: float) -> None:
        """Announce a motion that begins in so many seconds [s of the clock]. Needs no answer and returns at once."""
        ...


State = Literal["ok", "warn", "fail"]


@dataclass(frozen=True)
class DeviceCheck:
    """One line of the table of `decant robot check`.

    Attributes:
        name: of the checked item.
        state: 'warn' permits pours, 'fail' does not.
        found: the result.
        advice: the remedy; '' if none is needed.
    """

    name: str
    state: State
    found: str
    advice: str = ""
