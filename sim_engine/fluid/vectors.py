"""Products of vectors in space, written out: Taichi's own ones, for any shape, make kernels a third larger, and their
compiling and looking up that much slower."""

import taichi as ti


@ti.func
def dot(a, b):
    """a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@ti.func
def square(a):
    """|a|²."""
    return a[0] * a[0] + a[1] * a[1] + a[2] * a[2]


@ti.func
def length(a):
    """|a|."""
    return ti.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@ti.func
def turned(m, a):
    """m a, of a rotation matrix."""
    return ti.Vector(
        [
            m[0, 0] * a[0] + m[0, 1] * a[1] + m[0, 2] * a[2],
            m[1, 0] * a[0] + m[1, 1] * a[1] + m[1, 2] * a[2],
            m[2, 0] * a[0] + m[2, 1] * a[1] + m[2, 2] * a[2],
        ]
    )


@ti.func
def turned_back(m, a):
    """mᵀ a, of a rotation matrix."""
    return ti.Vector(
        [
            m[0, 0] * a[0] + m[1, 0] * a[1] + m[2, 0] * a[2],
            m[0, 1] * a[0] + m[1, 1] * a[1] + m[2, 1] * a[2],
            m[0, 2] * a[0] + m[1, 2] * a[1] + m[2, 2] * a[2],
        ]
    )
