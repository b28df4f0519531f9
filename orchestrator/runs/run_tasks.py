"""What a verb makes of a campaign: its plan, the stages that are to run, and the checks before they may.

The command line, the daemon and notebooks share it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from orchestrator.run_errors import RunError
from orchestrator.runs.stages import (
    POSTERIOR_DRAWS,
    StageDefinition,
    calibration_stages,
    deployment_stages,
    prediction_stages,
    stages_of,
)
from orchestrator.strategies.campaign_plan import CampaignPlan

if TYPE_CHECKING:
    from orchestrator.config.yaml.yaml_errors import Problem
    from sim_engine.liquids import SimulationParameters
    from sim_engine.vessel.shapes import VesselSpec

Verb = Literal["run", "calibrate", "plan"]

PREDICTION_SEEDS = 5

PLANNED = "-plan"
"""Behind the name of a campaign that is planned alone."""


class RunTaskError(RunError, ValueError):
    """The campaign can't run as it is asked to; the text has everything that is wrong."""

    exit_code = 2


@dataclass(frozen=True)
class RunTask:
    """Work for a laboratory.

    Attributes:
        plan: of the campaign, without what the verb leaves out.
        stages: that are to run.
    """

    plan: CampaignPlan
    stages: Sequence[StageDefinition]

    @property
    def pours(self) -> bool:
        """Whether it needs a bench."""
        return any(stage.pours for stage in self.stages)


@dataclass(frozen=True)
class GivenTheta:
    """θ that a campaign is planned with, of a calibration or written by hand.

    Attributes:
        theta: the θ itself.
        draws: of its posterior; empty where none is known, or the campaign's risk bears none.
        left_over: shift that the calibration left (`sim_engine.prediction_band`); None where it is not known.
    """

    theta: SimulationParameters
    draws: tuple[SimulationParameters, ...] = ()
    left_over: float | None = None


def read_theta(path: Path, plan: CampaignPlan) -> GivenTheta:
    """θ from a file, such as the `theta.json` of a calibration.

    Args:
        path: of the file.
        plan: whose θ has what the file does not name; if its risk bears draws of a posterior, the file needs them.

    Raises:
        ConfigError: anything is wrong with the file.
    """
    from orchestrator.config.file_loading import load_discrepancy, load_parameters, load_posterior

    needed = plan.deployment is not None and plan.deployment.settings.needs_posterior
    draws = load_posterior(path, POSTERIOR_DRAWS, plan.parameters) if needed else ()
    return GivenTheta(load_parameters(path, plan.parameters), draws, load_discrepancy(path))


def _nothing(told: object) -> None:
    """Default of a callback."""


def check_job(
    plan: CampaignPlan,
    *,
    as_written: bool = True,
    warn: Callable[[Problem], None] = _nothing,
    doing: Callable[[str], None] = _nothing,
) -> None:
    """Check all that can be checked before anything starts: draws of θ, vessels, loads, motions.

    Args:
        plan: of the work.
        as_written: its vessels are those of its file.
        warn: called with everything that is suspicious, but not wrong.
        doing: called with the step that is being done.

    Raises:
        JobError: with everything that is wrong.
    """
    from orchestrator.config.campaign_checks import check_campaign

    problems = [str(one) for one in check_campaign(plan, as_written=as_written, warn=warn, doing=doing)]
    if (problem := _lacking_posterior(plan)) is not None:
        problems.append(problem)
    if problems:
        raise RunTaskError("\n".join(problems))


