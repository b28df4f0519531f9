"""Loads campaigns, vessels, laboratories and parameters from files. All problems of a file are in one `ConfigError`."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any

from pydantic import create_model

from actors.laboratory_settings import LaboratorySettings
from orchestrator.campaigns.campaign_file import CampaignFile
from orchestrator.campaigns.campaign_prior import KnownPosterior, PosteriorSource, ResolvedPrior, no_posteriors
from orchestrator.campaigns.campaign_resolution import resolve_campaign
from orchestrator.campaigns.file_references import MESH_SUFFIXES, References, VesselFile, resolve_vessel
from orchestrator.campaigns.yaml.file_access import resolved
from orchestrator.campaigns.yaml.section_validation import validate
from orchestrator.campaigns.yaml.yaml_errors import ConfigError, Problem
from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report, wrong_kind
from orchestrator.learning.calibration.campaign_memory import CampaignMemory
from orchestrator.learning.campaign_plan import CampaignPlan
from sim_engine.liquids import Liquid, LiquidSettings, SimulationParameters
from sim_engine.prediction_band import CalibrationResidual
from sim_engine.settings.model import Settings
from sim_engine.settings.quantity import Quantity
from sim_engine.vessel.shapes import VesselSpec


def load_campaign(
    path: Path | str,
    laboratory: Path | str | None = None,
    seed: int | None = None,
    *,
    memory: CampaignMemory | None = None,
    posteriors: Callable[[], PosteriorSource] = no_posteriors,
) -> CampaignPlan:
    """The plan of a campaign file, with everything that it refers to.

    Args:
        path: the file.
        laboratory: a laboratory's file that replaces the campaign's laboratory, which may then be missing.
        seed: replaces the campaign's seed.
        memory: of the run that is resumed; it replaces the campaign's `prior`, which could find other runs by now.
        posteriors: opens those of this machine, for a campaign with a `prior`.

    Raises:
        ConfigError: the file or a file that it refers to is invalid; contains all problems.
    """
    other = None if laboratory is None else Path(laboratory)
    return campaign_from(Document.read(resolved(Path(path))), other, seed, memory, posteriors)


def campaign_from(
    document: Document,
    laboratory: Path | None = None,
    seed: int | None = None,
    memory: CampaignMemory | None = None,
    posteriors: Callable[[], PosteriorSource] = no_posteriors,
) -> CampaignPlan:
    """The plan of a campaign document; relative paths in it start from the folder of its path.

    Raises:
        ConfigError: as `load_campaign`.
    """
    if laboratory is not None:
        load_laboratory(laboratory)  # its problems are reported separately from the campaign's
    report = Report()
    place = Place(document)
    if (other := wrong_kind(place.document, "campaign")) is not None:
        raise ConfigError([other])
    if laboratory is not None and isinstance(document.data, dict):
        document.data.setdefault("laboratory", str(resolved(laboratory)))
    section = validate(CampaignFile, place, report)
    if section is not None and laboratory is not None:
        section = section.model_copy(update={"laboratory": str(resolved(laboratory))})
    if section is not None and seed is not None:
        section = section.model_copy(update={"seed": seed})
    if section is not None and memory is not None:
        section = section.model_copy(update={"prior": ResolvedPrior.of(memory)})
    plan = None if section is None else resolve_campaign(section, place, report, posteriors)
    report.raise_if_any()
    assert plan is not None, "a campaign without problems has a plan"
    return plan


def load_vessel(path: Path | str) -> VesselSpec:
    """The vessel of a file (its shape is built and checked by `sim_engine.vessel`).

    Raises:
        ConfigError: the file is invalid.
    """
    report, path = Report(), Path(path)
    if path.suffix.lower() in MESH_SUFFIXES:
        message = f"is a mesh; describe the vessel in a YAML file: {{name: {path.stem}, mesh: {path.name}, unit: mm}}"
        raise ConfigError([Problem(resolved(path), 0, 0, "", message)])
    section = References(report).file(resolved(path), VesselFile)
    vessel = None if section is None else resolve_vessel(*section, report)
    report.raise_if_any()
    assert vessel is not None, "a vessel without problems has a spec"
    return vessel


def load_posterior_file(path: Path) -> KnownPosterior:
    """The posterior of a file that `decant runs posterior` has written. Raises ConfigError."""
    report = Report()
    section = References(report).file(resolved(path), KnownPosterior)
    report.raise_if_any()
    assert section is not None, "a file without problems has a posterior"
    return section[0]


def vessel_from(document: Document) -> VesselSpec:
    """The vessel of a document, see `load_vessel`. Raises ConfigError."""
    report, place = Report(), Place(document)
    section = validate(VesselFile, place, report)
    vessel = None if section is None else resolve_vessel(section, place, report)
    report.raise_if_any()
    assert vessel is not None, "a vessel without problems has a spec"
    return vessel


def liquid_from(document: Document) -> Liquid:
    """The load of a document with the keys of a campaign's `liquid`. Raises ConfigError."""
    report = Report()
    section = validate(LiquidSettings, Place(document), report)
    report.raise_if_any()
    assert section is not None, "a liquid without problems has settings"
    return section.load()


def load_laboratory(path: Path, *, stored: bool = True) -> LaboratorySettings:
    """The laboratory of a file.

    Args:
        path: of the file.
        stored: read the recordings that it names, too.

    Raises:
        ConfigError: the file is invalid.
    """
    report = Report()
    references = References(report)
    section = references.file(resolved(path), LaboratorySettings)
    report.raise_if_any()
    assert section is not None, "a laboratory without problems has settings"
    if not stored:
        return section[0].ready()
    laboratory = references.laboratory(str(resolved(path)), section[1])
    report.raise_if_any()
    assert laboratory is not None, "a laboratory without problems is ready"
    return laboratory


