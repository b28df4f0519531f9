"""An objective: turn gently, so that nothing sloshes."""

from __future__ import annotations

from typing import Annotated, Literal

from decant.plugins import ACTION_DIMENSIONS, Action, Fractions, Objective, Quantity, Scene, Space


class Gentle(Objective):
    """Angular velocity / rough."""

    name: Literal["gentle"] = "gentle"
    """How fast the pourer turns."""

    rough: Annotated[float, Quantity("rad/s", "90 deg/s", 0.01, 10.0)] = 1.5707963267948966
    """An angular velocity that is as bad as spilling everything."""

    def cost(self, fractions: Fractions, action: Action, scene: Scene) -> float:
        """The angular velocity in units of a rough one."""
        return action.angular_velocity / self.rough

    def worst(self, scene: Scene, actions: Space) -> float:
        """That of the fastest action that may be asked for."""
        fastest = [axis.upper for axis in actions.axes if axis.name == "angular_velocity"]
        fixed = scene.fixed.get("angular_velocity") or ACTION_DIMENSIONS["angular_velocity"].upper
        return (fastest[0] if fastest else fixed) / self.rough
