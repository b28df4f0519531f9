"""Neighbour lists, and passes over pairs without lists.

**Lists.** Particles are sorted by cell (counting sort). Explicit half lists remain valid until a particle has moved too
far.

**Passes without lists**, for pairs within a long reach: eight pairs at a time. Particles take seats in the order of
their cells; cells are ordered in columns. The later seats within reach of a particle are then the rest of its own
column and a stretch of each of the four following columns. These numbers are adjacent in memory, so the processor
reads, computes and adds them in groups of eight. Four in five particles of a stretch are too far away and add nothing;
this costs less than listing the near ones and reading them one by one.

A stretch is processed in whole groups of eight, so a pass has to ignore seats beyond the stretch's end. After the last
seat of a scene there are eight empty ones.

Source: Green 2010 (counting sort on a grid); Verlet 1967 (lists with a skin); Páll & Hess 2013 (Verlet lists in
clusters, for the same reason).
"""

from sim_engine.fluid.compiler import ti
from sim_engine.fluid.kernels import square
from sim_engine.fluid.state import EIGHT, NEIGHBOURS, STRETCHES, SUPPORT
from sim_engine.outcome import ParticleState

SPILLED = int(ParticleState.SPILLED)

LAYERS = 3.0
"""Cells are as wide and deep as the lists' reach, and lower by this factor. A column is adjacent in memory, and a
search then reads little more of it than it needs."""


@ti.func
def cover(f: ti.template(), s, reach):
    """Cover all moving particles with cells of at least this width: their lowest corner, edges and numbers."""
    low = ti.Vector([1e9, 1e9, 1e9])
    high = ti.Vector([-1e9, -1e9, -1e9])
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        if f.home[i] < SPILLED:
            low = ti.min(low, f.x[i])
            high = ti.max(high, f.x[i])
    # The domain follows the liquid; if it spreads too far for the table, cells become larger. Without particles it is
    # one cell.
    # The number of cells is Π (⌊(high − low) / edge⌋ + 1) ≤ f.cells.
    low = ti.min(low, high)
    edge = ti.Vector([reach, reach, reach / LAYERS])
    size = ti.cast((high - low) / edge, ti.i32) + 1
    while ti.cast(size[0], ti.f32) * size[1] * size[2] > f.cells[s]:
        edge *= 1.25
        size = ti.cast((high - low) / edge, ti.i32) + 1
    return low, edge, size


@ti.func
def cell_at(table, x, low, edge, size):
    """Index of the cell of a position, in cells that begin at `table`; z varies fastest, so columns are adjacent."""
    q = ti.cast((x - low) / edge, ti.i32)
    return table + (q[0] * size[1] + q[1]) * size[2] + q[2]


@ti.func
def begin_cells(f: ti.template(), table, cells, begin):
    """Convert counts per cell to start indices, with `begin` as the first; there is one more entry than cells."""
    # Exclusive prefix sum: start_c = begin + Σ_{c' < c} count_c'.
    start = begin
    for c in range(table, table + cells + 1):
        count = f.cell_start[c]
        f.cell_start[c] = start
        start += count


@ti.func
def rebuild(f: ti.template(), s, skin):
    """Sort the moving particles by cell, with the others last, and list all pairs within h + skin·d, each once."""
    reach = (SUPPORT + skin) * f.spacing[s]
    low, edge, size = sort(f, s, reach)
    list_pairs(f, s, reach, low, edge, size)


@ti.func
def sort(f: ti.template(), s, reach):
    """Sort particles in the order of their cells, with those that do not move any more last.

    Returns:
        As `cover`. Afterwards cell_start[c] is the end of cell c, so that the cell begins at cell_start[c − 1].
    """
    begin = f.begin[s]
    end = begin + f.moving[s]
    table = f.cells_begin[s]
    low, edge, size = cover(f, s, reach)
    cells = size[0] * size[1] * size[2]
    for c in range(table, table + cells + 1):
        f.cell_start[c] = 0
    # Histogram: cell_start[c] = number of particles in cell c. One more cell holds those that do not move any more.
    for i in range(begin, end):
        c = table + cells
        if f.home[i] < SPILLED:
            c = cell_at(table, f.x[i], low, edge, size)
        f.cell[i] = c
        f.cell_start[c] = f.cell_start[c] + 1
        for values, copy in ti.static(f.carried):
            copy[i] = values[i]
    begin_cells(f, table, cells, begin)
    f.moving[s] = f.cell_start[table + cells] - begin
    # Scatter: in the order of their old indices, so that the sort is stable and a pour is repeatable.
    for i in range(begin, end):
        c = f.cell[i]
        k = f.cell_start[c]
        f.cell_start[c] = k + 1
        for values, copy in ti.static(f.carried):
            values[k] = copy[i]
        f.x_listed[k] = f.x_copy[i]
    return low, edge, size


