"""What a run came to: a table for people, `summary.json` for programs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orchestrator.plan import CampaignPlan
from orchestrator.report import style
from orchestrator.report.names import receiver_names
from orchestrator.report.occupancy import occupancy_lines
from orchestrator.report.posterior import posterior_lines
from orchestrator.report.results import (
    SPLITS,
    Result,
    Results,
    calibrated_label,
    calibration_of,
    deployments_of,
    evaluation_of,
    predictions_of,
    weighed,
)
from orchestrator.report.risk import risk_line, window_line
from orchestrator.report.trust import trust_line
from orchestrator.report.units import DISCREPANCY, LossUnit, at_least_nothing, deployment_unit
from sim_engine.spread import Spread

if TYPE_CHECKING:
    from rich.console import JustifyMethod, RenderableType

    from orchestrator.report.regimes import SpaceWarning
    from sim_engine.regimes import NotCovered

SUMMARY_NAME = "summary.json"

PLAIN_WIDTH, LONGEST_LINE = 110, 1_000
"""Columns of the table where stderr is no terminal: at least, at most."""


def summarise(
    plan: CampaignPlan,
    results: Results,
    *,
    figures: Mapping[str, Path] | None = None,
    recording: Path | None = None,
    dropped_events: int = 0,
    baselines: Mapping[str, Mapping[str, float | None]] | None = None,
    not_covered: Mapping[str, Sequence[SpaceWarning]] | None = None,
    best_not_covered: Mapping[str, Sequence[NotCovered]] | None = None,
    totals: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The summary of a run, JSON-ready; whatever a run hasn't got is None or empty.

    Args:
        plan: of the campaign.
        results: stage name → the strategy's result.
        figures: name → file.
        recording: the `.rrd`.
        dropped_events: that are missing in it.
        baselines: 'mean_predictor' and 'regression' by split.
        not_covered: what is not simulated in the action spaces, by scene.
        best_not_covered: and of the recommended actions.
        totals: further facts of the run (state, simulations, pours, cpu_s, occupancy, …), taken over as they are.

    Returns:
        'theta' with 'predicted_discrepancy'; 'discrepancy' by split and predictor (fractions of what was poured);
        'receivers' by scene, each with its 'receiver's name, first and best losses (the loss' own unit, named in
        'loss'), spillage r = spilled / poured, and the best actions in display units and SI; 'figures', 'recording',
        and `totals`.
    """
    calibration = calibration_of(results)
    names = receiver_names(plan)
    predictions = predictions_of(results)
    return {
        "campaign": plan.name,
        "seed": plan.seed,
        **(totals or {}),
        "theta": None if calibration is None else dict(calibration["theta"]),
        "predicted_discrepancy": None if calibration is None else calibration.get("predicted_discrepancy"),
        "predicted_deviation": None if calibration is None else calibration.get("predicted_deviation"),
        "posterior": None if calibration is None else _posterior(calibration),
        "discrepancy": _discrepancies(evaluation_of(results), baselines or {}),
        "loss": None if plan.deployment is None else plan.deployment.loss_name,
        "receivers": {
            scene: {
                "receiver": names.get(scene, scene),
                **_receiver(result),
                "prediction": predictions.get(scene),
                "not_covered": [one.as_json() for one in (best_not_covered or {}).get(scene, ())],
            }
            for scene, result in deployments_of(results).items()
        },
        "not_covered": {scene: [one.as_json() for one in found] for scene, found in (not_covered or {}).items()},
        "figures": {name: str(path) for name, path in (figures or {}).items()},
        "recording": None if recording is None else str(recording),
        "dropped_events": dropped_events,
    }


def _posterior(calibration: Result) -> dict[str, Any] | None:
    """What the pours say about θ, without the draws."""
    posterior = calibration.get("posterior")
    return None if posterior is None else {name: part for name, part in posterior.items() if name != "thetas"}


def _discrepancies(
    evaluation: Result | None, baselines: Mapping[str, Mapping[str, float | None]]
) -> dict[str, dict[str, float | None]]:
    table: dict[str, dict[str, float | None]] = {}
    label = None if evaluation is None else calibrated_label(evaluation)
    for split in SPLITS:
        row: dict[str, float | None] = {}
        if evaluation is not None and label is not None and split in evaluation["discrepancy"][label]:
            row["calibrated"] = evaluation["discrepancy"][label][split]
            row["random_theta"] = evaluation["random_median"].get(split)
        row |= {name: baselines[split].get(name) for name in ("mean_predictor", "regression") if split in baselines}
        if row:
            table[split] = row
    return table


