"""Compute how a thick liquid flows out of a turning cup on a grid, with OpenFOAM, as a reference for the solver.

    python benchmarks/grid_outflow.py --viscosity 1.0 [--viscosity 0.1] [--cells 10 13 16 20] [--work DIR] [--slip]

A straight cup (radius 40 mm, height 100 mm) with 200 mL of a Newtonian liquid of 1000 kg/m³ turns about its inner lip
at a constant 30 °/s. The result is the fraction of the liquid that is left at 2.1, 2.3, … 3.5 s. 'Left' is the volume
of liquid in the cylinder below the rim's plane; liquid above this plane or outside the cup has flowed out. The
computation is independent of Decant's solver.

Method: interFoam (finite volumes, volume of fluid, laminar) solves for liquid and air in the frame of the cup, whose
origin is the pivot. In this frame the direction of gravity turns, and centrifugal and Coriolis forces act; the source
term tabulatedAccelerationSource of fvOptions adds all three. The vertical plane through pivot and axis is a plane of
symmetry, so that only half of the cup is computed. Walls are no-slip, or free-slip with `--slip`. The computation
starts at 1.0 s, when the cup is tilted by 30° and nothing flows yet, with liquid at rest in the room and a level
surface. Surface tension is 0.033 N/m with a contact angle of 90°. The air's density is 1 kg/m³. Its viscosity is
1 mPa s, or a fifth of the liquid's if that is less. This is more than that of real air and limits the air's velocities,
which would otherwise determine the time step.

Mesh: cells are parallel to the axes, and each is either inside or outside the cup ('castellated'), so that the wall has
steps of one cell. The Debian build of OpenFOAM 1912 computes wrong cell velocities on meshes whose cells are not
parallel to the axes, such as one that follows the wall. Columns of cells within an effective radius form the cup. This
radius is chosen so that the volume of the cup agrees best with the true one; the printed table has the ratio of the two
volumes. The liquid always has its true volume.

On one core, 1 Pa s takes about 1 minute with 10 cells per radius, 2 minutes with 13, 5 minutes with 16 and 12 minutes
with 20. OpenFOAM is not a dependency of Decant. It was used as Debian's package `openfoam`, version 1912.200626-1+b1.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from machine import say
from numpy.typing import NDArray

from actors.runtime.child_process import ChildProcess
from sim_engine.hydrostatics import GRAVITY
from sim_engine.validation.viscous_flows import TIMES

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
Scalar = TypeVar("Scalar", bound=np.generic)

SOLVER, PACKAGE = "interFoam", "openfoam"
VERSION = "1912.200626-1+b1"
PROJECT_VARIABLE, PROJECT_FOLDER = "WM_PROJECT_DIR", "/usr/share/openfoam"
"""Variable with OpenFOAM's folder of settings, and its value in Debian."""

RADIUS, HEIGHT, WALL = 0.040, 0.100, 0.003
"""Inner radius and height of the cup, and thickness of its wall [m]."""

VOLUME, DENSITY, SURFACE_TENSION = 200e-6, 1000.0, 0.033
"""Of the liquid [m³, kg/m³, N/m]."""

AIR_DENSITY, AIR_VISCOSITY, AIR_SHARE = 1.0, 1e-3, 0.2
"""Density [kg/m³], viscosity [Pa s], and largest ratio of its viscosity to the liquid's."""

SPEED = math.radians(30.0)
"""Angular velocity of the cup [rad/s]."""

START, END = 1.0, TIMES[-1]
"""Start of the computation and the last time of the table [s]. At 0 s the cup is upright."""

MARGIN = 0.01
"""Computed beyond `END`, so that the last time is not extrapolated [s]."""

BESIDE, ABOVE, BELOW = 0.016, 0.020, 0.012
"""How far the mesh extends in front of the lip, above the rim and, outside the cup, below the rim [m]."""

AIR_ONLY_FROM, AIR_ONLY_HEIGHT = -0.008, 0.062
"""Cells behind the first coordinate x are left out if they are above a plane that is parallel to the first surface and
crosses the cup's axis at the second coordinate z. No liquid reaches them, and the faces towards them are open [m]."""

COURANT = 0.5
FEWEST_CELLS, MOST_CELLS = 10, 40
"""Cells per radius; with fewer, the volume of the cup may be off by several percent."""

REPORT_EVERY = 30.0
"""Time between two lines of progress [s]."""

