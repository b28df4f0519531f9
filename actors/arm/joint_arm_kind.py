"""What the kinds of all arms with joints have in common: `JointArmKind`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from actors.arm.arm_interface import ArmFigure, FloatArray, PlannedPour
from actors.arm.arm_settings import ArmKind
from actors.arm.joint_arm import JointArmSettings
from actors.arm.planned_pour import PlaceWay, PourPath
from actors.arm_geometry import Point, RobotCell
from actors.places import PlaceSettings
from sim_engine.action import Action
from sim_engine.scene import SampledMotion, Scene
from sim_engine.settings.model import Problems
from sim_engine.vessel.vessel import Vessel

S = TypeVar("S", bound=JointArmSettings)


class JointArmKind(ArmKind[S]):
    """An arm with joints: plans, checks and draws every path from its kinematics (`JointArmSettings.kinematics`)."""

    carries = True

    def check_laboratory(self, problems: Problems, *, mode: str, cell: RobotCell | None) -> None:
        """See `ArmKind.check_laboratory`."""
        if cell is None:
            if problems.valid("cell"):
                problems.add(
                    "an arm needs to know what stands where; add 'cell: {receiver: …, direction: …}' beside it", "arm"
                )
        elif problems.valid("arm", "cell"):
            from actors.arm.planning.path_checks import check_limits

            for problem in check_limits(self.spec.with_values(cell=cell)):
                key, _, text = problem.partition(": ")
                owner = problems if key.startswith("cell.") else problems.within("arm")
                owner.add(text, *key.split("."), more=True)

    def plan(self, scene: Scene, action: Action) -> PourPath:
        """See `ArmKind.plan`."""
        from actors.arm.planning.pour_planner import plan_path
        from actors.arm.pour_feasibility import plan_pour, vessel

        return plan_path(plan_pour(scene, action), self.spec, vessel(scene.pourer), vessel(scene.receiver))

    def place_problems(
        self, places: Sequence[PlaceSettings], vessels: Mapping[str, Vessel], opened: Mapping[str, float] = {}
    ) -> Iterable[tuple[int, str]]:
        """See `ArmKind.place_problems`."""
        from actors.arm.planning.place_ways import place_problems

        return place_problems(places, self.spec, vessels, opened)

    def way(
        self,
        place: PlaceSettings,
        places: Sequence[PlaceSettings],
        vessels: Mapping[str, Vessel],
        volume: float | None = None,
    ) -> PlaceWay:
        """See `ArmKind.way`."""
        from actors.arm.planning.place_ways import way_to

        return way_to(place, places, self.spec, vessels, volume)

    def pouring_at(self, place: PlaceSettings) -> S:
        """See `ArmKind.pouring_at`."""
        from actors.arm.planning.place_ways import vessel_at

        x, y, z = map(float, vessel_at(place, self.spec).position)
        foot = Point(x=x, y=y, z=z)
        return self.spec.with_values(cell=self.spec.cell.with_values(receiver=foot))

    def in_the_way(
        self, path: PlannedPour, pourer: Vessel, places: Sequence[PlaceSettings], vessels: Mapping[str, Vessel]
    ) -> list[str]:
        """See `ArmKind.in_the_way`."""
        from actors.arm.planning.place_ways import in_the_way

        assert isinstance(path, PourPath)
        return in_the_way(path, pourer, places, self.spec, vessels)

    def figure(self) -> ArmFigure:
        """See `ArmKind.figure`."""
        from actors.arm.appearance import LinkFigure

        return LinkFigure(self.spec)

    def pourer_motion(self, joints: FloatArray, times: FloatArray, *, grip_tilt: float = 0.0) -> SampledMotion:
        """See `ArmKind.pourer_motion`; the grip turns about the tool centre point."""
        from actors.arm.planning.kinematics import pourer_motion

        return pourer_motion(joints, times, self.spec, grip_tilt=grip_tilt)

    def workspace(self) -> FloatArray:
        """See `ArmKind.workspace`."""
        from actors.arm.planning.kinematics import cell_transforms

        return cell_transforms(self.spec).world.inverse.apply(np.array(self.spec.limits.box.corners))