def _receiver(result: Result) -> dict[str, Any]:
    pours = weighed(result)
    best = min(pours, key=lambda p: float(p["loss"]), default=None)
    return {
        "strategy": result["strategy"],
        "pours": len(pours),
        "failed_pours": result.get("failed_pours", 0),
        "refused_pours": result.get("refused_pours", 0),
        "simulations": result.get("simulations", 0),
        "first_loss": pours[0]["loss"] if pours else None,
        "first_spillage": pours[0]["spillage"] if pours else None,
        "best_loss": None if best is None else best["loss"],
        "best_spillage": None if best is None else best["spillage"],
        "best_pour": None if best is None else best["number"],
        "best_measured_action": None if best is None else best["action"],
        "best_action": result.get("action"),
        "best_action_si": result.get("action_si"),
        "predicted_loss": result.get("predicted_loss"),
        "predicted_deviation": result.get("predicted_deviation"),
        "predicted_scatter": result.get("predicted_scatter"),
        "predicted_spillage": result.get("predicted_spillage"),
        "predicted_spillage_deviation": result.get("predicted_spillage_deviation"),
        "untrustworthy_simulation": bool(result.get("trust", {}).get("alarm", False)),
        "trust": result.get("trust"),
        "gave_up": result.get("gave_up"),
        **{name: result[name] for name in ("front", "risk", "window") if name in result},
    }