SYMMETRY, OPEN, SOLID = 0, 1, 2
PATCHES = {"symmetry": "symmetryPlane", "outlet": "patch", "wall": "wall"}
"""Type of each patch, in the order of the numbers above."""

POLY_MESH = "constant/polyMesh"


# ---- mesh


@dataclass(frozen=True)
class Mesh:
    """Box of cells of which some are used; x forward over the lip, z upwards along the cup's axis.

    Attributes:
        nodes: coordinates of the planes between cells, per axis; the origin is the centre of the cup's floor [m].
        used: the cells of the computation, with shape (nx, ny, nz).
        cup: those below the rim's plane in the cup.
        air_only: cells left out although air is there; their faces are open.
    """

    nodes: tuple[Floats, Floats, Floats]
    used: Mask
    cup: Mask
    air_only: Mask

    @property
    def centres(self) -> tuple[Floats, Floats, Floats]:
        """Coordinates of the centres, per axis [m]."""
        x, y, z = (middles(line) for line in self.nodes)
        return x, y, z

    @property
    def size(self) -> tuple[float, float]:
        """Edges of a cell across and along the cup's axis [m]."""
        return float(self.nodes[0][1] - self.nodes[0][0]), float(self.nodes[2][1] - self.nodes[2][0])

    @property
    def numbers(self) -> Integers:
        """Number of each cell in OpenFOAM's files, x fastest; -1: not used."""
        numbers = np.full(self.used.shape, -1, dtype=np.int64)
        numbers.T[self.used.T] = np.arange(np.count_nonzero(self.used))
        return numbers

    @property
    def indices(self) -> tuple[Integers, Integers, Integers]:
        """Indices of the used cells in the order of their numbers, per axis."""
        k, j, i = np.nonzero(self.used.T)
        return i, j, k

    @property
    def positions(self) -> Floats:
        """Centres of the used cells (n, 3) in the order of their numbers [m]."""
        return np.stack([c[i] for c, i in zip(self.centres, self.indices, strict=True)], axis=1)

    @property
    def volume_ratio(self) -> float:
        """Volume of the mesh's cup over the true one."""
        across, _ = self.size
        columns = np.count_nonzero(self.cup.any(axis=2))
        return float(2.0 * columns * across**2 / (np.pi * RADIUS**2))


def make_mesh(cells: int) -> Mesh:
    """Return the mesh of half a cup and of the air around its lip.

    Args:
        cells: number of cells per radius.
    """
    across = RADIUS / cells
    layers = round(HEIGHT / across)
    along = HEIGHT / layers
    nodes = (
        planes(-cells, cells + round(BESIDE / across), across),
        planes(0, cells, across),
        planes(0, layers + round(ABOVE / along), along),
    )
    x, y, z = (middles(line) for line in nodes)
    from_axis = np.hypot(x[:, None], y[None, :])
    column = inside_columns(from_axis, x, across)
    below_rim = np.arange(len(z)) < layers
    cup = column[:, :, None] & below_rim
    beside = ~column & (from_axis > RADIUS + WALL) & (x[:, None] > 0.0)
    around = beside[:, :, None] & (z > HEIGHT - BELOW)
    surface = AIR_ONLY_HEIGHT + math.tan(SPEED * START) * x[:, None]
    unreached = (x[:, None] < AIR_ONLY_FROM) & (z > surface)
    used = cup | around | ~below_rim
    air_only = used & unreached[:, None, :]
    return Mesh(nodes, used & ~air_only, cup & ~air_only, air_only)


def planes(first: int, last: int, width: float) -> Floats:
    """Return coordinates of the planes between cells of a width [m], from the first multiple of it to the last."""
    return np.array([number * width for number in range(first, last + 1)])


def middles(line: Floats) -> Floats:
    """Return the centres of cells from the planes between them [m]."""
    centres: Floats = 0.5 * (line[1:] + line[:-1])
    return centres


def inside_columns(from_axis: Floats, x: Floats, across: float) -> Mask:
    """Return the columns of cells within the effective radius, for which the area agrees best with the true one.

    Args:
        from_axis: distance of each column's centre from the axis (nx, ny) [m].
        x: centres of the columns [m].
        across: edge of a cell [m].
    """
    wanted = 0.5 * np.pi * (RADIUS / across) ** 2
    near = (from_axis > 0.9 * RADIUS) & (from_axis < 1.1 * RADIUS)
    choices = [from_axis < radius + 1e-9 for radius in np.unique(from_axis[near].round(9))]
    within = [columns for columns in choices if not columns[x > RADIUS].any()]
    return min(within, key=lambda columns: abs(np.count_nonzero(columns) - wanted))


