"""Liquids and the simulator's knobs: what is poured (SI), and what calibration may turn: θ_s, nuisances."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

LARGEST_LIP_DROP = 1.0

THIN = 5e-6
"""Up to this kinematic viscosity a liquid is as thin as water to the solver: its boundary layers √(πνt), a millimetre
or two in what a pour takes, are thinner than half a spacing of a usual simulation [m²/s]."""

NEUTRAL = 0.5 * math.pi
"""Contact angle of a wall that is neither wet nor shunned: what the solver has where nobody says otherwise [rad]."""

FARTHEST_TILT = math.radians(5.0)

SHOWN = {"mm": 1e-3, "deg": math.pi / 180.0}
"""Units that people read in place of SI units, and what one of them is in SI."""


def _nuisance(unit: str, shown: str, tolerance: float) -> dict[str, Any]:
    """What a bench's nuisance declares beside default, bounds and meaning: `tolerance` is a standard deviation."""
    return {"unit": unit, "shown": shown, "tolerance": tolerance}


@dataclass(frozen=True)
class ParameterInfo:
    """A simulation parameter as forms, schema and plots need it (bounds are those of the model field).

    Attributes:
        unit: SI; '1' for a plain number.
        shown: unit that people read and write.
        tolerance: of a bench's nuisance, the standard deviation that it is thought to have before anything is measured,
            in SI; 0 for what is turned in the solver.
    """

    name: str
    unit: str
    lower: float
    upper: float
    integer: bool
    meaning: str
    shown: str
    tolerance: float

    @property
    def factor(self) -> float:
        """One shown unit in SI."""
        return SHOWN.get(self.shown, 1.0)

    @property
    def nuisance(self) -> bool:
        """Whether it is about how a bench differs from what was commanded, and not about the solver."""
        return self.tolerance > 0.0


class Liquid(BaseModel):
    """A load of liquid.

    Attributes:
        name: for people.
        mass: loaded mass [kg].
        density: [kg/m³].
        surface_tension: against air [N/m].
        dynamic_viscosity: [Pa s].
        contact_angle: of the liquid on the vessels [rad].

    A liquid of more than `THIN` is simulated with this viscosity and this tension, and sticks to walls. For one as thin
    as water they decide nothing: θ's `viscosity` and `cohesion` do, and it slips. From all of them and the planned flow
    follows what a simulation can't tell, see `sim_engine.regimes`. The defaults are water's at 20 °C.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = "water"
    mass: float = Field(gt=0.0, le=20.0)
    density: float = Field(default=998.0, gt=100.0, lt=20_000.0)
    surface_tension: float = Field(default=0.0728, ge=1e-3, le=1.0)
    dynamic_viscosity: float = Field(default=1.0e-3, ge=1e-5, le=1e3)
    contact_angle: float = Field(default=NEUTRAL, ge=0.0, le=math.pi)

    @property
    def volume(self) -> float:
        """Loaded volume [m³]."""
        return self.mass / self.density

    @property
    def kinematic_viscosity(self) -> float:
        """ν = μ/ρ [m²/s]: water's is 1e-6."""
        return self.dynamic_viscosity / self.density

    @property
    def is_thick(self) -> bool:
        """Whether its viscosity is simulated in SI."""
        return self.kinematic_viscosity > THIN

    def free_fields(self) -> frozenset[str]:
        """Fields that decide no request of this very liquid; of a thin one a simulation does not look at them."""
        free = set() if self.is_thick else {"surface_tension", "dynamic_viscosity"}
        return frozenset(free | ({"contact_angle"} if self.contact_angle == NEUTRAL else set()))

    def millilitres(self, mass: float) -> float:
        """Volume of some of it, as people read it [mL]; mass in [kg]."""
        return 1e6 * mass / self.density


