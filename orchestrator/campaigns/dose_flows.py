"""One simulated dose out of each source of a campaign that is no straight cup, compared with the controller's equation.

`dose_flows` simulates each equal dose once: in a process of its own, and kept by its content in the cache directory.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from actors.dosing.flow_comparison import PARTICLES, RESOLVED, FlowComparison, compare_flows
from actors.dosing.simulated_dose import check_straight
from actors.interfaces import DoseKnowledge, InvalidActionError, LaboratoryError
from actors.simulators.live_worker import LivePourProcess
from orchestrator.learning.campaign_plan import CampaignPlan
from sim_engine.engine_package import engine_version
from sim_engine.liquids import SimulationParameters
from sim_engine.resources import load_arrays, store_arrays
from sim_engine.scene import Scene
from sim_engine.solver_fingerprint import ROOT, folder_digest
from sim_engine.vessel.mesh_shape import MeshShape

MISSED = 0.5
"""Share of a simulated dose next to the receiver from which on the stream counts as missing it."""


@dataclass(frozen=True)
class DoseFlow:
    """The flow of one source into one receiver.

    Attributes:
        scene: of the doses.
        amount: of the largest one [kg].
        tolerance: the smallest one [kg].
        comparison: with the controller's equation; None if it could not be simulated.
        problem: why it could not be simulated; '' if it was.
    """

    scene: Scene
    amount: float
    tolerance: float
    comparison: FlowComparison | None
    problem: str = ""

    @property
    def title(self) -> str:
        """Vessel and liquid."""
        return f"{self.scene.liquid.name} out of '{self.scene.pourer.name}'"

    def text(self) -> str:
        """The comparison in one line; '' without one."""
        found = self.comparison
        if found is None:
            return ""
        onset, factor = math.degrees(found.onset), found.factor
        return (
            f"{self.title}, simulated with {PARTICLES} particles: the flow begins {abs(onset):.1f}° "
            f"{'later' if onset >= 0.0 else 'earlier'} than by the controller's equation and is {factor:.2f} times its "
            f"flow; with these two, the equation follows the poured mass within {1e3 * found.left_over:.2g} g"
        )

    def warnings(self) -> list[str]:
        """What may spoil the doses."""
        found, texts = self.comparison, []
        if found is None:
            return [f"{self.title}: the flow could not be compared with a simulation: {self.problem}"]
        if found.differs(self.tolerance):
            resolved = max(self.tolerance, RESOLVED * found.grain)
            texts.append(
                f"{self.title}: the simulated flow differs by {1e3 * found.left_over:.2g} g from the equation of the "
                f"dose controller, whatever onset and factor it finds, more than {1e3 * resolved:.2g} g: doses may "
                "miss their tolerance; tilt another side, or pour out of a vessel with an even rim"
            )
        if found.spilled > max(self.tolerance, RESOLVED * found.grain) and self.misses() is None:
            texts.append(self._spilled(found))
        return texts

    def misses(self) -> str | None:
        """Why the stream cannot reach the receiver: most of it falls next to it; None if it does not."""
        found = self.comparison
        return self._spilled(found) if found is not None and found.spilled > MISSED * found.simulated[-1] else None

    def _spilled(self, found: FlowComparison) -> str:
        return (
            f"{self.title}: {1e3 * found.spilled:.2g} g of {1e3 * found.simulated[-1]:.3g} g in a simulated dose fall "
            f"next to '{self.scene.receiver.name}': change x_offset or height, or use a wider receiver"
        )


def is_straight(scene: Scene) -> bool:
    """Whether the pourer is a straight cup, whose flow needs no simulation."""
    with contextlib.suppress(InvalidActionError):
        check_straight(scene)
        return not isinstance(scene.pourer.shape, MeshShape)
    return False


def dose_flows(plan: CampaignPlan, doing: Callable[[str], None] = lambda text: None) -> list[DoseFlow]:
    """Compare the flows of a campaign's doses; one simulated before takes no time.

    Args:
        plan: whose doses have vessels that hold them.
        doing: called with a description of each step; a simulation takes some seconds.
    """
    flows: list[DoseFlow] = []
    series, theta = plan.dispense, plan.parameters
    if series is None:
        return flows
    for scene in series.scenes:
        doses = [
            d for d in series.doses if d.receiver == scene.receiver.name and scene.pourer.name in series.sources_of(d)
        ]
        if not doses or is_straight(scene):
            continue
        amount, tolerance = max(dose.amount for dose in doses), min(dose.limit for dose in doses)
        doing(f"simulating a dose of {1e3 * amount:.3g} g of {scene.liquid.name} out of '{scene.pourer.name}'")
        try:
            flows.append(
                DoseFlow(scene, amount, tolerance, _compared(dose_digest(scene, amount, theta), scene, amount, theta))
            )
        except (LaboratoryError, OSError) as error:
            flows.append(DoseFlow(scene, amount, tolerance, None, str(error)))
    return flows


def simulated_knowledge(plan: CampaignPlan) -> dict[str, DoseKnowledge]:
    """What the simulated doses say about the sources before their first dose, by name."""
    return {
        flow.scene.pourer.name: flow.comparison.knowledge() for flow in dose_flows(plan) if flow.comparison is not None
    }


def dose_digest(scene: Scene, *further: object) -> str:
    """Digest of all that a computed dose depends on.

    Args:
        scene: of the dose.
        further: what else it depends on; equal values have equal representations.
    """
    liquid = scene.liquid.model_dump_json(exclude={"name"})
    vessels = scene.pourer.content_hash(), scene.receiver.content_hash()
    code = folder_digest(ROOT / "sim_engine"), folder_digest(ROOT / "actors" / "dosing"), engine_version()
    others = repr((scene.pivot, sorted(scene.fixed.items()), *further))
    return hashlib.sha256("\n".join((*vessels, liquid, *code, others)).encode()).hexdigest()[:24]


_compared_before: dict[str, FlowComparison] = {}
_comparing = threading.Lock()
"""A stage and the forecast of it may need the same dose at the same time."""


def _compared(content: str, scene: Scene, amount: float, theta: SimulationParameters) -> FlowComparison:
    with _comparing:
        if content not in _compared_before:
            name = f"flow-{content}"
            stored = load_arrays(name)
            if stored is not None:
                values = {key: value if value.ndim else float(value) for key, value in stored.items()}
                _compared_before[content] = FlowComparison(**values)  # type: ignore[arg-type]
            else:
                pours = LivePourProcess()
                try:
                    _compared_before[content] = compare_flows(scene, amount, theta, pours)
                finally:
                    pours.close()
                store_arrays(name, {key: np.asarray(value) for key, value in asdict(_compared_before[content]).items()})
        return _compared_before[content]