@dataclass(frozen=True)
class Faces:
    """Faces in the order of OpenFOAM's files: those between two cells, then those of each patch.

    Attributes:
        corners: numbers of their nodes in the box (F, 4), counter-clockwise as seen from outside the owner.
        owner: number of the first cell (F,).
        neighbour: number of the second cell, of faces between two cells.
        of_patch: numbers of faces in the patches.
    """

    corners: Integers
    owner: Integers
    neighbour: Integers
    of_patch: tuple[int, int, int]


def faces(mesh: Mesh) -> Faces:
    """Return the faces of a mesh's used cells."""
    inner: list[tuple[Integers, Integers, Integers]] = []
    outer: list[tuple[Integers, Integers, Integers]] = []
    for axis in range(3):
        low, high = both_sides(mesh.numbers, axis, -1)
        between = (low >= 0) & (high >= 0)
        inner.append((corners(mesh, axis, between), low[between], high[between]))
        for side, owner, other in ((1, low, high), (-1, high, low)):
            bounding = (owner >= 0) & (other < 0)
            turned = corners(mesh, axis, bounding)[:, ::side]
            outer.append((turned, owner[bounding], patch(mesh, axis, side, bounding)))
    corner, owner, neighbour = (np.concatenate(parts) for parts in zip(*inner, strict=True))
    outer_corner, outer_owner, patches = (np.concatenate(parts) for parts in zip(*outer, strict=True))
    order, by_patch = np.lexsort((neighbour, owner)), np.argsort(patches, kind="stable")
    of_patch = [int(np.count_nonzero(patches == number)) for number in (SYMMETRY, OPEN, SOLID)]
    return Faces(
        np.concatenate([corner[order], outer_corner[by_patch]]),
        np.concatenate([owner[order], outer_owner[by_patch]]),
        neighbour[order],
        (of_patch[0], of_patch[1], of_patch[2]),
    )


def both_sides(values: NDArray[Scalar], axis: int, outside: int) -> tuple[NDArray[Scalar], NDArray[Scalar]]:
    """Return the values of the cells on the lower and on the upper side of all faces that are normal to an axis.

    Args:
        values: of cells (nx, ny, nz).
        axis: 0, 1 or 2.
        outside: the value outside the box.
    """
    width = [(0, 0)] * 3
    width[axis] = (1, 1)
    padded = np.moveaxis(np.pad(values, width, constant_values=outside), axis, 0)
    return np.moveaxis(padded[:-1], 0, axis), np.moveaxis(padded[1:], 0, axis)


def corners(mesh: Mesh, axis: int, chosen: Mask) -> Integers:
    """Return the nodes (F, 4) of the chosen faces, counter-clockwise as seen from the upper side of the axis."""
    shape = tuple(len(line) for line in mesh.nodes)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    numbers = []
    for steps in ((0, 0), (1, 0), (1, 1), (0, 1)):
        node = list(np.nonzero(chosen))
        node[first], node[second] = node[first] + steps[0], node[second] + steps[1]
        numbers.append(np.ravel_multi_index(tuple(node), shape, order="F"))
    return np.stack(numbers, axis=1).astype(np.int64)


def patch(mesh: Mesh, axis: int, side: int, chosen: Mask) -> Integers:
    """Return the patches of the chosen faces.

    Args:
        mesh: the mesh.
        axis: the axis to which the faces are normal.
        side: 1 if they are on the upper side of their cells, else -1.
        chosen: mask of the faces; its shape has one more along the axis than that of the cells.
    """
    index = np.nonzero(chosen)
    lines = list(mesh.centres)
    lines[axis] = mesh.nodes[axis]
    x, _, z = (line[i] for line, i in zip(lines, index, strict=True))
    at_edge = (index[axis] == 0) | (index[axis] == len(mesh.nodes[axis]) - 1)
    above, beyond = z > HEIGHT, x > RADIUS
    low, high = both_sides(mesh.air_only, axis, 0)
    is_open = (high if side > 0 else low)[chosen]
    if axis == 0:
        is_open |= at_edge & (above | (side > 0))
    elif axis == 1:
        is_open |= at_edge & (side > 0) & (above | beyond)
    elif side > 0:
        is_open |= at_edge
    else:
        is_open |= beyond & (z < HEIGHT - 0.5 * mesh.size[1])
    patches = np.where(is_open, OPEN, SOLID)
    return np.where(at_edge & (axis == 1) & (side < 0), SYMMETRY, patches)


