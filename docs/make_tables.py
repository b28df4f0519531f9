"""Writes the tables of the pages under docs/ from the code's own declarations, between their markers.

A page holds `<!-- table: NAME -->` and `<!-- end of table -->`; what stands between is replaced. A test fails when a
page is not current. Run from the project's root: python docs/make_tables.py
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import os
import re
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from actors import laboratory_settings as laboratory
from actors.arm.arm_settings import arm_settings
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import ArmLimits, RobotCell
from actors.balance.balance_settings import SerialBalanceSettings
from actors.balance.display_behaviour import DisplayBehaviour
from actors.balance.scale_model import ScaleSettings
from actors.dosing_settings import DosingSettings
from actors.grippers.digital_gripper import DigitalSettings
from actors.grippers.franka_hand import HandSettings
from actors.grippers.onrobot_gripper import OnRobotSettings
from actors.grippers.robotiq_gripper import RobotiqSettings
from actors.interfaces import OperatorSettings, RaySettings
from actors.liquid_devices import SimulatedPumpSettings, SimulatedSpillSensorSettings, SourceSettings
from actors.places import ContainerSettings, PlaceSettings, RackSettings, UnattendedSettings
from orchestrator.campaigns import campaign_file as campaign
from orchestrator.campaigns import file_references as vessel
from orchestrator.campaigns.pour_table import MASS_COLUMNS, SPLITS, column_name
from orchestrator.campaigns.scene_builder import DEFAULTS, NEEDED
from orchestrator.campaigns.yaml.section_validation import sections_in
from orchestrator.catalogue.control_charts import CHECKS, QUANTITIES
from orchestrator.catalogue.run_reading import TABLES as CATALOGUE
from orchestrator.daemon.state import daemon_settings as daemon
from orchestrator.daemon.state.notifications import NotifySettings
from orchestrator.learning.campaign_plan import OutputSettings
from orchestrator.learning.deployment.model_monitoring import (
    RiskLimitSettings,
    StopSettings,
)
from orchestrator.learning.deployment.objectives import Objective
from orchestrator.learning.strategy_registry import OBJECTIVES, STRATEGIES
from orchestrator.recordings import recording_file as recording
from orchestrator.records.states import State
from orchestrator.study import study_file as study
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.liquids import KNOWN, ROOM, LiquidSettings, SimulationParameters
from sim_engine.outcome import Loss
from sim_engine.scene import PoseErrorSettings
from sim_engine.settings.model import Choice, Settings, meanings
from sim_engine.settings.quantity import Quantity
from sim_engine.vessel.shapes import ProfileShape, VesselGrip

FOLDER = Path(__file__).parent
MARKED = re.compile(r"(<!-- table: ([\w-]+) -->\n).*?(<!-- end of table -->)", re.DOTALL)

SECTIONS: dict[str, type[Settings]] = {
    "campaign": campaign.CampaignFile,
    "simulator": campaign.SimulatorSettings,
    "calibration": campaign.CalibrationSection,
    "pours": campaign.PoursSettings,
    "transfer": campaign.TransferSettings,
    "deployment": campaign.DeploymentSection,
    "risk_limit": RiskLimitSettings,
    "stop": StopSettings,
    "data": campaign.DataSettings,
    "dispense": campaign.DispenseSettings,
    "dose": campaign.DoseSettings,
    "mixtures": campaign.MixturesSettings,
    "mixed-liquid": campaign.MixedLiquidSettings,
    "cups": campaign.CupsSettings,
    "dosing": DosingSettings,
    "loss": Loss,
    "objective": Objective,
    "outputs": OutputSettings,
    "liquid": LiquidSettings,
    "vessel": vessel.VesselFile,
    "profile": ProfileShape,
    "grip": VesselGrip,
    "recording": recording.RecordingFile,
    "placement": recording.RecordedPlacement,
    "recorded-balance": recording.RecordedBalance,
    "origin": recording.RecordedOrigin,
    "laboratory": laboratory.LaboratorySettings,
    "ray": RaySettings,
    "arm": UrArmSettings,
    "limits": ArmLimits,
    "cell": RobotCell,
    "places": PlaceSettings,
    "rack": RackSettings,
    "container": ContainerSettings,
    "unattended": UnattendedSettings,
    "gripper-robotiq": RobotiqSettings,
    "gripper-onrobot": OnRobotSettings,
    "gripper-franka": HandSettings,
    "gripper-digital": DigitalSettings,
    "pump": SimulatedPumpSettings,
    "source": SourceSettings,
    "spill-sensor": SimulatedSpillSensorSettings,
    "operator": OperatorSettings,
    "bench": laboratory.BenchSettings,
    "balance": SerialBalanceSettings,
    "balance-display": laboratory.BenchBalance,
    "virtual-balance": ScaleSettings,
    "display-behaviour": DisplayBehaviour,
    "pose-error": PoseErrorSettings,
    "study": study.StudyFile,
    "level": study.LevelSettings,
    "compared-calibrations": study.CalibrationsSettings,
    "compared-deployments": study.DeploymentsSettings,
    "daemon": daemon.DaemonFile,
    "listen": daemon.ListenSettings,
    "tls": daemon.TlsSettings,
    "live": daemon.LiveSettings,
    "madsci": daemon.MadsciSettings,
    "recordings": daemon.RecordingsSettings,
    "notify": NotifySettings,
}

OF_SECTIONS = {
    **{model.__name__: f"[{name}](#{name})" for name, model in SECTIONS.items()},
    "BenchBalance": "[display](#display)",
    "ClusterSettings": "`{address: host:port}`",
    **dict.fromkeys((arm.__name__ for arm in arm_settings().values()), "[arm](#arm)"),
    "RobotCell": "[cell](#cell)",
    "ArmLimits": "[limits](#limits)",
    "Box": "`{low: {x, y, z}, high: {x, y, z}}`, lengths",
    "Plane": "`{normal: [x, y, z], offset: length}`",
    "Point": "`{x, y, z}`, lengths",
    "Centre": "`{x, y, z}`, lengths",
    "Pose": "`{x, y, z, rx, ry, rz}`, lengths and a rotation vector in rad",
    "Mount": "`{tilt, turn}`, angles",
    "JointAngles": "`{base, shoulder, elbow, wrist1, wrist2, wrist3}`, angles",
    "SerialBalanceSettings": "[balance](#balance)",
    "SimulatedBalanceSettings": "[balance](#balance)",
    "ScaleSettings": "[virtual balance](#virtual-balance)",
    "DisplayBehaviour": "[display behaviour](#display-behaviour)",
    "PumpSettings": "[pump](#pump)",
    "GripperSettings": "[gripper](grippers.md)",
    "PlaceSettings": "[place](places.md#settings)",
    "RackSettings": "[rack](places.md#racks)",
    "ContainerSettings": "[container](places.md#waste)",
    "UnattendedSettings": "[unattended](places.md#settings)",
    "EmulatedHandSettings": "[gripper](grippers.md)",
    "EmulatedOnRobotSettings": "[gripper](grippers.md)",
    "EmulatedRobotiqSettings": "[gripper](grippers.md)",
    "SpillSensorSettings": "[spill sensor](#spill-sensor)",
    "OperatorSettings": "[operator](#operator)",
    "TrueLiquid": "[parameters](#simulator), one value each",
    "PoseErrorSettings": "[pose error](#pose-error)",
    "PoseNoise": "standard deviations of the [pose error](#pose-error)",
    "TransferSettings": "[transfer](#transfer)",
    "RecordedPlacement": "[placement](#placement)",
    "RecordedBalance": "[balance](#recorded-balance)",
    "RecordedOrigin": "[origin](#origin)",
    "Loss": "[loss](#loss)",
    "Objective": "[objective](#objectives)",
    **{model.__name__: "[objective](#objectives)" for model in OBJECTIVES.all.values()},
    "RiskLimitSettings": "[risk limit](#risk-limit)",
    "StopSettings": "[stop](#stop)",
    "DataSettings": "[data](#data)",
    "DispenseSettings": "[dispense](#dispense)",
    "DoseSettings": "[dose](#dose)",
    "MixturesSettings": "[mixtures](#mixtures)",
    "MixedLiquidSettings": "[mixed liquid](#mixed-liquid)",
    "CupsSettings": "[cups](#cups)",
    "DosingSettings": "[dosing](#dosing)",
    "ProfileShape": "[profile](#profile)",
    "Motion": "[motion](#motion-and-actions)",
    "Actions": "[actions](#motion-and-actions)",
    "Parameters": "[parameters](#simulator)",
    "VesselFile": "[vessel](#vessel) or the path of its file",
    "LaboratorySettings": "[laboratory](#laboratory) or the path of its file",
    "LiquidSettings": "[liquid](#liquid) or the path of its file",
    "LevelSettings": "[level](#level)",
    **{
        model.__name__: f"`{{{', '.join(model.written_keys())}}}`, each a mapping"
        for model in (study.CalibrationsSettings, study.DeploymentsSettings)
    },
    **{f"{name}ArmSettings": "mapping" for name in STRATEGIES.names},
    **{model.__name__: "[calibration](#calibration)" for model in campaign.CALIBRATIONS.values()},
    **{model.__name__: "[deployment](#deployment)" for model in campaign.DEPLOYMENTS.values()},
}


REFERENCE = tuple(sorted((FOLDER / "reference").glob("*.md")))
"""Pages that explain the keys of files; a table on one of them may link to what another one explains."""


def render(text: str, page: Path) -> str:
    """The page with its tables as the code has them now.

    Args:
        text: of the page.
        page: its file; links to what other pages explain lead there.

    Raises:
        KeyError: a marker names a table that does not exist.
    """
    homes = {anchor: home for home in reversed(REFERENCE) for anchor in _anchors(home.read_text("utf-8"))}
    own = _anchors(text)

    def linked(match: re.Match[str]) -> str:
        home = homes.get(match[1])
        if match[1] in own or home is None or home == page:
            return match[0]
        return f"({os.path.relpath(home, page.parent)}#{match[1]})"

    def table(match: re.Match[str]) -> str:
        return f"{match[1]}{re.sub(r'[(]#([a-z-]+)[)]', linked, TABLES[match[2]]())}{match[3]}"

    return MARKED.sub(table, text)


def _anchors(text: str) -> set[str]:
    """Those of a page's headings."""
    return {heading.lower().replace(" ", "-") for heading in re.findall(r"^#+ ([A-Za-z ]+)$", text, re.MULTILINE)}


