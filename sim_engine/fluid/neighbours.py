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
from sim_engine.fluid.state import EIGHT, NEIGHBOURS, STRETCHES, SUPPORT, VESSELS
from sim_engine.outcome import ParticleState

SPILLED = int(ParticleState.SPILLED)

LAYERS = 3.0
"""Cells are as wide and deep as the lists' reach, and lower by this factor. A column is adjacent in memory, and a
search then reads little more of it than it needs."""


GOLDEN = 0.61803399
"""Fractional parts of its multiples are evenly spread over [0, 1) (Weyl 1916)."""

POLAR, AXIAL, SCALAR = (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), ()
"""Factors of the components of a velocity, a rotation and a number in the mirror image by the plane y = 0."""


@ti.func
def reflect(f: ti.template(), s, values: ti.template(), signs: ti.template()):
    """Give values of the particles near the plane of symmetry to their images.

    Args:
        values: of all particles; a fourth component is a number.
        signs: `POLAR`, `AXIAL` or `SCALAR`.
    """
    for m in range(f.begin[s], f.begin[s] + f.images[s]):
        i = f.near[m]
        value = values[i]
        for c in ti.static(range(len(signs))):
            value[c] *= signs[c]
        values[i + f.particles[s]] = value


@ti.func
def change_places(f: ti.template(), s, i):
    """Replace a particle behind the plane of symmetry by its image. The plane is no wall: momentum along it remains."""
    if f.mirrored[s] == 1 and f.x[i][1] < 0.0:
        for vector in ti.static((f.x, f.x0, f.v)):
            vector[i][1] = -vector[i][1]
        for b in ti.static(range(VESSELS)):
            f.normal[i][b, 1] = -f.normal[i][b, 1]
        f.stale[s] = 1


@ti.func
def part_from_own(f: ti.template(), s):
    """Lengthen the distance of each particle from its own image, squared in `pair`."""
    # r² = 4 y² + (a d)², a between 0 and `apart` for each particle: how near it may come to the plane differs.
    for m in range(f.begin[s], f.begin[s] + f.images[s]):
        i = f.near[m]
        k = ti.max(f.first[i] + f.count[i] - 1, 0)  # its own image is listed last
        if f.count[i] > 0 and f.neighbour[k] == i + f.particles[s]:
            share = GOLDEN * f.name[i]
            f.pair[k] = f.pair[k] + (f.apart[s] * f.spacing[s] * (share - ti.floor(share))) ** 2


@ti.func
def list_images(f: ti.template(), s, i, entries, reach, low, edge, size):
    """List the images within `reach` of a particle, its own last, and return the end of its list."""
    table = f.cells_begin[s]
    x = f.x[i]
    along = ti.sqrt(reach * reach - x[1] * x[1])  # an image is at least y away
    a0 = ti.max(ti.cast((x[0] - low[0] - along) / edge[0], ti.i32), 0)
    a1 = ti.min(ti.cast((x[0] - low[0] + along) / edge[0], ti.i32), size[0] - 1)
    b1 = ti.min(ti.cast((reach - x[1] - low[1]) / edge[1], ti.i32), size[1] - 1)
    c0 = ti.max(ti.cast((x[2] - low[2] - along) / edge[2], ti.i32), 0)
    c1 = ti.min(ti.cast((x[2] - low[2] + along) / edge[2], ti.i32), size[2] - 1)
    for a in range(a0, a1 + 1):
        for b in range(0, b1 + 1):
            column = table + (a * size[1] + b) * size[2]
            j0 = f.begin[s]
            if column + c0 > table:
                j0 = f.cell_start[column + c0 - 1]
            for j in range(j0, f.cell_start[column + c1]):
                f.neighbour[entries] = j + f.particles[s]
                r = x - f.x[j] * POLAR
                entries += ti.cast(square(r) < reach * reach and i != j, ti.i32)
    if 2.0 * x[1] < reach:
        f.neighbour[entries] = i + f.particles[s]
        entries += 1
    return entries


