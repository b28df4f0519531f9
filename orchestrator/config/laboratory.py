"""Laboratories as written in files. The hidden θ of a virtual bench lives here, and calibration never reads it."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, create_model

from actors.bench.spec import VirtualBenchSpec
from actors.spec import LaboratorySpec
from orchestrator.config.cluster import RaySection, ray_as_file, resolve_ray
from orchestrator.config.motion import parameter_quantity, value_as_file
from orchestrator.config.quantities import Quantity, format_quantity
from orchestrator.config.sections import Count, Name, Section, Switch
from sim_engine.liquid import SimulationParameters
from sim_engine.task import PoseError

_DEFAULT = VirtualBenchSpec(liquid=SimulationParameters())

Offset = Annotated[float, Quantity("m", "1 mm", -0.05, 0.05)]
Tilt = Annotated[float, Quantity("rad", "1 deg", -0.2, 0.2)]
Duration = Annotated[float, Quantity("s", "85 s", 0.0, 3600.0)]
Mass = Annotated[float, Quantity("kg", "0.1 g", 0.0, 0.1)]
Factor = Annotated[float, Quantity("1", "1.02", 0.5, 1.5)]
Spread = Annotated[float, Quantity("1", "0.01", 0.0, 0.5)]


class PoseErrorSection(Section):
    """How the real placement differs from the intended one."""

    x: Offset = 0.0
    """The receiver stands that much further from the pourer."""

    y: Offset = 0.0
    """… and that much sideways."""

    tilt: Tilt = 0.0
    """The pourer is held that much more tilted than commanded."""

    speed_factor: Factor = 1.0
    """Executed over commanded angular velocity."""


class PoseNoiseSection(Section):
    """Standard deviations of the same from pour to pour."""

    x: Annotated[float, Quantity("m", "0.5 mm", 0.0, 0.05)] = 0.0
    """Of the distance."""

    y: Annotated[float, Quantity("m", "0.5 mm", 0.0, 0.05)] = 0.0
    """Of the sideways placement."""

    tilt: Annotated[float, Quantity("rad", "0.3 deg", 0.0, 0.2)] = 0.0
    """Of the tilt."""

    speed_factor: Spread = 0.0
    """Of executed over commanded angular velocity."""


class BalanceSection(Section):
    """The virtual balance."""

    resolution: Mass = _DEFAULT.balance_resolution
    """Smallest step of the display."""

    noise: Mass = _DEFAULT.balance_noise
    """Standard deviation of a reading."""

    drift: Annotated[float, Quantity("kg/s", "0.01 g/s", -0.01, 0.01)] = _DEFAULT.balance_drift
    """Creep of the zero."""

    settling_time: Duration = _DEFAULT.settling_time
    """Time constant until a reading is stable."""


class HiddenLiquidBase(Section):
    """θ of the 'real' liquid between the virtual arm and the virtual balance. Hidden: calibration never reads it."""

    def parameters(self) -> SimulationParameters:
        """The hidden θ; what is not given has its default."""
        return SimulationParameters.from_values(
            {name: v for name in self.written_keys() if (v := self.value(name)) is not None}
        )


def hidden_liquid_model() -> type[HiddenLiquidBase]:
    """The section with one key per simulation parameter."""
    fields: Any = {
        name: (Annotated[float, parameter_quantity(name)] | None, Field(default=None, description=info.meaning or None))
        for name, info in SimulationParameters.info().items()
    }
    model: type[HiddenLiquidBase] = create_model(
        "HiddenLiquid", __base__=HiddenLiquidBase, __doc__=HiddenLiquidBase.__doc__, **fields
    )
    return model


HiddenLiquid: Any = hidden_liquid_model()


class BenchSection(Section):
    """A virtual bench: an arm, a balance, and a liquid that is not the simulator's."""

    required: ClassVar[dict[str, str]] = {"liquid": "{particles: 4000, cohesion: 0.05 N/m}"}

    liquid: HiddenLiquid | None = None
    """Hidden θ of the 'real' liquid; calibration never reads it."""

    pose_error: PoseErrorSection = PoseErrorSection()
    """Systematic error of grip and placement."""

    pose_noise: PoseNoiseSection = PoseNoiseSection()
    """Its scatter, drawn anew for each pour."""

    balance: BalanceSection = BalanceSection()
    """The virtual balance."""

    time_scale: Annotated[float, Quantity("1", "30", 0.0, 1e6)] = _DEFAULT.time_scale
    """Bench seconds per wall second; 0 waits for nothing."""

    operator_time: Duration = _DEFAULT.operator_time
    """Refilling, placing, wiping between two pours, in bench time."""