def pages() -> list[Path]:
    """All pages that hold tables. Those of the kill matrix are written by `tests.reliability.page`."""
    found = (page for page in sorted(FOLDER.rglob("*.md")) if page.parent.name != "notes")
    return [page for page in found if any(name in TABLES for _, name, _ in MARKED.findall(page.read_text("utf-8")))]


def actions() -> str:
    """What an action consists of."""
    rows = []
    for name, d in ACTION_DIMENSIONS.items():
        default: Any = DEFAULTS.get(name)
        if name in NEEDED:
            given = "none: fix it or search it"
        elif default is None:
            given = f"`{d.switched_off}`"
        else:
            given = f"{default / d.factor:g} {d.display_unit}"
        bounds = f"{d.lower / d.factor:g} … {d.upper / d.factor:g} {d.display_unit}"
        rows.append((f"`{name}`", bounds, given, d.meaning))
    return _table(("name", "bounds", "unless given", "meaning"), rows)


def parameters() -> str:
    """What calibration may turn."""
    rows = []
    for name, info in SimulationParameters.info().items():
        unit = "" if info.shown == "1" else f" {info.shown}"
        lower, upper, usual = (f"{round(value / info.factor, 6):g}" for value in (info.lower, info.upper, info.default))
        beforehand = f" Beforehand ± {info.tolerance / info.factor:.2g}{unit}." if info.nuisance else ""
        rows.append((f"`{name}`", f"{lower} … {upper}{unit}", f"{usual}{unit}", _one_line(info.meaning) + beforehand))
    return _table(("name", "bounds", "default", "meaning"), rows)


