"""Converts the sections `dispense` and `mixtures` of a campaign's file to the plan of a series of doses.

`resolve_mixtures` reads the amounts of mixtures, inline or from a table (CSV or .xlsx), and converts them to masses.
All problems are reported at once, with their lines.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace

from actors.laboratory_settings import LaboratorySettings
from actors.places import CellVessel, all_places
from orchestrator.campaigns.campaign_file import (
    DispenseSettings,
    DoseSeriesSettings,
    MixedLiquidSettings,
    MixturesSettings,
    parse_amount,
)
from orchestrator.campaigns.saved_table import TableRow, read_saved_table
from orchestrator.campaigns.scene_builder import SceneBuilder
from orchestrator.campaigns.yaml.file_access import missing_file, resolved
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.campaigns.yaml.yaml_source import Place, Report
from orchestrator.learning.campaign_plan import DispensePlan, MixturePlan, PlannedDose
from orchestrator.learning.mixtures import pouring_order
from sim_engine.errors import did_you_mean
from sim_engine.liquids import Liquid
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import VesselError, VesselSpec
from sim_engine.vessel.vessel import build_vessel

DOSE_MOTION = {"angular_velocity": math.radians(115.0), "max_angle": math.radians(110.0)}
"""Fastest tilt and range of a dose, where the motion does not limit them."""

CUP_COLUMNS = ("cup", "position", "well", "vial", "destination well")
"""Names of the column with the cups."""

WHOLE = 1e-3
"""Largest relative difference between the amounts of a mixture and its total, if some are percentages of it."""


def resolve_dispense(
    section: DispenseSettings, builder: SceneBuilder, place: Place, laboratory: LaboratorySettings | None
) -> DispensePlan | None:
    """The plan of a series of doses. Problems are added to the report; the plan may then be None."""
    report = builder.report
    require_bench(laboratory, place, report)
    pourers: list[VesselSpec | None] = (
        [builder.pourer(None, place)]
        if section.sources is None
        else [builder.references.vessel(source, place.at("sources", i)) for i, source in enumerate(section.sources)]
    )
    receivers: dict[str, VesselSpec | None] = {}
    doses = []
    for i, dose in enumerate(section.doses or ()):
        vessel = builder.receiver(dose.receiver, place.at("doses", i))
        if vessel is None or dose.amount is None:
            continue
        if receivers.setdefault(vessel.name, vessel) != vessel:
            report.add(place.at("doses", i), f"two different receivers are both called '{vessel.name}'")
        limit = section.tolerance if dose.tolerance is None else dose.tolerance
        doses.append(PlannedDose(dose.amount, limit, vessel.name, dose.position or ""))
    names = [source.name for source in pourers if source is not None]
    if len(set(names)) < len(names):
        report.add(place.at("sources"), "two sources have the same name; give each vessel its own")
    if report.problems or laboratory is None:
        return None
    scenes = [
        _scene(section, builder, place, "dispense", pourer, receiver)
        for pourer in pourers
        for receiver in receivers.values()
    ]
    return _plan(section, scenes, doses, laboratory)


def require_bench(laboratory: LaboratorySettings | None, place: Place, report: Report) -> None:
    """Report a section that pours in a laboratory without bench."""
    if laboratory is not None and not laboratory.pours:
        report.add(place, f"laboratory '{laboratory.name}' has no bench to pour on; name one with a bench", key=True)


def _scene(
    section: DoseSeriesSettings,
    builder: SceneBuilder,
    place: Place,
    prefix: str,
    source: VesselSpec | None,
    receiver: VesselSpec | None,
) -> Scene | None:
    """The scene of a source and a receiver, with the usual motion of a dose where the file gives none."""
    assert source is not None
    assert receiver is not None
    motions = [motion for motion in (builder.file.motion, section.motion) if motion is not None]
    given = {name for motion in motions for name in motion.fixed()}
    constants = {name: value for name, value in DOSE_MOTION.items() if name not in given}
    name, own = f"{prefix}-{source.name}-{receiver.name}", ((section.motion, place.at("motion")),)
    return builder.scene(name, source, receiver, own, (), place, constants=constants)


def _plan(
    section: DoseSeriesSettings,
    scenes: list[Scene | None],
    doses: list[PlannedDose],
    laboratory: LaboratorySettings,
    mixtures: MixturePlan | None = None,
) -> DispensePlan | None:
    complete = [scene for scene in scenes if scene is not None]
    if len(complete) < len(scenes):
        return None
    as_left = section.start == "as_left"
    return DispensePlan(
        tuple(complete), tuple(doses), section.refill_below, as_left, laboratory.name, mixtures=mixtures
    )


# ---- mixtures

Amounts = dict[str, dict[str, str]]
"""Amounts as texts with units, by cup and liquid."""

Complain = Callable[[str, str, str], None]
"""Reports a problem of a cup's liquid ('' for all of the cup)."""


