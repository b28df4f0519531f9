"""One simulated pour as a recording, for `decant simulate --rrd`."""

from __future__ import annotations

import time
from pathlib import Path

from orchestrator.monitor.recording import solid
from orchestrator.monitor.streams import Streams
from orchestrator.report import style
from sim_engine.simulated import SimulatedPour
from sim_engine.task import PourTask


def simulation_rrd(path: Path, task: PourTask, result: SimulatedPour) -> Path:
    """Write a recording of one simulated pour.

    Args:
        path: `.rrd` to write; replaced if it exists.
        task: what was simulated, with `record_rate` > 0.
        result: what came of it.

    Returns:
        `path`.

    Raises:
        ValueError: the result has no frames.
        OSError: the file can't be written.
    """
    if result.frames is None:
        raise ValueError("this simulation kept no frames to record; simulate it with a record rate above 0")
    scene, outcome = task.scene, result.outcome
    streams = Streams(path, name=f"{scene.pourer.name} into {scene.receiver.name}, seed {task.seed}")
    streams.at(wall=time.time(), pour=0)
    streams.film(
        result.frames,
        (scene.pourer, solid(scene.pourer)),
        (scene.receiver, solid(scene.receiver)),
        radius=0.5 * outcome.spacing,
    )
    streams.line(f"action: {style.display_values(task.action.values())}", source="action")
    streams.line(f"simulation parameters: {style.display_values(task.parameters.model_dump())}", source="parameters")
    streams.line(
        f"received {100 * outcome.received:.2f} %, spilled {100 * outcome.spilled:.2f} %, "
        f"retained {100 * outcome.retained:.2f} %, in flight {100 * outcome.in_flight:.2f} %",
        level="info" if outcome.invalid is None else "warning",
        source="outcome",
    )
    streams.close()
    return path