class SimulationParameters(BaseModel):
    """What calibration may turn: θ_s and nuisances of the bench. Names follow FleX where it has one; meanings are ours.

    Nuisances say how a bench differs, pour after pour, from what was given: where the receiver stands, how the pourer
    is held, how fast the arm's clock runs. The simulator applies them in one place (`PourTask.placement`).
    """

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    particles: int = Field(default=2_000, ge=200, le=50_000)
    """Number of particles at fixed liquid volume; sets the spacing d = (V/N)^(1/3)."""

    cohesion: float = Field(default=0.02, ge=0.0, le=0.2, json_schema_extra={"unit": "N/m"})
    """Surface tension [N/m], the same at any spacing: drops oscillate at Rayleigh's frequency.
    Below about one capillary length per spacing (2.7 mm for water) it only acts on drips."""

    viscosity: float = Field(default=3.0, ge=0.0, le=60.0, json_schema_extra={"unit": "1/s"})
    """Rate at which a particle's velocity relaxes to its neighbours' mean (XSPH) [1/s], whatever the time step, of
    liquids as thin as water."""

    viscosity_factor: float = Field(default=1.0, ge=0.1, le=10.0, json_schema_extra={"unit": "1"})
    """Of liquids above 5 mm²/s: their true viscosity over that of the scene's liquid. A degree of temperature changes
    it by 2 to 9 %, a point of water in glycerol by 10 %."""

    eddies: float = Field(default=0.17, ge=0.0, le=0.3, json_schema_extra={"unit": "1"})
    """Smagorinsky's constant C: motion that is finer than a spacing has the viscosity (C d)² |S|. 0.17 follows from
    theory, and keeps streams of few particles as narrow as those of many. At 0 shear makes particles climb over each
    other and widens the stream, as in solvers without such a viscosity."""

    friction: float = Field(default=0.0, ge=0.0, le=1.0, json_schema_extra={"unit": "1"})
    """Coulomb coefficient between particles and vessel walls. Water slips along cups: 0.05 already delays the standard
    pour by more than other solvers differ among themselves."""

    wall_distance: float = Field(default=0.5, ge=0.3, le=1.5, json_schema_extra={"unit": "1"})
    """Distance from a wall at which particles come to rest, in spacings (FleX: collision distance). At 0.5 a vessel
    holds its true volume; more narrows vessels and raises lips, as walls made of particles do."""

    lip_drop: float = Field(default=0.5, ge=0.0, le=LARGEST_LIP_DROP, json_schema_extra={"unit": "1"})
    """Rims are lower by so many spacings for particles at rest, and less the faster they are, down to not at all from
    √(g d) on. A layer of particles can't be thinner than a spacing: at 0.5 its middle passes a lip with the head that a
    film's needs. At 0 a lip holds back more, as in solvers that don't correct their lips."""

    receiver_x: float = Field(default=0.0, ge=-0.03, le=0.03, json_schema_extra=_nuisance("m", "mm", 0.005))
    """The receiver stands that much further from the pourer than intended."""

    receiver_y: float = Field(default=0.0, ge=-0.03, le=0.03, json_schema_extra=_nuisance("m", "mm", 0.003))
    """The receiver stands that much sideways."""

    receiver_z: float = Field(default=0.0, ge=-0.03, le=0.03, json_schema_extra=_nuisance("m", "mm", 0.003))
    """The receiver stands that much higher: the liquid falls less far."""

    tilt_zero: float = Field(
        default=0.0, ge=-FARTHEST_TILT, le=FARTHEST_TILT, json_schema_extra=_nuisance("rad", "deg", math.radians(0.7))
    )
    """The pourer is held that much more tilted than commanded."""

    speed_factor: float = Field(default=1.0, ge=0.8, le=1.25, json_schema_extra=_nuisance("1", "1", 0.02))
    """Executed over commanded angular velocity."""

    @classmethod
    def info(cls) -> dict[str, ParameterInfo]:
        """Name, unit, bounds and meaning of every parameter."""
        table = {}
        for name, field in cls.model_fields.items():
            lower = next(m.ge for m in field.metadata if hasattr(m, "ge"))
            upper = next(m.le for m in field.metadata if hasattr(m, "le"))
            extra: dict[str, Any] = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
            unit = str(extra.get("unit", "1"))
            table[name] = ParameterInfo(
                name,
                unit,
                float(lower),
                float(upper),
                field.annotation is int,
                field.description or "",
                str(extra.get("shown", unit)),
                float(extra.get("tolerance", 0.0)),
            )
        return table

    @classmethod
    def nuisances(cls) -> dict[str, ParameterInfo]:
        """Those that are about the bench."""
        return {name: info for name, info in cls.info().items() if info.nuisance}

    def of_the_solver(self) -> dict[str, float]:
        """Values of those that are not about the bench."""
        return self.model_dump(exclude=set(self.nuisances()))

    @classmethod
    def from_values(cls, values: dict[str, float]) -> SimulationParameters:
        """From a searched point; whole numbers are rounded. Parameters not named keep their defaults."""
        rounded = {k: round(v) if cls.model_fields[k].annotation is int else v for k, v in values.items()}
        return cls.model_validate(rounded)
