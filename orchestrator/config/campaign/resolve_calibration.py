"""From a calibration as written to its plan: pours, and what each strategy may spend."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from actors.optimizer.core.problem import Linear
from actors.spec import LaboratorySpec
from orchestrator.config.campaign.records_resolve import read_table, resolve_records
from orchestrator.config.campaign.resolve_data import records_of_run
from orchestrator.config.campaign.scenes import SceneBuilder
from orchestrator.config.campaign.sections import CalibrationSection
from orchestrator.config.yaml.source import Place, Report
from orchestrator.plan import CalibrationPlan, NormalPrior, RecordSet
from sim_engine.space import Axis, Space

BELONGS_TO = {
    "grid": ("C1",),
    "per_axis": ("C1",),
    "samples": ("C2",),
    "iterations": ("C3",),
    "initial": ("C3", "C4"),
    "kappa": ("C3", "C4"),
    "averaging": ("C4",),
}
"""Keys that only some strategies use: given to another, they were misunderstood."""

OWN_KEYS = {"C1": ("grid", "per_axis"), "C2": ("samples",), "C3": ("iterations",), "C4": ()}
"""Keys that say what a strategy tries; 'simulations' alone will do as well."""

EXAMPLES = {"C1": "per_axis: 10", "C2": "samples: 18", "C3": "iterations: 59", "C4": "simulations: 108"}

MOST_SIMULATIONS = 200_000
"""More than anybody waits for: a slip of the pen, or a grid over too many parameters."""


@dataclass(frozen=True)
class Budget:
    """What a strategy may spend; see `CalibrationPlan`."""

    simulations: int
    grid: dict[str, int] = field(default_factory=dict)
    thetas: int = 0


def resolve_calibration(
    section: CalibrationSection,
    builder: SceneBuilder,
    fixed: dict[str, float],
    searched: dict[str, Axis],
    place: Place,
    laboratory: LaboratorySpec | None,
) -> CalibrationPlan | None:
    """The plan of a calibration; what is wrong goes to the report, and then the plan may be None.

    Args:
        fixed: θ that are not searched.
        searched: axes of those that are, by name.
        place: of the section.
    """
    report = builder.report
    pours, at = section.pours, place.at("pours")
    from_file = pours is not None and pours.source is not None
    from_run = None if pours is None else pours.from_run
    pourer = builder.pourer(section.pourer, place)
    receiver = builder.receiver(section.receiver, place)
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
    records = transfer = None
    count = holdout = 0
    if pours is not None and (from_file or from_run is not None):
        source = "a file" if from_file else "a run"
        for key in ("count", "holdout"):
            if pours.value(key) is not None:
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
            records = records_of_run(from_run, at.at("from_run"), scene, actions, laboratory, report)
    elif pours is not None:
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
    train = _training_pours(count - holdout, records)
    budget = _budget(section, tuple(searched), train, place, report)
    if scene is None or actions is None or budget is None or not searched:
        return None
    return CalibrationPlan(
        strategy=section.strategy,
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
        simulations=budget.simulations,
        random_baseline=section.random_baseline,
        initial=section.initial,
        kappa=section.kappa,
        grid=budget.grid,
        thetas=budget.thetas,
        averaging=section.averaging,
    )


def _prior(
    section: CalibrationSection,
    builder: SceneBuilder,
    place: Place,
    actions: Space | None,
    constraints: tuple[Linear, ...],
) -> tuple[NormalPrior, ...]:
    """The prior over actions, which C4 alone averages over."""
    if section.strategy == "C4":
        return builder.prior(section.actions, place, actions, constraints)
    if not builder.report.is_broken(place.at("strategy")):
        why = f"belongs to C4, which averages over the prior; {section.strategy} simulates the weighed pours"
        if section.actions is None:
            builder.refuse_prior(builder.file.actions, builder.root, why)
        else:
            builder.refuse_prior(section.actions, place, why)
    return ()


def _training_pours(to_be_made: int, records: RecordSet | None) -> int:
    """Pours that every θ of C1, C2 and C3 is simulated on; of those still to be made some may be lost."""
    if records is None:
        return to_be_made
    return sum(pour.split == "train" and pour.normalised_spillage is not None for pour in records.pours)


def _budget(
    section: CalibrationSection, names: tuple[str, ...], train: int, place: Place, report: Report
) -> Budget | None:
    """Check a strategy's keys and count what they cost; None where something is wrong or missing."""
    strategy, before = section.strategy, len(report.problems)
    if report.is_broken(place.at("strategy")):
        return None
    for key, strategies in BELONGS_TO.items():
        if strategy not in strategies and place.at(key).loc in place.document.marks:
            report.add(place.at(key), f"belongs to {' and '.join(strategies)}, not to {strategy}; remove it", key=True)
    given = [key for key in OWN_KEYS[strategy] if section.value(key) is not None]
    if len(given) > 1:
        report.add(place.at(given[1]), f"stands beside '{given[0]}'; keep one of them", key=True)
    own = [place.at(key).loc for key in (*OWN_KEYS[strategy], "simulations")]
    broken = any(loc[: len(mine)] == mine for _, loc in report.broken for mine in own)
    if not given and section.simulations is None and not broken and len(report.problems) == before:
        wanted = "simulations" if strategy == "C4" else OWN_KEYS[strategy][-1]
        report.add(place, f"key '{wanted}' is missing; add for example '{EXAMPLES[strategy]}'", key=True)
    if len(report.problems) > before or broken or (not given and section.simulations is None):
        return None
    if strategy == "C4":
        assert section.simulations is not None
        _check_initial(section, section.simulations, "simulations", place, report)
        return Budget(section.simulations)
    if train < 1 or not names:
        return None  # said elsewhere
    if strategy == "C1":
        return _grid(section, names, train, place, report)
    key = given[0] if given else "simulations"
    thetas = section.value(key) if given else (section.simulations or 0) // train
    if not given and thetas < 1:
        text = f"allows not a single θ: each is simulated on all {train} training pours"
        report.add(place.at("simulations"), text)
        return None
    if strategy == "C3":
        _check_initial(section, thetas, key, place, report)
    return Budget(thetas * train, thetas=thetas) if _fits(section, thetas, train, key, place, report) else None


