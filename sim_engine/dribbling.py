"""Liquid that runs down the outside of the pourer (dribbling, the teapot effect): a model of the lip below the spacing.

A film that dribbles is one to three millimetres thick, thinner than a particle, so particles always leave the lip as a
jet. This model decides for each particle that has left whether the film to which it belongs would have left the wall:

* **Onset.** Adhesion holds a film at a wall with up to the work of adhesion σ (1 + cos θ) per width (Young-Dupré; θ is
  the contact angle), against its momentum flux ρU²e. Below the Weber number

      We_c = κ (1 + cos θ),    We = ρU²e/σ,

  it stays at the wall. κ is the parameter `lip_adhesion`: 1 for a sharp edge at a right angle, more for round edges, 0
  for none. U and e are those of the film at the lip, from the tilting-cup equation (`sim_engine.lip_flow`). The order
  in which particles leave matches them with this flow.
* **Path.** The liquid follows the outer wall downwards in the pouring direction and drips vertically off the lowest
  point that it reaches. If that is less than a capillary length below the lip, it drips off the lip, and the simulated
  jet stands for it: beyond a tilt of 90° a straight cup does not dribble.
* **Place.** Drops that fall into the receiver's opening are received, all others are spilled.

`dribbling_course` returns the decision over a pour, `DribblingCourse.select` applies it to particles, and
`rivulet_frames` shows it in recorded frames.

Sources:
    - Kistler & Scriven, The teapot effect, J. Fluid Mech. 263 (1994).
    - Duez, Ybert, Clanet & Bocquet, PRL 104, 084503 (2010): a critical Weber number, which grows with wetting and with
      the radius of the edge; liquids that do not wet (θ = 180°) do not dribble.
    - Bouwhuis & Snoeijer, The effect of surface wettability on inertial pouring flows (2015): below the critical Weber
      number no steady jet exists, by momentum balance with capillary forces.
    - de Gennes, Brochard-Wyart & Quéré, Capillarity and Wetting Phenomena (2004): work of adhesion.

Limitations: orders of magnitude, since κ depends on the edge; calibrate it. No hysteresis: a wet wall, which holds a
stream for longer, counts as a dry one. A film either stays at the wall or leaves it; none is divided. Drops that hit
the receiver's outer wall are spilled; no liquid stays on the outer wall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from sim_engine.hydrostatics import GRAVITY
from sim_engine.lip_flow import capillary_length, flow_course, weber
from sim_engine.liquids import Liquid
from sim_engine.motion import Motion
from sim_engine.outcome import ParticleState
from sim_engine.vessel.vessel import Vessel

Floats = NDArray[np.float64]

STEP = 0.5e-3
"""Distance of the points of an outer wall [m]."""

BRIDGED = 1e-3
"""Rise of the wall that running liquid crosses [m]: grooves, and the grid's roughness."""


@dataclass(frozen=True)
class DribblingCourse:
    """What dribbles of a planned pour, in the order in which the liquid leaves; arrays (K,).

    Attributes:
        until: fraction of the poured liquid that has left at the end of a step, increasing to 1.
        dribbles: whether the liquid of a step runs down the wall.
        received: whether it drips into the receiver.
        speed: of the film at the lip [m/s].
        length: path along the wall to the point where it drips [m].
        wall: outer wall in the pouring direction from the lip downwards, shape (M, 2): x and z in the pourer's frame
            [m].
    """

    until: Floats
    dribbles: NDArray[np.bool_]
    received: NDArray[np.bool_]
    speed: Floats
    length: Floats
    wall: Floats

    @property
    def share(self) -> float:
        """Fraction of the poured liquid that dribbles."""
        return float(np.diff(self.until, prepend=0.0)[self.dribbles].sum())

    def select(self, states: NDArray[np.uint8]) -> Dribbled:
        """Find the particles that dribble.

        Args:
            states: `ParticleState` of each particle at increasing times, shape (T, N). The first to leave are those
                that the tilting-cup equation lets leave first.
        """
        outside = states != ParticleState.IN_POURER
        stayed = np.argmax(~outside[::-1], axis=0)  # times since the particle was in the pourer last
        left = np.where(outside.all(axis=0), 0, len(states) - stayed)
        leaving = np.flatnonzero(outside[-1] & (states[-1] != ParticleState.ESCAPED))
        order = leaving[np.argsort(left[leaving], kind="stable")]
        step = np.searchsorted(self.until, (np.arange(len(order)) + 0.5) / max(len(order), 1))
        step = np.minimum(step, len(self.until) - 1)
        chosen = self.dribbles[step]
        return Dribbled(order[chosen], left[order[chosen]], step[chosen], self.received[step[chosen]])


