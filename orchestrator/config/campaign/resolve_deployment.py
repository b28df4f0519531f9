"""From a deployment as written to its plan: scenes, budgets, what is minimised, what is known beforehand."""

from __future__ import annotations

from actors.spec import LaboratorySpec
from orchestrator.config.campaign.complaints import PlacedComplaints
from orchestrator.config.campaign.resolve_data import resolve_data
from orchestrator.config.campaign.resolve_objectives import resolve_objectives
from orchestrator.config.campaign.scenes import SceneBuilder
from orchestrator.config.campaign.sections import DeploymentSection, LearningSection, LossSection
from orchestrator.config.yaml.source import Place
from orchestrator.plan import DeploymentPlan
from orchestrator.strategies.deployment.objectives import STOPS
from orchestrator.strategies.settings import Premises
from sim_engine.losses import Loss
from sim_engine.space import Space


def resolve_deployment(
    section: DeploymentSection, builder: SceneBuilder, place: Place, laboratory: LaboratorySpec | None
) -> DeploymentPlan | None:
    """The plan of a deployment; what is wrong goes to the report, and then the plan may be None."""
    report, settings = builder.report, section.settings
    known = not report.is_broken(place.at("strategy"))
    pourer = builder.pourer(section.pourer, place)
    receivers = builder.receivers(section, place)
    actions = builder.space(section.actions, section.motion, place)
    constraints = builder.constraints(section.actions, place, actions)
    builder.refuse_prior(
        section.actions, place, "is what calibration averages over; deployment looks for the best action"
    )
    if known:
        complaints = PlacedComplaints(place, report, frozenset(DeploymentSection.model_fields))
        settings.check(Premises(actions, section.objectives is not None), complaints)
    if settings.pours and laboratory is not None and not laboratory.pours:
        at = place.at("pours") if "pours" in settings.model_fields_set else place
        hint = "name one with a bench" if settings.learns_on_pours else "'pours: 0' only plans"
        report.add(at, f"laboratory '{laboratory.name}' has no bench to pour on; {hint}")
    elif section.confirm and laboratory is not None and not laboratory.pours:
        text = f"laboratory '{laboratory.name}' has no bench to pour on; name one with a bench, or remove it"
        report.add(place.at("confirm"), text)
    loss = section.loss or LossSection()
    if loss.retained_weight is not None and loss.name != "spilled_and_retained":
        report.add(
            place.at("loss", "retained_weight"), f"belongs to spilled_and_retained, not to {loss.name}", key=True
        )
    elif actions is not None and section.objectives is None:
        _check_that_pouring_pays(loss, actions, place.at("loss"), builder)
    scenes = []
    for receiver in receivers or [None]:
        name = "deployment" if receiver is None else f"deployment-{receiver.name}"
        motions = ((section.motion, place.at("motion")),)
        scene = builder.scene(
            name,
            pourer,
            receiver,
            motions,
            () if actions is None else actions.names,
            place,
            recorded=settings.pours == 0 and not section.confirm,
        )
        scenes.append(scene)
        if scene is None:
            break  # one cause, one message
    complete = tuple(scene for scene in scenes if scene is not None)
    if not complete or len(complete) < len(receivers) or actions is None or not known:
        return None
    data = None
    if isinstance(section, LearningSection) and section.data is not None:
        data = resolve_data(section.data, place.at("data"), complete, actions, laboratory, report)
    return DeploymentPlan(
        settings=settings,
        scenes=complete,
        actions=actions,
        loss=Loss(loss.name, 1.0 if loss.retained_weight is None else loss.retained_weight),
        data=data,
        objectives=resolve_objectives(section, place, complete[0], actions, report),
        constraints=constraints,
        confirm=section.confirm,
    )


def _check_that_pouring_pays(loss: LossSection, actions: Space, place: Place, builder: SceneBuilder) -> None:
    """Where a pour may stop before anything has left, doing so must not be the best that there is."""
    stops = [name for name in STOPS if name in actions.names]
    if not stops or (loss.name == "spilled_and_retained" and loss.retained_weight != 0.0):
        return
    at, what = (
        (place.at("retained_weight"), "with 0 the loss")
        if loss.name == "spilled_and_retained"
        else (place.at("name"), f"'{loss.name}'")
    )
    builder.report.add(
        at,
        f"{what} is least where next to nothing is poured, and with {' and '.join(stops)} searched a pour can stop so "
        f"early; fix {' and '.join(stops)} under motion, use spilled_and_retained with a retained_weight above 0, or "
        "'objectives' with their 'floor'",
    )
