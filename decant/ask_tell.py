"""Pours that another program or a person makes: `AskTell` asks for them and is told what was weighed.

    with AskTell(campaign, "runs/mine") as session:
        while (pour := session.ask()) is not None:
            spilled, received = my_robot(pour.settings)
            session.tell(pour, spilled_g=spilled, received_g=received)
    session.run.recommended

The campaign runs in a thread: simulations, optimiser, strategy and journal are those of every other run, and the bench
is the caller. The campaign's laboratory has `mode: external`. Everything that is asked and told is in the journal, so
that a session in the same folder continues after the process has ended.
"""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self, SupportsFloat

from actors.interfaces import (
    Bench,
    DoseTarget,
    Laboratory,
    LaboratoryError,
    NotPouredError,
    Optimizer,
    PourFailedError,
    ProgressCallback,
    SimulatorPool,
    UnknownPourError,
)
from actors.laboratory import open_laboratory
from actors.laboratory_settings import LaboratorySettings
from decant.run_results import Run, html_table
from decant.running import checked
from orchestrator.learning.campaign_plan import CampaignPlan, receiver_names
from orchestrator.learning.requests import Pour, Prediction
from orchestrator.learning.stage_result import displayed_action
from orchestrator.records.events import Subscriber as Watch
from orchestrator.records.run_record import read_record
from orchestrator.reports.publishing import publish_run
from orchestrator.runs.added_pours import weighed_by_hand
from orchestrator.runs.resume import LOST, Facts
from orchestrator.runs.run_service import RunHandle, RunResources, RunService, RunTaskError
from orchestrator.runs.run_tasks import run_task
from orchestrator.runs.stages import scenes_of
from sim_engine.action import Action
from sim_engine.errors import InvalidArgumentError
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene

SOURCE = "told by the program that asked for the pour"


@dataclass(frozen=True)
class AskedPour:
    """A pour that the caller shall make once.

    Attributes:
        stage: of the campaign.
        number: 1, 2, … within the stage.
        receiver: name of its vessel.
        action: the motion, in SI units.
        load_g: mass in the pourer before the pour [g].
        predicted: of the strategy, in the unit of the loss; None if it predicts nothing.
        unknown: a session before this one asked for it and was told nothing: it may have been made. Tell its masses if
            they are known, else `fail` it. It is never asked for again.
    """

    stage: str
    number: int
    receiver: str
    action: Action
    load_g: float
    predicted: Prediction | None = None
    unknown: bool = False

    @property
    def settings(self) -> dict[str, float | None]:
        """The action in display units: {'angular_velocity_deg_s': 41.2, 'x_offset_mm': 104.0, …}."""
        return displayed_action(self.action.values())

    def _repr_html_(self) -> str:
        """The pour as a table, in notebooks."""
        shown = {"pour": f"{self.stage} {self.number}", "receiver": self.receiver, "load_g": f"{self.load_g:g}"}
        shown |= {name: "off" if value is None else f"{value:.4g}" for name, value in self.settings.items()}
        return html_table(shown.items()) + ("<p>may have been made already</p>" if self.unknown else "")


