"""Arrays of the solver, apart from its algorithm. One set holds several scenes of up to `capacity` particles each."""

import taichi as ti

import os as _os
SUPPORT = float(_os.environ.get('SUP','2.0'))
"""Kernel support h over spacing d."""

VESSELS = 2
"""Pourer (0) and receiver (1)."""


@ti.data_oriented
class FluidState:
    """Particles, neighbour lists and per-scene scalars.

    Attributes (s: scene, i: particle, sorted by cell; those still moving come first):
        x, x0, v: position, position before the step [m], velocity [m/s].
        pressure, dp: accumulated density multiplier and its last change [m²].
        density: ρ/ρ₀.
        phi, normal: signed distance to each vessel [m] at the last look, linearised in between; its gradient.
        push: normal displacement given by each wall in this step [m].
        home: see `sim_engine.outcome.ParticleState`; `name`: index before any sorting.
        gradient, squares: Σ∇W and what the constraint's gradients amount to, Σ|∇C|².
        first, count, neighbour: neighbour lists (compressed rows), every pair once: at the particle sorted first.
    """

    def __init__(self, scenes: int, capacity: int, neighbours: int = 32, cells: int = 1 << 17) -> None:
        self.scenes, self.capacity, self.cells = scenes, capacity, cells
        self.list_capacity = capacity * neighbours
        row = (scenes, capacity)

        def vectors():
            return ti.Vector.field(3, ti.f32, shape=row)

        def scalars(kind=ti.f32):
            return ti.field(kind, shape=row)

        self.x, self.x0, self.v, self.dx, self.dv, self.x_listed = (vectors() for _ in range(6))
        self.x_copy, self.v_copy = vectors(), vectors()
        self.pressure, self.dp, self.density, self.pressure_copy = (scalars() for _ in range(4))
        self.phi = ti.Vector.field(VESSELS, ti.f32, shape=row)
        self.push = ti.Vector.field(VESSELS, ti.f32, shape=row)
        self.normal = ti.Matrix.field(VESSELS, 3, ti.f32, shape=row)
        self.home, self.home_copy, self.name, self.name_copy, self.cell = (scalars(ti.i32) for _ in range(5))
        self.gradient, self.squares = vectors(), scalars()
        self.edge = scalars()
        self.facing = vectors()
        self.bend = scalars()
        self.density_copy = scalars()
        self.rims = scalars()
        self.first, self.count = scalars(ti.i32), scalars(ti.i32)
        self.neighbour = ti.field(ti.i32, shape=(scenes, self.list_capacity))
        self.cell_start = ti.field(ti.i32, shape=(scenes, cells + 2))

        # Per scene: constants of the liquid …
        self.particles = ti.field(ti.i32, shape=scenes)
        self.spacing = ti.field(ti.f32, shape=scenes)
        self.attraction = ti.field(ti.f32, shape=scenes)  # peak cohesive acceleration of one pair [m/s²]
        self.viscosity = ti.field(ti.f32, shape=scenes)
        self.friction = ti.field(ti.f32, shape=scenes)
        self.gravity = ti.field(ti.f32, shape=scenes)  # downwards [m/s²]
        self.longest_step = ti.field(ti.f32, shape=scenes)  # [s]
        self.lip_drop = ti.field(ti.f32, shape=scenes)  # rims are lower for particles by so many spacings
        self.wall_shift = ti.field(ti.f32, shape=scenes)  # walls act as if that much nearer, in supports h
        self.table_step = ti.field(ti.f32, shape=scenes)  # of the pose table [s]
        self.table_length = ti.field(ti.i32, shape=scenes)
        # Poses of the vessels at the end and at the beginning of the step: vessel frame → world.
        self.origin, self.origin0 = (ti.Vector.field(3, ti.f32, shape=(scenes, VESSELS)) for _ in range(2))
        self.turn, self.turn0 = (ti.Matrix.field(3, 3, ti.f32, shape=(scenes, VESSELS)) for _ in range(2))
        self.spill_level = ti.field(ti.f32, shape=scenes)  # below it and in no vessel: spilled [m]
        # … and what changes with time.
        self.time = ti.field(ti.f64, shape=scenes)
        self.start = ti.field(ti.f64, shape=scenes)  # the pourer moves off [s]
        self.drift = ti.Vector.field(3, ti.f32, shape=scenes)  # velocity of all liquid at the start [m/s]
        self.dt = ti.field(ti.f32, shape=scenes)
        self.wait = ti.field(ti.f32, shape=scenes)
        self.waited = ti.field(ti.f32, shape=scenes)
        self.steps = ti.field(ti.i32, shape=scenes)
        self.skin = ti.field(ti.f32, shape=scenes)  # lists reach so many spacings beyond the support
        self.iterations = ti.field(ti.i32, shape=scenes)
        self.rebuilds = ti.field(ti.i32, shape=scenes)
        self.moving = ti.field(ti.i32, shape=scenes)
        self.stale = ti.field(ti.i32, shape=scenes)  # 1: neighbour lists must be rebuilt
        self.fault = ti.field(ti.i32, shape=scenes)  # 1: lists overflowed, 2: a position is not finite
        self.compression = ti.field(ti.f64, shape=scenes)  # sum over steps of the mean interior max(ρ/ρ₀ − 1, 0)
        # Signed distance grids: where they start in the shared pool of values, size, origin, spacing.
        self.grid_offset = ti.field(ti.i32, shape=(scenes, VESSELS))
        self.grid_size = ti.Vector.field(3, ti.i32, shape=(scenes, VESSELS))
        self.grid_origin = ti.Vector.field(3, ti.f32, shape=(scenes, VESSELS))
        self.grid_spacing = ti.field(ti.f32, shape=(scenes, VESSELS))
        self.swing = ti.field(ti.f32, shape=scenes)  # farthest that the pourer carries a point in this step [m]
        self.rim = ti.field(ti.f32, shape=(scenes, VESSELS))  # z of the lip in the vessel's frame [m]
        self.wall = ti.field(ti.f32, shape=(scenes, VESSELS))  # smallest thickness [m]
