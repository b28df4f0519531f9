"""Settings of a laboratory: the pool of simulators, the Ray cluster, and the bench if there is one. Plain values.

`LaboratorySpec` contains `RaySpec` and `VirtualBenchSpec`. Settings of arm and balance are in their own packages.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Annotated

from actors.arm.arm_settings import ArmSpec
from actors.balance.balance_settings import BalanceSpec
from actors.interfaces import OperatorSpec
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PoseError
from sim_engine.settings.model import NOT_IN_FINGERPRINT


@dataclass(frozen=True)
class VirtualBenchSpec:
    """The virtual bench: the ground truth hidden from calibration, and its time scale.

    Attributes:
        liquid: hidden θ of the 'real' liquid.
        pose_error: systematic error of grip and placement.
        pose_noise: standard deviation of the same, drawn for each pour.
        time_scale: bench seconds per wall-clock second; 0 skips all waits.
        operator_time: refilling, placing, wiping [s of bench time].
        balance_resolution, balance_noise, balance_drift: [kg], [kg], [kg/s]; settling_time [s].
    """

    liquid: SimulationParameters
    pose_error: PoseError = field(default_factory=PoseError)
    pose_noise: PoseError = field(default_factory=lambda: PoseError(speed_factor=0.0))
    time_scale: float = 30.0
    operator_time: float = 85.0
    balance_resolution: float = 1e-4
    balance_noise: float = 1e-4
    balance_drift: float = 0.0
    settling_time: float = 1.5


@dataclass(frozen=True)
class RaySpec:
    """A Ray cluster that is already running.

    Attributes:
        address: of its head, host:port.
        bench_resource: custom resource of the node on which arm, balance and bench run.
    """

    address: str
    bench_resource: str = "decant_bench"


@dataclass(frozen=True)
class LaboratorySpec:
    """Settings of the laboratory in which a campaign runs.

    Settings of the machine or the operator do not affect a campaign's results.

    Attributes:
        simulators: size of the pool; 0: one per core, of this machine or of the cluster.
        bench: ground truth of a virtual bench; None on hardware, and if the laboratory cannot pour.
        mode: 'virtual' or 'hardware'.
        in_process: everything in threads of one process, without Ray.
        object_store_mb: a private Ray's shared memory for results [MiB]; Ray needs at least 80.
        ray: the cluster to join; None for a private Ray on this machine.
        arm: of any kind, virtual or not; None for a simulated bench, or none.
        balance: of the bench with the arm; its time scale is the bench's.
        operator: of the bench with the arm.
        accepted_checksum: of the accepted safety settings of the hardware; '' if none are accepted. Filled in for a
            run, not part of a file.
    """

    name: str
    simulators: Annotated[int, NOT_IN_FINGERPRINT] = 0
    bench: VirtualBenchSpec | None = None
    mode: str = "virtual"
    in_process: Annotated[bool, NOT_IN_FINGERPRINT] = False
    object_store_mb: Annotated[int, NOT_IN_FINGERPRINT] = 160
    ray: Annotated[RaySpec | None, NOT_IN_FINGERPRINT] = None
    arm: ArmSpec | None = None
    balance: BalanceSpec | None = None
    operator: Annotated[OperatorSpec, NOT_IN_FINGERPRINT] = field(
        default_factory=lambda: OperatorSpec(answers="virtual")
    )
    accepted_checksum: Annotated[str, NOT_IN_FINGERPRINT] = ""

    @property
    def pours(self) -> bool:
        """Whether there is a bench."""
        return self.arm is not None or self.bench is not None


def simulator_count(spec: LaboratorySpec) -> int:
    """Size of the pool on this machine: as stated, or one per core."""
    return spec.simulators or os.cpu_count() or 1