def write_summary(directory: Path, summary: Mapping[str, Any]) -> Path:
    """Write `summary.json`, whole or not at all.

    Raises:
        OSError: the file can't be written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / SUMMARY_NAME
    draft = path.with_suffix(".json.part")
    draft.write_text(json.dumps(summary, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    draft.replace(path)
    return path


def summary_table(plan: CampaignPlan, summary: Mapping[str, Any]) -> RenderableType:
    """The summary for the terminal: θ*, discrepancies, losses and best actions by receiver, files."""
    from rich.console import Group
    from rich.text import Text

    parts: list[RenderableType] = [Text(f"\n{summary['campaign']}  seed {summary['seed']}", style="bold")]
    if summary["theta"] is not None:
        parts.append(_theta_line(plan, summary))
        parts += _posterior_lines(plan, summary)
    discrepancies = {split: row for split, row in summary["discrepancy"].items() if _has_numbers(row.values())}
    if discrepancies:
        parts.append(_discrepancy_table(discrepancies))
    if plan.deployment is not None:
        known = [row for row in summary["receivers"].values() if _has_numbers(row[key] for key in _LOSSES)]
        if known:
            parts.append(_receiver_table(known, deployment_unit(plan.deployment)))
        parts += _remarks(summary["receivers"].values(), deployment_unit(plan.deployment))
        parts += occupancy_lines(summary.get("occupancy") or {})
    files = [*summary["figures"].items(), *([("recording", summary["recording"])] if summary["recording"] else [])]
    if files:
        width = max(len(name) for name, _ in files)
        # Paths stand alone at their lines' ends, unbroken: terminals make them clickable, people copy them.
        parts.append(Text("\n".join(f"  {name:<{width}}  {path}" for name, path in files), overflow="fold"))
    if summary["dropped_events"]:
        parts.append(Text(f"  the recording lacks {summary['dropped_events']} events: it could not keep up", "yellow"))
    return Group(*parts)


def _theta_line(plan: CampaignPlan, summary: Mapping[str, Any]) -> RenderableType:
    from rich.text import Text

    text = Text(f"θ*  {style.display_values(summary['theta'])}")
    if summary["predicted_discrepancy"] is not None:
        text.append(
            "   expected |Δ| "
            + DISCREPANCY.text(summary["predicted_discrepancy"], summary["predicted_deviation"] or 0.0),
            style="dim",
        )
    return text


def _posterior_lines(plan: CampaignPlan, summary: Mapping[str, Any]) -> list[RenderableType]:
    from rich.text import Text

    if summary["posterior"] is None or plan.calibration is None:
        return []
    lines = posterior_lines(summary["posterior"], plan.calibration.parameters)
    return [Text(f"  {line}", style="dim") for line in lines]


_LOSSES = ("first_loss", "best_loss", "predicted_loss")
"""Numbers of a receiver that the table exists for."""


def _has_numbers(values: Iterable[Any]) -> bool:
    return any(value is not None for value in values)


def _discrepancy_table(rows: Mapping[str, Mapping[str, float | None]]) -> RenderableType:
    from rich.table import Table

    columns = {
        "calibrated": "θ*",
        "random_theta": "random θ (median)",
        "mean_predictor": "mean of training pours",
        "regression": "GP regression",
    }
    shown = [name for name in columns if any(row.get(name) is not None for row in rows.values())]
    table = Table(title="mean |measured − predicted| spillage [%]", title_justify="left", title_style="", box=_box())
    table.add_column("")
    for name in shown:
        table.add_column(columns[name], justify="right")
    for split, row in rows.items():
        cells = [row.get(name) for name in shown]
        table.add_row(SPLITS[split], *("—" if cell is None else f"{100 * cell:.2f}" for cell in cells))
    return table


def _receiver_table(rows: Sequence[Mapping[str, Any]], unit: LossUnit) -> RenderableType:
    from rich.table import Table

    columns: dict[str, tuple[JustifyMethod, list[str]]] = {
        "receiver": ("left", [row["receiver"] for row in rows]),
        "": ("left", [row["strategy"] for row in rows]),
        "pours": ("right", [str(row["pours"] or "") for row in rows]),
        "first": ("right", [_loss(row, "first_loss", unit) for row in rows]),
        "best measured": ("right", [_best_measured(row, unit) for row in rows]),
        "best expected": ("right", [_best_expected(row, unit) for row in rows]),
        "best action": ("left", [style.display_values(row["best_action_si"] or {}) for row in rows]),
    }
    table = Table(title=unit.label, title_justify="left", title_style="", box=_box())
    shown = {name: column for name, column in columns.items() if any(column[1])}
    for name, (justify, _) in shown.items():
        table.add_column(name, justify=justify)
    for cells in zip(*(cells for _, cells in shown.values()), strict=True):
        table.add_row(*(cell or "—" for cell in cells))
    return table


def _loss(row: Mapping[str, Any], key: str, unit: LossUnit) -> str:
    return "" if row[key] is None else unit.text(row[key])


def _best_measured(row: Mapping[str, Any], unit: LossUnit) -> str:
    return "" if row["best_loss"] is None else f"{unit.text(row['best_loss'])} (pour {row['best_pour']})"


def _best_expected(row: Mapping[str, Any], unit: LossUnit) -> str:
    if row["predicted_loss"] is None:
        return ""
    return unit.text(row["predicted_loss"], row["predicted_deviation"]) + unit.scatter(row["predicted_scatter"])


def _remarks(rows: Iterable[Mapping[str, Any]], unit: LossUnit) -> list[RenderableType]:
    from rich.text import Text

    remarks: list[RenderableType] = []
    for row in rows:
        receiver = row["receiver"]
        if row["untrustworthy_simulation"]:
            remarks.append(Text(f"  {receiver}: {trust_line(row['trust'])}", style="yellow"))
        if row["failed_pours"]:
            remarks.append(Text(f"  {receiver}: {row['failed_pours']} pour(s) failed", style="yellow"))
        if row["gave_up"]:
            remarks.append(Text(f"  {receiver}: {row['gave_up']}", style="yellow"))
        elif not _has_numbers(row[key] for key in _LOSSES):
            remarks.append(Text(f"  {receiver}: nothing was learnt; see the journal for what failed", style="yellow"))
        remarks += [Text(f"  {receiver}, nothing beats: {_compromise(one)}") for one in row.get("front", ())]
        if row.get("risk"):
            remarks.append(Text(f"  {receiver}, {risk_line(row['risk'], unit)}"))
        if row.get("window"):
            remarks.append(Text(f"  {receiver}, {window_line(row['window'], unit)}"))
        if row["prediction"]:
            remarks.append(Text(f"  {receiver}, best action: {_prediction(row['prediction'])}"))
        for one in row["not_covered"]:
            remarks.append(Text(f"  {receiver}, best action, {one['kind']}: {one['text']}", style="yellow"))
    return remarks


def _compromise(one: Mapping[str, Any]) -> str:
    """'spillage 1.2 ± 0.3 %, time 40.0 ± 1.0 %  with angular velocity 41.2 deg/s, …'."""
    parts = [
        f"{name.replace('_', ' ')} {100 * at_least_nothing(mean):.1f} ± {100 * one['deviations'][name]:.1f} %"
        for name, mean in one["objectives"].items()
    ]
    return f"{', '.join(parts)}  with {style.display_values(one['action_si'])}"


def _prediction(over_seeds: Mapping[str, Mapping[str, Any]]) -> str:
    """'spilled / poured 1.2 ± 0.4 % (mean ± standard deviation of 5 fresh seeds), retained …'."""
    shown = {name: Spread(**over_seeds[name]) for name in ("spillage", "spilled", "retained") if name in over_seeds}
    if not shown:
        return "no simulation of it could be used"
    words = {"spillage": "spilled / poured"}
    parts = [f"{words.get(name, name)} {spread.percent(2)}" for name, spread in shown.items()]
    count = max(spread.count for spread in shown.values())
    return f"{', '.join(parts)} (mean ± standard deviation, {count} fresh seeds)"


def print_summary(plan: CampaignPlan, summary: Mapping[str, Any]) -> None:
    """Write the summary's table to stderr.

    Where that is no terminal, nobody has a width to fit in: lines are as long as names and paths want them.
    """
    from rich.console import Console
    from rich.measure import Measurement

    console, table = Console(stderr=True), summary_table(plan, summary)
    if not console.is_terminal:
        wanted = Measurement.get(console, console.options.update(max_width=LONGEST_LINE), table).maximum
        console.width = max(PLAIN_WIDTH, wanted)
    console.print(table)


def _box() -> Any:
    from rich import box

    return box.SIMPLE_HEAD
