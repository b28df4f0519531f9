"""The prior of a campaign from earlier ones: the file of a posterior, the key `prior`, and its resolution.

- `KnownPosterior` is what the pours of one calibration tell about its parameters, and what it is about: vessels,
  liquid, arm, placement and simulator. The catalogue keeps one for each calibration.
- `resolve_prior` selects the posteriors that fit a campaign and combines them to its `CampaignMemory`.
- `ResolvedPrior` is the resolved form, which a run's record contains.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, create_model

from actors.laboratory_settings import LaboratorySettings
from orchestrator.campaigns.file_references import YAML_SUFFIXES, References
from orchestrator.campaigns.fingerprint import deciding, scene_by_content
from orchestrator.campaigns.yaml.yaml_source import Place
from orchestrator.learning.calibration.campaign_memory import (
    LIQUID,
    PLACEMENT,
    WALLS,
    CampaignMemory,
    RememberedParameter,
    WeighedPair,
    group_of,
    predicted,
    usual_spread,
)
from orchestrator.learning.run_errors import RunError
from orchestrator.records.codec import digest
from sim_engine.action import ACTION_DIMENSIONS, Action
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import Scene
from sim_engine.settings.model import Count, Example, Problems, Settings, Text
from sim_engine.settings.quantity import Quantity

CATALOGUE = "catalogue"

ALIKE = 0.1
"""Largest relative difference of a property of two liquids that count as the same."""

ENOUGH = 40
"""Number of weighed pours of earlier runs from which those of still older ones are left out."""


class EstimateSettings(Settings):
    """A parameter: mean and standard deviation."""

    mean: Any = None
    """Mean."""

    deviation: Any = None
    """Standard deviation."""


class RememberedSettings(EstimateSettings):
    """Prior of a parameter, with the runs that it comes from."""

    runs: Annotated[list[Text], Example("[quickstart-20300301-1]")]
    """Earlier runs."""


def _estimates(name: str, base: type[EstimateSettings]) -> Any:
    fields: dict[str, Any] = {}
    for parameter, info in SimulationParameters.info().items():
        unit = "" if info.shown == "1" else f" {info.shown}"
        width = Quantity(info.unit, f"{(info.upper - info.lower) / 50 / info.factor:.2g}{unit}", 0.0, positive=True)
        types: dict[str, Any] = {
            # without bounds: the pours alone may point beyond the parameter's range
            "mean": (Annotated[float, Quantity(info.unit, info.example)], ...),
            "deviation": (Annotated[float, width], ...),
        }
        kind = create_model(f"{name}{parameter.title().replace('_', '')}", __base__=base, __doc__=base.__doc__, **types)
        fields[parameter] = (kind | None, Field(default=None, description=info.meaning))
    return create_model(f"{name}Parameters", __base__=Settings, __doc__="Parameters by name.", **fields)


AnyEstimates: Any = _estimates("Known", EstimateSettings)
AnyRemembered: Any = _estimates("Remembered", RememberedSettings)


class KnownLiquidSettings(Settings):
    """A liquid and its properties."""

    name: Annotated[Text, Example("water")]
    """Its name."""

    density: Annotated[float, Quantity("kg/m^3", "998 kg/m^3", 0.0, positive=True)]
    """Density."""

    surface_tension: Annotated[float, Quantity("N/m", "72.8 mN/m", 0.0)]
    """Surface tension against air."""

    viscosity: Annotated[float, Quantity("Pa*s", "1 mPa*s", 0.0)]
    """Dynamic viscosity."""

    mass: Annotated[float, Quantity("kg", "200 g", 0.0, positive=True)] | None = None
    """Load of a pour."""


class WeighedPairSettings(Settings):
    """A weighed pour and its simulation by a θ* that was fitted without it."""

    into: Annotated[Text, Example("tumbler")]
    """Receiver, in a resolved prior with its run."""

    action: Annotated[dict[Text, float], Example("{angular_velocity: 1.2, x_offset: 0.1, height: 0.1}")]
    """The action [SI]; dimensions that are switched off are left out."""

    poured: Annotated[float, Field(ge=0.0, le=1.0), Example("0.98")]
    """Fraction of the load that left the pourer."""

    measured: Annotated[float, Field(ge=0.0, le=1.0), Example("0.12")]
    """Spilled / poured, weighed."""

    simulated: Annotated[float, Field(ge=0.0, le=1.0), Example("0.14")]
    """Spilled / poured, simulated."""

    def check_values(self, problems: Problems) -> None:
        """Check the action."""
        if problems.valid("action"):
            try:
                self.pair()
            except (TypeError, ValueError) as error:
                problems.add(str(error), "action")

    @classmethod
    def of(cls, pair: WeighedPair) -> WeighedPairSettings:
        """The settings of a pair."""
        action = {name: value for name, value in asdict(pair.action).items() if value is not None}
        values = {"poured": pair.poured, "measured": pair.measured, "simulated": pair.simulated}
        return cls.model_validate({"into": pair.into, "action": action, **values})

    def pair(self, run: str = "") -> WeighedPair:
        """The pair, of an earlier run if one is given. Raises ValueError and TypeError for an impossible action."""
        switched_off = {name: None for name, dimension in ACTION_DIMENSIONS.items() if dimension.optional}
        action, into = Action.compose(switched_off, self.action), f"{run} into {self.into}" if run else self.into
        return WeighedPair(into, action, self.poured, self.measured, self.simulated)


class KnownPosterior(Settings):
    """What the weighed pours of one calibration alone tell about its parameters."""

    posterior: Annotated[Text, Example("quickstart-20300301-1")]
    """Name of the run."""

    simulator: Annotated[Text, Example("85955227f3491c5b")]
    """Version of the solver's code; 'unknown' if the run does not state it."""

    laboratory: Annotated[Text, Example("virtual")]
    """Name of the laboratory."""

    mode: Literal["virtual", "hardware", "external"] = "virtual"
    """Mode of the laboratory."""

    arm: Annotated[Text, Example("ur10")]
    """Model of the arm; 'none' for a bench without one."""

    liquid: Annotated[KnownLiquidSettings, Example("{name: water, density: 998 kg/m^3, …}")]
    """The liquid."""

    pourer: Annotated[Text, Example("beaker")]
    """Vessel that was poured from."""

    shape: Annotated[Text, Example("9f2c01d4a7b3e865")]
    """Digest of the pourer's shape."""

    receivers: Annotated[list[Text], Example("[tumbler]")]
    """Vessels that were poured into."""

    pours: Annotated[Count, Example("12")]
    """Number of weighed pours that it comes from."""

    fixed: Annotated[dict[Text, float], Example("{particles: 600}")]
    """Values [SI] of the parameters that were not searched."""

    parameters: Annotated[AnyEstimates, Example("{friction: {mean: 0.2, deviation: 0.1}}")]
    """Parameters that the pours determine better than the searched range does."""

    contradicts: list[Text] = Field(default_factory=list)
    """Earlier runs whose placement its pours contradict: the receiver or the arm was moved since."""

    weighed: list[WeighedPairSettings] = Field(default_factory=list)
    """The weighed pours with their simulations: what they show about the simulator."""

    @property
    def estimates(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation [SI] by parameter."""
        written = {name: self.parameters.value(name) for name in self.parameters.written_keys()}
        return {name: (estimate.mean, estimate.deviation) for name, estimate in written.items() if estimate is not None}

    def check_values(self, problems: Problems) -> None:
        """Check that it tells something."""
        if problems.valid("parameters") and not self.estimates:
            problems.add("names no parameter", "parameters")


def shape_digest(scene: Mapping[str, Any]) -> str:
    """Digest of the shape of a scene's pourer, in 16 digits.

    Args:
        scene: as in the fingerprint of a plan.
    """
    return digest(scene["pourer"]["shape"])[:16]


def arm_of(laboratory: Mapping[str, Any]) -> str:
    """Model of the arm of a laboratory in a fingerprint; 'none' without one."""
    arm = laboratory.get("arm") or {}
    return str(arm.get("model") or arm.get("kind") or "none")


class ResolvedPrior(Settings):
    """Prior from earlier campaigns, as a run's record has it: nothing is looked up again."""

    parameters: AnyRemembered = Field(default_factory=AnyRemembered)
    """Normal distribution of each parameter, and the runs that it comes from."""

    left_out: list[Text] = Field(default_factory=list)
    """Posteriors and parameters that are not used, with reasons."""

    stale: list[Text] = Field(default_factory=list)
    """Posteriors that are used although later pours disagree with them."""

    pours: list[WeighedPairSettings] = Field(default_factory=list)
    """Weighed pours of these runs, with their simulations."""

    @classmethod
    def of(cls, memory: CampaignMemory) -> ResolvedPrior:
        """The settings of a resolved prior."""
        rows = {
            row.name: {"mean": row.mean, "deviation": row.deviation, "runs": list(row.runs)}
            for row in memory.parameters
        }
        pours = [WeighedPairSettings.of(pair) for pair in memory.pours or ()]
        lists = {"left_out": list(memory.left_out), "stale": list(memory.stale), "pours": pours}
        return cls.model_validate({"parameters": rows, **lists})

    @property
    def memory(self) -> CampaignMemory:
        """The resolved prior."""
        estimates = {name: self.parameters.value(name) for name in self.parameters.written_keys()}
        rows = [
            RememberedParameter(name, estimate.mean, estimate.deviation, tuple(estimate.runs))
            for name, estimate in estimates.items()
            if estimate is not None
        ]
        pours = tuple(settings.pair() for settings in self.pours)
        return CampaignMemory(tuple(rows), tuple(self.left_out), tuple(self.stale), pours or None)


def _form(value: Any) -> str:
    return "word" if isinstance(value, str) else "list" if isinstance(value, list | tuple) else "record"


AnyPrior = Annotated[
    Annotated[Literal["catalogue"], Tag("word")]
    | Annotated[list[Text], Tag("list")]
    | Annotated[ResolvedPrior, Tag("record")],
    Discriminator(_form),
]
"""'catalogue', names of runs and files of posteriors, or a resolved prior."""


@dataclass(frozen=True)
class PriorNeeds:
    """What a campaign needs to know.

    Attributes:
        scene: of its pours.
        laboratory: in which they are made.
        wanted: bounds [SI] of the parameters that a prior may tell, by name.
        fixed: values of the parameters that are not searched.
        measured: searched parameters whose prior the file gives itself.
        why: completes the message about a parameter that is not wanted.
        poured: scene of a deployment that believes weighed pours; None without one.
    """

    scene: Scene
    laboratory: LaboratorySettings
    wanted: Mapping[str, tuple[float, float]]
    fixed: Mapping[str, float]
    measured: frozenset[str] = frozenset()
    why: str = "is not searched here"
    poured: Scene | None = None


@dataclass(frozen=True)
class PosteriorSource:
    """Access to the posteriors of a machine.

    Attributes:
        simulator: version of the solver here.
        every: returns all posteriors of the catalogue.
        of_run: returns that of one run; raises RunError.
        stale: returns since when and how much later pours disagree with it, as text; '' if they do not.
    """

    simulator: str
    every: Callable[[], Sequence[KnownPosterior]]
    of_run: Callable[[str], KnownPosterior]
    stale: Callable[[KnownPosterior], str] = lambda posterior: ""


def no_posteriors() -> PosteriorSource:
    """Refuse to look for posteriors, where a campaign is read that has none or keeps its own.

    Raises:
        RunError: always.
    """
    raise RunError("posteriors of earlier runs are not read here")


def resolve_prior(
    prior: Any, needs: PriorNeeds, place: Place, references: References, source: Callable[[], PosteriorSource]
) -> CampaignMemory | None:
    """The prior of a campaign; None after a problem, which is added to the report.

    Args:
        prior: value of the key.
        needs: of the campaign.
        place: of the key.
        references: reads files of posteriors.
        source: opens the catalogue; not called for a resolved prior.
    """
    report = references.report
    if isinstance(prior, ResolvedPrior):
        return prior.memory
    try:
        opened = source()
        if prior == CATALOGUE:
            return _combined(opened.every(), needs, opened)
    except (RunError, OSError) as error:
        report.add(place, str(error))
        return None
    named: list[KnownPosterior] = []
    before = len(report.problems)
    if not prior:
        report.add(place, "is empty; name runs, or write 'prior: catalogue'")
    for i, name in enumerate(prior):
        earlier = _named(name, place.at(i), references, opened)
        if earlier is None:
            continue
        reasons = _unfit(earlier, needs, opened)
        if reasons:
            report.add(place.at(i), f"the posterior of {earlier.posterior} can't be a prior here: {'; '.join(reasons)}")
        named.append(earlier)
    if len(report.problems) > before:
        return None
    return _combined(named, needs, opened)


def _named(name: str, place: Place, references: References, source: PosteriorSource) -> KnownPosterior | None:
    if name.lower().endswith(YAML_SUFFIXES):
        section = references.section(name, place, KnownPosterior)
        return None if section is None or references.report.is_broken_within(section[1]) else section[0]
    try:
        return source.of_run(name)
    except (RunError, OSError) as error:
        references.report.add(place, str(error))
        return None


def _unfit(earlier: KnownPosterior, needs: PriorNeeds, source: PosteriorSource) -> list[str]:
    """Reasons why a posterior can't be used at all; empty if it can."""
    reasons = []
    laboratory = needs.laboratory
    if earlier.simulator != source.simulator:
        theirs = f"it is of another simulator (version {earlier.simulator}, here {source.simulator})"
        reasons.append(f"{theirs}; calibrate again")
    if earlier.mode != laboratory.mode:
        reasons.append(f"it is of a {earlier.mode} laboratory, and '{laboratory.name}' is {laboratory.mode}")
    if earlier.arm != (arm := arm_of(deciding(laboratory))):
        reasons.append(f"it is of another arm ({earlier.arm}, here {arm})")
    for name, value in earlier.fixed.items():
        ours = needs.fixed.get(name)
        if ours is not None and not math.isclose(value, ours, rel_tol=1e-9, abs_tol=1e-12):
            reasons.append(f"its simulations had {name} {value:g}, here it is {ours:g}")
    if not set(earlier.estimates).intersection(needs.wanted):
        names = ", ".join(earlier.estimates)
        reasons.append(f"it is about {names}, which {needs.why}")
    return reasons


def _combined(posteriors: Sequence[KnownPosterior], needs: PriorNeeds, source: PosteriorSource) -> CampaignMemory:
    """Combine the posteriors that fit, parameter by parameter."""
    left_out: list[str] = []
    usable: list[KnownPosterior] = []
    for posterior in posteriors:
        reasons = _unfit(posterior, needs, source)
        if reasons:
            left_out.append(f"{posterior.posterior}: {'; '.join(reasons)}")
        else:
            usable.append(posterior)
    if not posteriors:
        left_out.append("the catalogue has no posterior yet: a calibration with C4 makes one")
    local = [posterior for posterior in usable if posterior.laboratory == needs.laboratory.name]
    contradicted = {name: posterior.posterior for posterior in local for name in posterior.contradicts}
    left_out += _groups_left_out(usable, contradicted, needs)
    remembered: list[RememberedParameter] = []
    for name in needs.wanted:
        parameter, reason = _remembered(name, usable, contradicted, needs)
        if parameter is not None:
            remembered.append(parameter)
        elif reason:
            left_out.append(reason)
    pours = () if needs.poured is None else _transferred_pours(usable, remembered, needs, left_out)
    runs = {run for parameter in remembered for run in parameter.runs}
    stale = [(posterior.posterior, source.stale(posterior)) for posterior in usable if posterior.posterior in runs]
    texts = tuple(f"{name}: {text}" for name, text in stale if text)
    return CampaignMemory(tuple(remembered), tuple(left_out), texts, pours or None)


def _groups_left_out(usable: Sequence[KnownPosterior], contradicted: Mapping[str, str], needs: PriorNeeds) -> list[str]:
    """Reasons why the liquid or the placement of usable posteriors is not transferred.

    Args:
        contradicted: posteriors whose placement later pours contradict, with the run of these pours.
    """

    def tells(posterior: KnownPosterior, group: str) -> bool:
        return any(group_of(name) == group for name in posterior.estimates)

    elsewhere, here = [], []
    for posterior in usable:
        name, laboratory = posterior.posterior, posterior.laboratory
        difference = _liquid_differs(posterior, needs.scene)
        if difference and tells(posterior, LIQUID):
            elsewhere.append(f"{name}: its {LIQUID} is not transferred, {difference}")
        if not tells(posterior, PLACEMENT):
            continue
        if laboratory != needs.laboratory.name:
            text = f"it is of laboratory '{laboratory}', here it is '{needs.laboratory.name}'"
            elsewhere.append(f"{name}: its {PLACEMENT} is not transferred, {text}")
        elif name in contradicted:
            text = f"the pours of {contradicted[name]} contradict it"
            here.append(f"{name}: its {PLACEMENT} is not transferred, {text}")
    return elsewhere + here


def _remembered(
    name: str, usable: Sequence[KnownPosterior], contradicted: Mapping[str, str], needs: PriorNeeds
) -> tuple[RememberedParameter | None, str]:
    """What the posteriors tell about a wanted parameter; None without anything, or for the returned reason."""
    group, info = group_of(name), SimulationParameters.info()[name]
    sources = [posterior for posterior in usable if name in posterior.estimates]
    if group == LIQUID:
        sources = [posterior for posterior in sources if not _liquid_differs(posterior, needs.scene)]
    elif group == PLACEMENT:
        here = [posterior for posterior in sources if posterior.laboratory == needs.laboratory.name]
        sources = [posterior for posterior in here if posterior.posterior not in contradicted]
    vessel = shape_digest(scene_by_content(needs.scene))
    same_vessel = [posterior for posterior in sources if posterior.shape == vessel]
    if group == WALLS and same_vessel:
        sources = same_vessel
    if group is None or not sources:
        return None, ""
    if name in needs.measured:
        return None, f"{name}: the campaign gives what was measured"
    spread = usual_spread(info, same_vessel=bool(same_vessel))
    mean, deviation = predicted([posterior.estimates[name] for posterior in sources], spread)
    mean = min(max(mean, info.lower), info.upper)
    parameter = RememberedParameter(name, mean, deviation, tuple(posterior.posterior for posterior in sources))
    lower, upper = needs.wanted[name]
    if not lower - 3.0 * deviation <= mean <= upper + 3.0 * deviation:
        return None, f"{parameter} is outside the searched range; widen the range"
    return parameter, ""


def _transferred_pours(
    usable: Sequence[KnownPosterior],
    remembered: Sequence[RememberedParameter],
    needs: PriorNeeds,
    left_out: list[str],
) -> tuple[WeighedPair, ...]:
    """The weighed pours of the newest posteriors that say something about the simulator here.

    Args:
        left_out: reasons for the others are added here.
    """
    pours: list[WeighedPair] = []
    older = 0
    told = {(parameter.name, run) for parameter in remembered for run in parameter.runs}
    for posterior in reversed(usable):  # the newest first
        lost = [name for name in posterior.estimates if (name, posterior.posterior) not in told]
        if reason := _pours_unfit(posterior, needs, lost):
            left_out.append(f"{posterior.posterior}: its weighed pours are not transferred, {reason}")
        elif len(pours) >= ENOUGH:
            older += 1
        else:
            pours += [settings.pair(posterior.posterior) for settings in posterior.weighed]
    if older:
        left_out.append(f"weighed pours of {older} older run{'s' * (older > 1)}: {len(pours)} of newer ones are enough")
    return tuple(pours)


def _pours_unfit(earlier: KnownPosterior, needs: PriorNeeds, lost: Sequence[str]) -> str:
    """Why the pours of a usable posterior say nothing here about the simulator, as text; empty if they do.

    Args:
        needs: of a campaign with a deployment that believes weighed pours.
        lost: parameters that their simulations have and this campaign does not take over.
    """
    assert needs.poured is not None
    liquid = needs.poured.liquid
    if not earlier.weighed or earlier.liquid.mass is None:
        return "its file or its run has none with their simulations"
    if earlier.shape != shape_digest(scene_by_content(needs.poured)):
        return f"they are from another vessel ('{earlier.pourer}')"
    if difference := _liquid_differs(earlier, needs.poured):
        return difference
    if not math.isclose(earlier.liquid.mass, liquid.mass, rel_tol=ALIKE):
        return f"they are of {1e3 * earlier.liquid.mass:g} g, here it is {1e3 * liquid.mass:g} g"
    if earlier.laboratory != needs.laboratory.name:
        return f"they are of laboratory '{earlier.laboratory}', here it is '{needs.laboratory.name}'"
    return f"their simulations have another {', '.join(lost)}" if lost else ""


def _liquid_differs(earlier: KnownPosterior, scene: Scene) -> str:
    """How the liquid differs from that of a scene, as text; empty if it is the same."""
    theirs, ours = earlier.liquid, scene.liquid
    if theirs.name != ours.name:
        return f"it is of '{theirs.name}', here it is '{ours.name}'"
    pairs = {
        "density": (theirs.density, ours.density),
        "surface tension": (theirs.surface_tension, ours.surface_tension),
        "viscosity": (theirs.viscosity, ours.dynamic_viscosity),
    }
    for name, (value, expected) in pairs.items():
        if not math.isclose(value, expected, rel_tol=ALIKE):
            return f"its {name} is {value:g}, here it is {expected:g} (SI)"
    return ""
