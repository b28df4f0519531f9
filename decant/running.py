"""Campaigns that run: whole ones, calibration on a table of weighed pours, plans for a vessel.

Coroutines from plain functions, also in a notebook, whose thread has a loop already.

Campaigns and vessels: loaded from files, built in a program, or taken from the set that Decant comes with.
"""

from __future__ import annotations

import asyncio
import csv
import html
import json
import tempfile
import warnings
from collections.abc import Callable, Coroutine, Generator, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from decant.run_results import Run, table_of
from orchestrator.campaigns import file_loading
from orchestrator.campaigns.file_loading import campaign_from, load_laboratory, load_vessel
from orchestrator.campaigns.shipped import shipped, starting_set
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.campaigns.yaml.yaml_source import Document
from orchestrator.catalogue.catalogue import posterior_source
from orchestrator.learning.calibration.calibration_scores import calibration_residual
from orchestrator.learning.calibration.campaign_memory import CampaignMemory
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.mixtures import NO_MORE
from orchestrator.live_view.rerun_subscriber import recorder_of
from orchestrator.records.events import Subscriber as Watch
from orchestrator.records.journal_file import Header
from orchestrator.records.run_clock import run_time
from orchestrator.records.run_record import RunState
from orchestrator.reports.mixture_report import mixture_rows, mixtures_so_far
from orchestrator.reports.progress_state import ProgressState
from orchestrator.reports.publishing import publish_run
from orchestrator.reports.stage_views import evaluation_of
from orchestrator.reports.validity_warnings import not_simulated
from orchestrator.runs.bench_check import BenchReport, check_bench
from orchestrator.runs.motion_approval import read_record
from orchestrator.runs.resume import Facts, OperatorNeededError
from orchestrator.runs.run_folder import create_run
from orchestrator.runs.run_service import CheckReport, RunHandle, RunRequest, RunResources, RunService
from orchestrator.runs.run_tasks import (
    PREDICTION_SEEDS,
    TASKS,
    GivenTheta,
    Task,
    calibrate_task,
    plan_task,
    read_theta,
    run_task,
)
from orchestrator.runs.stages import POSTERIOR_DRAWS, posterior_draws
from sim_engine.errors import InvalidArgumentError
from sim_engine.liquids import SimulationParameters
from sim_engine.vessel.shapes import VesselSpec

__all__ = ["build_campaign", "load_campaign", "load_vessel", "shipped", "starting_set"]


def load_campaign(
    path: Path | str,
    laboratory: Path | str | None = None,
    seed: int | None = None,
    *,
    memory: CampaignMemory | None = None,
) -> CampaignPlan:
    """The plan of a campaign file, with everything that it refers to.

    Args:
        path: the file.
        laboratory: a laboratory's file that replaces the campaign's laboratory.
        seed: replaces the campaign's seed.
        memory: of the run that is resumed; it replaces the campaign's `prior`, which could find other runs by now.

    Raises:
        ConfigError: the file or a file that it refers to is invalid; contains all problems.
    """
    return file_loading.load_campaign(path, laboratory, seed, memory=memory, posteriors=posterior_source)


def build_campaign(content: Mapping[str, Any], folder: Path | str = ".") -> CampaignPlan:
    """A campaign from the keys of a campaign file, with its defaults and its checks.

    Args:
        content: as in YAML: quantities are texts with units ('40 deg/s'), vessels and laboratory paths or mappings.
        folder: that relative paths in it start from.

    Raises:
        ConfigError: anything is wrong with it; all problems at once, with their places.
    """
    path = Path(folder).expanduser().resolve() / "campaign.json"
    return campaign_from(
        Document.parse(json.dumps(content, indent=2, ensure_ascii=False), path), posteriors=posterior_source
    )


T = TypeVar("T")


