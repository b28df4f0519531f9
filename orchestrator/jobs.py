"""What a verb makes of a campaign: its plan, the stages that are to run, and whether the run can be resumed.

The command line, the daemon and notebooks share it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from orchestrator.errors import RunError
from orchestrator.plan import CampaignPlan
from orchestrator.stages import StageDefinition, calibration_stages, deployment_stages, prediction_stages, stages_of

if TYPE_CHECKING:
    from sim_engine.liquid import SimulationParameters
    from sim_engine.vessel.spec import VesselSpec

Verb = Literal["run", "calibrate", "plan"]

PREDICTION_SEEDS = 5

PLANNED = "-plan"
"""Behind the name of a campaign that is planned alone."""


class JobError(RunError):
    """The campaign has not what the verb needs."""

    exit_code = 2


@dataclass(frozen=True)
class Job:
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


def job(plan: CampaignPlan, verb: Verb = "run") -> Job:
    """The work that a verb asks for.

    Raises:
        JobError: the campaign has no section for it.
    """
    match verb:
        case "run":
            return Job(plan, stages_of(plan))
        case "calibrate":
            if plan.calibration is None:
                raise JobError(f"{plan.source}: has no 'calibration' section; there is nothing to calibrate")
            # The deployment stays out: its vessels need not be there yet.
            return Job(replace(plan, deployment=None), calibration_stages(plan.calibration))
        case "plan":
            plan = planned(plan)
            assert plan.deployment is not None
            stages = deployment_stages(plan, plan.deployment)
            return Job(plan, [*stages, *prediction_stages(plan, plan.deployment, PREDICTION_SEEDS)])


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
        left_over: shift that the calibration of θ left (`sim_engine.bands`); None: nobody knows.

    Raises:
        JobError: it has nothing to plan with.
    """
    from orchestrator.config.record import record_of
    from orchestrator.strategies.deployment.d1 import D1Settings

    deployment = plan.deployment
    if deployment is None:
        raise JobError(
            f"{plan.source}: has no 'deployment' section; it says which actions may be planned (actions, motion, loss)"
        )
    if deployment.settings.needs_posterior and not thetas:
        raise JobError(
            f"{plan.source}: deployment.risk.theta: 'posterior' needs --parameters, the theta.json of a calibration by "
            "C4, or a calibration in the same run"
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