def write_mesh(case: Path, mesh: Mesh) -> None:
    """Write the mesh with the pivot as origin, and the zone 'cup'."""
    found = faces(mesh)
    used, corner = np.unique(found.corners, return_inverse=True)
    node = np.unravel_index(used, tuple(len(line) for line in mesh.nodes), order="F")
    x, y, z = (line[i] for line, i in zip(mesh.nodes, node, strict=True))
    points = np.stack([x - RADIUS, y, z - HEIGHT], axis=1)
    quads = [f"4{vector(quad, 'd')}" for quad in corner.reshape(-1, 4).tolist()]
    write(case, POLY_MESH, "points", "vectorField", counted([vector(point) for point in points.tolist()]))
    write(case, POLY_MESH, "faces", "faceList", counted(quads))
    write(case, POLY_MESH, "owner", "labelList", counted(map(str, found.owner.tolist())))
    write(case, POLY_MESH, "neighbour", "labelList", counted(map(str, found.neighbour.tolist())))
    patches, first = [], len(found.neighbour)
    for (name, kind), number in zip(PATCHES.items(), found.of_patch, strict=True):
        patches.append(entries({name: {"type": kind, "nFaces": number, "startFace": first}}))
        first += number
    write(case, POLY_MESH, "boundary", "polyBoundaryMesh", counted(patches))
    labels = counted(map(str, np.sort(mesh.numbers[mesh.cup]).tolist()))
    zone = entries({"cup": {"type": "cellZone", "cellLabels": f"List<label>\n{labels}"}})
    write(case, POLY_MESH, "cellZones", "regIOobject", counted([zone]))


# ---- files of a case


def write(case: Path, folder: str, name: str, kind: str, text: str) -> None:
    """Write a file of a case.

    Args:
        case: folder of the case.
        folder: folder of the file in it.
        name: name of the file.
        kind: OpenFOAM's class of its content.
        text: its content.
    """
    path = case / folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"version": "2.0", "format": "ascii", "class": kind, "location": f'"{folder}"', "object": name}
    path.write_text(entries({"FoamFile": header}) + "\n" + text + "\n", encoding="ascii")


def write_entries(case: Path, folder: str, name: str, content: Mapping[str, object]) -> None:
    """Write a dictionary file of a case."""
    write(case, folder, name, "dictionary", entries(content))


def entries(content: Mapping[str, object]) -> str:
    """Return the lines of an OpenFOAM dictionary."""
    lines = []
    for key, value in content.items():
        if isinstance(value, Mapping):
            lines.append(f"{key}\n{{\n{entries(value)}\n}}")
        else:
            lines.append(f"{key} {f'{value:.9g}' if isinstance(value, float) else value};")
    return "\n".join(lines)


def counted(items: Iterable[str]) -> str:
    """Return an OpenFOAM list with its number of items."""
    lines = list(items)
    return "\n".join([str(len(lines)), "(", *lines, ")"])


def vector(values: Sequence[float], form: str = ".9g") -> str:
    """Return numbers as OpenFOAM writes a vector."""
    return f"({' '.join(format(value, form) for value in values)})"


def write_case(case: Path, mesh: Mesh, viscosity: float, cells: int, slip: bool) -> None:
    """Write all files that the solver reads.

    Args:
        case: folder to write.
        mesh: the mesh.
        viscosity: dynamic viscosity of the liquid [Pa s].
        cells: number of cells per radius.
        slip: whether liquid slips along the walls.
    """
    write_mesh(case, mesh)
    write_start(case, mesh, slip)
    write_liquids(case, viscosity)
    write_accelerations(case)
    write_numerics(case, viscosity, cells)


