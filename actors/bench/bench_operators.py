"""The operator of a bench: questions with reminders, a deadline and a log, and the operators of a virtual bench.

- `OperatorQuestions` forwards questions to one operator and records each answer as an `AnsweredQuestion`.
- `VirtualOperator` carries out the requested steps, takes a person's time for them, and answers by itself.
- `PlayedOperator` passes the questions to a person, and virtual hands carry out the steps.
- `Hands` changes the `BenchContents`: the objects and the liquid on a virtual bench. The load on the balance follows
  from them.

The wording of the questions belongs to `actors.bench.consent` and `actors.balance.weighing_plan`.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from actors.balance.weighing_plan import Placement
from actors.interfaces import LaboratoryError, Notice, Operator, OperatorQuestion, OperatorSettings


@dataclass(frozen=True)
class AnsweredQuestion:
    """A question and its answer.

    Attributes:
        about: subject of the question.
        answer: as given; '' if none was.
        after: time until the answer [s of the clock].
        problem: why the question was repeated; '' the first time.
    """

    about: str
    answer: str
    after: float
    problem: str = ""


class OperatorQuestions:
    """Asks one operator.

    Args:
        operator: answers the questions.
        spec: reminder and deadline.
        tell: receives notices for the journal: questions, answers, missing answers, and problems as warnings. The
            operator's own screen shows questions with their problems, and reminders.
        time_scale: bench seconds per second of the clock; for a virtual operator the times of `spec` are divided by it.
    """

    def __init__(
        self, operator: Operator, spec: OperatorSettings, tell: Callable[[Notice], None], time_scale: float = 1.0
    ) -> None:
        self._operator, self._notify = operator, tell
        self._on_screen = spec.answers == "person"
        pace = time_scale if spec.answers == "virtual" else 1.0
        self._reminder, self._deadline = spec.reminder / pace, spec.deadline / pace
        self.log: list[AnsweredQuestion] = []

    async def ask(self, question: OperatorQuestion) -> str:
        """Ask a question and wait for the answer.

        Raises:
            LaboratoryError: no answer came before the deadline.
            LaboratoryError: the operator gave up.
        """
        if question.problem:
            self._notify(Notice("warning", question.problem, asked=self._on_screen))
        begun, answer = time.monotonic(), ""
        answering = asyncio.ensure_future(self._operator.ask(question))
        try:
            answer = await self._await(answering, question, begun)
            return answer
        finally:
            answering.cancel()
            await asyncio.wait({answering})
            if not answering.cancelled():
                answering.exception()
            after = time.monotonic() - begun
            self.log.append(AnsweredQuestion(question.about, answer, after, question.problem))
            reply = f"'{answer}' after {after:.1f} s" if answer else f"no answer within {after:.1f} s"
            text = f"operator ({question.about}): {question.text} → {reply}"
            self._notify(Notice("note", text, about=question.about or None))

    async def announce(self, text: str, seconds: float) -> None:
        """Announce that something moves after the given time [s of the clock]."""
        self._notify(Notice("note", f"operator told: {text}"))
        await self._operator.announce(text, seconds)

    def take_log(self) -> list[dict[str, Any]]:
        """Return the questions and answers since the last call, JSON-ready."""
        log, self.log = self.log, []
        return [{k: round(v, 3) if isinstance(v, float) else v for k, v in asdict(e).items() if v != ""} for e in log]

    async def _await(self, answering: asyncio.Future[str], question: OperatorQuestion, begun: float) -> str:
        while True:
            left = begun + self._deadline - time.monotonic()
            done, _ = await asyncio.wait({answering}, timeout=max(min(self._reminder, left), 0.0))
            if done:
                return answering.result()
            waited = time.monotonic() - begun
            if waited >= self._deadline:
                raise LaboratoryError(f"no answer within {self._deadline:g} s: '{question.text}'")
            unseen: Literal["note", "warning"] = "note" if self._on_screen else "warning"
            self._notify(Notice(unseen, f"still waiting, for {waited:.0f} s now: {question.text}"))


DRY = {"dry pourer": 0.312, "pourer": 0.312, "receiver": 0.186, "tray": 0.428}
"""Dry masses [kg] of glass beakers and a steel tray; all differ, so that no error cancels by chance."""


@dataclass
class BenchContents:
    """Vessels and tray around a balance.

    Attributes:
        placement: where the balance stands.
        on_balance: names of the vessels that stand on it, or 'tray'.
        on_tray: liquid [kg].
        stands: names of the places where vessels stand that the arm carries.
        spilt_back: liquid that misses the pourer the next time the receiver is poured back [kg].
        liquids, dry: liquid in the vessels, and their own masses [kg].
        pourer, receiver: names of the two vessels of the present pour.
    """

    placement: Placement
    on_balance: set[str] = field(default_factory=set)
    on_tray: float = 0.0
    stands: dict[str, str] = field(default_factory=dict)
    spilt_back: float = 0.0
    liquids: dict[str, float] = field(default_factory=dict)
    dry: dict[str, float] = field(default_factory=lambda: dict(DRY))
    pourer: str = "pourer"
    receiver: str = "receiver"

    @property
    def in_pourer(self) -> float:
        """Liquid in the pourer [kg]."""
        return self.liquids.get(self.pourer, 0.0)

    @in_pourer.setter
    def in_pourer(self, mass: float) -> None:
        self.liquids[self.pourer] = mass

    @property
    def in_receiver(self) -> float:
        """Liquid in the receiver [kg]."""
        return self.liquids.get(self.receiver, 0.0)

    @in_receiver.setter
    def in_receiver(self, mass: float) -> None:
        self.liquids[self.receiver] = mass

    def move(self, vessel: str, place: str, *, on_balance: bool) -> None:
        """Move a vessel to a place, or into the gripper ('')."""
        self.stands[vessel] = place
        (self.on_balance.add if on_balance else self.on_balance.discard)(vessel)

    def pour_back(self, film: float) -> None:
        """Pour the receiver back into the pourer; a film [kg] stays."""
        left = max(self.in_receiver - film, 0.0)
        spilt, self.spilt_back = min(self.spilt_back, left), 0.0
        self.in_receiver -= left
        self.in_pourer += left - spilt
        self.on_tray += spilt

    def mass(self, name: str) -> float:
        """Mass of an object with its contents [kg]."""
        return self.dry[name] + (self.on_tray if name == "tray" else self.liquids.get(name, 0.0))

    @property
    def carried(self) -> float:
        """Mass on the balance [kg]."""
        return sum(self.mass(name) for name in self.on_balance)

    def receive(self, spilled: float, retained: float) -> None:
        """Apply the masses of a pour that is over or was aborted.

        Args:
            spilled: mass outside the receiver [kg].
            retained: mass left in the pourer [kg].
        """
        self.in_receiver += self.in_pourer - spilled - retained
        self.on_tray += spilled
        self.in_pourer = retained

    def do(self, about: str, fill: float) -> None:
        """Carry out the step of a weighing question; other questions change nothing.

        Args:
            about: of the question, see `actors.balance.weighing_plan`.
            fill: mass that the pourer is filled with, if the step fills it [kg].
        """
        under = {"tray"} if self.placement in (Placement.TRAY, Placement.EVERYTHING) else set()
        alone = self.placement in (Placement.TRAY, Placement.TARED)
        match about:
            case "tray_wiped":
                self.on_tray, self.on_balance = 0.0, under
            case "tray_full":
                self.on_tray = 0.0
            case "laid_out":
                self.in_receiver = self.in_pourer = 0.0
                self.on_balance = under
            case "top_up" | "source_refill":
                self.in_pourer = fill
            case "vessels_laid_out":
                self.on_balance = under
            case "cup_exchanged":
                self.in_receiver = 0.0
            case "dry_pourer" | "dry_pourer_after":
                self.on_balance = {"dry pourer"}
            case "cleared" | "cleared_after":
                self.on_balance = set()
            case "pourer_empty":
                self.in_pourer, self.on_balance = 0.0, under | {"pourer"}
            case "pourer_full":
                self.in_pourer, self.on_balance = fill, under | {"pourer"}
            case "receiver_empty":
                self.in_receiver, self.on_balance = 0.0, under | {"receiver"}
            case "dose_source":
                self.in_pourer, self.on_balance = fill, under
            case "dose_cleared" | "dose_exchanged":
                self.on_balance = under
            case "dose_receiver":
                if self.receiver == "receiver":  # an empty one; a cup with a name has what was poured into it
                    self.in_receiver = 0.0
                self.on_balance = under | {self.receiver}
            case "set_up":
                self.in_receiver, self.on_tray = 0.0, 0.0
                self.on_balance = {"tray"} if alone else under | {"receiver"}
            case "tray_before":
                self.in_receiver, self.on_tray = 0.0, 0.0
            case "receiver_gone":
                self.on_balance = under
            case "pourer_after":
                self.on_balance = under | {"pourer"}

    def typed(self, about: str, step: float) -> str:
        """The weight that a person reads from another scale and types.

        Args:
            about: a weighing's key.
            step: of that scale [kg].
        """
        mass = self.mass(about.partition("_")[0])
        return f"{1e3 * round(mass / step) * step:.1f} g"


SCATTER = 1e-3
"""Standard deviation of a filling by hand [kg]."""

FILLED = 0.3e-3
"""Likewise, of a source that is filled on a scale [kg]."""

TYPED_STEP = 1e-4
"""Step of the scale for typed weights [kg]."""

SHARES = {
    "pourer_full": 4.0,
    "set_up": 2.0,
    "receiver_empty": 2.0,
    "tray_wiped": 1.0,
    "tray_before": 2.0,
    "start": 1.0,
    "pourer_after": 2.0,
    "cleared_after": 1.0,
    "receiver_gone": 1.0,
    "tray_after": 1.0,
    "dose_source": 4.0,
    "dose_receiver": 1.0,
}
"""Relative time of each step within one pour; an answer without a step takes `GLANCE`."""

GLANCE = 0.02
"""Share of the time for one pour that an answer without work takes."""

PERSISTENCE = 12
"""Limit of consecutive questions about problems. After that the answer is no, because endless confirmations would hide
the problem."""

Put = Callable[[float], Awaitable[None]]
"""Replaces the mass on the virtual balance [kg]."""

Hold = Callable[[float | None], Awaitable[None]]
"""Holds a vessel of this width between the fingers of a virtual gripper [m], or takes it away with None."""


class Hands:
    """Moves objects on a virtual bench.

    Args:
        contents: the bench contents.
        put: changes the mass on the balance; None without a balance.
        hold: puts the pourer between the fingers of a gripper; None without one.
    """

    def __init__(self, contents: BenchContents, put: Put | None, hold: Hold | None = None) -> None:
        self.contents, self._put, self._hold = contents, put, hold
        self._rng = np.random.default_rng(0)
        self._load = 0.0

    def prepare(self, load: float, seed: tuple[int, ...]) -> None:
        """Prepare the next pour.

        Args:
            load: mass to refill to [kg].
            seed: of the random fill error.
        """
        self._load, self._rng = load, np.random.default_rng(seed)

    async def do(self, question: OperatorQuestion) -> None:
        """Carry out the step of a question."""
        self.contents.do(question.about, self._load + float(self._rng.normal(0.0, SCATTER)))
        match question.about:
            case "laid_out":
                self.contents.stands = {"receiver": str(question.details["receiver"])}
            case "vessels_laid_out":
                self._lay_out(question.details)
            case "grasp_failed":
                self.contents.stands[str(question.details["role"])] = str(question.details["place"])
            case "pourer_empty" | "pourer_full":
                self.contents.stands["pourer"] = str(question.details.get("place", ""))
        if self._put is not None and question.wants == "done":
            await self._put(self.contents.carried)
        if self._hold is not None and question.about in ("grasp", "let_go", "open_gripper", "activate_gripper"):
            await self._hold(1e-3 * float(question.details["width_mm"]) if question.about == "grasp" else None)

    def _lay_out(self, details: Mapping[str, float | str]) -> None:
        """Put vessels on their places: those to be filled get their load, others keep what they hold."""
        self.contents.stands = {name: place for name, place in details.items() if isinstance(place, str)}
        for name in self.contents.stands:
            if (load := details.get(f"{name} filled_g")) is not None:
                error = float(self._rng.normal(0.0, FILLED)) if float(load) > 0.0 else 0.0  # an empty one is dry
                self.contents.liquids[name] = max(1e-3 * float(load) + error, 0.0)
            self.contents.liquids.setdefault(name, 1e-3 * float(details.get(f"{name} held_g", 0.0)))


class VirtualOperator:
    """See `actors.interfaces.Operator`. Confirms that reported problems are fixed, up to `PERSISTENCE` times in a row.

    Args:
        hands: carry out the steps.
        time: for all steps of one pour [s of the clock].
    """

    def __init__(self, hands: Hands, time: float) -> None:
        self._hands, self._time = hands, time
        self._again = 0
        self.heard: list[OperatorQuestion] = []
        self.announced: list[tuple[str, float]] = []

    async def ask(self, question: OperatorQuestion) -> str:
        """See `Operator.ask`."""
        self.heard.append(question)
        about = question.about
        self._again = self._again + 1 if question.problem else 0
        share = SHARES[about] / sum(SHARES.values()) if about in SHARES else GLANCE
        await asyncio.sleep(share * self._time)
        if self._again > PERSISTENCE:
            if question.wants == "yes or no":
                return "no"
            reason = f"{question.problem}. The question was: {question.text}"
            raise LaboratoryError(f"the virtual operator gives up: {reason}")
        await self._hands.do(question)
        match question.wants:
            case "weight":
                return self._hands.contents.typed(about, TYPED_STEP)
            case "done":
                return "done"
            case "option":
                return question.options[0]
        return "no" if about == "cups_kept" and question.details["begins"] else "yes"  # a new series has new cups

    async def announce(self, text: str, seconds: float) -> None:
        """See `Operator.announce`."""
        self.announced.append((text, seconds))


class PlayedOperator:
    """A person who tries the procedure on a virtual bench: the person answers, and virtual hands carry out the steps.

    Args:
        person: answers the questions.
        hands: carry out the steps.
    """

    def __init__(self, person: Operator, hands: Hands) -> None:
        self._person, self._hands = person, hands

    async def ask(self, question: OperatorQuestion) -> str:
        """See `Operator.ask`."""
        if question.wants == "weight":  # the person has no scale to read
            await self._hands.do(question)
            shown = self._hands.contents.typed(question.about, TYPED_STEP)
            question = replace(question, text=f"{question.text} (The virtual scale shows {shown}.)")
            return await self._person.ask(question)
        answer = await self._person.ask(question)
        if answer in ("done", "yes"):
            await self._hands.do(question)
        return answer

    async def announce(self, text: str, seconds: float) -> None:
        """See `Operator.announce`."""
        await self._person.announce(text, seconds)