def _validated() -> dict[str, Any]:
    """The records of the solver's validation, by case."""
    return dict(json.loads((FOLDER / "data" / "validation.json").read_text(encoding="utf-8"))["cases"])


def counted_claims() -> str:
    """Claims that are counts or ratios of measured figures: validation, speed, and D3's intervals."""
    judged = [one for record in _validated().values() for one in record["measurements"] if one["judged"]]
    performance = json.loads((FOLDER / "data" / "performance.json").read_text(encoding="utf-8")).values()
    ratios = [one["result"] for one in performance if "ratio_per_simulated_second" in one["result"]]
    faster, whole = (
        f"{min(row['ratio'] for row in rows):.0f} to {max(row['ratio'] for row in rows):.0f} times"
        for rows in (ratios, [row["whole"] for row in ratios])
    )
    results = json.loads((FOLDER / "data" / "results.json").read_text(encoding="utf-8"))
    pours = next(row for row in results["first-pours"]["rows"] if row[:3] == ["with evidence", "all", "first"])
    return _table(
        ("claim", "shown by"),
        (
            (
                f"{sum(one['passed'] for one in judged)} of {len(judged)} physical criteria are met",
                "[validation](validation.md)",
            ),
            (
                f"On one core {faster} as fast as SPlisHSPlasH, by symmetry; whole pours {whole}",
                "[performance](performance.md)",
            ),
            (
                f"First pours after a calibration: {pours[6]} points from their expectation in the mean, {pours[8]} of "
                f"{pours[3]} in their 90 % intervals",
                "[first pours](first-pours.md)",
            ),
        ),
    )


