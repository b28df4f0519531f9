"""The posteriors of earlier calibrations: of one run, of the catalogue, and from files.

- `posterior_of` reads what a finished calibration tells (`orchestrator.campaigns.campaign_prior.KnownPosterior`).
- `posterior_text` writes the file of one; `import_posterior` enters what another machine has exported.

A posterior enters later campaigns by what its own pours tell: without the prior that the calibration itself had, and
without the bounds of its searched range. Otherwise the oldest campaign would be counted in every later one.
"""

from __future__ import annotations

import io
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from orchestrator.campaigns.campaign_prior import KnownPosterior, WeighedPairSettings, arm_of, shape_digest
from orchestrator.campaigns.run_snapshot import written
from orchestrator.catalogue.control_charts import LaboratoryChart
from orchestrator.learning.calibration.calibration_scores import CALIBRATED, ScoredPair, ScoredPour
from orchestrator.learning.calibration.campaign_memory import PLACEMENT, WeighedPair, estimates, group_of
from orchestrator.learning.campaign_plan import MeasuredPour, RecordedPour
from orchestrator.learning.deployment.calibration_evidence import weighed_pairs
from orchestrator.learning.run_errors import RunError
from orchestrator.learning.strategy import plural
from orchestrator.records.codec import from_json
from orchestrator.records.run_record import RunState, read_record
from orchestrator.records.run_registry import make_state_directory, state_directory
from orchestrator.runs.run_folder import SIMULATOR, read_versions
from sim_engine.action import Action
from sim_engine.liquids import Liquid, ParameterInfo, SimulationParameters
from sim_engine.search_space import Axis

FOLDER = "posteriors"
"""Folder of imported posteriors in the state directory."""

TELLS = 0.8
"""Largest ratio of a posterior's variance to that of its prior at which the pours tell something."""


class NoPosteriorError(RunError):
    """A run has no posterior that later campaigns can use; the text gives the reason."""


def posterior_of(directory: Path, record: RunState | None = None) -> KnownPosterior:
    """The posterior of a run's calibration.

    Args:
        directory: folder of the run.
        record: its journal, if it was read already.

    Raises:
        NoPosteriorError: there is none.
        RunError: the journal can't be read.
    """
    record = read_record(directory) if record is None else record
    plan, name = record.header.fingerprint, directory.name
    results = [from_json(event.encoded) for event in record.closed.values()]
    encoded: dict[str, Any] = next((result for result in results if result.get("kind") == "calibration"), {})
    calibrated, calibration = encoded.get("found") or {}, plan.get("calibration")
    if calibration is None:
        raise NoPosteriorError(f"{name}: has no calibration, and therefore no posterior")
    if not calibrated:
        raise NoPosteriorError(f"{name}: its calibration is not finished; resume it first")
    rows = (calibrated.get("posterior") or {}).get("thetas")
    if not rows:
        raise NoPosteriorError(f"{name}: its calibration has no posterior of the parameters; C4 has one")
    memory = encoded.get("memory") or {}
    parameters = _estimated_parameters(calibration, memory, rows)
    if not parameters:
        raise NoPosteriorError(f"{name}: its pours leave all parameters open")
    scene, liquid = calibration["scene"], Liquid.model_validate(calibration["scene"]["liquid"])
    laboratory = plan.get("laboratory") or {}
    scenes = [scene, *calibration.get("further", ())]
    return KnownPosterior.model_validate(
        {
            "posterior": name,
            "simulator": str(read_versions(directory).get(SIMULATOR) or "unknown"),
            "laboratory": str(laboratory.get("name", "")),
            "mode": laboratory.get("mode", "virtual"),
            "arm": arm_of(laboratory),
            "liquid": {
                "name": liquid.name,
                "density": liquid.density,
                "surface_tension": liquid.surface_tension,
                "viscosity": liquid.dynamic_viscosity,
                "mass": liquid.mass,
            },
            "pourer": scene["pourer"]["name"],
            "shape": shape_digest(scene),
            "receivers": list(dict.fromkeys(entry["receiver"]["name"] for entry in scenes)),
            "pours": int(encoded.get("training_pours", 0)),
            "fixed": {key: float(value) for key, value in calibration["fixed_parameters"].items()},
            "parameters": parameters,
            "contradicts": _contradicted_runs(memory),
            "weighed": [WeighedPairSettings.of(pair) for pair in _weighed_pairs(calibration, results)],
        }
    )


