"""Passes over pairs that reach far, without lists: eight pairs at a time.

Particles take seats in the order of their cells, cells in the order of columns. What lies within reach of a particle,
behind it in that order, is then the rest of its own column and a stretch of each of the four columns behind it:
numbers side by side in memory, which the processor reads, works out and adds to in eights. Four in five of a stretch's
particles are too far away and add nothing; that is cheaper than to list who is near, and to fetch them one by one.

A stretch is gone through in whole eights, so a pass has to count nobody from the stretch's end on. Behind the last seat
of a scene there are eight empty ones.

Source: Green 2010 (counting sort on a grid); verlet lists in clusters, for the same reason: Páll & Hess 2013.
"""

import taichi as ti

from sim_engine.fluid.neighbours import begin_cells, cover
from sim_engine.fluid.state import EIGHT, STRETCHES


@ti.func
def take_seats(f: ti.template(), s, reach):
    """Seat the moving particles of a scene, and find each one's stretches for pairs within `reach`.

    Returns:
        The first seat and the one behind the last.
    """
    begin = f.begin[s]
    end = begin + f.moving[s]
    seats = begin + EIGHT * s
    table = f.cells_begin[s]
    low, edge, size = cover(f, s, reach)
    cells = size[0] * size[1] * size[2]
    for c in range(table, table + cells + 1):
        f.cell_start[c] = 0
    for i in range(begin, end):
        q = ti.cast((f.x[i] - low) / edge, ti.i32)
        c = table + (q[0] * size[1] + q[1]) * size[2] + q[2]
        f.cell[i] = c
        f.cell_start[c] = f.cell_start[c] + 1
    begin_cells(f, table, cells, seats)
    for i in range(begin, end):
        c = f.cell[i]
        k = f.cell_start[c]
        f.cell_start[c] = k + 1
        f.seated[k] = i
        f.seat[k] = f.x[i] / reach
    behind = seats + f.moving[s]
    for k in range(behind, behind + EIGHT):
        f.seat[k] = ti.Vector([0.0, 0.0, 0.0])
        f.lean[k] = ti.Vector([0.0, 0.0, 0.0])  # what a pour that diverged left there, times nothing, is no number
        f.missing[k] = 0.0
    # cell_start[c] is where cell c ends now, so that it begins at cell_start[c − 1].
    for k in range(seats, behind):
        x = f.x[f.seated[k]]
        q = ti.cast((x - low) / edge, ti.i32)
        c0 = ti.max(ti.cast((x[2] - low[2] - reach) / edge[2], ti.i32), 0)
        c1 = ti.min(ti.cast((x[2] - low[2] + reach) / edge[2], ti.i32), size[2] - 1)
        n = k * STRETCHES
        for a in range(q[0], q[0] + 2):
            for b in range(q[1] - 1 + ti.cast(a == q[0], ti.i32), q[1] + 2):
                first = seats
                last = seats
                if a < size[0] and b >= 0 and b < size[1]:
                    column = table + (a * size[1] + b) * size[2]
                    first = k + 1
                    last = f.cell_start[column + c1]
                    if a != q[0] or b != q[1]:
                        first = seats
                        if column + c0 > table:
                            first = f.cell_start[column + c0 - 1]
                f.stretch[n] = ti.Vector([first, last])
                n += 1
    return seats, behind


@ti.func
def in_eights(count):
    """The same number or the next one that eight divides; of a stretch that is empty nothing."""
    return (ti.max(count, 0) + (EIGHT - 1)) & -EIGHT
