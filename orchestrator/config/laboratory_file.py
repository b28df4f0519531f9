"""File sections of a laboratory: simulators, arm, balance, operator, virtual bench, Ray cluster.

`LaboratoryFile` is the whole file, `resolve_laboratory` converts it. The hidden θ of a virtual bench is part of it;
calibration never reads it. The sections of arm and balance are in `arm_file` and `balance_file`.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field, Strict, create_model
from pydantic_core import PydanticCustomError

from actors.balance.balance_settings import BalanceSpec
from actors.interfaces import OperatorSpec
from actors.laboratory_settings import LaboratorySpec, RaySpec, VirtualBenchSpec
from orchestrator.config.arm_file import ARMS, ArmSettings, CellSection
from orchestrator.config.balance_file import any_balance, resolve_balance
from orchestrator.config.search_ranges import parameter_quantity
from orchestrator.config.yaml.yaml_source import Place, Report
from orchestrator.strategies.deployment.disturbances import PoseErrorSection, PoseNoiseSection
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PoseError
from sim_engine.settings.model import MADE, Count, Name, Settings, Switch, tagged
from sim_engine.settings.quantity import Quantity

_OPERATOR = OperatorSpec()

Patience = Annotated[float, Quantity("s", "30 min", 0.0, 7 * 86400.0, positive=True)]


class OperatorSection(Settings):
    """The operator, who refills, wipes and places the vessels, and confirms each step."""

    answers: Literal["person", "virtual"] | None = None
    """A 'person' at the terminal, or a 'virtual' operator; unless given, it follows from the laboratory's mode."""

    time: Annotated[float, Quantity("s", "85 s", 0.0, 3600.0)] = _OPERATOR.time
    """Total time of a virtual operator for one pour, in bench time."""

    reminder: Patience = _OPERATOR.reminder
    """Time after which an open question is repeated."""

    deadline: Patience = _OPERATOR.deadline
    """Time after which an open question is abandoned: nothing moves then, and the campaign pauses."""


def resolve_operator(section: OperatorSection, place: Place, report: Report, *, mode: str) -> OperatorSpec | None:
    """The operator of a file; None after a problem, which is added to the report.

    Args:
        section: the section as written.
        place: place of the section.
        report: receives problems.
        mode: mode of the laboratory, 'virtual' or 'hardware'.
    """
    before = len(report.problems)
    if mode == "hardware" and section.answers == "virtual":
        report.add(
            place.at("answers"),
            "where an arm moves, a person has to say that no hand is in its way; write 'person', or remove the key",
        )
    if mode == "hardware" and "time" in section.model_fields_set:
        report.add(place.at("time"), "is a virtual operator's; a person takes the time that it takes; remove the key")
    if section.reminder > section.deadline:
        report.add(place.at("reminder"), "comes after the deadline; it should be shorter")
    if len(report.problems) > before:
        return None
    return OperatorSpec(
        answers=section.answers or ("person" if mode == "hardware" else "virtual"),
        time=section.time,
        reminder=section.reminder,
        deadline=section.deadline,
    )


def _address(text: str) -> str:
    host, colon, port = text.rpartition(":")
    if colon and re.fullmatch(r"[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]", host) and port.isdigit() and 0 < int(port) < 65536:
        return text
    raise PydanticCustomError(
        "ray_address",
        "{text} should be host:port of the cluster's head as 'ray start --head' prints it, e.g. 10.0.0.1:6379",
        {"text": repr(text)},
    )


Address = Annotated[str, Strict(), AfterValidator(_address)]


class RaySection(Settings):
    """An existing Ray cluster; Decant connects to it and does not stop it."""

    required: ClassVar[dict[str, str]] = {"address": "10.0.0.1:6379"}

    address: Address | None = None
    """Address of its head node, host:port."""

    bench_resource: Name = RaySpec.bench_resource
    """Custom resource of the node that runs arm, balance and bench; set it with 'ray start --resources'."""


def resolve_ray(section: RaySection | None) -> RaySpec | None:
    """The cluster of a file; None without a cluster, or if its address is invalid (which is reported already)."""
    if section is None or section.address is None:
        return None
    return RaySpec(section.address, section.bench_resource)


_DEFAULT = VirtualBenchSpec(liquid=SimulationParameters())

