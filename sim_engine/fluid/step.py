"""One time step, and the loop over steps. Serial within a scene; scenes run side by side.

Order of a step:

1. move the pourer, predict positions, sweep against the walls;
2. refresh neighbour lists if needed, look up wall distances;
3. warm start, iterate the density constraint, sweep again;
4. derive velocities, friction, viscosity and cohesion, lower rims, classify particles.

Source: Macklin & Müller 2013; adaptive steps by displacement (CFL).
"""

from sim_engine.fluid.compiler import ti
from sim_engine.fluid.density import displace, measure, measure_before, measure_first, multiply, multiply_first
from sim_engine.fluid.kernels import dot, length, square, turned, turned_back
from sim_engine.fluid.neighbours import change_places, rebuild
from sim_engine.fluid.state import VESSELS, FluidState
from sim_engine.fluid.tension import pull
from sim_engine.fluid.viscosity import STIFFEST, flow, relax, yield_to_shear
from sim_engine.fluid.walls import (
    FAR,
    STRETCH,
    crossed,
    distance_and_gradient,
    in_cavity,
    lower_rims,
    swept,
    to_vessel,
    to_world,
)
from sim_engine.outcome import ParticleState

CFL = 1.5
"""Largest displacement per step, in spacings."""
LONGEST_STEP = 4e-3
PACE = 0.18
"""Longest step in units of √(d/g): in a longer one gravity presses layers together faster than the iterations separate
them."""
SHORTEST_STEP = 1e-4
ITERATIONS = 2
"""Least number of passes over the density constraint in a step."""
TOLERANCE = 0.015
"""Mean compression inside above which a step makes more passes: a deep vessel needs more than a shallow one."""
STRAIN = 0.002
"""The same bound in thick liquids, for the compression that a step adds, which remains in the velocities. At 0.015
liquid at rest kept falling by three times g dt in every step, and `decompress` raised it again."""
MOST_ITERATIONS = 30
"""Largest number of passes over the density constraint in a step."""
SKIN = 0.03
"""Reach of neighbour lists beyond the support, in spacings. With a skin of 0.3 lists lasted for three steps of calm
liquid, but they were half as long again, which slowed every pass over them."""
SMOOTHEST, ROUGHEST = 0.7, 3.7
"""Range of eigenvalues of the iteration matrix that Chebyshev's polynomials damp. ROUGHEST is the largest that occurs
(dense packing, h = 2.2 d); a smaller SMOOTHEST gives larger steps, and noise at rest."""
CONTACT = 0.2
"""Distance of particles' centres from solid, in spacings; the density constraint keeps about half a spacing."""
WARM = 0.3
"""Fraction of the last step's multipliers with which a step starts. From one half on, oscillations grow in deep liquid,
because the multipliers respond to the previous state (docs/notes/solver.md has the analysis)."""
TREACLE = 0.7
"""Factor by which velocities shrink in every step before the start, so that a lattice settles without splashing. Those
of thick liquids become zero: an expanding lattice would throw films off walls."""

FACTS = ("time", "fault", "steps", "iterations", "compression", "open")
"""Names of the fields that `Stepper.advance` returns for a scene, after its number of particles in each state."""
STATES = len(ParticleState)

IN_POURER, IN_FLIGHT, RECEIVED, SPILLED, ESCAPED = (int(s) for s in ParticleState)