@dataclass(frozen=True)
class Dribbled:
    """Particles that dribble; arrays (D,).

    Attributes:
        particles: indices.
        left: index of the first time at which they are outside the pourer for good.
        step: step of the course.
        received: whether they drip into the receiver.
    """

    particles: NDArray[np.int64]
    left: NDArray[np.int64]
    step: NDArray[np.int64]
    received: NDArray[np.bool_]

    def placed(self, states: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """States (T, N) with the particles' final places: they land when the simulated jet would."""
        placed = states.copy()
        theirs = placed[:, self.particles]
        landed = (theirs == ParticleState.RECEIVED) | (theirs == ParticleState.SPILLED)
        final = np.where(self.received, ParticleState.RECEIVED, ParticleState.SPILLED).astype(np.uint8)
        placed[:, self.particles] = np.where(landed, final, theirs)
        return placed


def dribbling_course(
    motion: Motion,
    liquid: Liquid,
    pourer: Vessel,
    receiver: Vessel,
    *,
    adhesion: float,
    receiver_at: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> DribblingCourse | None:
    """Decide when a pour dribbles, and where it drips.

    Args:
        motion: of the pourer.
        liquid: initial content of the pourer.
        pourer, receiver: vessels.
        adhesion: κ, the parameter `lip_adhesion`.
        receiver_at: displacement of the receiver from its place [m].

    Returns:
        None if nothing leaves.

    Raises:
        ValueError: the pourer cannot hold the liquid.
    """
    course = flow_course(motion, liquid, pourer, receiver)
    if course is None:
        return None
    wall = outer_wall(pourer)
    tilts, poses = motion.tilt(course.time), motion.sample(course.time)
    x, z = _turned(wall, tilts[:, None], poses[:, None])
    lowest, rows = _drip_points(z), np.arange(len(z))
    below_critical = weber(liquid, course.velocity, course.film) < critical_weber(adhesion, liquid.contact_angle)
    runs_down = z[:, 0] - z[rows, lowest] > capillary_length(liquid)
    inside = np.hypot(x[rows, lowest] - receiver_at[0], receiver_at[1]) < receiver.opening_radius
    return DribblingCourse(
        until=np.cumsum(course.volume) / course.volume.sum(),
        dribbles=below_critical & runs_down,
        received=inside & (z[rows, lowest] > receiver.rim_height + receiver_at[2]),
        speed=course.velocity,
        length=_along(wall)[lowest],
        wall=wall,
    )


def critical_weber(adhesion: float, contact_angle: float) -> float:
    """Weber number We_c = κ (1 + cos θ) of the film at the lip below which it stays at the wall.

    Args:
        adhesion: κ.
        contact_angle: θ [rad].
    """
    return adhesion * (1.0 + math.cos(contact_angle))


_walls: WeakKeyDictionary[Vessel, Floats] = WeakKeyDictionary()


def outer_wall(vessel: Vessel) -> Floats:
    """The vessel's outer wall in the pouring direction, from the height of the lip down, and its underside to the axis.

    Returns:
        Shape (M, 2): x and z in the vessel's frame, about `STEP` apart [m].
    """
    if vessel not in _walls:
        lip = vessel.lip_point(0.0)
        heights = np.arange(lip[2] - 0.5 * STEP, 0.5 * STEP, -STEP)
        across = np.arange(0.0, vessel.outer_radius + 2.0 * STEP, 0.5 * STEP)[::-1]
        z, x = np.meshgrid(heights, across, indexing="ij")
        points = np.stack([x, np.zeros_like(x), z], axis=-1).reshape(-1, 3)
        solid = vessel.grid.sample(points).reshape(z.shape) < 0.0
        side = np.column_stack([across[np.argmax(solid, axis=1)], heights])[solid.any(axis=1)]
        if not len(side):  # walls thinner than the grid resolves
            side = np.column_stack([np.full(len(heights), vessel.outer_radius), heights])
        below = np.arange(side[-1, 0], 0.0, -STEP)
        _walls[vessel] = np.concatenate([side, np.column_stack([below, np.zeros(len(below))])])
    return _walls[vessel]


def _turned(wall: Floats, tilts: Floats, poses: Floats) -> tuple[Floats, Floats]:
    """World x and z of points (…, 2) of a wall at tilts (…) and poses (…, 7), broadcast against each other [m]."""
    cosine, sine = np.cos(tilts), np.sin(tilts)
    x = poses[..., 0] + wall[..., 0] * cosine + wall[..., 1] * sine
    return x, poses[..., 2] - wall[..., 0] * sine + wall[..., 1] * cosine


def _drip_points(heights: Floats) -> NDArray[np.int64]:
    """Indices (K,) of the lowest points that liquid reaches downhill along a wall of heights (K, M)."""
    lowest = np.minimum.accumulate(heights, axis=1)
    reached = np.logical_and.accumulate(heights <= lowest + BRIDGED, axis=1)
    return np.asarray(np.argmin(np.where(reached, heights, np.inf), axis=1))


def _along(wall: Floats) -> Floats:
    """Distances of a wall's points (M, 2) from its first one, along the wall (M,) [m]."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(wall, axis=0).T))])


def rivulet_frames(
    course: DribblingCourse,
    dribbled: Dribbled,
    motion: Motion,
    times: Floats,
    frames: list[tuple[float, NDArray[np.float32], NDArray[np.uint8]]],
) -> list[tuple[float, NDArray[np.float32], NDArray[np.uint8]]]:
    """Show dribbling particles in frames: along the wall with the speed of the film, then in free fall.

    Args:
        course, dribbled: of the pour.
        motion: of the pourer.
        times: of the states from which the particles were selected, shape (T,) [s].
        frames: time [s], positions (N, 3) [m], states (N,).
    """
    begun, along = times[np.minimum(dribbled.left, len(times) - 1)], _along(course.wall)
    speed, length = course.speed[dribbled.step], course.length[dribbled.step]
    drips = begun + length / np.maximum(speed, 1e-3)
    final = np.where(dribbled.received, ParticleState.RECEIVED, ParticleState.SPILLED)
    shown = []
    for time, before, homes in frames:
        positions, states = before.copy(), homes.copy()
        gone = np.flatnonzero(time > begun)
        at_wall = np.minimum(time, drips[gone])
        place = np.minimum((at_wall - begun[gone]) * speed[gone], length[gone])
        wall = np.column_stack([np.interp(place, along, course.wall[:, i]) for i in range(2)])
        x, z = _turned(wall, motion.tilt(at_wall), motion.sample(at_wall))
        z -= 0.5 * GRAVITY * np.square(time - at_wall)
        states[dribbled.particles[gone]] = np.where(z > 0.0, ParticleState.IN_FLIGHT, final[gone])
        positions[dribbled.particles[gone]] = np.column_stack([x, np.zeros(len(gone)), np.maximum(z, 0.0)])
        shown.append((time, positions, states))
    return shown
