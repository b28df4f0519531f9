"""What a verb makes of a campaign: its plan, the stages that are to run, and whether the run can be resumed.

The command line, the daemon and notebooks share it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from orchestrator.errors import RunError
from orchestrator.plan import CampaignPlan
from orchestrator.stages import StageDefinition, calibration_stages, deployment_stages, prediction_stages, stages_of

Verb = Literal["run", "calibrate", "plan"]

PREDICTION_SEEDS = 5


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
            from orchestrator.strategies.deployment.d1 import D1Settings

            if plan.deployment is None:
                raise JobError(
                    f"{plan.source}: has no 'deployment' section; it says which actions may be planned (actions, "
                    "motion, loss)"
                )
            if plan.deployment.settings.needs_posterior:
                raise JobError(f"{plan.source}: deployment.risk.theta: 'posterior' needs a calibration in the same run")
            settings = D1Settings.like(plan.deployment.settings, pours=0)
            deployment = replace(plan.deployment, settings=settings, confirm=0)
            planned = replace(plan, name=f"{plan.name}-plan", calibration=None, deployment=deployment)
            stages = deployment_stages(planned, deployment)
            return Job(planned, [*stages, *prediction_stages(planned, deployment, PREDICTION_SEEDS)])
