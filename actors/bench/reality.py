"""The virtual bench's reality: what truly becomes of the liquid when its controller moves the pourer as it did.

Nothing of it is known to those who learn but what the balance shows. What the controller executed counts, and neither
what was planned nor what the driver read back: a motion that was broken off leaves liquid in the pourer, or lets it run
on while the pourer stands tilted.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from actors.arm.joint_path import FloatArray, PourPath
from actors.arm.path.frames import pourer_motion
from actors.arm.spec import UrArmSpec
from actors.bench.place import Site
from actors.bench.site import History
from actors.bench.spec import VirtualBenchSpec
from actors.bench.virtual_operator import Hands
from actors.bench.world import ATTEMPTS, draw_pose_error, spill_of, stream
from actors.protocols import InvalidActionError, LaboratoryError, SimulatorPool
from sim_engine.action import Action
from sim_engine.sampled_motion import SampledMotion
from sim_engine.task import PoseError, PourTask, Scene

AT_START = 2e-3
"""How near the pour's first pose the arm stands when it begins [rad]."""

AT_REST = 1e-6
"""Joints that change by less from sample to sample stand still [rad]."""

UPRIGHT = math.radians(0.5)
"""Below this tilt [rad] a pourer is upright; ways to and from a pour keep it so."""

LONGEST_REST = 6.0
"""Rest in the middle of a motion is simulated for so long [s]: what runs out meanwhile has run out by then."""


NOTING_INTERVAL = 40.0
"""Between two looks at what the controller did [s of its time]; it remembers two minutes."""

LONGEST_GAP = 0.1
"""Between two samples of a history without a gap [s of controller time]; it is sampled at 125 Hz."""


@dataclass(frozen=True)
class PourAsk:
    """The pour that is under way; `seed` is that of all its chance."""

    scene: Scene
    action: Action
    path: PourPath
    seed: int


class Reality:
    """Of one virtual bench.

    Args:
        spec: what is hidden.
        arm: the cell as everybody believes it to be.
        site: controller and balance.
        hands: that fill the pourer, and know what stands where.
        simulators: a pool of its own for the hidden liquid.
    """

    def __init__(
        self,
        spec: VirtualBenchSpec,
        arm: UrArmSpec,
        site: Site,
        hands: Hands,
        simulators: SimulatorPool,
    ) -> None:
        self._spec, self._arm, self._simulators = spec, arm, simulators
        self.site, self.things, self._hands = site, hands.things, hands
        self._noting = asyncio.Lock()
        self._pour: PourAsk | None = None
        self._times: list[float] = []
        self._joints: list[tuple[float, ...]] = []
        self._since = self._earlier = 0.0
        self._settled = False
        self._gap = ""

    async def prepare(self, pour: PourAsk) -> None:
        """A pour is about to be prepared by the operator."""
        self._pour = pour
        self._hands.prepare(pour.scene.liquid.mass, stream(pour.seed, "arm"))
        await self.site.prepare(stream(pour.seed, "balance"))
        await self.site.put(self.things.carried)

    async def begin(self) -> None:
        """The arm is about to leave home."""
        self._times, self._joints, self._settled, self._gap = [], [], False, ""
        self._earlier, self._since = 0.0, (await self.site.history(math.inf)).now

    async def note(self) -> None:
        """Take down what the arm did since.

        The controller remembers two minutes of its time: whoever comes later, because its process was held up, misses
        part of the motion. That is kept in mind, and `settle` then doesn't say what became of the liquid.
        """
        async with self._noting:
            history = await self.site.history(self._since)
            if history.now < self._since:  # the controller was switched off, and its clock begins anew
                self._gap = self._gap or "the controller was switched off, and forgot what its arm had done before"
                self._earlier += self._since
                self._since = 0.0
                history = await self.site.history(0.0)
            if (missed := _missed(history, self._since)) > LONGEST_GAP:
                self._gap = self._gap or f"{missed:.0f} s of its arm's motion are forgotten by the controller"
            self._take(history)

    async def follow(self) -> None:
        """Note again and again, for as long as the arm is away from home; ends by being cancelled."""
        while True:
            await asyncio.sleep(NOTING_INTERVAL / self._arm.time_scale)
            with contextlib.suppress(LaboratoryError):  # what matters is noted once more at the end
                await self.note()

    def _take(self, history: History) -> None:
        last = self._times[-1] if self._times else -math.inf
        for t, q in zip(history.times, history.joints, strict=True):
            if t <= history.now and t + self._earlier > last:
                self._times.append(t + self._earlier)
                self._joints.append(q)
                self._since = t

    async def settle(self) -> None:
        """Let the liquid follow what the arm did, once, and have the balance carry what became of it.

        Raises:
            LaboratoryError: with the errors of this pour's placement the vessels would touch, the liquid could not be
                simulated, or part of the motion is not known: then nobody can say what became of the liquid.
        """
        assert self._pour is not None
        if self._gap:
            raise LaboratoryError(
                f"the virtual bench can't tell what became of the liquid: {self._gap}, because a process of the bench "
                "was stopped or starved meanwhile"
            )
        if self._settled:
            return
        self._settled = True
        error = draw_pose_error(self._spec, self._pour.seed)
        motion = self._motion(error.tilt)
        if motion is not None:
            spilled, retained = await self._simulate(self._pour, motion, error)
            self.things.receive(spilled, retained)
        self._times, self._joints = [], []
        await self.site.put(self.things.carried)

    def _motion(self, grip_tilt: float) -> SampledMotion | None:
        """What the pourer truly did, from the pour's first pose on; None if it never left it."""
        assert self._pour is not None
        if len(self._times) < 2:
            return None
        cut = executed_pour(np.array(self._times), np.array(self._joints), self._pour.path.pour.joints[0])
        if cut is None:
            return None
        times, joints = cut
        tilted = np.flatnonzero(pourer_motion(joints, times, self._arm).tilt(times) > UPRIGHT)
        if len(tilted) == 0:
            return None
        end = min(int(tilted[-1]) + 2, len(times))  # what follows is the way home
        return pourer_motion(joints[:end], times[:end], self._arm, grip_tilt=grip_tilt)

    async def _simulate(self, pour: PourAsk, motion: SampledMotion, error: PoseError) -> tuple[float, float]:
        """Masses spilled and retained [kg]; same motion, same seed, same masses."""
        mass, reason = self.things.in_pourer, None
        scene = replace(pour.scene, liquid=pour.scene.liquid.model_copy(update={"mass": mass}))
        shift = PoseError(x=error.x, y=error.y)
        for seed in np.random.default_rng(stream(pour.seed, "liquid")).integers(0, 2**31, ATTEMPTS):
            task = PourTask(scene, pour.action, self._spec.liquid, int(seed), pose_error=shift, motion=motion)
            try:
                outcome = (await self._simulators.simulate(task)).outcome
            except InvalidActionError as touching:
                raise LaboratoryError(f"the vessels as they truly stand: {touching}") from touching
            if outcome.invalid is None:
                spill = spill_of(outcome, mass)
                return spill.spilled, spill.retained
            reason = outcome.invalid
        raise LaboratoryError(f"the virtual bench's liquid could not be simulated: {reason}")