def columns() -> str:
    """Columns of a file of weighed pours."""
    rows = [(f"`{name}`", "g") for name in MASS_COLUMNS] + [("`split`", ", ".join(SPLITS))]
    rows += [(f"`{column_name(d)}`", d.display_unit) for d in ACTION_DIMENSIONS.values()]
    return _table(("column", "unit or words"), rows)


def states() -> str:
    """States of a campaign, each with its docstring."""
    source = Path(State.__module__.replace(".", "/")).with_suffix(".py")
    text = (FOLDER.parent / source).read_text(encoding="utf-8")
    said = dict(re.findall(r'^    ([A-Z_]+) = "[^"]+"\n    """(.*?)"""', text, re.MULTILINE))
    return _table(("state", "meaning"), [(f"{state}", said[state.name]) for state in State])


def catalogued(table: str) -> str:
    """What the columns of one of the catalogue's tables mean."""
    rows = [(f"`{c.name}`", c.unit.replace("1", "fraction"), _one_line(c.meaning)) for c in CATALOGUE[table]]
    return _table(("column", "unit", "meaning"), rows)


def charted() -> str:
    """Quantities with a control chart, and what to check."""
    rows = [(q.label, q.unit, ", ".join(q.groups), _one_line(CHECKS[q.column])) for q in QUANTITIES]
    return _table(("quantity", "unit", "compared for the same", "if it leaves its limits"), rows)


def section(model: type[Settings]) -> str:
    """Keys of a section as people write them."""
    rows = []
    for key, name in model.written_keys().items():
        info = model.model_fields[name]
        default = _default(key, info, model)
        value = _value(info.annotation, info.metadata)
        if model is Objective and name == model.tag:
            value = ", ".join(f"`{word}`" for word in OBJECTIVES.names)
        rows.append((f"`{key}`", value, default, _one_line(meanings(model)[name])))
    return _table(("key", "value", "unless given", "meaning"), rows)


def variants(models: Mapping[str, type[Settings]], common: type[Settings]) -> str:
    """Keys of a tagged union that not all sections of its kind have, each with the variants that have it."""
    owners: dict[tuple[str, ...], list[str]] = {}
    tag = next(iter(models.values())).tag
    for name, model in models.items():
        for key, field in model.written_keys().items():
            info = model.model_fields[field]
            if field in common.model_fields or field == tag:
                continue
            described = _value(info.annotation, info.metadata), _default(key, info, model)
            owners.setdefault((f"`{key}`", *described, _one_line(meanings(model)[field])), []).append(name)
    rows = [("all" if len(names) == len(models) else ", ".join(names), *row) for row, names in owners.items()]
    return _table(("of", "key", "value", "unless given", "meaning"), rows)


def _arms(model: type[Settings]) -> dict[str, type[Settings]]:
    """Sections of the arms of a study, by the strategy that each is of."""
    found = [s for info in model.model_fields.values() for s in sections_in(info.annotation)]
    return {section.variant: section for section in found}


def liquids() -> str:
    """The table of known liquids at 20 °C, solutions at some shares."""
    rows = []
    for known in KNOWN:
        shares = (0.0,) if known.share is None else tuple(s for s in SHOWN_SHARES if s <= known.share[1])
        for share in shares:
            name = known.name if known.share is None else f"{known.name} {share:g} %"
            found = known.at(ROOM, share)
            rows.append(
                (
                    f"`{name}`",
                    f"{found.density:.0f}",
                    f"{1e3 * found.dynamic_viscosity:.3g}",
                    f"{1e6 * found.dynamic_viscosity / found.density:.3g}",
                    f"{1e3 * found.surface_tension:.1f}",
                    f"{known.temperatures[0]:g} … {known.temperatures[1]:g}",
                    f"{100 * known.uncertainty:.0f} %",
                )
            )
    head = ("name", "density kg/m³", "viscosity mPa s", "mm²/s", "tension mN/m", "known at °C", "viscosity ±")
    sources = "".join(f"- {known.name}: {known.source}.\n" for known in KNOWN)
    return f"{_table(head, rows)}\n\n{sources.rstrip()}"


SHOWN_SHARES = (20.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0)


MEASURED = (
    *(
        "recorded",
        "convergence",
        "halves",
        "quickstart-fits",
        "first-pours",
        "misled",
        "memory",
    ),
    *(
        "cliffs",
        "learning",
        "viscosity",
        "dribbling",
        "effects",
    ),
)
"""Tables of docs/data/results.json that a page shows."""
MACHINE = "AMD EPYC, 2 shared cores, Linux x86_64, Python 3.11"
"""The machine of tables that name no other one, as docs/evidence/calibration.md says."""


