"""The strategies that a study compares, as written in its file: those of Decant, and those that packages add."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import Field, create_model

from orchestrator.config.yaml.sections import (
    MADE,
    PositiveCount,
    PositivePourCount,
    PositiveSimulationCount,
    Section,
    SimulationCount,
)
from orchestrator.strategies.calibration.c1 import C1Settings
from orchestrator.strategies.calibration.c2 import C2Settings
from orchestrator.strategies.calibration.c3 import C3Settings
from orchestrator.strategies.calibration.c4 import C4Settings
from orchestrator.strategies.deployment.d1 import D1Settings
from orchestrator.strategies.deployment.d2 import D2Settings
from orchestrator.strategies.deployment.d3_settings import D3Settings
from orchestrator.strategies.doors import calibrations, deployments
from orchestrator.strategies.settings import StrategySettings


class ArmSection(Section):
    """A strategy that is compared: how often, and what it may spend."""

    required: ClassVar[dict[str, str]] = {"repetitions": "10"}

    repetitions: Annotated[PositiveCount, Field(le=10_000)] | None = None
    """How often it is run: a calibration each time on pours of its own, a deployment into each receiver."""

    def changes(self) -> dict[str, Any]:
        """Settings of the strategy that are given here."""
        own = type(self).model_fields.keys() - ArmSection.model_fields.keys()
        return {name: value for name in own if (value := getattr(self, name)) is not None}


def _arm(settings: type[StrategySettings], *keys: str, **required: str) -> Any:
    """The section of an arm: some of its strategy's settings, none of which has to be given but the required ones."""
    fields: Any = {}
    for key in keys:
        info = settings.model_fields[key]
        value: Any = Annotated[(info.annotation, *info.metadata)] if info.metadata else info.annotation
        fields[key] = (value | None, Field(None, description=info.description))
    name = f"{settings.model_fields['strategy'].default}ArmSection"
    model = create_model(name, __base__=ArmSection, __doc__=ArmSection.__doc__, **fields)
    model.required = ArmSection.required | required
    model.variant = settings.model_fields["strategy"].default
    return model


C1Arm: Any = _arm(C1Settings, "per_axis", per_axis="10")
C2Arm: Any = _arm(C2Settings, "samples", samples="18")
C3Arm: Any = _arm(C3Settings, "iterations", "initial", "kappa", iterations="59")
C4Arm: Any = _arm(C4Settings, "simulations", "initial", "kappa", simulations="108")
D2Arm: Any = _arm(D2Settings, "pours", "mean", "initial", "kappa", pours="15")


class D1ArmSection(_arm(D1Settings, "simulations_per_iteration", "initial", "kappa")):  # type: ignore[misc]
    """A strategy that is compared: how often, and what it may spend."""

    iterations: list[PositiveSimulationCount] = Field(default=[15], min_length=1)
    """Iterations of the optimiser, one campaign for each number: [5, 10, 15]."""


class D3ArmSection(_arm(D3Settings, "pours", "prior_simulations", "initial", "kappa", pours="15")):  # type: ignore[misc]
    """A strategy that is compared: how often, and what it may spend."""

    per_pour: SimulationCount | None = None
    """Simulations told between two pours; not 'free', for then the clock would decide what is asked for."""


class C4ActiveArmSection(_arm(C4Settings, "simulations", "initial", "kappa", simulations="108", pours="6")):  # type: ignore[misc]
    """C4 on pours that it chooses itself, each by what it will tell about the deployments."""

    pours: PositivePourCount | None = None
    """Training pours that it chooses; it is scored on the repetition's test pours."""

    design_simulations: PositiveSimulationCount = 64
    """Simulations to choose them with."""

    def changes(self) -> dict[str, Any]:
        """Settings of C4 that are given here."""
        return {name: value for name, value in super().changes().items() if name in C4Settings.model_fields}


class CalibrationsBase(Section):
    """The calibrations that are compared."""

    C1: C1Arm | None = None
    """Uniform grid."""

    C2: C2Arm | None = None
    """Stratified sampling."""

    C3: C3Arm | None = None
    """Bayesian optimisation, each θ on all training pours."""

    C4: C4Arm | None = None
    """Bayesian optimisation, one simulation an iteration; the θ that it recommends is what D1 and D3 simulate with."""

    C4_paper: C4Arm | None = None
    """C4 as in the paper: the surrogate takes the action's influence for noise; compared, and used by nobody."""

    C4_active: C4ActiveArmSection | None = None
    """C4 on fewer pours that were chosen actively; compared, and used by nobody."""


class DeploymentsBase(Section):
    """The deployments that are compared, into each of the base campaign's receivers."""

    D1: D1ArmSection | None = None
    """Plan in simulation, pour once."""

    D2: D2Arm | None = None
    """Learn on real pours."""

    D2_paper: D2Arm | None = None
    """D2 as in the paper: a surrogate with a zero mean."""

    D3: D3ArmSection | None = None
    """Real pours with a simulated prior, the campaign's model of it and check of trust."""

    D3_paper: D3ArmSection | None = None
    """D3 as in the paper: a GP of the residual around the simulations' mean, always trusted."""


def _with_others(base: type[Section], installed: Mapping[str, type[StrategySettings]]) -> Any:
    """The section with a key for each strategy that a package adds; its settings are those of the strategy."""
    fields: Any = {}
    for name, settings in installed.items():
        if name not in base.model_fields:
            own = settings.model_fields.keys() - {"strategy"}
            meaning = settings.model_fields["strategy"].description
            fields[name] = (_arm(settings, *sorted(own)) | None, Field(None, description=meaning))
    name = base.__name__.replace("Base", "Section")
    return create_model(name, __base__=base, __doc__=base.__doc__, __cls_kwargs__=MADE, **fields)


CalibrationsSection: Any = _with_others(CalibrationsBase, calibrations())
DeploymentsSection: Any = _with_others(DeploymentsBase, deployments())