def write_start(case: Path, mesh: Mesh, slip: bool) -> None:
    """Write the fields at the start: liquid at rest in the room, level in the tilted cup."""
    filled = fill_level(mesh)
    from_pivot = mesh.positions - np.array([RADIUS, 0.0, HEIGHT])
    velocity = -np.cross([0.0, SPEED, 0.0], from_pivot) * (filled > 0.0)[:, None]
    fractions = counted(f"{fraction:.8g}" for fraction in filled.tolist())
    velocities = counted(vector(each, ".8g") for each in velocity.tolist())
    write_field(
        case,
        ("alpha.water", "volScalarField", "[0 0 0 0 0 0 0]"),
        f"nonuniform List<scalar>\n{fractions}",
        outlet={"type": "inletOutlet", "inletValue": "uniform 0", "value": "uniform 0"},
        wall={"type": "zeroGradient"},
    )
    write_field(
        case,
        ("U", "volVectorField", "[0 1 -1 0 0 0 0]"),
        f"nonuniform List<vector>\n{velocities}",
        outlet={"type": "pressureInletOutletVelocity", "value": "uniform (0 0 0)"},
        wall={"type": "slip" if slip else "noSlip"},
    )
    write_field(
        case,
        ("p_rgh", "volScalarField", "[1 -1 -2 0 0 0 0]"),
        "uniform 0",
        outlet={"type": "prghTotalPressure", "p0": "uniform 0", "value": "uniform 0"},
        wall={"type": "fixedFluxPressure", "value": "uniform 0"},
    )


def write_field(
    case: Path, field: tuple[str, str, str], values: str, outlet: Mapping[str, object], wall: Mapping[str, object]
) -> None:
    """Write a field at the start.

    Args:
        case: folder of the case.
        field: name, class and dimensions.
        values: of the cells.
        outlet: condition at the open faces.
        wall: condition at the walls.
    """
    name, kind, dimensions = field
    conditions = {"symmetry": {"type": "symmetryPlane"}, "outlet": outlet, "wall": wall}
    content = {"dimensions": dimensions, "internalField": values, "boundaryField": conditions}
    write(case, f"{START:g}", name, kind, entries(content))


def fill_level(mesh: Mesh) -> Floats:
    """Return the liquid's share of each used cell at the start; the surface is level in the tilted cup."""
    across, along = mesh.size
    x, _, z = mesh.positions.T
    in_cup = mesh.cup[mesh.indices]
    parts = x[:, None] + ((np.arange(8) + 0.5) / 8 - 0.5) * across

    def filled(height: float) -> Floats:
        surface = height + parts * math.tan(SPEED * START)
        shares: Floats = np.clip((surface - (z - 0.5 * along)[:, None]) / along, 0.0, 1.0).mean(axis=1)
        return shares * in_cup

    low, high = 0.0, HEIGHT
    for _ in range(50):
        middle = 0.5 * (low + high)
        if 2.0 * filled(middle).sum() * across**2 * along > VOLUME:
            high = middle
        else:
            low = middle
    return filled(low)


def write_liquids(case: Path, viscosity: float) -> None:
    """Write the properties of liquid and air; viscosity [Pa s]."""
    air = min(AIR_VISCOSITY, AIR_SHARE * viscosity)
    phases = {
        "phases": "(water air)",
        "water": {"transportModel": "Newtonian", "nu": viscosity / DENSITY, "rho": DENSITY},
        "air": {"transportModel": "Newtonian", "nu": air / AIR_DENSITY, "rho": AIR_DENSITY},
        "sigma": SURFACE_TENSION,
    }
    write_entries(case, "constant", "transportProperties", phases)
    write_entries(case, "constant", "turbulenceProperties", {"simulationType": "laminar"})


def write_accelerations(case: Path) -> None:
    """Write gravity as for the upright cup, and the table of what the turning adds to it, for each 0.02 s."""
    gravity = {"dimensions": "[0 1 -2 0 0 0 0]", "value": vector((0.0, 0.0, -GRAVITY))}
    write(case, "constant", "g", "uniformDimensionedVectorField", entries(gravity))
    rows = []
    for now in np.arange(-5, 210) * 0.02:
        angle = SPEED * now
        added = (-GRAVITY * np.sin(angle), 0.0, GRAVITY * (np.cos(angle) - 1.0))
        turning = f"{vector(added)} {vector((0.0, SPEED, 0.0))} {vector((0.0, 0.0, 0.0))}"
        rows.append(f"({now:.6g} ({turning}))")
    (case / "constant" / "accelerations.dat").write_text("(\n" + "\n".join(rows) + "\n)\n", encoding="ascii")
    source = {
        "type": "tabulatedAccelerationSource",
        "active": "yes",
        "selectionMode": "all",
        "U": "U",
        "timeDataFileName": '"$FOAM_CASE/constant/accelerations.dat"',
    }
    write_entries(case, "constant", "fvOptions", {"turning": source})