def run_coroutine(work: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine to its end: here, or where a loop is running, in a thread of its own.

    Interrupted from the keyboard in a plain program, it is cancelled, and with it the campaign comes to rest.
    """
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return asyncio.run(work)
    with ThreadPoolExecutor(1, thread_name_prefix="decant") as thread:
        return thread.submit(asyncio.run, work).result()


def run(
    campaign: CampaignPlan,
    *,
    watch: Sequence[Watch] = (),
    resume: Path | str | None = None,
    in_process: bool = True,
    propose: Propose | None = None,
) -> Run:
    """Run a campaign on its virtual bench, or go on with a run of it, and publish it.

    Args:
        campaign: what to do.
        watch: called with every event (`decant.events`), in the order in which things happen. They must not wait.
        resume: folder of the run to go on with; a new one is begun otherwise.
        in_process: everything in this process, without Ray; else simulations run side by side.
        propose: of a campaign with `cups: {proposals: …}`, called when all mixtures are poured. Its argument is the
            table of `Run.mixtures` so far; it returns the next mixtures, such as `[{"water": "30 g"}]`, or none.

    What is suspicious about the campaign, or not simulated, is issued as `UserWarning` before it begins. A recording
    is written if the campaign has `outputs: {recording: true}` and Rerun is installed.

    Raises:
        ValueError: the vessels or motions can't be used, draws of θ are missing, or the laboratory is hardware, whose
            motion the command line enables (`RunError` or `InvalidArgumentError`, both a `DecantError`).
        LaboratoryError: the laboratory can't be opened.
        RunError: the run can't begin, go on or end; the text says what is kept, and what to do.
    """
    request = run_task(campaign)
    proposals = None if propose is None else _Proposals(campaign, propose)
    watch = (*watch, *([] if proposals is None else [proposals.record.take]))
    ask = None if proposals is None else proposals.answer
    resources = checked(request, RunResources(in_process=in_process, subscribers=watch, ask_operator=ask))
    if resume is not None:
        request = replace(request, folder=Path(resume).expanduser(), resume=True)
    return _run(request, resources)


Propose = Callable[[Any], Sequence[Mapping[str, str]]]


class _Proposals:
    """Answers a run's question for further mixtures by a function of the caller."""

    def __init__(self, campaign: CampaignPlan, propose: Propose) -> None:
        self.record = RunState(Header(campaign.name, {}))
        self._campaign, self._propose = campaign, propose

    async def answer(self, question: str, options: Sequence[str], facts: Facts) -> str:
        """See `AskOperator`. Raises OperatorNeededError: another question, or mixtures that are impossible."""
        if NO_MORE not in options or "Refused: " in question:
            raise OperatorNeededError(question)
        mixtures = mixtures_so_far(self._campaign, self.record)
        assert mixtures is not None
        table = table_of(mixture_rows(mixtures, self.record))
        return json.dumps([dict(row) for row in await asyncio.to_thread(self._propose, table)])


def check(campaign: CampaignPlan, task: Task = "run") -> CheckReport:
    """Check a campaign as `decant validate` does, without running it.

    Args:
        campaign: what to check.
        task: 'run', 'calibrate' or 'plan'.

    Returns:
        Problems, each of which prevents the run, and warnings.

    Raises:
        ValueError: the campaign has no section for the task.
    """
    return RunService().check(TASKS[task](campaign))


def doctor(laboratory: Path | str) -> BenchReport:
    """Check everything that a pour needs, as `decant robot check` does: controller, safety settings, balance, packages.

    Nothing moves and no setting is changed. For a virtual laboratory, its devices are started for the check.

    Args:
        laboratory: file of a laboratory with an arm.

    Returns:
        The checks with their remedies; `ready` is whether none fails.

    Raises:
        ConfigError: the file is invalid.
        InvalidArgumentError: the laboratory has no arm.
        RunError: the record of accepted safety settings is invalid.
        LaboratoryError: a package is missing, or a virtual device does not start.
    """
    path = Path(laboratory).expanduser()
    spec = load_laboratory(path)
    if spec.arm is None:
        text = f"{path}: laboratory {spec.name} has no 'arm': there is no device to check"
        raise InvalidArgumentError(text)
    return check_bench(spec, path, None if spec.mode != "hardware" else read_record(path))


class RunningCampaign:
    """A campaign that runs in the event loop of a notebook or program. `await` returns its `Run`.

    Attributes:
        directory: of the run.
    """

    def __init__(self, campaign: CampaignPlan, handle: RunHandle, progress: ProgressState) -> None:
        self._campaign, self._handle, self._progress = campaign, handle, progress
        self.directory = handle.folder
        self._task = asyncio.ensure_future(self._finished())

    async def _finished(self) -> Run:
        try:
            result = await self._handle.wait()
        finally:
            self._handle.close()
        return Run(self._campaign, result, await asyncio.to_thread(publish_run, self._handle))

    def __await__(self) -> Generator[Any, None, Run]:
        return self._task.__await__()

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        return self._task.done()

    @property
    def seconds_left(self) -> float | None:
        """Expected time until it ends [s]; None if unknown."""
        return self._progress.forecast.left(run_time())

    def __str__(self) -> str:
        """Progress in one line."""
        return self._progress.counts_line() or "starting"

    def pause(self) -> None:
        """Pause at the next safe point; `run(..., resume=directory)` continues. `await` then raises CancelledError."""
        self._handle.pause()

    def _repr_html_(self) -> str:
        """Progress, in notebooks."""
        return f"<b>{html.escape(self._campaign.name)}</b>: {html.escape(str(self))}"


async def start(campaign: CampaignPlan, *, watch: Sequence[Watch] = (), in_process: bool = True) -> RunningCampaign:
    """Start a campaign in the running event loop and return at once, so that its progress can be shown.

    Args:
        campaign: what to do.
        watch: see `run`.
        in_process: see `run`.

    Raises:
        ValueError, LaboratoryError, RunError: see `run`.
    """
    progress = ProgressState(campaign)
    request = run_task(campaign)
    resources = await asyncio.to_thread(
        checked, request, RunResources(in_process=in_process, subscribers=(*watch, progress))
    )
    return RunningCampaign(campaign, RunService().start(request, resources), progress)


def calibrate(
    campaign: CampaignPlan,
    pours: Any,
    *,
    watch: Sequence[Watch] = (),
    in_process: bool = True,
) -> Run:
    """Calibrate the simulator on weighed pours, as the campaign says: strategy, searched θ, scene and motion are its.

    Args:
        campaign: with a calibration.
        pours: a table: a pandas.DataFrame, or a list of dicts. The columns are those of a file of weighed pours:
            'angular_velocity_deg_s' and the other searched dimensions with their units, 'poured_g', 'spilled_g',
            'retained_g' and 'split' ('train', 'test').
        watch: see `run`.
        in_process: see `run`.

    Raises:
        ConfigError: a column or a value of the table is wrong; the text says which.
        ValueError, LaboratoryError, RunError: see `run`.
    """
    if campaign.calibration is None or campaign.resolved.get("calibration") is None:
        raise InvalidArgumentError(f"campaign '{campaign.name}' has no calibration")
    rows = _rows(pours)
    with tempfile.TemporaryDirectory(prefix="decant-") as folder:  # a table that is refused leaves no run behind
        table = Path(folder) / "pours.csv"
        _write_table(table, rows)
        try:
            stage = _calibration_of(campaign, table)
        except ConfigError as error:
            shown = Path("pours.csv")
            raise ConfigError(
                replace(problem, path=shown) if problem.path == table else problem for problem in error.problems
            ) from None
        resources = checked(calibrate_task(stage), RunResources(in_process=in_process, subscribers=watch))
    directory = create_run(campaign)
    _write_table(directory / table.name, rows)
    request = calibrate_task(_calibration_of(campaign, directory / table.name))
    return _run(replace(request, folder=directory), resources)


def _calibration_of(campaign: CampaignPlan, table: Path) -> CampaignPlan:
    """The campaign's calibration, on the pours of a table."""
    content = {key: value for key, value in campaign.resolved.items() if key != "deployment"}
    section: dict[str, Any] = dict(content["calibration"])
    settings = {key: value for key, value in dict(section["pours"]).items() if key in ("lip_radius", "split")}
    section["pours"] = {**settings, "from": str(table)}
    return build_campaign({**content, "calibration": section}, campaign.source.parent)


def plan(
    campaign: CampaignPlan,
    receiver: VesselSpec | Path | str | None = None,
    *,
    theta: SimulationParameters | Run | Path | str | None = None,
    iterations: int | None = None,
    seeds: int = PREDICTION_SEEDS,
    watch: Sequence[Watch] = (),
    in_process: bool = True,
) -> Run:
    """Find the action to pour with in simulation alone (D1), and what to expect of it with new seeds.

    Args:
        campaign: with a deployment: it says which actions may be planned, and what is minimised.
        receiver: another vessel than the campaign's, or its file.
        theta: parameters to plan with; the campaign's unless given. A run that has calibrated, or its `theta.json`,
            also gives the draws of the posterior, if the weighed pours justify θ*; the simulations use them in turn.
        iterations: actions that are tried, 1 or more; as the campaign says unless given.
        seeds: number of new seeds, 1 or more, that the recommended action is simulated with.
        watch: see `run`.
        in_process: see `run`.

    Returns:
        The run: `recommended` has the action of each receiver, `predictions` what the new seeds came to.

    Raises:
        ConfigError: the file of `theta` or of the receiver is wrong.
        ValueError, LaboratoryError, RunError: see `run`.
    """
    for name, value in (("seeds", seeds), ("iterations", 1 if iterations is None else iterations)):
        if value < 1:
            raise InvalidArgumentError(f"{name}={value!r}: should be 1 or more")
    vessel = load_vessel(Path(receiver).expanduser()) if isinstance(receiver, str | Path) else receiver
    chosen = given_theta(theta, campaign)
    request = plan_task(campaign, chosen, vessel, iterations, seeds)
    return _run(request, checked(request, RunResources(in_process=in_process, subscribers=watch)))


def given_theta(theta: SimulationParameters | Run | Path | str | None, campaign: CampaignPlan) -> GivenTheta:
    """θ as `plan` and `simulate` accept it, and what else its calibration found."""
    if theta is None:
        return GivenTheta(campaign.parameters)
    if isinstance(theta, SimulationParameters):
        return GivenTheta(theta)
    if not isinstance(theta, Run):
        return read_theta(Path(theta).expanduser(), campaign)
    calibrated, recommended = theta.calibrated, theta.theta
    if calibrated is None or recommended is None:
        raise InvalidArgumentError(f"theta: run {theta.directory} has found no θ*; give one that has calibrated")
    scores = evaluation_of(theta.results)
    return GivenTheta(
        recommended,
        posterior_draws(calibrated, POSTERIOR_DRAWS) if recommended == calibrated.theta else (),
        None if scores is None else calibration_residual(theta.campaign.calibration, scores, len(calibrated.searched)),
    )


def checked(request: RunRequest, resources: RunResources) -> RunResources:
    """Refuse what can't be run, and warn of what is suspicious, before a run folder is made.

    Returns:
        `resources`, with a recorder for the live view.
    """
    campaign, service = request.campaign, RunService()
    if campaign.laboratory.mode == "hardware":
        raise InvalidArgumentError(
            f"laboratory {campaign.laboratory.name} is hardware, whose motion is enabled from the command line alone: "
            f"decant run {campaign.source} --enable-motion"
        )
    report = service.check(request)
    report.require()
    problems = list(report.warnings)
    problems.append("\n".join(not_simulated(campaign, problems.append)))
    for text in filter(None, dict.fromkeys(problems)):
        _warn(text)
    service.check_laboratory(request, resources)
    return replace(resources, recorder=lambda plan, run: recorder_of(plan, run, _warn))


def _warn(text: str) -> None:
    warnings.warn(text, UserWarning, stacklevel=4)


def _run(request: RunRequest, resources: RunResources) -> Run:
    """Run what was checked, record it, and publish it."""
    with closing(RunService().start(request, resources)) as handle:
        result = run_coroutine(handle.wait())
    return Run(request.campaign, result, publish_run(handle))


def _rows(table: Any) -> list[dict[str, Any]]:
    """The rows of a table.

    Raises:
        InvalidArgumentError: it is none.
    """
    rows = table.to_dict("records") if hasattr(table, "to_dict") else table
    if not isinstance(rows, Iterable) or isinstance(rows, str | bytes | Mapping):
        raise InvalidArgumentError(
            f"pours: should be a pandas.DataFrame or a list of dicts, not {type(table).__name__}"
        )
    listed = list(rows)
    if wrong := [row for row in listed if not isinstance(row, Mapping)]:
        raise InvalidArgumentError(f"pours: every row should be a dict from column to value, not {wrong[0]!r}")
    return [dict(row) for row in listed]


def _write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """A table as a file of weighed pours."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
