"""From a deployment as written to its plan: scenes, budgets, what is minimised, what is known beforehand."""

from __future__ import annotations

from actors.spec import LaboratorySpec
from orchestrator.config.campaign.resolve_data import resolve_data
from orchestrator.config.campaign.resolve_objectives import STOPS, resolve_objectives
from orchestrator.config.campaign.scenes import SceneBuilder
from orchestrator.config.campaign.sections import DeploymentSection, PricesSection, TrustSection
from orchestrator.config.yaml.source import Place
from orchestrator.fingerprint import NEW_MODEL
from orchestrator.plan import DeploymentPlan, PricesPlan, RiskPlan, TrustPlan
from sim_engine.losses import Loss
from sim_engine.space import Space
from sim_engine.task import PoseError

EXACT = PoseError(speed_factor=0.0)
"""Standard deviations of errors that are none."""

BELONGS_TO = {
    "iterations": ("D1",),
    "simulations_per_iteration": ("D1",),
    "prior_simulations": ("D3",),
    "per_pour": ("D3",),
    "model": ("D3",),
    "trust": ("D3",),
    "risk": ("D1",),
    "window": ("D1",),
    "prices": ("D3",),
    "mean": ("D2",),
    "data": ("D2", "D3"),
}
"""Deployment keys that only some strategies use: given to another, they were misunderstood."""


def resolve_deployment(
    section: DeploymentSection, builder: SceneBuilder, place: Place, laboratory: LaboratorySpec | None
) -> DeploymentPlan | None:
    """The plan of a deployment; what is wrong goes to the report, and then the plan may be None."""
    report = builder.report
    strategy = section.strategy
    pourer = builder.pourer(section.pourer, place)
    receivers = builder.receivers(section, place)
    actions = builder.space(section.actions, section.motion, place)
    constraints = builder.constraints(section.actions, place, actions)
    builder.refuse_prior(
        section.actions, place, "is what calibration averages over; deployment looks for the best action"
    )
    for key, strategies in BELONGS_TO.items():
        if strategy is not None and section.value(key) is not None and strategy not in strategies:
            report.add(place.at(key), f"belongs to {' and '.join(strategies)}, not to {strategy}; remove it", key=True)
    pours = section.pours
    if pours is None and strategy == "D1":
        pours = 1
    if pours is None and strategy is not None and not report.is_broken(place.at("pours")):
        report.add(
            place, f"key 'pours' is missing; {strategy} learns on real pours, add for example 'pours: 15'", key=True
        )
    if pours == 0 and strategy in ("D2", "D3"):
        report.add(place.at("pours"), f"{strategy} learns on real pours; at least 1 (D1 plans without any)")
    if pours and laboratory is not None and not laboratory.pours:
        at = place.at("pours") if section.pours is not None else place
        hint = "'pours: 0' only plans" if strategy == "D1" else "name one with a bench"
        report.add(at, f"laboratory '{laboratory.name}' has no bench to pour on; {hint}")
    loss = section.loss
    if loss.retained_weight is not None and loss.name != "spilled_and_retained":
        report.add(
            place.at("loss", "retained_weight"), f"belongs to spilled_and_retained, not to {loss.name}", key=True
        )
    elif actions is not None and section.objectives is None:
        _check_that_pouring_pays(section, actions, place.at("loss"), builder)
    scenes = []
    for receiver in receivers or [None]:
        name = "deployment" if receiver is None else f"deployment-{receiver.name}"
        motions = ((section.motion, place.at("motion")),)
        scene = builder.scene(
            name, pourer, receiver, motions, () if actions is None else actions.names, place, recorded=pours == 0
        )
        scenes.append(scene)
        if scene is None:
            break  # one cause, one message
    complete = tuple(scene for scene in scenes if scene is not None)
    if not complete or len(complete) < len(receivers) or actions is None or strategy is None or pours is None:
        return None
    risk = _resolve_risk(section, place, builder)
    objectives = resolve_objectives(section, place, complete[0], actions, report)
    data = None
    if section.data is not None and strategy in BELONGS_TO["data"]:
        data = resolve_data(section.data, place.at("data"), complete, actions, laboratory, report)
    trust = section.trust or TrustSection()
    per_pour = section.per_pour if section.per_pour is not None else 2
    free = strategy == "D3" and per_pour == "free"
    if section.prices is not None and strategy == "D3" and not free:
        report.add(
            place.at("prices"),
            f"decides nothing with 'per_pour: {per_pour}'; write 'per_pour: free', or remove it",
            key=True,
        )
    prices = section.prices or PricesSection()
    model = (section.model or NEW_MODEL) if strategy == "D3" else "residual"
    return DeploymentPlan(
        strategy=strategy,
        scenes=complete,
        actions=actions,
        constraints=constraints,
        loss=Loss(loss.name, 1.0 if loss.retained_weight is None else loss.retained_weight),
        pours=pours,
        iterations=section.iterations or (15 if risk is None else 30),
        simulations_per_iteration=section.simulations_per_iteration or 2,
        prior_simulations=37 if section.prior_simulations is None else section.prior_simulations,
        per_pour=(None if per_pour == "free" else int(per_pour)) if strategy == "D3" else 0,
        mean=section.mean or "constant",
        kappa=section.kappa,
        initial=section.initial,
        on_failed_pour=section.on_failed_pour,
        data=data,
        objectives=objectives,
        model=model,
        trust=TrustPlan(trust.pours, trust.limit, trust.policy) if strategy == "D3" else None,
        noise=section.noise,
        refusals="avoid",
        risk=risk,
        tolerance=None if section.window is None else section.window.tolerance,
        prices=PricesPlan(prices.pour, prices.simulation, prices.worth) if free else None,
        plain=strategy == "D3" and model == "residual",
    )


def _check_that_pouring_pays(section: DeploymentSection, actions: Space, place: Place, builder: SceneBuilder) -> None:
    """Where a pour may stop before anything has left, doing so must not be the best that there is."""
    loss = section.loss
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


def _resolve_risk(section: DeploymentSection, place: Place, builder: SceneBuilder) -> RiskPlan | None:
    """What a deployment under risk has to bear; without meaning beside objectives."""
    report, risk = builder.report, section.risk
    for key in ("risk", "window"):
        if section.value(key) is not None and section.objectives is not None:
            report.add(place.at(key), "is about a loss; it can't be combined with 'objectives'", key=True)
    if risk is None:
        return None
    at = place.at("risk")
    broken = any(path == at.document.path and loc[: len(at.loc)] == at.loc for path, loc in report.broken)
    if risk.level is not None and risk.measure != "cvar" and not broken:
        report.add(at.at("level"), "belongs to 'measure: cvar'; remove it, or ask for cvar", key=True)
    errors = PoseError(**risk.pose_error.model_dump())
    if errors == EXACT and risk.theta == "best" and not broken:
        report.add(
            at,
            "names nothing that could go wrong; add 'pose_error: {x: 3 mm, speed_factor: 0.02}', or 'theta: posterior'",
            key=True,
        )
    if section.simulations_per_iteration == 1:
        report.add(
            place.at("simulations_per_iteration"),
            "one simulation of each action is made as planned, so that with 'risk' at least 2 are needed",
        )
    return RiskPlan(risk.measure, 0.9 if risk.level is None else risk.level, errors, risk.theta)