def _missed(history: History, since: float) -> float:
    """How long nothing is known of the motion, from a time on that was asked for until what was kept of it [s]."""
    return max((history.times[0] if history.times else history.now) - since, 0.0)


def executed_pour(times: FloatArray, joints: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """The part of a history that is the pour: from the first movement away from its first pose to the last movement.

    The clock plays no part in where it begins or ends, and long rests are shortened, so that the same motion is cut the
    same however long anybody took over it.

    Args:
        times: shape (T,), increasing [s].
        joints: shape (T, 6) [rad].
        start: the pour's first joints, shape (6,) [rad].

    Returns:
        Times from 0, and joints; None if nothing moved after the arm had stood there.
    """
    away = np.max(np.abs(joints - start), axis=1) >= AT_START
    moves = np.max(np.abs(np.diff(joints, axis=0)), axis=1) > AT_REST
    rests = np.flatnonzero(~away[:-1] & ~moves)
    if len(rests) == 0:
        return None
    first = int(rests[0])
    left = np.flatnonzero(away[first:])
    if len(left) == 0:
        return None
    begin = first + int(left[0])
    while begin > first and moves[begin - 1]:
        begin -= 1
    end = begin + int(np.flatnonzero(moves[begin:])[-1]) + 1
    return _without_long_rests(np.diff(times[begin : end + 1]), moves[begin:end], joints[begin : end + 1])


def _without_long_rests(
    gaps: FloatArray, moved: NDArray[np.bool_], joints: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Times from 0; of a rest only its beginning is kept."""
    kept, now, rest = [(0.0, 0)], 0.0, 0.0
    for i, (gap, moves) in enumerate(zip(gaps, moved, strict=True), start=1):
        allowed = float(gap) if moves else min(float(gap), LONGEST_REST - rest)
        rest = 0.0 if moves else rest + allowed
        if allowed > 0.0:
            now += allowed
            kept.append((now, i))
    return np.array([t for t, _ in kept]), joints[[i for _, i in kept]]