Duration = Annotated[float, Quantity("s", "85 s", 0.0, 3600.0)]
Mass = Annotated[float, Quantity("kg", "0.1 g", 0.0, 0.01)]


class BalanceSection(Settings):
    """The virtual balance."""

    resolution: Mass = _DEFAULT.balance_resolution
    """Smallest step of the display."""

    noise: Mass = _DEFAULT.balance_noise
    """Standard deviation of a reading."""

    drift: Annotated[float, Quantity("kg/s", "0.01 g/s", -0.01, 0.01)] = _DEFAULT.balance_drift
    """Drift of the zero."""

    settling_time: Duration = _DEFAULT.settling_time
    """Time constant until a reading is stable."""


class HiddenLiquidBase(Settings):
    """θ of the 'real' liquid of the virtual bench. Hidden: calibration never reads it."""

    def parameters(self) -> SimulationParameters:
        """The hidden θ; missing values have their defaults."""
        return SimulationParameters.from_values(
            {name: v for name in self.written_keys() if (v := self.value(name)) is not None}
        )


def hidden_liquid_model() -> type[HiddenLiquidBase]:
    """The section with one key per parameter of the solver; the nuisance parameters of a bench are its `pose_error`."""
    fields: Any = {
        name: (Annotated[float, parameter_quantity(name)] | None, Field(default=None, description=info.meaning or None))
        for name, info in SimulationParameters.info().items()
        if not info.nuisance
    }
    model: type[HiddenLiquidBase] = create_model(
        "HiddenLiquid", __base__=HiddenLiquidBase, __doc__=HiddenLiquidBase.__doc__, __cls_kwargs__=MADE, **fields
    )
    return model


HiddenLiquid: Any = hidden_liquid_model()


class BenchSection(Settings):
    """Ground truth of a virtual bench: a liquid that differs from the simulator's, execution errors, and the speed of
    time."""

    required: ClassVar[dict[str, str]] = {"liquid": "{particles: 4000, cohesion: 0.05 N/m}"}

    liquid: HiddenLiquid | None = None
    """Hidden θ of the 'real' liquid; calibration never reads it."""

    pose_error: PoseErrorSection = PoseErrorSection()
    """Systematic error of grip and placement."""

    pose_noise: PoseNoiseSection = PoseNoiseSection()
    """Random error of grip and placement, drawn for each pour."""

    balance: BalanceSection = BalanceSection()
    """The balance of a simulated bench; a laboratory with an arm has a separate section for it."""

    time_scale: Annotated[float, Quantity("1", "30", 0.0, 1e6)] = _DEFAULT.time_scale
    """Bench seconds per wall second; 0 means no waiting (not with an arm)."""

    operator_time: Duration = _DEFAULT.operator_time
    """Time to refill, place and wipe between two pours, in bench time; with an arm see 'operator'."""


AnyArm: Any = tagged(ARMS.all)
"""Settings type of all installed kinds of arms."""

AnyBalance: Any = any_balance()


class LaboratoryFile(Settings):
    """The laboratory in which a campaign runs."""

    recorded_as_given: ClassVar[bool] = True

    required: ClassVar[dict[str, str]] = {"name": "virtual"}

    name: Name | None = None
    """Its name in journals and banners."""

    mode: Literal["virtual", "hardware"] = "virtual"
    """'virtual' moves nothing, 'hardware' moves an arm."""

    simulators: Annotated[Count, Field(le=10_000)] = 0
    """Number of simulators in the pool; 0: one per core of this machine or of the cluster."""

    in_process: Switch = False
    """Run everything in one process (slow, for debugging)."""

    object_store: Annotated[float, Quantity("MB", "160 MB", 80.0, 100_000.0)] = 160.0
    """Shared memory for simulators' results, without a cluster."""

    ray: RaySection | None = None
    """The Ray cluster to run on; unless given, a private Ray on this machine."""

    arm: AnyArm | None = None
    """The arm that holds the pourer, virtual or real; `kind` is one of the installed kinds."""

    cell: CellSection | None = None
    """Objects around the arm."""

    balance: AnyBalance | None = None
    """The balance next to the arm."""

    operator: OperatorSection = OperatorSection()
    """The operator next to the arm."""

    bench: BenchSection | None = None
    """Ground truth of a virtual bench. Without bench and arm, the laboratory only simulates and plans."""


