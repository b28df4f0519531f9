"""Campaigns that run: whole ones, calibration on a table of weighed pours, plans for a vessel."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from actors.laboratory import check_laboratory, open_laboratory
from decant import loop
from decant.campaigns import build_campaign
from decant.runs import Run
from orchestrator.campaign import run_campaign
from orchestrator.commands.campaigns import planning_plan
from orchestrator.config.campaign.check import check_campaign
from orchestrator.config.load import load_vessel
from orchestrator.events import Event
from orchestrator.plan import CampaignPlan
from orchestrator.publish import publish
from orchestrator.runs import create_run
from orchestrator.stages import StageDefinition, calibration_stages, deployment_stages, prediction_stages, stages_of
from sim_engine.liquid import SimulationParameters
from sim_engine.vessel.spec import VesselSpec

PREDICTION_SEEDS = 5
"""Fresh seeds that a planned action is simulated with."""

Watch = Callable[[Event], object]


def run(
    campaign: CampaignPlan,
    *,
    watch: Sequence[Watch] = (),
    resume: Path | str | None = None,
    in_process: bool = True,
) -> Run:
    """Run a campaign on its virtual bench, or go on with a run of it, and publish it.

    Args:
        campaign: what to do.
        watch: called with every event (`decant.events`), in the order in which things happen. They must not wait.
        resume: folder of the run to go on with; a new one is begun otherwise.
        in_process: everything in this process, without Ray; else simulations run side by side.

    Raises:
        ValueError: the vessels or motions don't do, or the laboratory is hardware, which the command line arms.
        LaboratoryError: the laboratory can't be opened.
        RunError: the run can't begin, go on or end; the text says what is kept, and what to do.
    """
    return _run(campaign, stages_of(campaign), watch, resume, in_process)


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
    directory = create_run(campaign)
    table = directory / "pours.csv"
    _write_table(table, pours)
    content = {key: value for key, value in campaign.resolved.items() if key != "deployment"}
    section: dict[str, Any] = dict(content.get("calibration") or {})
    if not section:
        raise ValueError(f"campaign '{campaign.name}' has no calibration")
    kept = {key: value for key, value in dict(section["pours"]).items() if key in ("lip_radius", "split")}
    section["pours"] = {**kept, "from": str(table)}
    plan = build_campaign({**content, "calibration": section}, campaign.source.parent)
    assert plan.calibration is not None
    return _run(plan, calibration_stages(plan.calibration), watch, None, in_process, directory)


def plan(
    campaign: CampaignPlan,
    receiver: VesselSpec | Path | str | None = None,
    *,
    theta: SimulationParameters | None = None,
    iterations: int | None = None,
    seeds: int = PREDICTION_SEEDS,
    watch: Sequence[Watch] = (),
    in_process: bool = True,
) -> Run:
    """Find the action to pour with in simulation alone (D1), and what to expect of it with fresh seeds.

    Args:
        campaign: with a deployment: it says which actions may be planned, and what is minimised.
        receiver: another vessel than the campaign's, or its file.
        theta: calibrated parameters; the campaign's unless given.
        iterations: actions that are tried; as the campaign says unless given.
        seeds: fresh ones that what is recommended is simulated with.
        watch: see `run`.
        in_process: see `run`.

    Returns:
        The run: `recommended` has the action of each receiver, `predictions` what the fresh seeds came to.

    Raises:
        ValueError, LaboratoryError, RunError: see `run`.
    """
    vessel = load_vessel(Path(receiver).expanduser()) if isinstance(receiver, str | Path) else receiver
    planned = planning_plan(campaign, theta, vessel, iterations)
    deployment = planned.deployment
    assert deployment is not None
    stages = [*deployment_stages(planned, deployment), *prediction_stages(planned, deployment, seeds)]
    return _run(planned, stages, watch, None, in_process, as_written=receiver is None)


def _run(
    campaign: CampaignPlan,
    stages: Sequence[StageDefinition],
    watch: Sequence[Watch],
    resume: Path | str | None,
    in_process: bool,
    directory: Path | None = None,
    *,
    as_written: bool = True,
) -> Run:
    if campaign.laboratory.mode == "hardware":
        raise ValueError(
            f"laboratory {campaign.laboratory.name} is hardware, which is armed from the command line alone: "
            f"decant run {campaign.source} --arm"
        )
    if problems := check_campaign(campaign, as_written=as_written):
        raise ValueError("\n".join(map(str, problems)))
    pouring = any(stage.pours for stage in stages)
    spec = replace(campaign.laboratory, in_process=in_process or campaign.laboratory.in_process)
    check_laboratory(spec, need_bench=pouring)
    begun = Path(resume).expanduser() if resume is not None else directory or create_run(campaign)
    work = run_campaign(
        campaign,
        open_laboratory(spec, need_bench=pouring),
        begun,
        resume=resume is not None,
        watchers=[_watcher(one) for one in watch],
        stages=stages,
    )
    result = loop.run(work)
    return Run(campaign, result, publish(campaign, result))


def _watcher(watch: Watch) -> Callable[[Event], None]:
    def watcher(event: Event) -> None:
        watch(event)

    return watcher


def _write_table(path: Path, table: Any) -> None:
    """A table as a file of weighed pours."""
    rows: Iterable[Mapping[str, Any]] = table.to_dict("records") if hasattr(table, "to_dict") else table
    found = [dict(row) for row in rows]
    columns = list(dict.fromkeys(name for row in found for name in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(found)