def resolve_mixtures(
    section: MixturesSettings, builder: SceneBuilder, place: Place, laboratory: LaboratorySettings | None
) -> tuple[DispensePlan | None, MixturesSettings]:
    """The plan of mixtures, and their section with the amounts of its table.

    Problems are added to the report; the plan may then be None.
    """
    report = builder.report
    require_bench(laboratory, place, report)
    liquids, sources = _liquids(section, builder, place)
    cup = builder.receiver(section.cups.vessel, place.at("cups"))
    names = [liquid.name for liquid in section.liquids or () if liquid.name is not None]
    if section.source is None:
        amounts, complain = {name: dict(row) for name, row in (section.wanted or {}).items()}, _in_file(builder, place)
    else:
        amounts, complain = _read_table(section.source, builder, place.at("from"), names)
    masses = _Masses(section, liquids, names, complain)
    cups = {name: masses.of_cup(name, row) for name, row in amounts.items()}
    positions = _positions(section, list(cups), builder, place, complain)
    if laboratory is not None and laboratory.places:
        _check_places(laboratory, section, positions, place, builder, complain)
    if cup is not None:
        _check_brim(cup, cups, liquids, section, complain)
    if report.problems or laboratory is None or cup is None:
        return None, section
    limits = {liquid.name: liquid.tolerance or section.tolerance for liquid in section.liquids}
    planned = {
        positions[name]: {
            liquid: PlannedDose(row[liquid], limits[liquid], cup.name, positions[name], liquid)
            for liquid in pouring_order(row, section.order)
        }
        for name, row in cups.items()
    }
    spares, proposals = (
        tuple(_position(section, cup) for cup in cups or ()) for cups in (section.cups.spares, section.cups.proposals)
    )
    order = None if section.order is None or not proposals else tuple(section.order)
    batches = {liquid.name: liquid.batch for liquid in section.liquids if liquid.batch is not None}
    mixtures = MixturePlan(planned, section.on_miss, spares, section.max_open, batches, proposals or None, order)
    scenes = [
        _scene(section, replace(builder, liquid=liquids[liquid]), place, "mixtures", source, cup)
        for liquid, source in sources
    ]
    doses = [dose for row in planned.values() for dose in row.values()]
    read = section.model_copy(update={"wanted": amounts, "source": None})
    return _plan(section, scenes, doses, laboratory, mixtures), read


def _liquids(
    section: MixturesSettings, builder: SceneBuilder, place: Place
) -> tuple[dict[str, Liquid], list[tuple[str, VesselSpec]]]:
    """The liquids by name, and the sources of each, named after their stands."""
    liquids: dict[str, Liquid] = {}
    sources: list[tuple[str, VesselSpec]] = []
    taken: set[str] = set()
    for i, entry in enumerate(section.liquids or ()):
        at = place.at("liquids", i)
        liquid = builder.references.liquid(entry.liquid, at.at("liquid"))
        vessel = (
            builder.pourer(None, place)
            if entry.source is None
            else builder.references.vessel(entry.source, at.at("source"))
        )
        if liquid is not None and entry.name is not None:
            liquids[entry.name] = liquid.model_copy(update={"name": entry.name})
        for j, stand in enumerate(_stands(entry)):
            if stand in taken:
                builder.report.add(at.at("stands", j), f"another source is called '{stand}'; each stand holds one")
            taken.add(stand)
            if vessel is not None and entry.name is not None:
                sources.append((entry.name, vessel.model_copy(update={"name": stand})))
        if entry.stands == []:
            builder.report.add(at.at("stands"), "is empty; name at least one, or remove it")
    return liquids, sources