class AskTell:
    """A run of a campaign whose pours the caller makes. Use it as a context manager, or call `close`.

    Args:
        campaign: with `laboratory: {name: …, mode: external}`.
        directory: folder of the run. A run that is there continues; None makes a new folder.
        watch: called with every event, in the thread of the run. They must not wait.
        in_process: simulations in this process, one after the other; else on all cores, with Ray.
        answer: to the question with which a strategy paused the run before; see the error of `ask`.

    Raises:
        ValueError: the laboratory is not external, or the campaign can't be used (`RunError`, `InvalidArgumentError`).
        LaboratoryError: the simulators can't be opened.
        RunError: the run in the folder is damaged, or belongs to another campaign.
    """

    def __init__(
        self,
        campaign: CampaignPlan,
        directory: Path | str | None = None,
        *,
        watch: Sequence[Watch] = (),
        in_process: bool = True,
        answer: str | None = None,
    ) -> None:
        if campaign.laboratory.mode != "external":
            raise InvalidArgumentError(
                f"laboratory {campaign.laboratory.name} is {campaign.laboratory.mode}, and Decant pours there; write "
                "'laboratory: {name: …, mode: external}' for pours that your program makes"
            )
        service, request = RunService(), run_task(campaign)
        if not request.pours:
            raise RunTaskError(f"campaign '{campaign.name}' asks for no pours; use decant.run")
        resources = checked(
            request,
            RunResources(
                in_process=in_process,
                subscribers=watch,
                ask_operator=self._settle,
                laboratory=self._external_laboratory,
            ),
        )
        if directory is not None:
            request = replace(request, folder=Path(directory).expanduser())
        self._request = request = service.with_folder(request)
        assert request.folder is not None
        self._campaign, self._folder, self._answer = campaign, request.folder, answer
        self._names = receiver_names(campaign)
        self._unknown = read_record(request.folder).unknown_pours if request.resume else []
        self._waiting: queue.SimpleQueue[_Waiting | None] = queue.SimpleQueue()
        self._current: _Waiting | None = None
        self._handle: RunHandle | None = None
        self._run: Run | None = None
        self._error: BaseException | None = None
        self._closing = False
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(
            target=self._work, args=(service, resources), name="decant ask/tell", daemon=True
        )
        self._thread.start()

    # ---- the caller's side

    @property
    def directory(self) -> Path:
        """Folder of the run, with which a later session continues."""
        return self._folder

    @property
    def run(self) -> Run | None:
        """The published run, once `ask` has returned None."""
        return self._run

    def ask(self, timeout: float | None = None) -> AskedPour | None:
        """Wait for the next pour. Until it is told or failed, the same pour is returned again.

        Args:
            timeout: longest time to wait [s]; None: as long as the simulations take.

        Returns:
            The pour; None if the campaign has finished and its results are in `run`.

        Raises:
            TimeoutError: the next pour is not decided yet; ask again.
            RunError, LaboratoryError: the run has stopped; the text says what to do. A session in the same folder
                continues it.
        """
        if self._current is None:
            if self._closing:
                raise InvalidArgumentError(f"the session is closed; AskTell(campaign, '{self._folder}') continues it")
            try:
                self._current = self._waiting.get(timeout=timeout)
            except queue.Empty:
                raise TimeoutError(f"no pour was decided within {timeout:g} s") from None
            if self._current is None:
                self._waiting.put(None)  # for those who ask again
                self._thread.join()
                if self._error is not None:
                    raise self._error
                return None
        return self._current.pour

    def tell(
        self,
        pour: AskedPour,
        *,
        spilled_g: SupportsFloat,
        received_g: SupportsFloat | None = None,
        retained_g: SupportsFloat | None = None,
        loaded_g: SupportsFloat | None = None,
        notes: dict[str, Any] | None = None,
    ) -> None:
        """Tell what was weighed. Give the mass that was received, or the mass that was left in the pourer.

        Masses are numbers of Python, NumPy or pandas. `decant.correct_pour` corrects them once the session is closed.

        Args:
            pour: that `ask` has returned.
            spilled_g: mass next to the receiver [g].
            received_g: mass in the receiver [g].
            retained_g: mass left in the pourer [g].
            loaded_g: mass in the pourer before [g]; as asked for unless given.
            notes: kept with the pour in the journal; JSON-ready.

        Raises:
            InvalidArgumentError: a mass is not a finite number, the masses do not fit the load or may be kilograms, or
                another pour is asked for.
        """
        waiting = self._asked(pour)
        measured, answer = weighed_by_hand(
            pour.load_g,
            spilled_g=spilled_g,
            received_g=received_g,
            retained_g=retained_g,
            loaded_g=loaded_g,
            notes={**(notes or {}), "source": SOURCE},
        )
        self._current = None
        waiting.reply(measured, answer)

    def fail(self, pour: AskedPour, reason: str) -> None:
        """Tell that the pour gave nothing that could be weighed. It counts as failed and is not repeated.

        Args:
            pour: that `ask` has returned.
            reason: kept in the journal.

        Raises:
            InvalidArgumentError: another pour is asked for.
        """
        waiting = self._asked(pour)
        self._current = None
        waiting.reply(PourFailedError(reason), LOST)

    def close(self) -> None:
        """End the session. A pour that was asked for and not told is unknown; a later session settles it."""
        self._closing = True
        current, self._current = self._current, None
        if current is not None:
            current.reply(UnknownPourError("the session was closed before its outcome was told"), None)
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._pause)
        while self._thread.is_alive():
            with contextlib.suppress(queue.Empty):
                if (waiting := self._waiting.get(timeout=0.1)) is not None:
                    waiting.reply(NotPouredError("the session was closed before it was asked for"), None)
        self._waiting.put(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _asked(self, pour: AskedPour) -> _Waiting:
        if self._current is None or self._current.pour != pour:
            pending = "none" if self._current is None else f"{self._current.pour.stage} {self._current.pour.number}"
            raise InvalidArgumentError(
                f"pour {pour.stage} {pour.number} is not the one that is asked for ({pending}); outcomes are told once"
            )
        return self._current

    # ---- the run's side, in its thread

    def _work(self, service: RunService, resources: RunResources) -> None:
        try:
            with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
                runner.run(self._campaign_run(service, resources))
        except asyncio.CancelledError:
            self._error = LaboratoryError(f"the run is paused; AskTell(campaign, '{self._folder}') continues it")
        except BaseException as error:  # raised again by `ask`
            self._error = error
        finally:
            self._waiting.put(None)

    async def _campaign_run(self, service: RunService, resources: RunResources) -> None:
        with contextlib.closing(service.start(self._request, resources)) as handle:
            self._handle = handle
            if self._closing:
                handle.pause()
            result = await handle.wait()
        self._run = Run(self._campaign, result, await asyncio.to_thread(publish_run, handle))

    def _pause(self) -> None:
        if self._handle is not None:
            self._handle.pause()

    def _external_laboratory(self, spec: LaboratorySettings, pours: bool) -> Laboratory:
        return _ExternalLaboratory(open_laboratory(spec, pours=False), self._outcome)

    async def _outcome(self, scene: Scene, action: Action) -> PourMeasurement:
        """Hand a pour to the caller and wait for its outcome."""
        assert self._handle is not None
        started = self._handle.state.pour
        assert started is not None
        waiting = self._hand_out(started.stage, started.request, scene.liquid.mass)
        measured, _ = await waiting.outcome
        if isinstance(measured, BaseException):
            raise measured
        return measured

    async def _settle(self, question: str, options: Sequence[str], facts: Facts) -> str:
        """Answer a question of a run that continues: by the caller, if it is about a pour."""
        if LOST not in options:
            return self._answer or ""
        pour = self._unknown[0]
        load = scenes_of(self._campaign)[pour.request.scene].liquid.mass
        waiting = self._hand_out(pour.stage, pour.request, load, unknown=True)
        outcome, answer = await waiting.outcome
        if answer is None:
            assert isinstance(outcome, BaseException)
            raise asyncio.CancelledError
        self._unknown.pop(0)
        return answer

    def _hand_out(self, stage: str, request: Pour, load: float, unknown: bool = False) -> _Waiting:
        pour = AskedPour(
            stage,
            request.number,
            self._names.get(request.scene, request.scene),
            request.action,
            round(1e3 * load, 6),
            request.predicted,
            unknown,
        )
        waiting = _Waiting(pour, asyncio.get_running_loop().create_future())
        self._waiting.put(waiting)
        return waiting


@dataclass(frozen=True)
class _Waiting:
    """A pour that waits for its outcome."""

    pour: AskedPour
    outcome: asyncio.Future[tuple[PourMeasurement | LaboratoryError, str | None]]

    def reply(self, outcome: PourMeasurement | LaboratoryError, answer: str | None) -> None:
        """Give the outcome from another thread; as an object, and as an operator answers; None: no answer."""

        def settle() -> None:
            if not self.outcome.done():
                self.outcome.set_result((outcome, answer))

        with contextlib.suppress(RuntimeError):  # the loop has ended
            self.outcome.get_loop().call_soon_threadsafe(settle)


class _ExternalLaboratory:
    """A laboratory with simulators and an optimiser of its own; the caller is its bench."""

    def __init__(self, inner: Laboratory, outcome: Callable[[Scene, Action], Any]) -> None:
        self._inner, self._bench = inner, _ExternalBench(outcome)

    @property
    def simulators(self) -> SimulatorPool:
        return self._inner.simulators

    @property
    def optimizer(self) -> Optimizer:
        return self._inner.optimizer

    @property
    def bench(self) -> Bench:
        return self._bench

    async def __aenter__(self) -> Laboratory:
        await self._inner.__aenter__()
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._inner.__aexit__(*exc)


class _ExternalBench:
    mode = "external"

    def __init__(self, outcome: Callable[[Scene, Action], Any]) -> None:
        self._outcome = outcome

    async def pour(
        self,
        scene: Scene,
        action: Action,
        *,
        seed: int,
        progress: ProgressCallback | None = None,
        dose: DoseTarget | None = None,
    ) -> PourMeasurement:
        """See `Bench.pour`."""
        if dose is not None:
            raise NotPouredError("wanted amounts need an arm of Decant")
        measured: PourMeasurement = await self._outcome(scene, action)
        return measured
