"""Settings of a laboratory: the pool of simulators, and the bench if there is one. Plain values."""

from __future__ import annotations

from dataclasses import dataclass

from actors.bench.spec import VirtualBenchSpec


@dataclass(frozen=True)
class LaboratorySpec:
    """Where a campaign runs.

    Attributes:
        simulators: size of the pool; 0: one per core.
        bench: None where the laboratory can't pour.
        mode: 'virtual', the only one yet.
        in_process: everything in threads of one process, without Ray.
        object_store_mb: Ray's shared memory for results [MiB]; Ray takes no less than 80.
    """

    name: str
    simulators: int = 0
    bench: VirtualBenchSpec | None = None
    mode: str = "virtual"
    in_process: bool = False
    object_store_mb: int = 160
