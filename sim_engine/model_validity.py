"""Effects of a planned pour that the simulator does not cover, predicted from dimensionless numbers before it runs.

The numbers are those of `sim_engine.lip_flow`. A warning is given if more than 5 % of the poured liquid leaves under
such conditions, since every pour begins and ends with a trickle. `regimes` returns a `ModelValidity` with a list of
`NotCovered`.

Sources:
    - Duez, Ybert, Clanet & Bocquet, Wetting controls separation of inertial flows from solid surfaces, PRL 104, 084503
      (2010), and Bouwhuis & Snoeijer, The effect of surface wettability on inertial pouring flows (2015): a critical
      Weber number, which grows with wetting and with the roundness of the edge.
    - Kistler & Scriven, The teapot effect, J. Fluid Mech. 263 (1994): wetting and its hysteresis.
    - Taylor, Proc. R. Soc. A 253 (1959): speed at which the edge of a sheet recedes.
    - de Gennes, Brochard-Wyart & Quéré, Capillarity and Wetting Phenomena (2004), chapter 2: capillary length, puddles.
    - Bretherton, J. Fluid Mech. 10 (1961): bubbles that do not rise in narrow tubes.
    - Clanet & Searby, On the glug-glug of ideal bottles, J. Fluid Mech. 510 (2004).

Limitations: those of `sim_engine.lip_flow`. The limits are orders of magnitude; the absence of a warning guarantees
nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from sim_engine.action import Action
from sim_engine.lip_flow import EDGE, FlowCourse, FlowNumbers, bond, capillary_length, flow_course, reynolds, weber
from sim_engine.liquids import Liquid
from sim_engine.motion import Motion, plan_motion
from sim_engine.scene import Scene
from sim_engine.vessel.vessel import Vessel

DRIBBLING_WEBER = 2.0
"""Weber number of the film at the lip below which liquid dribbles. Surface tension, which pulls a free sheet's edge
back with 2σ, then exceeds the momentum flux ρU²e that carries it away (Taylor 1959). A wetted wall at a right angle to
the film holds it with up to the same force, σ (1 + cos of the contact angle). Over round, well wetted edges liquid
already dribbles at several times this value."""

WETTING_BOND = 1.0
"""Bond number of the film at the lip below which it is thinner than the capillary length √(σ/ρg). Liquid that does not
wet its lip rises up to twice that length above it before it leaves; liquid that does creeps over it."""

VISCOUS_REYNOLDS = 100.0
"""Reynolds number of the film at the lip below which viscosity matters. A boundary layer of 5√(νl/U) fills the film
within the length l ≈ 3e in which it accelerates at about Re = 75; above, the time is too short for viscosity to act.
For liquids as thin as water only; for others viscosity is simulated within the bounds of CREEPING and ADDED."""

CREEPING = 2.0
"""Largest viscosity that was compared with theory [Pa s] (`benchmarks.validation film`)."""

ADDED = 3.0
"""Viscosity is simulated above the kinematic viscosity ADDED · d² [m²/s] that the solver adds at a spacing d: vortices
of 10 mm²/s decay as those of 110, 84, 50 and 49 mm²/s at spacings of 6.9, 5.8, 4.6 and 2.9 mm (0.2 m/s;
`benchmarks.validation.viscous_flows.own_viscosity`)."""

LEAST_ADDED = 40e-6
"""Least kinematic viscosity that the solver is assumed to add [m²/s]."""

PARTICLES_ACROSS = 2.0
"""Particles across the falling stream: with fewer, no particle has neighbours all around it, and the stream is a
string.
"""

AIRTIGHT_BOND = 0.842
"""Bond number of the opening below which air does not rise into it while it is full of liquid (Bretherton 1961)."""


@dataclass(frozen=True)
class NotCovered:
    """An effect that influences where the liquid goes and that the simulator does not model.

    Attributes:
        kind: 'dribbling', 'wetting', 'viscous', 'thin_stream', 'glugging' or 'airtight'.
        share: fraction of the poured liquid that leaves under such conditions.
        text: description and remedy, for the user.
    """

    kind: str
    share: float
    text: str

    def as_json(self) -> dict[str, Any]:
        """JSON-ready mapping."""
        return {"kind": self.kind, "share": self.share, "text": self.text}


@dataclass(frozen=True)
class ModelValidity:
    """Flow of a planned pour, and its effects outside the model.

    Attributes:
        poured: fraction of the load that leaves, by the tilting-cup equation.
        lip, stream: None if nothing leaves.
        not_covered: effects of this pour that the simulator does not cover.
    """

    poured: float
    lip: FlowNumbers | None = None
    stream: FlowNumbers | None = None
    not_covered: tuple[NotCovered, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """JSON-ready mapping."""
        return {
            "poured": self.poured,
            "lip": None if self.lip is None else self.lip.as_json(),
            "stream": None if self.stream is None else self.stream.as_json(),
            "not_covered": [regime.as_json() for regime in self.not_covered],
        }


def regimes(
    scene: Scene,
    action: Action,
    pourer: Vessel,
    receiver: Vessel,
    *,
    spacing: float,
    adhesion: float = 0.0,
    motion: Motion | None = None,
) -> ModelValidity:
    """Analyse a planned pour without simulating it.

    Args:
        scene: its liquid, pivot and fixed values.
        action: complete action.
        pourer, receiver: geometry of the scene's vessels.
        spacing: of the particles in the pour's simulation [m].
        adhesion: its `lip_adhesion`; above 0, dribbling is simulated.
        motion: to use instead of the planned one.

    Raises:
        ValueError: the pourer cannot hold the load.
    """
    motion = plan_motion(scene, action, pourer, receiver) if motion is None else motion
    liquid = scene.liquid
    course = flow_course(motion, liquid, pourer, receiver)
    if course is None:
        return ModelValidity(0.0)
    regimes_of_pour = [
        *([_dribbling(course, liquid)] if adhesion == 0.0 else []),
        _wetting(course, liquid),
        _viscous(course, liquid, spacing),
        _thin_stream(course, liquid, spacing),
        _without_air(course, liquid, pourer),
    ]
    return ModelValidity(
        float(course.volume.sum()) / liquid.volume,
        course.lip_numbers(liquid),
        course.stream_numbers(liquid),
        tuple(regime for regime in regimes_of_pour if regime.share > EDGE),
    )


def _dribbling(course: FlowCourse, liquid: Liquid) -> NotCovered:
    share = course.share(weber(liquid, course.velocity, course.film) < DRIBBLING_WEBER)
    return NotCovered(
        "dribbling",
        share,
        f"{_percent(share)} of what is poured leaves the lip at a Weber number below {DRIBBLING_WEBER:g} and may run "
        "down the outside of the wall, which is not simulated. More may be spilled than predicted; tilt faster or "
        "farther, or set the parameter lip_adhesion (1 for a sharp rim)",
    )


def _wetting(course: FlowCourse, liquid: Liquid) -> NotCovered:
    share = course.share(bond(liquid, course.film) < WETTING_BOND)
    return NotCovered(
        "wetting",
        share,
        f"{_percent(share)} of what is poured leaves in a film thinner than the capillary length "
        f"({1e3 * capillary_length(liquid):.1f} mm; Bond number below {WETTING_BOND:g}). How the liquid wets the lip "
        "decides when such a film starts and stops to flow; contact angles are right for finer particles only",
    )


def _viscous(course: FlowCourse, liquid: Liquid, spacing: float) -> NotCovered:
    if liquid.is_thick:
        stiff, limit = liquid.dynamic_viscosity > CREEPING, f"was compared with theory up to {CREEPING:g} Pa*s"
        added = max(ADDED * spacing**2, LEAST_ADDED)
        if not stiff:
            limit = (
                f"adds about {1e6 * added:.0f} mm^2/s at this number of particles, so that a liquid below that pours "
                "later than it should; use more particles, or calibrate viscosity_factor on pours of this liquid"
            )
        amount = f"{liquid.dynamic_viscosity:.3g} Pa*s ({1e6 * liquid.kinematic_viscosity:.3g} mm^2/s)"
        share = float(stiff or liquid.kinematic_viscosity < added)
        return NotCovered("viscous", share, f"the viscosity is {amount}; the simulator {limit}")
    share = course.share(reynolds(liquid, course.velocity, course.film) < VISCOUS_REYNOLDS)
    return NotCovered(
        "viscous",
        share,
        f"{_percent(share)} of what is poured leaves the lip at a Reynolds number below {VISCOUS_REYNOLDS:g}: the "
        f"liquid's viscosity ({1e3 * liquid.dynamic_viscosity:.3g} mPa*s) holds it back. Of a liquid this thin it is "
        "not simulated; calibrate on pours of this very liquid",
    )


def _thin_stream(course: FlowCourse, liquid: Liquid, spacing: float) -> NotCovered:
    """Uses the median, because every pour begins and ends with a thin stream."""
    median = course.quantile(course.diameter, 0.5)
    share = course.share(course.diameter < PARTICLES_ACROSS * spacing) if median < PARTICLES_ACROSS * spacing else 0.0
    enough = liquid.volume * (PARTICLES_ACROSS / median) ** 3
    return NotCovered(
        "thin_stream",
        share,
        f"{_percent(share)} of what is poured falls in a stream of fewer than {PARTICLES_ACROSS:g} particles across "
        f"({median / spacing:.1f} in the median, {1e3 * spacing:.1f} mm each, at the receiver's rim). Where it lands "
        f"is approximate; {_rounded_up(enough)} particles would resolve half of it",
    )


def _without_air(course: FlowCourse, liquid: Liquid, pourer: Vessel) -> NotCovered:
    radius = pourer.opening_radius
    if float(bond(liquid, radius)) < AIRTIGHT_BOND:
        return NotCovered(
            "airtight",
            1.0,
            f"the opening is {2e3 * radius:.1f} mm wide: so narrow that no air gets in past the liquid that fills it. "
            "In truth hardly anything leaves; the simulator knows no air, and pours",
        )
    share = course.share(course.covered)
    return NotCovered(
        "glugging",
        share,
        f"{_percent(share)} of what is poured leaves while liquid covers the whole opening and air has to bubble in "
        "against it. The simulator knows no air: in truth it leaves later and by fits and starts. Tilt less or more "
        "slowly",
    )


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _rounded_up(number: float) -> str:
    """Rounded up to two digits, with a space between thousands: '3 500'."""
    digits = 10 ** max(math.floor(math.log10(number)) - 1, 0)
    return f"{math.ceil(number / digits) * digits:,}".replace(",", " ")