def _estimated_parameters(
    calibration: Mapping[str, Any], memory: Mapping[str, Any], rows: Sequence[Mapping[str, float]]
) -> dict[str, dict[str, float]]:
    """Moments of the searched parameters from the pours alone; without those that the pours leave open.

    Args:
        calibration: its plan in the run's fingerprint.
        memory: how the calibration used a prior from earlier campaigns; empty without one.
        rows: draws of the posterior.
    """
    alone = {key: (entry["mean"], entry["deviation"]) for key, entry in (memory.get("alone") or {}).items()}
    moments = alone or {key: (entry.mean, entry.deviation) for key, entry in estimates(rows).items()}
    priors = {entry["name"]: entry for entry in calibration.get("parameter_prior", ())}
    parameters = {}
    for axis in (Axis(**row) for row in calibration["parameters"]["axes"]):
        estimate = _without_range(*moments[axis.name], axis, priors.get(axis.name))
        if estimate is not None and group_of(axis.name) is not None:
            parameters[axis.name] = {"mean": estimate[0], "deviation": estimate[1]}
    return parameters


def _contradicted_runs(memory: Mapping[str, Any]) -> list[str]:
    """Earlier runs whose placement the pours contradict."""
    groups = [group for group in memory.get("groups", ()) if group["group"] == PLACEMENT and group["contradicted"]]
    return [run for group in groups for run in group["runs"]]


def _weighed_pairs(calibration: Mapping[str, Any], results: Iterable[Mapping[str, Any]]) -> list[WeighedPair]:
    """The weighed pours of an evaluated calibration, with simulations by its θ*; none if it was not evaluated.

    Args:
        calibration: its plan in the run's fingerprint.
        results: of the run's stages, as JSON.
    """
    by_kind = {str(result.get("kind")): result for result in results}
    if "evaluation" not in by_kind:
        return []
    first, records = calibration["scene"], calibration["records"] or {"pours": ()}
    scenes = {scene["name"]: scene for scene in (first, *calibration["further"], *calibration["tested"])}
    weighed = []
    for pour in by_kind.get("pours", {}).get("pours", ()):
        if "poured" in pour:  # weighed
            scene = scenes.get(pour["scene"], first)
            action = Action.compose(scene["fixed"], pour["action_si"])
            measured = MeasuredPour(action, pour["spillage"], pour["poured"], pour["split"])
            weighed.append(ScoredPour(scene["receiver"]["name"], measured))
    for row in records["pours"]:
        scene = scenes.get(row["scene"], records["scene"])
        pour = MeasuredPour.from_record(from_json(row, RecordedPour))
        weighed.append(ScoredPour(scene["receiver"]["name"], pour))
    pairs = [ScoredPair.model_validate(pair) for pair in by_kind["evaluation"]["pairs"]]
    own = [pair for pair in pairs if pair.theta == CALIBRATED and pair.split != "transfer"]
    return weighed_pairs(weighed, own, len(calibration["parameters"]["axes"]))


def _without_range(
    mean: float, deviation: float, axis: Axis, prior: Mapping[str, Any] | None
) -> tuple[float, float] | None:
    """A posterior's moments divided by those of its prior: what the pours alone tell; None if they tell nothing.

    Both are taken for normal distributions. The prior is uniform over the searched range, or a measured value.
    """
    centre, spread = 0.5 * (axis.lower + axis.upper), (axis.upper - axis.lower) / math.sqrt(12.0)
    if axis.scale == "log":  # nearly uniform in the logarithm: the range as seen from the mean
        spread = mean * math.log(axis.upper / axis.lower) / math.sqrt(12.0)
        centre = math.sqrt(axis.lower * axis.upper)
    if prior is not None:
        centre, spread = float(prior["mean"]), float(prior["deviation"])
    deviation = max(deviation, 1e-6 * spread)
    if deviation**2 > TELLS * spread**2:
        return None
    precision = 1.0 / deviation**2 - 1.0 / spread**2
    return (mean / deviation**2 - centre / spread**2) / precision, 1.0 / math.sqrt(precision)