def _stands(entry: MixedLiquidSettings) -> list[str]:
    return [f"source/{entry.name}"] if entry.stands is None else entry.stands


def _in_file(builder: SceneBuilder, place: Place) -> Complain:
    def complain(cup: str, liquid: str, text: str) -> None:
        builder.report.add(place.at("wanted", cup, *([liquid] if liquid else [])), text, key=not liquid)

    return complain


def _read_table(source: str, builder: SceneBuilder, place: Place, liquids: list[str]) -> tuple[Amounts, Complain]:
    """The amounts of a table: a column of cups, and one for each liquid.

    The unit of an amount is in the header, 'water_g' or 'water [g]', or in each cell.
    """
    problems, amounts, path = builder.report.problems, Amounts(), resolved(place.directory / source)
    rows: dict[str, TableRow] = {}
    columns: dict[int, tuple[str, str]] = {}
    try:
        if (missing := missing_file(path)) is not None:
            builder.report.add(place, missing)
            raise ConfigError([])
        table = read_saved_table(path)
    except ConfigError as error:
        problems.extend(error.problems)
        return amounts, lambda cup, liquid, text: None

    def complain(cup: str, liquid: str, text: str) -> None:
        index = next((i for i, (name, _) in columns.items() if name == liquid), None)
        problems.append(table.problem(rows[cup], index, liquid or cup, text))

    cups: list[int] = []
    for i, cell in enumerate(table.header.cells):
        if " ".join(re.split(r"[\s_]+", str(cell).strip().lower())) in CUP_COLUMNS:
            cups.append(i)
            continue
        name, unit = _column(str(cell), liquids)
        if name not in liquids:
            guess = did_you_mean(name, liquids)
            text = f"did you mean '{guess}'?" if guess else f"no source holds it; there are {', '.join(liquids)}"
            problems.append(table.problem(table.header, i, str(cell), f"is no liquid of the mixtures: {text}"))
        elif any(name == other for other, _ in columns.values()):
            problems.append(table.problem(table.header, i, str(cell), f"'{name}' has two columns; keep one"))
        else:
            columns[i] = (name, unit)
    if len(cups) != 1:
        text = "has no column 'cup'" if not cups else "has two columns with cups; keep one"
        names = f"it names the position of each mixture, in one line ({', '.join(CUP_COLUMNS)})"
        problems.append(table.problem(table.header, None, "", f"{text}; {names}"))
        return amounts, complain
    problems.extend(misfits := table.misfits())
    for row in () if misfits else table.rows:
        cup = str(row.cells[cups[0]]).strip().removesuffix(".0")
        if not cup:
            problems.append(table.problem(row, cups[0], "cup", "is empty; every mixture needs a cup"))
            continue
        if cup in rows:
            text = f"'{cup}' is named in line {rows[cup].line}, too; a cup is filled once"
            problems.append(table.problem(row, cups[0], "cup", text))
            continue
        rows[cup] = row
        amounts[cup] = {}
        for i, (name, unit) in columns.items():
            if row.cells[i] == "":
                continue
            try:
                text = f"{table.number(row.cells[i]):.12g} {unit}" if unit else str(row.cells[i])
                parse_amount(text)
            except ValueError as error:
                problems.append(table.problem(row, i, name, str(error)))
            else:
                amounts[cup][name] = text
    return amounts, complain