MEANS_ONLY, HIDDEN = (
    ("recorded", "quickstart-fits", "memory", "cliffs", "milder", "learning"),
    ("seed", "seeds", "best of 15"),
)
"""Tables of which a page shows the means alone, and columns that it leaves out: docs/data/results.json has all."""


LEFT_OUT: dict[str, Callable[[Sequence[str]], bool]] = {
    "first-pours": lambda row: row[0] == "no evidence" and row[1] != "all",
    "quickstart-fits": lambda row: row[1] != "auto",
    "effects": lambda row: set(row[2:]) == {"none"},
}
"""Rows that a page leaves out, likewise."""


def measured(name: str) -> str:
    """A table of docs/data/results.json, with how it was measured."""
    found = json.loads((FOLDER / "data" / "results.json").read_text(encoding="utf-8"))[name]
    head, rows = found["head"], found["rows"]
    if name in MEANS_ONLY:
        columns = [i for i, title in enumerate(head) if not (title in HIDDEN or title.isdecimal())]
        rows = [[row[i] for i in columns] for row in rows if "mean" in row or "seed" not in head]
        head = [head[i] for i in columns]
    rows = [row for row in rows if not (name in LEFT_OUT and LEFT_OUT[name](row))]
    machine = "" if found["machine"] == MACHINE else f"{found['machine']}; "
    how = f"<sub>`{found['command']}`; {found['settings']}. {machine}{found['date']}, version {found['version']}.</sub>"
    return f"{_table(head, rows)}\n{how}\n"


DOSE_COLUMNS = (*("mean error g", "95 % g", "over +1 g", "first dose, 95 % g", "spilled g", "50 g weighed, 95 % s"),)


def _dose_figures(f: Mapping[str, float]) -> tuple[str, ...]:
    figures = (
        *(f"{f[key]:.2f}" for key in ("mean", "p95")),
        f"{100 * f['over_1g']:.1f} %",
        *(f"{f[key]:.2f}" for key in ("first_p95", "spill_mean")),
        f"{f['time_50_p95']:.1f}",
    )
    return tuple(text.replace("-", "−") for text in figures)


def _poured(found: Mapping[str, Any]) -> str:
    doses = f"{found['particles']['doses']} doses of each controller"
    how = f"{doses}, same seeds from {found['seeds'][0]}; {found['machine']['date']}"
    return f"<sub>`python benchmarks/dosing.py --final --json`; {how}.</sub>\n"


def dosing() -> str:
    """The figures of the first group of doses, with how they were measured."""
    data = json.loads((FOLDER / "data" / "dosing.json").read_text(encoding="utf-8"))
    found = data["groups"]["spout, water, lag 0.1 to 0.5 s"]
    rows = []
    for name, f in found.items():
        if name in ("paired", "machine", "seeds", "PID, fast"):
            continue
        rows.append((name if name in found["paired"] else f"**{name}**", *_dose_figures(f)))
    head = ("controller", *DOSE_COLUMNS)
    return f"{_table(head, rows)}\n{_poured(found)}"


HARD_G, LEAST_COVERAGE = 0.7, 0.85
"""Mean error [g] above which the page shows a balance, and coverage below which it does; the data have all."""

SERIES = 300
"""Doses of a measurement; fewer were made while the weighing of doses was changed."""


def dosing_balances() -> str:
    """Doses with displays that repeat, delay and lose readings: the harder ones, alone or two together."""
    data = json.loads((FOLDER / "data" / "dosing-balances.json").read_text(encoding="utf-8"))["rows"]
    rows, others, fresh = [], [], 0
    for name, row in data.items():
        again = row.get("later", {}).get("now", {}).get("doses") == SERIES
        figures = row["later"]["now"] if again else row["now"]
        easy = figures["mean"] <= HARD_G and figures["coverage"] >= LEAST_COVERAGE and not figures["false_stops"]
        if easy:
            others.append(figures)
            fresh += again
            continue
        low, high = figures["mean_interval"]
        rows.append(
            (
                name if again else f"{name} †",
                f"{figures['mean']:.2f} ({low:.2f} … {high:.2f})",
                f"{figures['p95']:.2f}",
                f"{figures['worst']:.1f}",
                f"{100 * figures['coverage']:.0f} %",
                f"{figures['time']:.1f}",
                str(figures["false_stops"]),
            )
        )
    ranges = (("mean", ".2f", 1), ("p95", ".2f", 1), ("worst", ".1f", 1), ("coverage", ".0f", 100), ("time", ".1f", 1))
    cells = []
    for key, form, factor in ranges:
        low, high = (factor * end(row[key] for row in others) for end in (min, max))
        cells.append(f"{low:{form}} to {high:{form}}{' %' if key == 'coverage' else ''}")
    rows.append((f"{len(others)} others, {len(others) - fresh} of them †", *cells, "0"))
    head = ("balance", "mean error g", "95 % g", "worst g", "interval covers", "weighed after s", "false stops")
    how = f"{SERIES} doses a row, seeds from 16000 (†: from 14000)"
    how += "; all rows: [dosing-balances.json](../data/dosing-balances.json)"
    return f"{_table(head, rows)}\n<sub>`python benchmarks/dosing_balances.py --final --json`; {how}.</sub>\n"


