"""Settings of a laboratory: the pool of simulators, the Ray cluster, arm, balance and operator, and the virtual bench.

`LaboratorySettings` is the whole file. `BenchSettings` is a section of it; the settings of Ray, arm, balance and
operator are in their own modules. The ground truth of a virtual bench is part of the file; calibration
never reads it.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, create_model, field_validator

from actors.arm.arm_settings import ArmSettings, arm_kind, arm_settings
from actors.arm_geometry import RobotCell
from actors.balance.balance_settings import BalanceSettings
from actors.balance.dialect_registry import kinds
from actors.balance.scale_model import Drift
from actors.dosing_settings import DosingSettings
from actors.grippers.gripper_interface import GRIPPERS, GripperSettings
from actors.interfaces import OperatorSettings, RaySettings
from actors.liquid_devices import (
    SPILL_SENSORS,
    SourceSettings,
    SpillSensorSettings,
    check_devices,
)
from actors.places import CellVessel, PlaceSettings, UnattendedSettings, all_places, check_places
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PoseErrorSettings, PoseNoise
from sim_engine.settings.model import (
    NOT_IN_FINGERPRINT,
    SET_BY_PROGRAM,
    Count,
    Example,
    Name,
    OneOf,
    Problems,
    Settings,
    Switch,
    Text,
)
from sim_engine.settings.quantity import Quantity

MODE_LABELS = {"virtual": "VIRTUAL", "hardware": "REAL", "external": "EXTERNAL"}
"""How reports, lists and the live view write a laboratory's mode."""


Duration = Annotated[float, Quantity("s", "85 s", 0.0, 3600.0)]
Mass = Annotated[float, Quantity("kg", "0.1 g", 0.0, 0.01)]


class BenchBalance(Settings):
    """The virtual balance."""

    resolution: Mass = 1e-4
    """Smallest step of the display."""

    noise: Mass = 1e-4
    """Standard deviation of a reading."""

    drift: Drift = 0.0
    """Drift of the zero."""

    settling_time: Duration = 1.5
    """Time constant until a reading is stable."""


class TrueLiquidBase(Settings):
    """The ground truth: θ of the virtual bench's liquid, which calibration never reads."""

    def parameters(self) -> SimulationParameters:
        """θ of the ground truth."""
        return SimulationParameters.from_values(self.model_dump())

    def free_fields(self) -> frozenset[str]:
        """As those of `SimulationParameters`."""
        return self.parameters().free_fields()


def _true_liquid() -> type[TrueLiquidBase]:
    """The settings with one key per parameter of the solver; the nuisances of a bench are its `pose_error`."""
    fields: Any = {
        name: (
            Annotated[float, info.quantity, AfterValidator(round)] if info.integer else Annotated[float, info.quantity],
            Field(default=info.default, description=info.meaning or None),
        )
        for name, info in SimulationParameters.info().items()
        if not info.nuisance
    }
    model: type[TrueLiquidBase] = create_model(
        "TrueLiquid",
        __base__=TrueLiquidBase,
        __doc__=TrueLiquidBase.__doc__,
        __module__=__name__,
        **fields,
    )
    return model


TrueLiquid: Any = _true_liquid()


class BenchSettings(Settings):
    """Ground truth of a virtual bench: a liquid that differs from the simulator's, execution errors, and the speed of
    time."""

    liquid: Annotated[TrueLiquid, Example("{particles: 4000, cohesion: 0.05 N/m}")]
    """Ground truth: θ of the bench's liquid, which calibration never reads."""

    pose_error: PoseErrorSettings = PoseErrorSettings()
    """Systematic error of grip and placement."""

    pose_noise: PoseNoise = PoseNoise()
    """Random error of grip and placement, drawn for each pour."""

    doses: Annotated[Literal["formula", "particles"], NOT_IN_FINGERPRINT] = "formula"
    """Liquid of doses: 'particles' as in other pours; with a 'formula' they take no simulation, out of straight cups only, and never miss the receiver."""  # noqa: E501

    balance: BenchBalance = BenchBalance()
    """The balance of a simulated bench; a laboratory with an arm has a separate section for it."""

    time_scale: Annotated[float, Quantity("1", "30", 0.0, 1e6)] = 30.0
    """Bench seconds per wall second; 0 means no waiting (not with an arm). An arm pours doses in real time."""

    operator_time: Duration = 85.0
    """Time to refill, place and wipe between two pours, in bench time; with an arm see 'operator'."""

    @field_validator("liquid", mode="before")
    @classmethod
    def _from_parameters(cls, value: Any) -> Any:
        """A program may also give the θ itself."""
        return TrueLiquid(**value.of_the_solver()) if isinstance(value, SimulationParameters) else value

    def check_values(self, problems: Problems) -> None:
        """See `Settings.check_values`."""
        if self.doses == "particles" and problems.valid("liquid") and self.theta.lip_adhesion > 0.0:
            text = (
                "what runs down the outside of the pourer is not simulated in doses: remove 'lip_adhesion', or write "
                "'doses: formula'"
            )
            problems.add(text, "liquid", "lip_adhesion")

    @property
    def theta(self) -> SimulationParameters:
        """θ of the ground truth."""
        parameters: SimulationParameters = self.liquid.parameters()
        return parameters