def resolve_laboratory(section: LaboratoryFile, place: Place, report: Report) -> LaboratorySpec | None:
    """The laboratory of a file; None after a problem, which is added to the report.

    Args:
        section: the section as written.
        place: place of the section.
        report: receives problems.
    """
    before = len(report.problems)
    if section.mode == "hardware":
        _check_hardware(section, place, report)
    _check_wires(section, place, report)
    operator = resolve_operator(section.operator, place.at("operator"), report, mode=section.mode)
    written: ArmSettings | None = section.arm
    arm = None if written is None else written.resolve(section.cell, place, report, mode=section.mode)
    balance = None
    if section.arm is not None and section.balance is not None:
        balance = resolve_balance(section.balance, place.at("balance"), report, mode=section.mode)
    if section.name is None or operator is None or len(report.problems) > before:
        return None
    if (section.arm is None) is not (arm is None) or (section.bench is not None and section.bench.liquid is None):
        return None  # reported already, as missing
    bench = None if section.bench is None else _bench(section.bench)
    if arm is not None and bench is not None:
        arm, balance = arm.paced(bench.time_scale), _paced(balance, bench.time_scale)
    return LaboratorySpec(
        name=section.name,
        simulators=section.simulators,
        bench=bench,
        mode=section.mode,
        in_process=section.in_process,
        object_store_mb=round(section.object_store),
        ray=resolve_ray(section.ray),
        arm=arm,
        balance=balance,
        operator=operator if arm is not None else OperatorSpec(answers="virtual"),
    )


def _check_hardware(section: LaboratoryFile, place: Place, report: Report) -> None:
    if section.bench is not None:
        report.add(
            place.at("bench"),
            "is what a virtual bench hides, and how fast its time runs; hardware hides its own, and its time is the "
            "clock's. Remove the section, or write 'mode: virtual'",
        )
    if section.arm is None and not report.is_broken(place.at("arm")):
        report.add(place, "a laboratory of hardware needs its arm; add an 'arm' and a 'cell' section", key=True)


def _check_wires(section: LaboratoryFile, place: Place, report: Report) -> None:
    """Keys that need an arm, and keys that belong to other sections if there is an arm."""
    if section.arm is None:
        if report.is_broken(place.at("arm")):
            return
        for key in ("cell", "balance", "operator"):
            if key in section.model_fields_set:
                meant = "; a bench of numbers has 'bench: {balance: …, operator_time: …}'" if key != "cell" else ""
                report.add(place.at(key), f"belongs to an arm, and there is none; add 'arm', or remove it{meant}")
        return
    if section.balance is None and not report.is_broken(place.at("balance")):
        report.add(
            place, "an arm that pours needs a balance; add 'balance: {placement: tray, …}', or 'placement: manual'"
        )
    if section.mode == "hardware":
        return
    if section.bench is None:
        if not report.is_broken(place.at("bench")):
            report.add(place, "a virtual arm pours a hidden liquid; add 'bench: {liquid: {…}}', or 'mode: hardware'")
        return
    at, bench = place.at("bench"), section.bench
    for key, other in (("balance", "the section 'balance'"), ("operator_time", "'time' in the section 'operator'")):
        if key in bench.model_fields_set:
            report.add(at.at(key), f"is of a bench without wires; with an arm write it into {other}")
    if bench.pose_error.speed_factor != 1.0 or bench.pose_noise.speed_factor != 0.0:
        key = "pose_error" if bench.pose_error.speed_factor != 1.0 else "pose_noise"
        report.add(
            at.at(key, "speed_factor"),
            "an arm over its wires moves as fast as it is told; its own lag is in what it reads back. Remove the key",
        )
    if bench.time_scale < 1.0:
        report.add(at.at("time_scale"), "an arm takes its time: 1 or more, and at most some 50")


def _bench(b: BenchSection) -> VirtualBenchSpec:
    assert b.liquid is not None
    return VirtualBenchSpec(
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


def _paced(balance: BalanceSpec | None, time_scale: float) -> BalanceSpec | None:
    """A virtual balance that runs in bench time."""
    if balance is None or balance.device is None:
        return balance
    return replace(balance, device=balance.device.paced(time_scale))
