"""All figures of a run.

`draw_figures` writes them into a folder; `figures_of` returns them for notebooks. The modules of the single figures do
the drawing.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.journal.codec import Results
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
    """Draw all figures that the results allow.

    These are the discrepancy map and its trials, the test discrepancy, spillage against pours, loss maps, safe windows,
    and the comparison of the first pours with simulations. With more than two searched axes, a map shows the two most
    important ones, and the trials against every axis are a separate figure.

    A figure that can't be drawn is reported and left out, so that it does not end a long run with an error.

    Args:
        directory: folder of the PNGs.
        plan: plan of the campaign.
        results: results of the stages.
        formats: suffixes of additional files next to each PNG.

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
    """The same figures for notebooks, not written to files. An error in a figure is raised."""
    found = {}
    for name, job in _jobs(Path(), plan, results).items():
        with style.unsaved() as figures:
            job()
        found[name] = figures[0]
    return found


def _jobs(directory: Path, plan: CampaignPlan, results: Results) -> dict[str, Callable[[], Path]]:
    """The functions that draw the figures, by name."""
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
