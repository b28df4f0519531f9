"""Neighbour lists: particles sorted by cell (counting sort), explicit half lists that last until one has moved too far.

Source: Green 2010 (counting sort on a grid); Verlet 1967 (lists with a skin).
"""

import taichi as ti

from sim_engine.fluid.state import SUPPORT
from sim_engine.outcome import ParticleState

LIST_RESERVE = 2_000
"""Entries that one particle may add before the overflow check sees them; far above any packing."""

SPILLED = int(ParticleState.SPILLED)


@ti.func
def rebuild(f: ti.template(), s, skin):
    """Sort the moving particles by cell, put the others last, and list all pairs within h + skin·d, each once."""
    d = f.spacing[s]
    reach = (SUPPORT + skin) * d
    low = ti.Vector([1e9, 1e9, 1e9])
    high = ti.Vector([-1e9, -1e9, -1e9])
    n_before = f.moving[s]
    for i in range(n_before):
        if f.home[s, i] < SPILLED:
            low = ti.min(low, f.x[s, i])
            high = ti.max(high, f.x[s, i])
    # The domain follows the liquid; if it spreads too far for the table, cells grow. With nobody left it is one cell.
    low = ti.min(low, high)
    edge = reach
    size = ti.cast((high - low) / edge, ti.i32) + 1
    while ti.cast(size[0], ti.f32) * size[1] * size[2] > f.cells:
        edge *= 1.25
        size = ti.cast((high - low) / edge, ti.i32) + 1
    cells = size[0] * size[1] * size[2]
    for c in range(cells + 2):
        f.cell_start[s, c] = 0
    for i in range(n_before):
        c = cells
        if f.home[s, i] < SPILLED:
            q = ti.cast((f.x[s, i] - low) / edge, ti.i32)
            c = (q[0] * size[1] + q[1]) * size[2] + q[2]
        f.cell[s, i] = c
        f.cell_start[s, c + 1] = f.cell_start[s, c + 1] + 1
        f.x_copy[s, i] = f.x[s, i]
        f.v_copy[s, i] = f.v[s, i]
        f.dx[s, i] = f.x0[s, i]
        f.pressure_copy[s, i] = f.pressure[s, i]
        f.home_copy[s, i] = f.home[s, i]
        f.name_copy[s, i] = f.name[s, i]
    for c in range(cells + 1):
        f.cell_start[s, c + 1] = f.cell_start[s, c + 1] + f.cell_start[s, c]
    f.moving[s] = f.cell_start[s, cells]
    for i in range(n_before):
        c = f.cell[s, i]
        k = f.cell_start[s, c]
        f.cell_start[s, c] = k + 1
        f.x[s, k] = f.x_copy[s, i]
        f.x_listed[s, k] = f.x_copy[s, i]
        f.v[s, k] = f.v_copy[s, i]
        f.x0[s, k] = f.dx[s, i]
        f.pressure[s, k] = f.pressure_copy[s, i]
        f.home[s, k] = f.home_copy[s, i]
        f.name[s, k] = f.name_copy[s, i]
    # After the scatter cell_start[c] is where cell c ends, so that it begins at cell_start[c − 1].
    entries = 0
    reach2 = reach * reach
    for i in range(f.moving[s]):
        xi = f.x[s, i]
        q = ti.cast((xi - low) / edge, ti.i32)
        f.first[s, i] = entries
        # Every pair once, at the particle that comes first: what is left is the rest of the own column of cells and the
        # columns behind it. Particles of up to three cells of a column lie side by side.
        for a in range(q[0], ti.min(q[0] + 2, size[0])):
            b0 = q[1]
            if a > q[0]:
                b0 = ti.max(q[1] - 1, 0)
            for b in range(b0, ti.min(q[1] + 2, size[1])):
                column = (a * size[1] + b) * size[2]
                begin = i + 1
                if a != q[0] or b != q[1]:
                    c0 = column + ti.max(q[2] - 1, 0)
                    begin = 0
                    if c0 > 0:
                        begin = f.cell_start[s, c0 - 1]
                for j in range(begin, f.cell_start[s, column + ti.min(q[2] + 1, size[2] - 1)]):
                    # Branch-free: write always, keep by counting on.
                    r = xi - f.x[s, j]
                    f.neighbour[s, entries] = j
                    entries += ti.cast(r.dot(r) < reach2, ti.i32)
        f.count[s, i] = entries - f.first[s, i]
        if entries > f.list_capacity - LIST_RESERVE:
            f.fault[s] = 1
            entries = 0
    f.rebuilds[s] += 1
    f.stale[s] = 0
    f.skin[s] = skin
