"""From a calibration as written to its plan: pours, and what each strategy may spend."""

from __future__ import annotations

from actors.optimizer.core.problem import Linear
from actors.spec import LaboratorySpec
from orchestrator.config.campaign.complaints import PlacedComplaints
from orchestrator.config.campaign.records_resolve import read_table, resolve_records
from orchestrator.config.campaign.resolve_data import records_of_run
from orchestrator.config.campaign.scenes import SceneBuilder
from orchestrator.config.campaign.sections import CalibrationSection
from orchestrator.config.yaml.source import Place
from orchestrator.plan import CalibrationPlan, NormalPrior
from orchestrator.strategies.doors import calibrations
from sim_engine.space import Axis, Space
from sim_engine.task import Scene

DESIGN_SIMULATIONS = 64
"""Simulations of an active design unless a campaign says how many."""


def resolve_calibration(
    section: CalibrationSection,
    builder: SceneBuilder,
    fixed: dict[str, float],
    searched: dict[str, Axis],
    place: Place,
    laboratory: LaboratorySpec | None,
    known: tuple[NormalPrior, ...] = (),
) -> CalibrationPlan | None:
    """The plan of a calibration; what is wrong goes to the report, and then the plan may be None.

    Args:
        fixed: θ that are not searched.
        searched: axes of those that are, by name.
        place: of the section.
        known: what is known of searched ones beforehand.
    """
    report = builder.report
    pours, at = section.pours, place.at("pours")
    from_file = pours is not None and pours.source is not None
    from_run = None if pours is None else pours.from_run
    pourer = builder.pourer(section.pourer, place)
    receivers = builder.receivers(section, place, inherit=False)
    receiver = receivers[0] if receivers else None
    actions = builder.space(section.actions, section.motion, place)
    constraints = builder.constraints(section.actions, place, actions)
    prior = _prior(section, builder, place, actions, constraints)
    motions = ((section.motion, place.at("motion")),)
    searched_actions = () if actions is None else actions.names
    table = read_table(pours, pours.source, at.at("from"), builder) if pours is not None else None
    constants = {} if table is None else table.constants()
    scene = builder.scene(
        "calibration",
        pourer,
        receiver,
        motions,
        searched_actions,
        place,
        recorded=from_file or from_run is not None,
        constants=constants,
    )
    further = tuple(
        builder.scene(f"calibration-{other.name}", pourer, other, motions, searched_actions, place)
        for other in receivers[1:]
        if other is not None and scene is not None
    )
    if further and from_file:
        text = "stands beside pours that are read 'from' a file, which were made into one; keep 'receiver'"
        report.add(place.at("receivers"), text, key=True)
    tested: list[Scene | None] = []
    for i, value in enumerate((None if pours is None else pours.holdout_receivers) or ()):
        vessel = builder.references.vessel(value, at.at("holdout_receivers", i))
        if vessel is not None and scene is not None:
            name = f"calibration-{vessel.name}"
            if name in {other.name for other in (*further, *tested) if other is not None}:
                report.add(at.at("holdout_receivers", i), f"'{vessel.name}' is poured into already")
            tested.append(builder.scene(name, pourer, vessel, motions, searched_actions, place))
    records = transfer = None
    count = holdout = 0
    if pours is not None and (from_file or from_run is not None):
        source = "a file" if from_file else "a run"
        for key in ("count", "holdout", "holdout_receivers", "design", "simulations"):
            if pours.value(key) not in (None, "stratified"):  # what is meant anyway stands in a run's record
                report.add(
                    at.at(key), f"belongs to pours that are still to be made; these are read 'from' {source}", key=True
                )
    if pours is not None and not from_file:
        for key in ("lip_radius", "transfer", "columns"):
            if at.at(key).loc in at.document.marks:
                report.add(at.at(key), "belongs to pours that are read 'from' a CSV file", key=True)
    if pours is not None and from_file:
        if from_run is not None:
            report.add(at.at("from_run"), "stands beside 'from'; keep one of them", key=True)
        records, transfer = resolve_records(pours, at, builder, table, actions, scene, pourer, motions)
    elif from_run is not None:
        if scene is not None and actions is not None:
            scenes = (scene, *(other for other in (*further, *tested) if other is not None))
            records = records_of_run(from_run, at.at("from_run"), scenes, actions, laboratory, report)
    elif pours is not None:
        if pours.simulations is not None and pours.design != "active":
            report.add(at.at("simulations"), "belongs to 'design: active'; remove it, or add that", key=True)
        count = pours.count or 0
        if (
            not count
            and not report.is_broken(at)
            and not any(report.is_broken(at.at(k)) for k in ("count", "from", "from_run"))
        ):
            text = "needs 'count' (pours to make on the bench), 'from' (a CSV file of weighed pours) or 'from_run'"
            report.add(at, text, key=True)
        holdout = max(1, count // 8) if pours.holdout is None and count > 1 else pours.holdout or 0
        if count and holdout >= count:
            report.add(at.at("holdout"), f"keeps {holdout} of {count} pours for testing, so that none is left to fit")
        if count and laboratory is not None and not laboratory.pours:
            report.add(
                at.at("count"), f"laboratory '{laboratory.name}' has no bench to pour on; name a CSV file with 'from'"
            )
    settings = None
    if not report.is_broken(place.at("strategy")):
        train = count - holdout if records is None else records.training_pours
        complaints = PlacedComplaints(place, report, frozenset(CalibrationSection.model_fields))
        settings = section.settings.settled(tuple(searched), train, complaints)
    active = pours is not None and pours.design == "active" and count > 0
    others = tuple(other for other in further if other is not None)
    if scene is None or len(others) < len(receivers) - 1 or actions is None or settings is None or not searched:
        return None
    return CalibrationPlan(
        settings=settings,
        scene=scene,
        actions=actions,
        constraints=constraints,
        prior=prior,
        parameters=Space(tuple(searched.values())),
        fixed_parameters=fixed,
        pour_count=count,
        holdout=holdout,
        records=records,
        transfer=transfer,
        random_baseline=section.random_baseline,
        parameter_prior=known,
        further=others,
        tested=tuple(scene for scene in tested if scene is not None),
        design="stratified" if pours is None else pours.design,
        design_simulations=(pours.simulations or DESIGN_SIMULATIONS) if pours is not None and active else 0,
    )


def _prior(
    section: CalibrationSection,
    builder: SceneBuilder,
    place: Place,
    actions: Space | None,
    constraints: tuple[Linear, ...],
) -> tuple[NormalPrior, ...]:
    """The prior over actions, for a strategy that averages over it."""
    report, strategy = builder.report, section.settings.strategy
    if section.settings.has_prior:
        return builder.prior(section.actions, place, actions, constraints)
    if not report.is_broken(place.at("strategy")):
        owners = " and ".join(name for name, settings in calibrations().items() if settings.has_prior)
        why = f"belongs to {owners}, which averages over the prior; {strategy} simulates the weighed pours"
        if section.actions is None:
            builder.refuse_prior(builder.file.actions, builder.root, why)
        else:
            builder.refuse_prior(section.actions, place, why)
    return ()