class PosteriorAge(BaseModel):
    """Age of a posterior, and whether later pours still agree with what was predicted from it."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    made: float
    """When its run ended, seconds since 1970."""

    later_pours: int
    """Number of predicted pours since then in its laboratory, from its pourer and of its liquid."""

    since: float | None = None
    """Begin of the disagreement, as the control chart of the prediction error estimates it; null if there is none."""

    deviations: float | None = None
    """Mean distance of the pours since then from the earlier prediction errors, in standard deviations."""

    renewing_pours: int
    """Number of pours that would renew it: as many as it comes from."""

    @property
    def text(self) -> str:
        """'since 2030-03-14 later pours disagree by +4.2 standard deviations; 12 pours would renew it', or ''."""
        if self.since is None or self.deviations is None:
            return ""
        day = time.strftime("%Y-%m-%d", time.localtime(self.since))
        off = f"since {day} later pours disagree by {self.deviations:+.1f} standard deviations"
        return f"{off}; a calibration with {plural(self.renewing_pours, 'pour')} would renew it"


def age_of(posterior: KnownPosterior, made: float, charts: Iterable[LaboratoryChart]) -> PosteriorAge:
    """The age of a posterior: later pours disagree if the prediction error has left its limits since it was made.

    Args:
        posterior: the posterior.
        made: when its run ended [s since 1970].
        charts: of all laboratories.
    """
    age = PosteriorAge(made=made, later_pours=0, renewing_pours=posterior.pours)
    bench = (posterior.laboratory, posterior.mode, "prediction_error")
    chart = next((chart for chart in charts if (chart.laboratory, chart.mode, chart.quantity) == bench), None)
    if chart is None:
        return age
    # The day on which it was made may have pours from before it, and its own deployment.
    vessels = {", ".join((posterior.pourer, receiver, posterior.liquid.name)) for receiver in posterior.receivers}
    later = [point for point in chart.points if point.time > made and point.about in vessels]
    age.later_pours = sum(point.pours for point in later)
    lasting = chart.lasting
    if lasting is not None and lasting.noticed > made:
        off = [p.deviations for p in later if p.time >= lasting.begun and p.deviations is not None]
        if off:
            age.since, age.deviations = max(lasting.begun, made), sum(off) / len(off)
    return age


def imported(state: Path | None = None) -> Iterable[KnownPosterior]:
    """The imported posteriors, by name.

    Raises:
        OSError: one can't be read.
    """
    folder = (state or state_directory()) / FOLDER
    for path in sorted(folder.glob("*.json")):
        try:
            yield KnownPosterior.model_validate_json(path.read_bytes())
        except ValueError as error:
            raise NoPosteriorError(f"{path}: is damaged ({error}); delete it, and import the posterior again") from None


def import_posterior(posterior: KnownPosterior, state: Path | None = None) -> None:
    """Enter a posterior, which replaces one of the same run.

    Raises:
        OSError: it can't be written.
    """
    folder = (state or state_directory()) / FOLDER
    make_state_directory(folder.parent)
    folder.mkdir(exist_ok=True)
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in posterior.posterior)
    path = folder / f"{name}.json"
    partial = path.with_suffix(".part")
    partial.write_text(posterior.model_dump_json(), encoding="utf-8")
    partial.replace(path)


def posterior_text(posterior: KnownPosterior) -> str:
    """A posterior as a YAML file, with units as they are displayed."""
    from ruamel.yaml import YAML

    text = io.StringIO()
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 110
    yaml.dump(posterior_table(posterior), text)
    return text.getvalue()


def posterior_table(posterior: KnownPosterior) -> dict[str, Any]:
    """A posterior as the content of its file, with units as they are displayed."""
    table: dict[str, Any] = written(posterior)
    infos = SimulationParameters.info()
    table["parameters"] = {
        name: {"mean": _shown(mean, infos[name]), "deviation": _shown(deviation, infos[name])}
        for name, (mean, deviation) in posterior.estimates.items()
    }
    return table


def _shown(value: float, info: ParameterInfo) -> Any:
    number = float(f"{value / info.factor:.6g}")
    return number if info.shown == "1" else f"{number!r} {info.shown}"