@ti.func
def list_pairs(f: ti.template(), s, reach, low, edge, size):
    """List all pairs within `reach`, each at its first particle."""
    begin = f.begin[s]
    table = f.cells_begin[s]
    entries = f.list_begin[s]
    last = f.list_begin[s] + f.particles[s] * NEIGHBOURS
    reach2 = reach * reach
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xi = f.x[i]
        q = ti.cast((xi - low) / edge, ti.i32)
        f.first[i] = entries
        # Every pair is listed once, at its first particle: the candidates are the rest of the own column of cells and
        # the following columns. Particles in the cells of a column are adjacent.
        c0 = ti.max(ti.cast((xi[2] - low[2] - reach) / edge[2], ti.i32), 0)
        c1 = ti.min(ti.cast((xi[2] - low[2] + reach) / edge[2], ti.i32), size[2] - 1)
        for a in range(q[0], ti.min(q[0] + 2, size[0])):
            b0 = q[1]
            if a > q[0]:
                b0 = ti.max(q[1] - 1, 0)
            for b in range(b0, ti.min(q[1] + 2, size[1])):
                column = table + (a * size[1] + b) * size[2]
                j0 = i + 1
                if a != q[0] or b != q[1]:
                    j0 = begin
                    if column + c0 > table:
                        j0 = f.cell_start[column + c0 - 1]
                for j in range(j0, f.cell_start[column + c1]):
                    # Branch-free: always write, and advance the count only for pairs to keep.
                    r = xi - f.x[j]
                    f.neighbour[entries] = j
                    entries += ti.cast(square(r) < reach2, ti.i32)
        f.count[i] = entries - f.first[i]
        if entries > last:
            f.fault[s] = 1
            entries = f.list_begin[s]
    f.list_end[s] = entries
    f.rebuilds[s] += 1
    f.stale[s] = 0


@ti.func
def measure_pairs(f: ti.template(), s):
    """Distances of all listed pairs, squared, to `pair`."""
    # r² = |x_i − x_j|² [m²]; the pair's index k runs through the rows of all i, which are adjacent.
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xi = f.x[i]
        for k in range(f.first[i], f.first[i] + f.count[i]):
            f.pair[k] = square(xi - f.x[f.neighbour[k]])


@ti.func
def take_seats(f: ti.template(), s, reach):
    """Seat the moving particles of a scene, and find each one's stretches for pairs within `reach`.

    Returns:
        The first seat and the one after the last.
    """
    begin = f.begin[s]
    end = begin + f.moving[s]
    seats = begin + EIGHT * s
    table = f.cells_begin[s]
    low, edge, size = cover(f, s, reach)
    cells = size[0] * size[1] * size[2]
    for c in range(table, table + cells + 1):
        f.cell_start[c] = 0
    # Counting sort as in `sort`, of seats only: particles keep their indices.
    for i in range(begin, end):
        c = cell_at(table, f.x[i], low, edge, size)
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
        f.lean[k] = ti.Vector([0.0, 0.0, 0.0])  # a diverged pour may have left NaN there, and NaN times 0 is NaN
        f.missing[k] = 0.0
    # cell_start[c] is now the end of cell c, so that the cell begins at cell_start[c − 1].
    # Half of the neighbourhood: the own column from the next seat on, and the columns (0, +1), (+1, −1), (+1, 0),
    # (+1, +1) relative to it, each from the layer c0 at z − reach to the layer c1 at z + reach.
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
    """The number rounded up to a multiple of eight; 0 for an empty stretch."""
    return (ti.max(count, 0) + (EIGHT - 1)) & -EIGHT