@ti.func
def rotation(q):
    """Rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ti.Matrix(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@ti.func
def received(f: ti.template(), cavities: ti.template(), s, x):
    """1 if a point of the world lies in the receiver, or up to half a spacing above it."""
    y = to_vessel(f, s, 1, x, False)
    inside = in_cavity(f, cavities, s, 1, y)
    if inside == 0:
        inside = in_cavity(f, cavities, s, 1, y - ti.Vector([0.0, 0.0, 0.5 * f.spacing[s]]))
    return inside


@ti.data_oriented
class Stepper:
    """The solver's algorithm on a `FluidState`."""

    def __init__(self, state: FluidState) -> None:
        self.state = state
        self.facts = [getattr(state, name) for name in FACTS]

    @ti.func
    def place_pourer(self, s, time, tables: ti.template()):
        """Pose of the pourer from its table, whose rows are `table_step` apart."""
        f = self.state
        # Linear between rows k and k + 1 at the weight w: p = p_k + w (p_{k+1} − p_k); a quaternion is then normalised.
        u = ti.cast(ti.max(time, f.start[s]) / f.table_step[s], ti.f32)
        k = ti.min(ti.cast(u, ti.i32), f.table_length[s] - 2)
        w = ti.min(u - k, 1.0)
        k = f.poses_begin[s] + 7 * k
        row = ti.Vector([0.0] * 7)
        for c in ti.static(range(7)):
            row[c] = tables[k + c] + w * (tables[k + 7 + c] - tables[k + c])
        q = ti.Vector([row[3], row[4], row[5], row[6]]).normalized()
        f.origin[s, 0] = ti.Vector([row[0], row[1], row[2]])
        f.turn[s, 0] = rotation(q)

    @ti.func
    def predict(self, s, dt, grids: ti.template(), thick: ti.template()):
        """Ballistic prediction, stopped by walls. Requests new lists if a particle has moved too far."""
        f = self.state
        clear = CONTACT * f.spacing[s]
        limit = 0.45 * SKIN * f.spacing[s]
        for i in range(f.begin[s], f.begin[s] + f.moving[s]):
            # x* = x0 + dt (v − dt g), Macklin & Müller 2013, algorithm 1. In thick liquids `flow` has added gravity.
            x0 = f.x[i]
            f.x0[i] = x0
            v = f.v[i]
            if ti.static(not thick):
                v[2] -= f.gravity[s] * dt
            x = x0 + dt * v
            # φ is that of the end of the last step: solid farther away than the displacement cannot be reached.
            reach = STRETCH * dt * length(v) + 2.0 * clear
            for b in range(VESSELS):
                if f.phi[i][b] < reach + STRETCH * f.swing[s, b]:
                    y0 = to_vessel(f, s, b, x0, True)
                    y1 = to_vessel(f, s, b, x, False)
                    y = swept(f, grids, s, b, y0, y1, clear, f.sag[i][b])
                    if square(y - y1) > 0.0:
                        x = to_world(f, s, b, y)
            f.x[i] = x
            f.push[i] = ti.Vector([0.0, 0.0])
            change_places(f, s, i)
            # Lists reach SKIN · d beyond h: while each particle has moved by less than half of it, no pair is missing.
            if square(x - f.x_listed[i]) > limit * limit:
                f.stale[s] = 1

    @ti.func
    def look_at_walls(self, s, planes: ti.template()):
        """Distance and normal of both vessels' equivalent planes at all moving particles, to be linearised."""
        f = self.state
        for b in range(VESSELS):
            turn, origin = f.turn[s, b], f.origin[s, b]
            for i in range(f.begin[s], f.begin[s] + f.moving[s]):
                y = turned_back(turn, f.x[i] - origin)
                wall = distance_and_gradient(f, planes, f.plane_offset[s, b], s, b, y, f.sag[i][b])
                f.phi[i][b] = wall[3]
                n = turned(turn, wall)
                for c in ti.static(range(3)):
                    f.normal[i][b, c] = n[c]

    @ti.func
    def apply(self, s):
        """Move by the computed displacements; linearised wall contact.

        `CONTACT` is enforced only at the step's end: if it was enforced in every iteration, the ring of particles in a
        corner never came to rest.
        """
        f = self.state
        for i in range(f.begin[s], f.begin[s] + f.moving[s]):
            move = ti.Vector([f.move[i][0], f.move[i][1], f.move[i][2]])
            x = f.x[i] + move
            for b in ti.static(range(VESSELS)):
                phi = f.phi[i][b]
                if phi < 4.0 * f.spacing[s]:
                    # φ(x + Δx) ≈ φ(x) + n · Δx; a penetration −φ is undone along n, and counts as the wall's push.
                    n = ti.Vector([f.normal[i][b, 0], f.normal[i][b, 1], f.normal[i][b, 2]])
                    phi += dot(n, move)
                    if phi < 0.0:
                        x -= phi * n
                        f.push[i][b] = f.push[i][b] - phi
                        phi = 0.0
                    f.phi[i][b] = phi
            f.x[i] = x

    @ti.func
    def iterate(self, s, warm: ti.template(), thick: ti.template()):
        """Chebyshev-accelerated Jacobi iteration on the density, from the present multipliers.

        Args:
            s: scene.
            warm: whether these are multipliers whose displacements the first iteration includes; otherwise they are 0.
            thick: whether the viscosity is in SI.
        """
        f = self.state
        n = 0
        compressed = ti.cast(1.0, ti.f32)
        tolerance = ti.cast(TOLERANCE, ti.f32)
        if ti.static(thick and warm):
            tolerance = STRAIN
        # Three-term recurrence of the Chebyshev iteration on eigenvalues in [SMOOTHEST, ROUGHEST] = centre ± half
        # (Golub & Varga 1961): with σ_0 = half / centre, σ_{k+1} = 1 / (2 / σ_0 − σ_k),
        #     Δλ_{k+1} = σ_{k+1} σ_k Δλ_k + (2 σ_{k+1} / half) C / Σ|∇C|²,    Δλ_0 = (1 / centre) C / Σ|∇C|²
        # The factors of the two terms are momentum and rate; `multiply` applies them.
        centre = ti.cast(0.5 * (ROUGHEST + SMOOTHEST), ti.f32)
        half = ti.cast(0.5 * (ROUGHEST - SMOOTHEST), ti.f32)
        sigma = half / centre
        rate = 1.0 / centre
        momentum = ti.cast(0.0, ti.f32)
        while n < ITERATIONS or (compressed > tolerance and n < MOST_ITERATIONS):
            if ti.static(warm) and n == 0:
                measure_first(f, s)
                compressed = multiply_first(f, s, rate, thick)
            else:
                if n > 0:
                    following = 1.0 / (2.0 * centre / half - sigma)
                    momentum = sigma * following
                    rate = 2.0 * following / half
                    sigma = following
                measure(f, s)
                compressed = multiply(f, s, rate, momentum, thick)
            displace(f, s)
            self.apply(s)
            n += 1
        f.iterations[s] = f.iterations[s] + n

    @ti.func
    def solve_density(self, s, ratio, thick: ti.template()):
        """Chebyshev-accelerated Jacobi iteration, which starts from a fraction of the last step's multipliers.

        This fraction causes no displacement by itself; the first iteration's displacements include it.

        In thick liquids only compression beyond that of the step's beginning is resolved here; see `decompress`.

        Args:
            s: scene.
            ratio: this step's dt² over the last one's, which scales the multipliers.
            thick: whether the viscosity is in SI.
        """
        f = self.state
        for i in range(f.begin[s], f.begin[s] + f.moving[s]):
            # λ ~ pressure · dt²: the same pressure has a multiplier that grows with the square of the step.
            f.pressure[i] = f.pressure[i] * WARM * ratio
        self.iterate(s, True, thick)

    @ti.func
    def decompress(self, s):
        """Remove the compression that is left from earlier steps: the displacements change no velocity.

        Otherwise each correction would be a velocity of its size over dt, which throws films off walls.
        """
        f = self.state
        for i in range(f.begin[s], f.begin[s] + f.moving[s]):
            f.pressure_copy[i] = f.pressure[i]
            f.pressure[i] = 0.0
            f.allowed[i] = 0.0
            f.dv[i] = f.x[i]
        self.iterate(s, False, True)
        for i in range(f.begin[s], f.begin[s] + f.moving[s]):
            f.pressure[i] = f.pressure_copy[i]
            f.dv[i] = f.x[i] - f.dv[i]

    @ti.func
    def find_contact(self, s, b, y0, y1, clear, sag, grids: ti.template()):
        """Where a particle's step from y0 to y1 in a vessel's frame ends, and the wall there.

        Returns:
            The end, as a position in the vessel's frame; (n, φ), normal and distance of the wall as a 4-vector; and
            whether the wall was within reach of the step.
        """
        f = self.state
        y = y1
        wall = ti.Vector([0.0, 0.0, 0.0, FAR])
        within_reach = False
        # At most two passes through one look-up, which compiles to half as much code as two of them.
        passes = 1
        while passes > 0:
            wall = distance_and_gradient(f, grids, f.grid_offset[s, b], s, b, y, sag)
            passes -= 1
            # |∇φ| ≤ STRETCH: with φ(y1) ≥ STRETCH |y1 − y0| there is no solid on the path. Otherwise it is swept.
            if not within_reach and wall[3] < STRETCH * length(y1 - y0):
                within_reach = True
                passes = 1
                y = swept(f, grids, s, b, y0, y1, 0.5 * clear, sag)
        return y, wall, within_reach

    @ti.func
    def push_off(self, s, b, i, y0, y, wall, clear):
        """Enforce the distance `CONTACT`, and Coulomb's friction.

        Returns:
            The new position in the vessel's frame, and its distance from the wall [m].
        """
        f = self.state
        n = ti.Vector([wall[0], wall[1], wall[2]])
        phi = wall[3]
        push = f.push[i][b]  # the wall's normal displacement in this step [m], in the place of its normal force
        moved = y
        if phi < clear and phi > 0.0:
            moved += (clear - phi) * n
            push += clear - phi
            phi = clear
        if push > 0.0 and phi < 1.5 * f.spacing[s]:
            # Coulomb: the wall, at rest in the vessel's frame, holds back at most μ times its normal displacement:
            # Δx_t ← Δx_t (1 − min(μ push / |Δx_t|, 1)), as Macklin, Müller, Chentanez & Kim 2014 do, with one μ.
            step = moved - y0
            tangential = step - dot(step, n) * n
            slid = length(tangential)
            if slid > 1e-9:
                moved -= tangential * ti.min(f.friction[s] * push / slid, 1.0)
        return moved, phi

    @ti.func
    def note_crossing(self, s, b, i, y0, y, grids: ti.template()):
        """Take a particle out of play whose step leads through a wall."""
        f = self.state
        if crossed(f, grids, s, b, y0, y, f.sag[i][b]) == 1:
            f.home[i] = ESCAPED
            f.stale[s] = 1

    @ti.func
    def set_velocity(self, s, i, x0, x, dt, thick: ti.template()):
        """Velocity of a particle from its positions; a fault if it is not finite."""
        f = self.state
        # v = (x − x0) / dt (Macklin & Müller 2013, algorithm 1), without the displacements of `decompress`.
        v = (x - x0) / dt
        if ti.static(thick):
            v -= f.dv[i] / dt
        f.v[i] = v
        if not (ti.abs(v[0]) + ti.abs(v[1]) + ti.abs(v[2]) < 1e3):  # true for NaN, too
            f.fault[s] = 2

    @ti.func
    def finish(self, s, dt, grids: ti.template(), thick: ti.template()):
        """Contact of all moving particles with the walls at the step's end, and their velocities."""
        f = self.state
        d = f.spacing[s]
        clear = CONTACT * d
        for i in range(f.begin[s], f.begin[s] + f.moving[s]):
            x = f.x[i]
            x0 = f.x0[i]
            reach = STRETCH * length(x - x0) + d
            for b in range(VESSELS):
                if f.phi[i][b] < reach + STRETCH * f.swing[s, b]:
                    y0 = to_vessel(f, s, b, x0, True)
                    y1 = to_vessel(f, s, b, x, False)
                    contact, wall, within_reach = self.find_contact(s, b, y0, y1, clear, f.sag[i][b], grids)
                    y, phi = self.push_off(s, b, i, y0, contact, wall, clear)
                    if square(y - y1) > 0.0:
                        x = to_world(f, s, b, y)
                    f.phi[i][b] = phi
                    if within_reach:
                        self.note_crossing(s, b, i, y0, y, grids)
            f.x[i] = x
            self.set_velocity(s, i, x0, x, dt, thick)

    @ti.func
    def classify(self, s, cavities: ti.template()):
        """Classify every moving particle by its place, and find the largest speed.

        The space up to half a spacing above the opening plane counts as the receiver.
        """
        f = self.state
        compressed = ti.cast(0.0, ti.f32)
        fastest = ti.cast(0.0, ti.f32)
        inside = 0
        for i in range(f.begin[s], f.begin[s] + f.moving[s]):
            fastest = ti.max(fastest, square(f.v[i]))
            if f.home[i] != ESCAPED:
                x = f.x[i]
                home = IN_FLIGHT
                if f.phi[i][0] < FAR and in_cavity(f, cavities, s, 0, to_vessel(f, s, 0, x, False)) == 1:
                    home = IN_POURER
                elif f.phi[i][1] < FAR and received(f, cavities, s, x) == 1:
                    home = RECEIVED
                elif x[2] < f.spill_level[s]:
                    home = SPILLED
                    f.stale[s] = 1
                f.home[i] = home
                # Mean of max(ρ/ρ₀ − 1, 0) over interior particles; a surface has a lower density than 0.95.
                if f.density[i] > 0.95:
                    inside += 1
                    compressed += ti.max(f.density[i] - 1.0, 0.0)
        f.fastest[s] = ti.sqrt(fastest)
        if inside > 0:
            f.compression[s] += compressed / inside

    @ti.func
    def let_fall(self, s, dt):
        """Particles out of play fall to the table, for display only."""
        f = self.state
        # Symplectic Euler without any contact but the table's plane z = 0: v_z ← v_z − g dt, x ← x + dt v.
        for i in range(f.begin[s] + f.moving[s], f.begin[s] + f.particles[s]):
            if f.x[i][2] > 0.0:
                f.v[i][2] = f.v[i][2] - f.gravity[s] * dt
                x = f.x[i] + dt * f.v[i]
                x[2] = ti.max(x[2], 0.0)
                f.x[i] = x

    @ti.func
    def step(
        self,
        s,
        tables: ti.template(),
        cavities: ti.template(),
        thick: ti.template(),
    ):
        """One time step of one scene, up to cohesion, which has a separate kernel; `conclude` completes the step."""
        f = self.state
        # CFL condition on displacements: dt = CFL d / max|v|, between SHORTEST_STEP and min(longest_step, PACE √(d/g)).
        longest = ti.min(f.longest_step[s], PACE * ti.sqrt(f.spacing[s] / ti.max(f.gravity[s], 1e-3)))
        dt = ti.min(ti.max(CFL * f.spacing[s] / (f.fastest[s] + 1e-6), SHORTEST_STEP), longest)
        # Viscosity: dt ν / d² ≤ STIFFEST, for accuracy; it is implicit and stable at any step.
        if ti.static(thick):
            dt = ti.max(ti.min(dt, STIFFEST * f.spacing[s] ** 2 / f.kinematic[s]), SHORTEST_STEP)
        ratio = ti.min((dt / f.dt[s]) ** 2, 4.0)
        f.dt[s] = dt
        f.origin0[s, 0] = f.origin[s, 0]
        f.turn0[s, 0] = f.turn[s, 0]
        f.time[s] += dt
        self.place_pourer(s, f.time[s], tables)
        # Upper bound of the displacement of any point of the pourer's grid in the step: a difference of two rotations
        # stretches nothing by more than 1/√2 of its Frobenius norm.
        turned = f.turn[s, 0] - f.turn0[s, 0]
        f.swing[s, 0] = length(f.origin[s, 0] - f.origin0[s, 0]) + turned.norm() * (f.arm[s] / ti.sqrt(2.0))
        if ti.static(thick):
            flow(f, s, dt)
        self.predict(s, dt, tables, thick)
        if f.stale[s] == 1:
            rebuild(f, s, SKIN)
        self.look_at_walls(s, tables)
        if ti.static(thick):
            measure_before(f, s)
        self.solve_density(s, ratio, thick)
        if ti.static(thick):
            self.decompress(s)
        self.finish(s, dt, tables, thick)
        if ti.static(thick):
            yield_to_shear(f, s, dt)
        else:
            f.waited[s] += dt
            if f.waited[s] >= f.wait[s]:
                relax(f, s, f.waited[s])
                f.waited[s] = 0.0
        f.pull_waited[s] += dt
        f.open[s] = 1

    @ti.func
    def conclude(self, s, cavities: ti.template(), thick: ti.template()):
        """Complete a time step."""
        f = self.state
        dt = f.dt[s]
        # While the lattice settles, velocities decay by TREACLE per step; all liquid begins to drift at the start.
        if f.time[s] < f.start[s]:
            for i in range(f.begin[s], f.begin[s] + f.moving[s]):
                if ti.static(thick):
                    f.v[i] = ti.Vector([0.0, 0.0, 0.0])
                else:
                    f.v[i] = f.v[i] * TREACLE
        elif f.time[s] - dt < f.start[s]:
            for i in range(f.begin[s], f.begin[s] + f.moving[s]):
                f.v[i] = f.v[i] + f.drift[s]
        lower_rims(f, s, dt, thick)
        self.classify(s, cavities)
        self.let_fall(s, dt)
        f.steps[s] += 1
        f.open[s] = 0

    @ti.kernel
    def advance(
        self,
        scene: ti.i32,
        until: ti.f64,
        tables: ti.types.ndarray(dtype=ti.f32, ndim=1),
        cavities: ti.types.ndarray(dtype=ti.u8, ndim=1),
        facts: ti.types.ndarray(dtype=ti.f64, ndim=2),
        thick: ti.template(),
    ):
        """Advance a scene until its time reaches `until` [s], a fault stops it, or cohesion is due. Store the number of
        its particles in each state and `FACTS`, in its row.

        Cohesion is due in the middle of a step, which is then `open`: call `cohere`, and then this kernel again. Two
        kernels compile in less time than one with both parts, and simulations without cohesion never compile the
        second. A call costs 7 µs for each array.

        The scene is `thick`, a liquid with a viscosity in SI, or it is not. These are two kernels, so that neither
        contains code of the other.
        """
        f = self.state
        for s in range(scene, scene + 1):
            due = 0
            while due == 0 and (f.open[s] == 1 or (f.time[s] < until and f.fault[s] == 0)):
                if f.open[s] == 1:
                    self.conclude(s, cavities, thick)
                else:
                    self.step(s, tables, cavities, thick)
                    # Cohesion that acts too late is unstable, so it acts before the interval ends.
                    if f.cohesion[s] > 0.0 and f.pull_waited[s] + f.dt[s] > f.pull_wait[s]:
                        due = 1
            counts = ti.Vector([0] * STATES)
            for i in range(f.begin[s], f.begin[s] + f.particles[s]):
                for state in ti.static(range(STATES)):
                    counts[state] += ti.cast(f.home[i] == state, ti.i32)
            for state in ti.static(range(STATES)):
                facts[s, state] = counts[state]
            for k in ti.static(range(len(FACTS))):
                facts[s, STATES + k] = self.facts[k][s]

    @ti.kernel
    def cohere(self, s0: ti.i32, s1: ti.i32):
        """Let cohesion act in the scenes s0 … s1 − 1."""
        f = self.state
        for s in range(s0, s1):
            pull(f, s, f.pull_waited[s])
            f.pull_waited[s] = 0.0