def _lacking_posterior(plan: CampaignPlan) -> str | None:
    """Draws of θ that deployment is to bear are given, or made by the campaign's own calibration; else the problem."""
    from orchestrator.strategies.strategy_registry import calibrations

    if plan.deployment is None or not plan.deployment.settings.needs_posterior or plan.deployment.thetas:
        return None
    if plan.calibration is not None and plan.calibration.settings.makes_posterior:
        return None
    known = [name for name, settings in calibrations().items() if settings().makes_posterior]
    has = "has no calibration"
    if plan.calibration is not None and plan.calibration.strategy not in known:
        has = f"calibrates with {plan.calibration.strategy}"
    elif plan.calibration is not None:
        return (
            f"{plan.source}: deployment.risk.theta: 'posterior' needs draws of θ, which no surrogate makes that "
            "takes actions for noise; write 'calibration: {averaging: context}', or 'theta: best'"
        )
    return (
        f"{plan.source}: deployment.risk.theta: 'posterior' needs draws of θ, which only {' and '.join(known)} "
        f"makes, and this campaign {has}; calibrate with {known[0]}, write 'theta: best', or use decant plan "
        "--parameters with the theta.json of a calibration"
    )


def job(plan: CampaignPlan, verb: Verb = "run", given: GivenTheta | None = None) -> RunTask:
    """The work that a verb asks for.

    Args:
        plan: of the campaign.
        verb: what to do with it.
        given: to 'plan': θ in place of the campaign's.

    Raises:
        JobError: the campaign has no section for it.
    """
    match verb:
        case "run":
            return RunTask(plan, stages_of(plan))
        case "calibrate":
            if plan.calibration is None:
                raise RunTaskError(f"{plan.source}: has no 'calibration' section; there is nothing to calibrate")
            # The deployment stays out: its vessels need not be there yet.
            return RunTask(replace(plan, deployment=None), calibration_stages(plan.calibration))
        case "plan":
            plan = (
                planned(plan) if given is None else planned(plan, given.theta, None, None, given.draws, given.left_over)
            )
            assert plan.deployment is not None
            stages = deployment_stages(plan, plan.deployment)
            return RunTask(plan, [*stages, *prediction_stages(plan, plan.deployment, PREDICTION_SEEDS)])


def planned(
    plan: CampaignPlan,
    theta: SimulationParameters | None = None,
    receiver: VesselSpec | None = None,
    iterations: int | None = None,
    thetas: tuple[SimulationParameters, ...] = (),
    left_over: float | None = None,
) -> CampaignPlan:
    """A campaign turned into D1 without pours, and its record.

    Unless the campaign has D1's own settings, each action is simulated once: simulations of other actions tell about
    it, too, and its prediction is made with fresh seeds.

    Args:
        plan: of the campaign.
        theta: to plan with; the campaign's unless given.
        receiver: in place of the campaign's.
        iterations: as the campaign says unless given.
        thetas: draws of a posterior, where its risk is to bear them.
        left_over: shift that the calibration of θ left (`sim_engine.prediction_band`); None: nobody knows.

    Raises:
        JobError: it has nothing to plan with.
    """
    from orchestrator.config.run_snapshot import record_of
    from orchestrator.strategies.deployment.d1 import D1Settings

    deployment = plan.deployment
    if deployment is None:
        raise RunTaskError(
            f"{plan.source}: has no 'deployment' section; it says which actions may be planned (actions, motion, loss)"
        )
    if deployment.settings.needs_posterior and not thetas:
        raise RunTaskError(
            f"{plan.source}: deployment.risk.theta: 'posterior' needs --parameters, the theta.json of a calibration by "
            "C4 (in a program: theta), or a calibration in the same run"
        )
    scenes = deployment.scenes
    if receiver is not None:
        scenes = (replace(scenes[0], name=f"plan:{receiver.name}", receiver=receiver),)
    changes: dict[str, Any] = {"pours": 0} | ({} if iterations is None else {"iterations": iterations})
    if not isinstance(deployment.settings, D1Settings):
        changes["simulations_per_iteration"] = 1
    settings = D1Settings.like(deployment.settings, **changes)
    found = replace(
        plan,
        name=f"{plan.name.removesuffix(PLANNED)}{PLANNED}",
        parameters=plan.parameters if theta is None else theta,
        calibration=None,
        deployment=replace(deployment, settings=settings, scenes=scenes, thetas=thetas, left_over=left_over, confirm=0),
    )
    return replace(found, resolved=record_of(plan.resolved, found))