class _LooseQuantity(Quantity):
    """A quantity that also accepts a number without unit, in SI units, as programs write them."""

    def parse(self, value: Any) -> float | str:
        if isinstance(value, (int, float)) and not isinstance(value, bool) and self.unit != "1":
            return super().parse(f"{value!r} {self.unit}")
        return super().parse(value)


class _ThetaBase(Settings):
    """Parameters as `decant calibrate` writes them: numbers in SI, or quantities with units."""


def _theta_model() -> type[_ThetaBase]:
    fields: Any = {}
    for name, info in SimulationParameters.info().items():
        loose = _LooseQuantity(info.unit, info.example, info.lower, info.upper, whole=info.integer)
        fields[name] = (Annotated[float, loose] | None, None)
    model: type[_ThetaBase] = create_model("Theta", __base__=_ThetaBase, **fields)
    return model


_Theta = _theta_model()

THETA_KEYS = ("theta", "parameters")
POSTERIOR_KEY, RECOMMENDED_KEY = "posterior", "recommended"
DISCREPANCY_KEY, SHIFT_KEY, SCENES_KEY = "remaining_discrepancy", "shift", "scenes"


def predicts_with_posterior(path: Path) -> bool:
    """Whether predictions with a file of θ use its posterior: it has one, and θ is the calibrated one.

    Raises:
        ConfigError: the file is not YAML or JSON.
    """
    data = Document.read(resolved(path)).data
    return isinstance(data, dict) and POSTERIOR_KEY in data and data.get(RECOMMENDED_KEY) != "uncalibrated"


def load_discrepancy(path: Path) -> CalibrationResidual | None:
    """The residual of a calibration, from a run's `theta.json`; None if it has none.

    Files of earlier versions do not tell its scenes.

    Raises:
        ConfigError: its shift is not a number ≥ 0, or its scenes are no digests.
    """
    document = Document.read(resolved(path))
    section = document.data.get(DISCREPANCY_KEY) if isinstance(document.data, dict) else None
    if section is None:
        return None
    place, report = Place(document).at(DISCREPANCY_KEY), Report()
    value, scenes = (section.get(SHIFT_KEY), section.get(SCENES_KEY, [])) if isinstance(section, dict) else (None, [])
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0.0 <= value < math.inf:
        report.add(place, f"needs a '{SHIFT_KEY}' from 0 on, as decant calibrate writes it")
    if not isinstance(scenes, list) or not all(isinstance(scene, str) for scene in scenes):
        report.add(place.at(SCENES_KEY), "should be a list of digests, as decant calibrate writes it")
    report.raise_if_any()
    return CalibrationResidual(float(value or 0.0), tuple(scenes))


def load_posterior(
    path: Path, count: int, base: SimulationParameters | None = None
) -> tuple[SimulationParameters, ...]:
    """`count` posterior draws of θ from a run's `theta.json`, each with a probability given by its weight.

    They are drawn evenly along the cumulated weights: the same file gives the same θ.

    Args:
        path: the file.
        count: ≥ 1.
        base: values of the parameters that the file does not name.

    Raises:
        ConfigError: the file has no posterior, or is invalid.
    """
    report = Report()
    document = Document.read(resolved(path))
    place = Place(document)
    rows = document.data.get(POSTERIOR_KEY) if isinstance(document.data, dict) else None
    weights: list[float] = []
    thetas: list[SimulationParameters] = []
    if not isinstance(rows, list) or not rows:
        report.add(place, f"has no '{POSTERIOR_KEY}'; C4 writes one into a run's theta.json, θ* alone has none")
        report.raise_if_any()
    for i, row in enumerate(rows or []):
        at = place.at(POSTERIOR_KEY, i)
        weight = row.get("weight") if isinstance(row, dict) else None
        if not isinstance(weight, int | float) or isinstance(weight, bool) or not 0.0 < weight < math.inf:
            report.add(at, "needs a 'theta' and a 'weight' above 0")
            continue
        section = validate(_Theta, at.at("theta"), report)
        if section is not None:
            values = {name: v for name in section.written_keys() if (v := section.value(name)) is not None}
            thetas.append(SimulationParameters.from_values((base or SimulationParameters()).model_dump() | values))
            weights.append(float(weight))
    report.raise_if_any()
    total = list(accumulate(weights))
    return tuple(thetas[bisect_right(total, (i + 0.5) / count * total[-1])] for i in range(count))


def load_parameters(path: Path, base: SimulationParameters | None = None) -> SimulationParameters:
    """θ from a file: the output of `decant calibrate --json`, or a file written by hand.

    The file is JSON or YAML: a mapping of parameter names, or a mapping that contains one under `theta` (or
    `parameters`). Values are numbers in SI units (cohesion in N/m, xsph_rate in 1/s) or quantities with units.

    Args:
        path: the file.
        base: values of the parameters that the file does not name; the simulator's defaults unless given.

    Raises:
        ConfigError: the file is invalid.
    """
    report = Report()
    document = Document.read(resolved(path))
    place = Place(document)
    if isinstance(document.data, dict):
        place = next((place.at(key) for key in THETA_KEYS if key in document.data), place)
    if place.loc:
        report.problems.extend(document.problems)
    section = validate(_Theta, place, report)
    values: dict[str, float] = (base or SimulationParameters()).model_dump()
    if section is not None:
        written = {name: v for name in section.written_keys() if (v := section.value(name)) is not None}
        if not written and not report.problems:
            report.add(place, f"names no parameter; known are {', '.join(values)}")
        values |= written
    report.raise_if_any()
    return SimulationParameters.from_values(values)