def _column(header: str, liquids: list[str]) -> tuple[str, str]:
    """Liquid and unit that the header of a column names; the unit is '' if it has none."""
    bracketed = re.fullmatch(r"(.*?)\s*[\[(]\s*(.*?)\s*[\])]", header)
    text, unit = (bracketed[1], bracketed[2]) if bracketed else (header, "")
    text = re.sub(r"(?i)([\s_]+transfer)?[\s_]+(volume|mass|weight|amount)$", "", text) if bracketed else text
    by_word = {re.sub(r"[\s_-]+", "_", liquid.strip()).lower(): liquid for liquid in liquids}
    word = re.sub(r"[\s_-]+", "_", text.strip()).lower()
    if word in by_word:
        return by_word[word], unit
    for name in sorted(by_word, key=len, reverse=True):
        if word.startswith(f"{name}_") and not unit:
            suffix = re.split(r"[\s_-]+", text.strip())[-1]
            return by_word[name], "%" if suffix == "percent" else suffix
    return text, unit


class _Masses:
    """Converts the amounts of mixtures to masses.

    Args:
        section: tolerances and the total.
        liquids: with their densities, by name; those with a problem are absent.
        names: of all liquids.
        complain: receives the problems.
    """

    def __init__(
        self, section: MixturesSettings, liquids: Mapping[str, Liquid], names: list[str], complain: Complain
    ) -> None:
        self._section, self._liquids, self._names, self._complain = section, liquids, names, complain
        self._limits = {entry.name: entry.tolerance or section.tolerance for entry in section.liquids or ()}

    def of_cup(self, cup: str, row: Mapping[str, str]) -> dict[str, float]:
        """The masses of one cup by liquid [kg]; liquids without any are absent."""
        masses: dict[str, float] = {}
        shares: list[float] = []
        for name, text in row.items():
            if name not in self._names:
                guess = did_you_mean(name, self._names)
                hint = f"did you mean '{guess}'?" if guess else "add it to 'liquids', with its source"
                self._complain(cup, name, f"no source holds '{name}'; {hint}")
                continue
            amount, unit = parse_amount(text)
            if unit == "1" and self._section.total is None:
                self._complain(cup, name, f"{text} needs the mass of the mixture; add for example 'total: 60 g'")
                continue
            if unit == "1":
                shares.append(amount)
                amount *= self._section.total or 0.0
            elif unit == "m^3" and name in self._liquids:
                amount *= self._liquids[name].density
            if amount > 0.0 and name in self._liquids:
                masses[name] = amount
                self._check_dose(cup, name, amount)
        if not masses and set(row) <= set(self._names):
            self._complain(cup, "", "has nothing to pour; name an amount, or remove the cup")
        total = self._section.total
        if shares and total is not None and len(masses) == len(row) and abs(sum(masses.values()) / total - 1.0) > WHOLE:
            made = f"{1e3 * sum(masses.values()):.4g} g"
            self._complain(cup, "", f"the amounts make {made}, and 'total' is {1e3 * total:.4g} g; which is meant?")
        return masses

    def _check_dose(self, cup: str, name: str, amount: float) -> None:
        limit, full = self._limits[name], self._liquids[name].mass
        needed = amount + (limit or 0.0) + self._section.refill_below
        if limit is not None and amount <= limit:
            self._complain(cup, name, f"{1e3 * amount:.4g} g should be more than its tolerance, {1e3 * limit:.4g} g")
        elif needed >= full:
            text = f"a full source holds {1e3 * full:g} g, and the dose, its tolerance and refill_below need"
            self._complain(cup, name, f"{text} {1e3 * needed:.4g} g")


def _positions(
    section: MixturesSettings, cups: list[str], builder: SceneBuilder, place: Place, complain: Complain
) -> dict[str, str]:
    """The positions of the cups, by their names in the table; each is named once."""
    positions: dict[str, str] = {}
    for cup in cups:
        position = _position(section, cup)
        other = next((name for name, taken in positions.items() if taken == position), None)
        if other is not None:
            complain(cup, "", f"'{cup}' is '{other}', which is named before; a cup is filled once")
        positions[cup] = position
    for key in ("spares", "proposals"):
        for i, cup in enumerate(getattr(section.cups, key) or ()):
            position = _position(section, cup)
            if position in positions.values():
                builder.report.add(place.at("cups", key, i), f"'{cup}' is named before; such a cup is empty")
            positions[f"{key} {i}"] = position
    return positions