def _grid(
    section: CalibrationSection, names: tuple[str, ...], train: int, place: Place, report: Report
) -> Budget | None:
    """C1's: as it is written, or the finest with the same number on every axis that the simulations allow."""
    if section.grid is not None:
        key, grid, before = "grid", {name: section.grid.get(name, 0) for name in names}, len(report.problems)
        for name in section.grid:
            if name not in names:
                report.add(place.at("grid", name), f"is not searched; searched are {', '.join(names)}", key=True)
        for name in (n for n in names if n not in section.grid):
            report.add(place.at("grid"), f"has no number of values for {name}, which is searched", key=True)
        if len(report.problems) > before:
            return None
    elif section.per_axis is not None:
        key, grid = "per_axis", dict.fromkeys(names, section.per_axis)
    else:
        key, per_axis = "simulations", 1
        while train * (per_axis + 1) ** len(names) <= (section.simulations or 0):
            per_axis += 1
        if per_axis < 2:
            least = train * 2 ** len(names)
            text = f"allows no grid: 2 values of each searched parameter on {train} training pours take {least}"
            report.add(place.at("simulations"), text)
            return None
        grid = dict.fromkeys(names, per_axis)
    thetas = math.prod(grid.values())
    return Budget(thetas * train, grid) if _fits(section, thetas, train, key, place, report) else None


def _fits(section: CalibrationSection, thetas: int, train: int, key: str, place: Place, report: Report) -> bool:
    cost, limit = thetas * train, section.simulations or MOST_SIMULATIONS
    if cost > limit:
        said = "'simulations' allows" if section.simulations is not None else "at most are possible:"
        report.add(place.at(key), f"makes {thetas} θ × {train} training pours = {cost} simulations; {said} {limit}")
    return cost <= limit


def _check_initial(section: CalibrationSection, budget: int, key: str, place: Place, report: Report) -> None:
    if section.initial > budget:
        at = "initial" if place.at("initial").loc in place.document.marks else key
        unit = "simulations" if section.strategy == "C4" else "θ"
        report.add(place.at(at), f"{section.initial} random parameters don't fit into {budget} {unit}")