def write_numerics(case: Path, viscosity: float, cells: int) -> None:
    """Write time steps, schemes and tolerances.

    Part of the viscous force is explicit. Thick liquids therefore need several outer iterations per step, and the
    thickest shorter steps on finer meshes.

    Args:
        case: folder of the case.
        viscosity: [Pa s].
        cells: number of cells per radius.
    """
    outer, corrections = (3, 2) if viscosity >= 0.5 else (2, 2) if viscosity >= 0.05 else (1, 3)
    longest = 200 // cells * 1e-4 if viscosity >= 0.5 else 2e-3
    left = {
        "type": "volFieldValue",
        "libs": "(fieldFunctionObjects)",
        "writeControl": "timeStep",
        "writeInterval": 1,
        "log": "no",
        "writeFields": "no",
        "regionType": "cellZone",
        "name": "cup",
        "operation": "volIntegrate",
        "fields": "(alpha.water)",
    }
    control = {
        "application": SOLVER,
        "startFrom": "startTime",
        "startTime": START,
        "stopAt": "endTime",
        "endTime": END + MARGIN,
        "deltaT": 2e-4,
        "adjustTimeStep": "yes",
        "maxCo": COURANT,
        "maxAlphaCo": COURANT,
        "maxDeltaT": longest,
        "writeControl": "adjustableRunTime",
        "writeInterval": 0.2,
        "writeFormat": "ascii",
        "writePrecision": 6,
        "timePrecision": 8,
        "runTimeModifiable": "no",
        "libs": "(fvOptions)",
        "functions": {"left": left},
    }
    schemes = {
        "ddtSchemes": {"default": "Euler"},
        "gradSchemes": {"default": "Gauss linear"},
        "divSchemes": {
            "default": "none",
            "div(rhoPhi,U)": "Gauss linearUpwind grad(U)",
            "div(phi,alpha)": "Gauss vanLeer",
            "div(phirb,alpha)": "Gauss linear",
            "div(((rho*nuEff)*dev2(T(grad(U)))))": "Gauss linear",
        },
        "laplacianSchemes": {"default": "Gauss linear corrected"},
        "interpolationSchemes": {"default": "linear"},
        "snGradSchemes": {"default": "corrected"},
    }
    smooth = {"solver": "smoothSolver", "smoother": "symGaussSeidel", "tolerance": 1e-8}
    multigrid = {"solver": "GAMG", "smoother": "DICGaussSeidel"}
    interface = {"nAlphaCorr": 2, "nAlphaSubCycles": 1, "cAlpha": 1, "MULESCorr": "yes", "nLimiterIter": 5}
    solution = {
        "solvers": {
            '"alpha.water.*"': {**interface, **smooth, "relTol": 0},
            '"pcorr.*"': {"solver": "PCG", "preconditioner": "DIC", "tolerance": 1e-6, "relTol": 0.01},
            "p_rgh": {**multigrid, "tolerance": 1e-6, "relTol": 0.02},
            "p_rghFinal": {**multigrid, "tolerance": 1e-5, "relTol": 0.001},
            '"U.*"': {**smooth, "relTol": 0.001},
        },
        "PIMPLE": {
            "momentumPredictor": "yes",
            "nOuterCorrectors": outer,
            "nCorrectors": corrections,
            "nNonOrthogonalCorrectors": 0,
        },
        "relaxationFactors": {"equations": {'".*"': 1}},
    }
    write_entries(case, "system", "controlDict", control)
    write_entries(case, "system", "fvSchemes", schemes)
    write_entries(case, "system", "fvSolution", solution)


# ---- runs


def course(case: Path) -> tuple[Floats, Floats]:
    """Return times [s] and the fraction left at them; empty before the first step."""
    files = sorted(case.glob("postProcessing/left/*/volFieldValue.dat"))
    lines = [line.split() for file in files for line in file.read_text(encoding="ascii").splitlines()]
    # The solver may be writing the last line.
    rows = np.array([[float(value) for value in line] for line in lines if line[0] != "#" and len(line) == 2])
    rows = rows.reshape(-1, 2)
    return rows[:, 0], 2.0 * rows[:, 1] / VOLUME