class LaboratorySettings(Settings):
    """The laboratory in which a campaign runs."""

    recorded_as_given: ClassVar[bool] = True

    name: Annotated[Name, Example("virtual")]
    """Its name in journals and banners."""

    mode: Literal["virtual", "hardware", "external"] = "virtual"
    """'virtual' moves nothing, 'hardware' moves an arm. 'external': your program pours; see `decant.AskTell`."""

    simulators: Annotated[Count, Field(le=10_000), NOT_IN_FINGERPRINT] = 0
    """Number of simulators in the pool; 0: one per core of this machine or of the cluster."""

    in_process: Annotated[Switch, NOT_IN_FINGERPRINT] = False
    """Run everything in one process (slow, for debugging)."""

    ray: Annotated[RaySettings | None, NOT_IN_FINGERPRINT] = None
    """The Ray cluster to run on; unless given, a private Ray on this machine."""

    arm: Annotated[ArmSettings, OneOf(arm_settings)] | None = None
    """The arm that holds the pourer, virtual or real; `kind` is one of the installed kinds."""

    cell: RobotCell | None = None
    """Objects around the arm."""

    gripper: Annotated[Annotated[GripperSettings, OneOf(lambda: GRIPPERS.all)] | None, NOT_IN_FINGERPRINT] = None
    """The gripper that holds the pourer; `kind` is one of the installed kinds. The operator works it unless given."""

    places: Annotated[tuple[PlaceSettings, ...], NOT_IN_FINGERPRINT] = ()
    """Places between which the arm carries the vessels, instead of the operator."""

    safeguard: Annotated[Text, NOT_IN_FINGERPRINT] = ""
    """What keeps people out while the arm moves without a person: fence, scanner, and the safety input that it is wired to. Needed for `unattended` pours."""  # noqa: E501

    unattended: Annotated[UnattendedSettings | None, SET_BY_PROGRAM] = None
    """What the campaign asks for."""

    vessels: Annotated[tuple[CellVessel, ...], SET_BY_PROGRAM] = ()
    """All vessels of the campaign's doses, of a laboratory with places; empty: the only source and the only cup."""

    balance: Annotated[BalanceSettings, OneOf(kinds)] | None = None
    """The balance next to the arm."""

    source: Annotated[SourceSettings | None, NOT_IN_FINGERPRINT] = None
    """Devices at the source vessel."""

    spill_sensor: Annotated[
        Annotated[SpillSensorSettings, OneOf(lambda: SPILL_SENSORS.all)] | None, NOT_IN_FINGERPRINT
    ] = None
    """A sensor that watches the table for spills; nothing more is poured until the operator has wiped it."""

    operator: Annotated[OperatorSettings, NOT_IN_FINGERPRINT] = OperatorSettings()
    """The operator next to the arm."""

    bench: BenchSettings | None = None
    """Ground truth of a virtual bench. Without bench and arm, the laboratory only simulates and plans."""

    dosing: Annotated[DosingSettings, NOT_IN_FINGERPRINT] = DosingSettings()
    """How wanted amounts are poured."""

    accepted_checksum: Annotated[str, SET_BY_PROGRAM] = ""
    """Checksum of the accepted safety settings of the hardware; '' if none are accepted."""

    @property
    def pours(self) -> bool:
        """Whether there is a bench."""
        return self.arm is not None or self.bench is not None or self.mode == "external"

    @property
    def needs_person(self) -> bool:
        """Whether the laboratory needs a person who answers questions."""
        return self.arm is not None and self.operator.answers == "person"

    @property
    def simulator_count(self) -> int:
        """Size of the pool on this machine: as stated, or one per core."""
        return self.simulators or os.cpu_count() or 1

    def ready(self) -> Self:
        """The laboratory of a file as a program uses it.

        The arm knows its cell, arm and balance the time scale of the bench, and the operator who answers.
        """
        scale = 1.0 if self.bench is None else self.bench.time_scale
        answers = "virtual" if self.arm is None or self.mode == "virtual" else "person"
        return self.with_values(
            arm=None if self.arm is None else self.arm.in_laboratory(self.cell, scale),
            balance=None if self.balance is None else self.balance.with_values(time_scale=scale),
            operator=self.operator.with_values(answers=self.operator.answers or answers),
        )

    @property
    def expected_arm(self) -> ArmSettings | None:
        """The arm with the geometry that a run will use: for checks before it is connected."""
        return None if self.arm is None else self.arm.expected(virtual=self.mode == "virtual")

    def resumed(self) -> Self:
        """The laboratory in the middle of a campaign: the sources hold what was left in them."""
        return self.with_values(vessels=tuple(replace(vessel, filled=False) for vessel in self.vessels))

    def in_real_time(self) -> Self:
        """The laboratory for wanted amounts: an arm over its wires that carries nothing then moves in real time.

        A virtual operator needs as much time of the clock as before.
        """
        scale = 1.0 if self.bench is None else self.bench.time_scale
        if self.arm is None or self.bench is None or scale == 1.0 or self.places:
            return self
        return self.with_values(
            bench=self.bench.with_values(time_scale=1.0),
            arm=self.arm.with_values(time_scale=1.0),
            balance=None if self.balance is None else self.balance.with_values(time_scale=1.0),
            operator=self.operator.with_values(time=self.operator.time / scale),
        )

    # ---- rules between the sections

    def check_values(self, problems: Problems) -> None:
        """See `Settings.check_values`."""
        if self.mode == "hardware":
            self._check_hardware(problems)
        if self.mode == "external":
            self._check_external(problems)
            return
        at_source = any(place.use == "source" for place in self.places)
        check_devices(problems, self.mode, self.source, self.spill_sensor, at_source=at_source)
        if self.arm is None:
            self._check_without_arm(problems)
        else:
            self._check_with_arm(problems)
            arm_kind(self.arm).check_laboratory(problems, mode=self.mode, cell=self.cell)
            if self.gripper is not None:
                self.gripper.check_laboratory(problems.within("gripper"), mode=self.mode, arm=self.arm)
            if self.places and problems.valid("places", "arm", "cell"):
                self._check_places(problems)
            if self.balance is not None:
                inner = problems.within("balance")
                if self.balance.typed:
                    self.balance.check_manual(inner)
                self.balance.check_laboratory(inner, mode=self.mode)

    def _check_hardware(self, problems: Problems) -> None:
        self.operator.check_hardware(problems.within("operator"))
        if self.bench is not None:
            problems.add(
                "is what a virtual bench hides, and how fast its time runs; hardware hides its own, and its time is "
                "the clock's. Remove the section, or write 'mode: virtual'",
                "bench",
            )
        if self.arm is None:
            text = "a laboratory of hardware needs its arm; add an 'arm' and a 'cell' section"
            problems.add(text, key=True, of="arm")

    def _check_external(self, problems: Problems) -> None:
        for key in ("arm", "cell", "gripper", "balance", "source", "spill_sensor", "operator", "bench"):
            if key in self.model_fields_set and problems.valid(key):
                text = "an external laboratory has no devices of Decant: your program pours and weighs; remove it"
                problems.add(text, key, key=True)

    def _check_places(self, problems: Problems) -> None:
        assert self.arm is not None
        if self.gripper is None:
            problems.add("vessels are carried between places by a gripper; add 'gripper: {model: …}'", "places")
        balance = self.balance
        if balance is not None and (balance.typed or balance.placement != "receiver" or balance.pourer != "here"):
            problems.add("with places the balance stands under the receiver and is connected: 'placement: receiver'",
                "balance")  # fmt: skip
        check_places(problems, self.places, getattr(self.arm, "tool", None))
        if problems.valid("places", "arm", "cell"):
            arm = self.arm.in_laboratory(self.cell, 1.0).expected(virtual=self.mode == "virtual")
            owners = [number for number, place in enumerate(self.places) for _ in place.each]
            for number, text in arm_kind(arm).place_problems(all_places(self.places), {}):
                problems.add(text, "places", owners[number], more=True)

    def _check_without_arm(self, problems: Problems) -> None:
        for key in ("cell", "gripper", "places", "balance", "operator", "source", "spill_sensor"):
            if key in self.model_fields_set:
                meant = (
                    "; a simulated bench has 'bench: {balance: …, operator_time: …}'"
                    if key not in ("cell", "gripper", "places")
                    else ""
                )
                text = f"belongs to an arm, and there is none; add 'arm', or remove it{meant}"
                problems.add(text, key, of="arm")

    def _check_with_arm(self, problems: Problems) -> None:
        if self.balance is None:
            text = "an arm that pours needs a balance; add 'balance: {placement: tray, …}', or 'placement: manual'"
            problems.add(text, of="balance")
        if self.mode == "hardware":
            return
        if self.bench is None:
            text = (
                "a virtual arm needs the true parameters of its liquid: add 'bench: {liquid: {…}}', or 'mode: hardware'"
            )
            problems.add(text, of="bench")
            return
        bench, inner = self.bench, problems.within("bench")
        for key, other in (("balance", "the section 'balance'"), ("operator_time", "'time' in the section 'operator'")):
            if key in bench.model_fields_set:
                inner.add(f"is of a bench without wires; with an arm write it into {other}", key)
        if bench.pose_error.speed_factor != 1.0 or bench.pose_noise.speed_factor != 0.0:
            inner.add(
                "an arm over its wires moves as fast as it is told; its own lag is in what it reads back. Remove the "
                "key",
                "pose_error" if bench.pose_error.speed_factor != 1.0 else "pose_noise",
                "speed_factor",
            )
        if bench.time_scale < 1.0:
            inner.add("an arm takes its time: 1 or more, and at most some 50", "time_scale")