GAPS = {
    "none": "none",
    "readings": "readings",
    "commands": "commands",
    "both": "readings and commands",
}
"""Rows of the gaps in docs/data/dosing-balances.json, and their names."""


def dosing_gaps() -> str:
    """Doses in which readings, commands or both pause; of docs/data/dosing-balances.json."""
    data = json.loads((FOLDER / "data" / "dosing-balances.json").read_text(encoding="utf-8"))["gaps"]
    head = ["gap of", "doses", "mean error g", "95 % g", "most above g", "over +1 g"]
    rows = [
        [
            name,
            str(one["doses"]),
            f"{one['mean']:.2f}",
            f"{one['p95']:.2f}",
            f"{one['most']:+.2f}",
            str(one["over"]),
        ]
        for row, name in GAPS.items()
        if (one := data.get(row)) is not None
    ]
    first, last = data["both"]["seeds"]
    how = f"two doses of each seed from {first} to {last}"
    return f"{_table(head, rows)}\n<sub>`python benchmarks/dosing_gaps.py --final --json`; {how}.</sub>\n"


def dosing_faults() -> str:
    """Doses of the virtual bench with a fault each."""
    data = json.loads((FOLDER / "data" / "dosing.json").read_text(encoding="utf-8"))["faults"]
    rows = [
        (
            row["fault"],
            ", ".join(f"{count} {end}" for end, count in row["ends"].items()),
            f"{row['most_above']:+.1f}" if row["most_above"] > 0.0 else "none",
        )
        for row in data["rows"]
    ]
    head = ("fault", "ends", "most above 100 g")
    first, count = data["seeds"]
    how = f"{count} doses each, seeds from {first}; {data['machine']['date']}"
    return f"{_table(head, rows)}\n<sub>`python benchmarks/dosing.py --faults --json`; {how}.</sub>\n"


def dosing_particles() -> str:
    """Doses of particles in closed loop."""
    data = json.loads((FOLDER / "data" / "dosing-particles.json").read_text(encoding="utf-8"))
    rows = data["rows"]
    head = ["source", "seeds", "doses", "mean error g", "95 % g", "worst g", "bias g"]
    lines = [
        [
            name,
            "–".join(dict.fromkeys(map(str, row["seeds"]))),
            str(row["doses"]),
            f"{row['mean']:.2f}",
            f"{row['p95']:.2f}",
            *(f"{row[number]:+.2f}".replace("-", "−") for number in ("worst", "bias")),
        ]
        for name, row in rows.items()
    ]
    how = f"five doses of each seed; {data['machine']['date']}"
    command = "python benchmarks/dosing_particles.py --first SEED --into FILE --json"
    return f"{_table(head, lines)}\n<sub>`{command}`; {how}.</sub>\n"


def command_line() -> str:
    """Every command with its arguments, options and examples."""
    import typer.main

    from orchestrator.cli.app import app

    parts: list[str] = []

    def add(command: Any, words: tuple[str, ...]) -> None:
        if isinstance(getattr(command, "commands", None), dict):
            if len(words) > 1:
                parts.append(f"## `{' '.join(words)} …`\n\n{_prose(command.help)}\n\n{_examples(command.epilog)}")
            for name, below in command.commands.items():
                if not below.hidden:
                    add(below, (*words, name))
            return
        parameters = [option for option in command.params if not getattr(option, "hidden", False)]
        usage = " ".join([*words, *(_usage(one) for one in parameters if one.param_type_name == "argument")])
        parts.append(f"{'##' if len(words) == 2 else '###'} `{usage}`\n\n{_prose(command.help)}\n")
        rows = [
            (f"`{', '.join((*one.opts, *one.secondary_opts))}`", _prose(one.help))
            for one in parameters
            if one.param_type_name == "option" and one.name != "help"
        ]
        if rows:
            parts.append(_table(("option", "meaning"), rows))
        parts.append(f"{_examples(command.epilog)}")

    add(typer.main.get_command(app), ("decant",))
    return "\n".join(parts)