@ti.func
def cover(f: ti.template(), s, reach, depth):
    """Cover all moving particles with cells of at least this width: their lowest corner, edges and numbers.

    Args:
        depth: of the images behind the plane of symmetry that are covered too [m].
    """
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
    if depth > 0.0:
        low[1] = -depth
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
    """Sort the moving particles by cell, with the others last, and list all pairs within h + skin·d, each once.

    Pairs with images are listed at both particles: they add to the particle alone."""
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
    low, edge, size = cover(f, s, reach, 0.0)
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
    f.images[s] = 0
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
        if f.mirrored[s] == 1 and xi[1] < reach:
            f.near[begin + f.images[s]] = i
            f.images[s] = f.images[s] + 1
            entries = list_images(f, s, i, entries, reach, low, edge, size)
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
    reflect(f, s, f.x, POLAR)
    # r² = |x_i − x_j|² [m²]; the pair's index k runs through the rows of all i, which are adjacent.
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xi = f.x[i]
        for k in range(f.first[i], f.first[i] + f.count[i]):
            f.pair[k] = square(xi - f.x[f.neighbour[k]])
    part_from_own(f, s)


@ti.func
def take_seats(f: ti.template(), s, reach):
    """Seat the moving particles of a scene, and find each one's stretches for pairs within `reach`.

    Images of particles within `reach` of the plane of symmetry have seats, too.

    Returns:
        The first seat and the one after the last.
    """
    begin = f.begin[s]
    end = begin + f.moving[s]
    seats = begin + EIGHT * s
    behind = seats + f.moving[s]
    n = f.particles[s]
    table = f.cells_begin[s]
    for i in range(begin, end):
        change_places(f, s, i)
    low, edge, size = cover(f, s, reach, reach * f.mirrored[s])
    cells = size[0] * size[1] * size[2]
    for c in range(table, table + cells + 1):
        f.cell_start[c] = 0
    # Counting sort as in `sort`, of seats only: particles keep their indices.
    for i in range(begin, end):
        c = cell_at(table, f.x[i], low, edge, size)
        f.cell[i] = c
        f.cell_start[c] = f.cell_start[c] + 1
        if f.mirrored[s] == 1 and f.x[i][1] < reach:
            f.x[i + n] = f.x[i] * POLAR
            c = cell_at(table, f.x[i + n], low, edge, size)
            f.cell_start[c] = f.cell_start[c] + 1
            behind += 1
    begin_cells(f, table, cells, seats)
    for i in range(begin, end):
        c = f.cell[i]
        k = f.cell_start[c]
        f.cell_start[c] = k + 1
        f.seated[k] = i
        f.seat[k] = f.x[i] / reach
        f.cell[i] = k  # its seat, for its image
        if f.mirrored[s] == 1 and f.x[i][1] < reach:
            c = cell_at(table, f.x[i + n], low, edge, size)
            k = f.cell_start[c]
            f.cell_start[c] = k + 1
            f.seated[k] = i + n
            f.seat[k] = f.x[i + n] / reach
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
        # The first row of cells holds images alone, unless cells had to become larger: they need no pairs there.
        b0 = ti.cast(f.mirrored[s] == 1 and q[1] == 0 and edge[1] == reach, ti.i32)
        c = k * STRETCHES
        for a in range(q[0], q[0] + 2):
            for b in range(q[1] - 1 + ti.cast(a == q[0], ti.i32), q[1] + 2):
                first = seats
                last = seats
                if a < size[0] and b >= b0 and b < size[1]:
                    column = table + (a * size[1] + b) * size[2]
                    first = k + 1
                    last = f.cell_start[column + c1]
                    if a != q[0] or b != q[1]:
                        first = seats
                        if column + c0 > table:
                            first = f.cell_start[column + c0 - 1]
                f.stretch[c] = ti.Vector([first, last])
                c += 1
    return seats, behind


@ti.func
def in_eights(count):
    """The number rounded up to a multiple of eight; 0 for an empty stretch."""
    return (ti.max(count, 0) + (EIGHT - 1)) & -EIGHT
