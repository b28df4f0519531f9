"""All figures of a run, under its directory."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.journal.stage_results import Results
from orchestrator.results import figure_style as style
from orchestrator.results.figure_style import safe_name
from orchestrator.results.loss_units import deployment_unit
from orchestrator.results.spillage_figures import draw_discrepancy, draw_spillage
from orchestrator.results.stage_views import (
    calibration_of,
    calibration_picture,
    deployment_picture,
    deployments_of,
    discrepancy_groups,
    evaluation_of,
    pour_series,
    receiver_name,
    theta_of,
)
from orchestrator.results.surrogate_figures import draw_posterior, draw_surrogate, draw_trials, draw_window
from orchestrator.strategies.campaign_plan import CampaignPlan

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_log = logging.getLogger(__name__)


def draw_figures(
    directory: Path, plan: CampaignPlan, results: Results, formats: tuple[str, ...] = (".svg",)
) -> dict[str, Path]:
    """Draw what the results allow: discrepancy map and trials, test discrepancy, spillage against pours, loss maps,
    and the first pours against what was simulated.

    Of more than two searched axes a map shows the two that matter most; the trials against every axis are then a figure
    of their own.

    A figure that can't be drawn is reported and left out: days of pouring don't end in a traceback about a picture.

    Args:
        directory: where the PNGs go.
        plan: of the campaign.
        results: what the stages learnt.
        formats: suffixes of the files that are written beside each PNG.

    Returns:
        Name of each figure → its PNG.
    """
    drawn: dict[str, Path] = {}
    with style.also_as(*formats):
        for name, job in _jobs(directory, plan, results).items():
            try:
                drawn[name] = job()
            except Exception as error:
                _log.warning("figure '%s' was not drawn: %s: %s", name, type(error).__name__, error)
    return drawn


def figures_of(plan: CampaignPlan, results: Results) -> dict[str, Figure]:
    """The same figures, not written: for notebooks. One that can't be drawn raises what went wrong with it."""
    found = {}
    for name, job in _jobs(Path(), plan, results).items():
        with style.unsaved() as figures:
            job()
        found[name] = figures[0]
    return found


def _jobs(directory: Path, plan: CampaignPlan, results: Results) -> dict[str, Callable[[], Path]]:
    """What draws each figure."""
    jobs: dict[str, Callable[[], Path]] = {}
    calibration, evaluation, theta = calibration_of(results), evaluation_of(results), theta_of(results)
    if calibration is not None and (picture := calibration_picture(plan, calibration)) is not None:
        jobs["discrepancy map"] = lambda p=picture: draw_surrogate(directory / "discrepancy-map.png", p)  # type: ignore[misc]
        if picture.held and picture.points:
            jobs["discrepancy trials"] = lambda p=picture: draw_trials(directory / "discrepancy-trials.png", p)  # type: ignore[misc]
    if theta is not None and plan.calibration is not None and (posterior := theta.posterior) is not None:
        space, best = plan.calibration.parameters, theta.theta.model_dump()
        jobs["posterior"] = lambda: draw_posterior(directory / "posterior.png", posterior, space, best)
    if evaluation is not None and (groups := discrepancy_groups(evaluation)):
        jobs["test discrepancy"] = lambda: draw_discrepancy(
            directory / "test-discrepancy.png", groups, title=f"How far the simulator is from the balance: {plan.name}"
        )
    if plan.deployment is not None:
        unit = deployment_unit(plan.deployment)
        if series := pour_series(plan, results, unit):
            jobs["spillage against pours"] = lambda: draw_spillage(
                directory / "spillage.png", series, cost=unit.label, title=f"What every pour came to: {plan.name}"
            )
        for scene, result in deployments_of(results).items():
            if (picture := deployment_picture(plan, result)) is not None:
                name = receiver_name(plan, scene)
                jobs[f"loss map {name}"] = lambda p=picture, n=name: draw_surrogate(  # type: ignore[misc]
                    directory / f"loss-map-{safe_name(n)}.png", p
                )
            if result.window is not None:
                picture, name = deployment_picture(plan, result), receiver_name(plan, scene)
                jobs[f"safe window {name}"] = lambda r=result, p=picture, n=name: draw_window(  # type: ignore[misc]
                    directory / f"window-{safe_name(n)}.png", r, p, unit=unit, receiver=n
                )
    return jobs