ATTRIBUTE = r"^ {4}(\w+): (.*(?:\n {8}.*)*)"
"""A line of the attributes in a dataclass's docstring."""


def json_output() -> str:
    """The output of every command with --json, from its schema."""
    from orchestrator.cli.json_output import output_schema

    schema = output_schema()
    kinds, parts = schema["$defs"], []
    first: dict[str, str] = {}
    for command, output in schema["properties"].items():
        parts.append(f"## `decant {command} --json`\n")
        if (shown := first.setdefault(str(output), command)) != command:
            parts.append(f"As of `decant {shown} --json`.\n")
            continue
        for reference in output.get("anyOf", [output]):
            model = kinds[reference["$ref"].rpartition("/")[2]]
            text, _, fields = model["description"].partition("Attributes:\n")  # of a dataclass
            described = dict(re.findall(ATTRIBUTE, fields, re.MULTILINE))
            rows = [
                (f"`{key}`", _json_type(part), _prose(part.get("description", described.get(key))))
                for key, part in model["properties"].items()
            ]
            parts.append(f"{_prose(text.strip())}\n\n{_table(('key', 'value', 'meaning'), rows)}")
    return "\n".join(parts)


def _json_type(part: Mapping[str, Any]) -> str:
    if "anyOf" in part:
        return " or ".join(dict.fromkeys(map(_json_type, part["anyOf"])))
    if "$ref" in part:
        return f"`{part['$ref'].rpartition('/')[2]}`"
    if "enum" in part or "const" in part:
        return ", ".join(f"`{word}`" for word in part.get("enum", [part.get("const")]))
    match part.get("type"):
        case "array":
            return f"list of: {_json_type(part['items'])}" if "items" in part else "list"
        case "object":
            values = part.get("additionalProperties")
            return f"mapping to: {_json_type(values)}" if isinstance(values, dict) else "mapping"
        case None:
            return "any"
        case kind:
            names = {"string": "text", "integer": "whole number", "boolean": "`true` or `false`", "null": "`null`"}
            return names.get(str(kind), str(kind))


def _usage(argument: Any) -> str:
    name = str(argument.metavar or argument.name.upper())
    name = f"{name}…" if argument.nargs == -1 else name
    return name if argument.required else f"[{name}]"


def _examples(epilog: str | None) -> str:
    """The examples at the end of a command's help, as a list."""
    commands = [line for line in (epilog or "").splitlines() if line.startswith("`")]
    return "Examples:\n\n" + "\n".join(f"- {command}" for command in commands) + "\n"


def _prose(text: str | None) -> str:
    return _one_line((text or "").partition("\f")[0]).replace("<", "&lt;")


def rest() -> str:
    """The operations of the API, from docs/openapi.json."""
    document = json.loads((FOLDER / "openapi.json").read_text(encoding="utf-8"))
    rows = [
        (f"`{method.upper()} {path}`", _one_line(operation.get("description") or operation["summary"]))
        for path, operations in document["paths"].items()
        for method, operation in operations.items()
    ]
    return _table(("request", "meaning"), rows)


def events() -> str:
    """The events of a run with their fields."""
    from orchestrator.records import events as module

    parts = []
    for name, kind in vars(module).items():
        if isinstance(kind, type) and issubclass(kind, module.Event) and kind.__module__ == module.__name__:
            text, _, fields = inspect.cleandoc(kind.__doc__ or "").partition("Attributes:\n")
            base = [field.name for field in dataclasses.fields(module.Event)]
            fields_of = [field.name for field in dataclasses.fields(kind)]
            own = base if kind is module.Event else [field for field in fields_of if field not in base]
            described = dict(re.findall(ATTRIBUTE, fields, re.MULTILINE))
            rows = [(f"`{field}`", _one_line(described.get(field, ""))) for field in own]
            parts.append(f"## {name}\n\n{_one_line(text)}\n")
            if rows:
                parts.append(_table(("field", "meaning"), rows))
    return "\n".join(parts)


def plugin_names() -> str:
    """The public names for plug-ins, each with the first sentence of its description."""
    from decant import plugins

    rows = []
    for name in plugins.__all__:
        text = inspect.getdoc(getattr(plugins, name)) if not isinstance(getattr(plugins, name), (int, dict)) else ""
        first = _one_line(text or "").partition(". ")[0].rstrip(".")
        rows.append((f"`{name}`", first if isinstance(getattr(plugins, name), type) else ""))
    return _table(("name", "meaning"), rows)