class LaboratoryFile(Section):
    """Where a campaign runs."""

    required: ClassVar[dict[str, str]] = {"name": "virtual"}

    name: Name | None = None
    """Its name in journals and banners."""

    mode: Literal["virtual"] = "virtual"
    """What it is made of: 'virtual' moves nothing."""

    simulators: Count = 0
    """Simulators in the pool; 0: one per core, of this machine or of the cluster."""

    in_process: Switch = False
    """Run everything in one process (slow, for finding errors)."""

    object_store: Annotated[float, Quantity("MB", "160 MB", 80.0, 100_000.0)] = 160.0
    """Shared memory for simulators' results, without a cluster."""

    ray: RaySection | None = None
    """The Ray cluster to run on; unless given, a private Ray on this machine."""

    bench: BenchSection | None = None
    """The virtual bench; without one the laboratory simulates and plans, and can't pour."""


def resolve_laboratory(section: LaboratoryFile) -> LaboratorySpec | None:
    """The laboratory of a file, None if something required is missing (which is reported already)."""
    bench = None
    if section.bench is not None:
        if section.bench.liquid is None:
            return None
        b = section.bench
        assert b.liquid is not None
        bench = VirtualBenchSpec(
            liquid=b.liquid.parameters(),
            pose_error=PoseError(**b.pose_error.model_dump()),
            pose_noise=PoseError(**b.pose_noise.model_dump()),
            time_scale=b.time_scale,
            operator_time=b.operator_time,
            balance_resolution=b.balance.resolution,
            balance_noise=b.balance.noise,
            balance_drift=b.balance.drift,
            settling_time=b.balance.settling_time,
        )
    if section.name is None:
        return None
    return LaboratorySpec(
        name=section.name,
        simulators=section.simulators,
        bench=bench,
        mode=section.mode,
        in_process=section.in_process,
        object_store_mb=round(section.object_store),
        ray=resolve_ray(section.ray),
    )


def laboratory_as_file(spec: LaboratorySpec) -> dict[str, object]:
    """The laboratory as a file would have it, JSON-ready."""
    table: dict[str, object] = {
        "name": spec.name,
        "mode": spec.mode,
        "simulators": spec.simulators,
        "in_process": spec.in_process,
        "object_store": f"{spec.object_store_mb} MB",
        **({} if spec.ray is None else {"ray": ray_as_file(spec.ray)}),
    }
    if spec.bench is None:
        return table
    b = spec.bench
    info = SimulationParameters.info()
    liquid = b.liquid.model_dump()
    return table | {
        "bench": {
            "liquid": {
                n: value_as_file(v, info[n].unit, info[n].unit, whole=info[n].integer) for n, v in liquid.items()
            },
            "pose_error": _pose_as_file(b.pose_error),
            "pose_noise": _pose_as_file(b.pose_noise),
            "balance": {
                "resolution": format_quantity(b.balance_resolution, "kg", "g"),
                "noise": format_quantity(b.balance_noise, "kg", "g"),
                "drift": format_quantity(b.balance_drift, "kg/s", "g/s"),
                "settling_time": format_quantity(b.settling_time, "s", "s"),
            },
            "time_scale": b.time_scale,
            "operator_time": format_quantity(b.operator_time, "s", "s"),
        }
    }


def _pose_as_file(pose: PoseError) -> dict[str, object]:
    return {
        "x": format_quantity(pose.x, "m", "mm"),
        "y": format_quantity(pose.y, "m", "mm"),
        "tilt": format_quantity(pose.tilt, "rad", "deg"),
        "speed_factor": pose.speed_factor,
    }