def _position(section: MixturesSettings, cup: str) -> str:
    """The position of a cup: 'rack/A1' for 'a1', 'A01' and 'rack/A1'."""
    name = cup.strip().removeprefix(f"{section.cups.rack}/")
    usual = re.fullmatch(r"([A-Za-z])0*([1-9][0-9]*)", name)
    return f"{section.cups.rack}/{usual[1].upper()}{usual[2]}" if usual else f"{section.cups.rack}/{name}"


def _check_places(
    laboratory: LaboratorySettings,
    section: MixturesSettings,
    positions: Mapping[str, str],
    place: Place,
    builder: SceneBuilder,
    complain: Complain,
) -> None:
    """Check that every source and cup has a place in the laboratory."""
    places = [position.name for position in all_places(laboratory.places)]
    lacks = f"laboratory '{laboratory.name}' has no place"
    ends = [[position.name for position in each.each] for each in laboratory.places]
    named = ", ".join(f"{names[0]} … {names[-1]}" if len(names) > 1 else names[0] for names in ends)
    for name, position in positions.items():
        key, _, number = name.partition(" ")
        if position not in places and key in ("spares", "proposals"):
            builder.report.add(place.at("cups", key, int(number)), f"{lacks} '{position}'")
        elif position not in places:
            complain(name, "", f"{lacks} '{position}'; there are {named}")
    for i, entry in enumerate(section.liquids or ()):
        for j, stand in enumerate(_stands(entry)):
            at = place.at("liquids", i, "name") if entry.stands is None else place.at("liquids", i, "stands", j)
            if stand not in places:
                builder.report.add(at, f"{lacks} '{stand}'; there are {named}")


def cell_vessels(plan: DispensePlan) -> tuple[CellVessel, ...]:
    """The vessels of mixtures by their identities, for a laboratory with places; none without mixtures."""
    if plan.mixtures is None:
        return ()
    vessels = []
    for source in plan.sources:
        scene = next(scene for scene in plan.scenes if scene.pourer.name == source)
        liquid = scene.liquid
        vessels.append(CellVessel(source, scene.pourer, liquid.name, liquid.mass, liquid.volume, not plan.as_left))
    densities = {scene.liquid.name: scene.liquid.density for scene in plan.scenes}
    rows = [list(row.values()) for row in plan.mixtures.cups.values()]
    mass = max(sum(dose.amount + dose.limit for dose in row) for row in rows)
    volume = max(sum((dose.amount + dose.limit) / densities[dose.liquid or ""] for dose in row) for row in rows)
    cup = plan.scenes[0].receiver
    names = (*plan.mixtures.cups, *plan.mixtures.spares, *(plan.mixtures.proposals or ()))
    return (*vessels, *(CellVessel(name, cup, "", mass, volume) for name in names))


def _check_brim(
    cup: VesselSpec,
    cups: Mapping[str, Mapping[str, float]],
    liquids: Mapping[str, Liquid],
    section: MixturesSettings,
    complain: Complain,
) -> None:
    """Check that each mixture, with its tolerances, fits into its cup."""
    try:
        capacity = build_vessel(cup).capacity
    except (VesselError, OSError):
        return  # which the check of the vessels reports
    limits = {entry.name: entry.tolerance or section.tolerance or 0.0 for entry in section.liquids or ()}
    for name, masses in cups.items():
        volume = sum((mass + limits[liquid]) / liquids[liquid].density for liquid, mass in masses.items())
        if volume > capacity:
            text = f"with its tolerances the mixture has {1e6 * volume:.4g} mL"
            complain(name, "", f"{text}, and '{cup.name}' holds {1e6 * capacity:.4g} mL to the brim")
