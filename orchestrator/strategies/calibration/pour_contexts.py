"""Coordinates of a calibration pour for a surrogate: its action and its receiver.

`Contexts` converts pours, actions and scenes to points of a common space and back. It makes no prediction.
"""

from __future__ import annotations

from collections.abc import Sequence

from actors.optimizer.questions import Point
from orchestrator.strategies.calibration.action_prior import actions_of_prior
from orchestrator.strategies.campaign_plan import CalibrationPlan, MeasuredPour
from sim_engine.action import Action
from sim_engine.scene import Scene
from sim_engine.search_space import Axis, Space


class Contexts:
    """Maps actions and scenes to the inputs of a surrogate: the actions' unit cube, extended by scene coordinates.

    A single scene needs no coordinate. Two scenes are the ends of one additional axis. With three or more, each scene
    has its own axis, which is 1 for this scene and 0 for the others. The fitted lengthscales of these axes determine
    how much data from one receiver contributes to predictions for another.
    """

    def __init__(self, actions: Space, scenes: Sequence[Scene]) -> None:
        self._actions, self._scenes = actions, tuple(scenes)
        self._names = {scene.name: i for i, scene in enumerate(self._scenes)}
        count = len(self._scenes)
        extra = 0 if count == 1 else 1 if count == 2 else count
        self._marks = [
            tuple(float(i) for _ in range(extra)) if count == 2 else tuple(float(i == j) for j in range(extra))
            for i in range(count)
        ]
        self.space = Space((*actions.axes, *(Axis(f"scene{j + 1}", 0.0, 1.0) for j in range(extra))))

    @classmethod
    def of(cls, plan: CalibrationPlan) -> Contexts:
        """The contexts of a calibration."""
        return cls(plan.actions, plan.scenes)

    def knows(self, pour: MeasuredPour) -> bool:
        """Whether a pour was made in one of the scenes."""
        return not pour.scene or pour.scene in self._names

    def point(self, pour: MeasuredPour) -> Point:
        """Point of a weighed pour.

        Raises:
            ValueError: a searched dimension is switched off in the pour.
        """
        return self.at(self._encoded(pour.action), self._names.get(pour.scene, 0))

    def place(self, scene: Scene, action: Action) -> Point:
        """Point of an action in one of the scenes; raises as `point`."""
        return self.at(self._encoded(action), self._names[scene.name])

    def _encoded(self, action: Action) -> Point:
        values = {name: _number(action, name) for name in self._actions.names}
        return tuple(map(float, self._actions.encode(values)))

    def at(self, action: Point, scene: int) -> Point:
        """Point of an action of the unit cube in the scene with this index."""
        return (*action, *self._marks[scene])

    def request(self, point: Point) -> tuple[Scene, Action]:
        """Scene and action of a point."""
        dimension = self._actions.dimension
        scene = self._scenes[self._marks.index(tuple(point[dimension:]))]
        return scene, scene.action(self._actions.decode(point[:dimension]))

    def sequence(self, plan: CalibrationPlan, count: int, seed: int) -> tuple[Point, ...]:
        """Actions of the prior g along an even sequence, alternating between the scenes."""
        actions = actions_of_prior(plan.actions, count, seed, plan.constraints, plan.prior)
        return tuple(self.at(action, i % len(self._scenes)) for i, action in enumerate(actions))


def _number(action: Action, name: str) -> float:
    value = getattr(action, name)
    if value is None:
        raise ValueError(f"{name} is searched, but switched off in a measured pour")
    return float(value)