def finished(case: Path) -> bool:
    """Return whether a case has been computed to the end."""
    times, _ = course(case)
    return len(times) > 0 and float(times[-1]) >= END


def solve(case: Path, name: str) -> None:
    """Run the solver, and report its progress. It ends with this process.

    Args:
        case: its folder.
        name: for the reports.

    Raises:
        SystemExit: the solver failed; the message has the end of its output.
    """
    log = case / "log"
    folder = os.environ.get(PROJECT_VARIABLE, PROJECT_FOLDER)
    begun = time.monotonic()
    with log.open("wb") as output:
        child = ChildProcess(
            [SOLVER, "-case", str(case)],
            environment={PROJECT_VARIABLE: folder},
            input=False,
            output=False,
            errors=output,
            dies_with_parent=True,
        )
        try:
            while not child.wait(REPORT_EVERY):
                times, left = course(case)
                if len(times):
                    say(f"{name}: {times[-1]:.2f} of {END:g} s, {left[-1]:.3f} left")
        finally:
            child.close(grace=2.0, terminate=child.alive)
    if child.status != 0 or not finished(case):
        said = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-12:]
        raise SystemExit(f"{name}: {SOLVER} ended with {child.status}:\n" + "\n".join(said))
    say(f"{name}: finished in {time.monotonic() - begun:.0f} s")


def outflow(work: Path, viscosity: float, cells: int, slip: bool) -> list[str]:
    """Compute one case unless it is finished, and return its row of the table.

    Args:
        work: folder of all cases.
        viscosity: [Pa s].
        cells: number of cells per radius.
        slip: whether liquid slips along the walls.
    """
    case = work / f"viscosity-{viscosity:g}-cells-{cells}{'-slip' if slip else ''}"
    mesh = make_mesh(cells)
    name = f"{viscosity:g} Pa s, {cells} cells per radius"
    if finished(case):
        say(f"{name}: was finished before, in {case}")
    else:
        shutil.rmtree(case, ignore_errors=True)
        say(f"{name}: {np.count_nonzero(mesh.used):,} cells")
        write_case(case, mesh, viscosity, cells, slip)
        solve(case, name)
    left = np.interp(TIMES, *course(case))
    return [f"{viscosity:g}", str(cells), f"{mesh.volume_ratio:.4f}", *(f"{fraction:.3f}" for fraction in left)]


def positive(text: str) -> float:
    """Return a positive number of the command line."""
    value = float(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def cell_number(text: str) -> int:
    """Return a number of cells per radius of the command line."""
    value = int(text)
    if not FEWEST_CELLS <= value <= MOST_CELLS:
        raise argparse.ArgumentTypeError(f"{text}: {FEWEST_CELLS} to {MOST_CELLS} cells per radius are possible")
    return value


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--viscosity",
        type=positive,
        action="append",
        required=True,
        metavar="PA_S",
        help="dynamic viscosity of the liquid [Pa s]; may be given several times",
    )
    parser.add_argument(
        "--cells",
        type=cell_number,
        nargs="+",
        default=[10, 13, 16, 20],
        metavar="N",
        help="numbers of cells per radius (40 mm) (default: 10 13 16 20)",
    )
    parser.add_argument(
        "--work",
        type=Path,
        metavar="DIR",
        help="keep cases and logs in this folder, and do not repeat finished ones (default: a temporary folder)",
    )
    parser.add_argument("--slip", action="store_true", help="free-slip walls instead of no-slip walls")
    return parser.parse_args()


def main() -> None:
    """Run the command line."""
    asked = arguments()
    if shutil.which(SOLVER) is None:
        say(f"{SOLVER} is not on the PATH: install OpenFOAM (Debian package {PACKAGE}; used: {VERSION})")
        raise SystemExit(2)
    rows = [["viscosity, Pa s", "cells per radius", "volume of the cup", *(f"{t:g} s" for t in TIMES)]]
    try:
        with tempfile.TemporaryDirectory(prefix="decant-grid-") as scratch:
            work: Path = asked.work.resolve() if asked.work else Path(scratch)
            for viscosity in asked.viscosity:
                rows += [outflow(work, viscosity, cells, asked.slip) for cells in asked.cells]
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    print("fraction left in the cup, " + ("walls with slip" if asked.slip else "walls without slip"))
    for row in rows:
        print(" | ".join(row))


if __name__ == "__main__":
    main()