TABLES: dict[str, Callable[[], str]] = {
    "charts": charted,
    "catalogue-runs": partial(catalogued, "run"),
    "catalogue-pours": partial(catalogued, "pour"),
    "actions": actions,
    "parameters": parameters,
    "columns": columns,
    "counted-claims": counted_claims,
    "liquids": liquids,
    "states": states,
    **{name: partial(section, model) for name, model in SECTIONS.items()},
    "calibration-strategies": partial(variants, campaign.CALIBRATIONS, campaign.CalibrationSection),
    "deployment-strategies": partial(variants, campaign.DEPLOYMENTS, campaign.DeploymentSection),
    "objectives": partial(variants, OBJECTIVES.all, Objective),
    "compared-calibration": partial(variants, _arms(study.CalibrationsSettings), Settings),
    "compared-deployment": partial(variants, _arms(study.DeploymentsSettings), Settings),
    **{f"result-{name}": partial(measured, name) for name in MEASURED},
    "dosing-spout": dosing,
    "dosing-balances": dosing_balances,
    "dosing-gaps": dosing_gaps,
    "dosing-faults": dosing_faults,
    "dosing-particles": dosing_particles,
    "command-line": command_line,
    "output": json_output,
    "rest": rest,
    "events": events,
    "plugin-names": plugin_names,
}


def _default(key: str, info: FieldInfo, model: type[Settings]) -> str:
    if key in model.required_keys():
        return "must be given"
    value = info.get_default()
    if value is None or value is PydanticUndefined or value in ((), "") or isinstance(value, Settings):
        return ""
    quantity = next((m for m in info.metadata if isinstance(m, Quantity)), None)
    if quantity is not None and quantity.unit != "1":
        return f"{_shown(value, quantity)} {quantity.display}"
    if isinstance(value, tuple):
        return ", ".join(f"`{one}`" for one in value)
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _value(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """What may be written for a field, from its annotation."""
    quantity = next((m for m in metadata if isinstance(m, Quantity)), None)
    if quantity is not None:
        words = "".join(f" or `{word}`" for word in quantity.words)
        bounds = f"number, {quantity.bounds()}" if quantity.display == "1" else quantity.bounds()
        if quantity.positive:
            bounds = f"above 0, up to {bounds.removesuffix(' and less').removeprefix('0 … ')}"
        return bounds + words
    origin = typing.get_origin(annotation)
    if origin is typing.Annotated:
        inner, *more = typing.get_args(annotation)
        return _value(inner, [*more, *metadata])
    if origin in (typing.Union, types.UnionType):
        parts = [_value(part) for part in typing.get_args(annotation) if part is not type(None)]
        sections = [part for part in parts if "or the path of its file" in part]
        return " or ".join(dict.fromkeys(sections or parts))
    choice = next((m for m in metadata if isinstance(m, Choice)), None)
    if choice is not None:
        return ", ".join(f"`{word}`" for word in choice.words())
    if origin is Literal:
        return ", ".join(f"`{word}`" for word in typing.get_args(annotation))
    if origin is list:
        return f"list of: {_value(typing.get_args(annotation)[0])}"
    if origin is tuple:
        inner = typing.get_args(annotation)
        if isinstance(inner[0], type) and issubclass(inner[0], Settings):
            return f"list of: {_value(inner[0])}"
        if typing.get_origin(inner[0]) is Literal:
            return f"list of: {_value(inner[0])}"
        if typing.get_args(inner[0])[-1:] == (...,):
            return "list of rows of numbers"
        return "`[x, y, z]`" if len(inner) == 3 else "list of `[r, z]`"
    if origin is dict:
        return "mapping"
    if isinstance(annotation, type) and issubclass(annotation, Settings):
        return OF_SECTIONS.get(annotation.__name__, f"mapping: {_one_line(annotation.__doc__ or '')}")
    metadata = [deep for m in metadata for deep in (m.metadata if isinstance(m, FieldInfo) else [m])]
    if annotation is int:
        lowest = next((m.ge for m in metadata if getattr(m, "ge", None) is not None), None)
        highest = next((m.le for m in metadata if getattr(m, "le", None) is not None), None)
        return f"whole number, {lowest} … {highest}" if highest is not None else f"whole number, {lowest} or more"
    return {bool: "`true` or `false`", str: "text"}[annotation]


def _shown(value: float, quantity: Quantity) -> str:
    from sim_engine.settings.quantity import format_quantity

    return format_quantity(float(value), quantity.unit, quantity.display).split(" ", 1)[0]


def _one_line(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(cell if cell else " " for cell in row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Bring all pages up to date."""
    for page in pages():
        old = page.read_text(encoding="utf-8")
        new = render(old, page)
        if new != old:
            page.write_text(new, encoding="utf-8")
            print(f"{page}: updated")


if __name__ == "__main__":
    main()
