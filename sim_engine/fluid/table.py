"""What is kept of every scene, written in one go.

Taichi compiles a kernel for every field that Python writes to or reads from: for sixty fields that was a fifth of the
time that a fresh machine took to answer.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import taichi as ti
from numpy.typing import ArrayLike, NDArray


@ti.data_oriented
class SceneTable:
    """Fields of one value a scene, or of one a vessel of a scene, as the columns of a table.

    Args:
        fields: by name, of the shape (scenes,) numbers or vectors, of (scenes, vessels) numbers, vectors or matrices.
    """

    def __init__(self, fields: Mapping[str, ti.Field]) -> None:
        self._begin: dict[str, tuple[int, int]] = {}
        # Fields with their place in them and their column in the table.
        self.scalars: list[tuple[ti.Field, int]] = []
        self.vectors: list[tuple[ti.Field, int, int]] = []
        self.of_vessels: list[tuple[ti.Field, int, int]] = []
        self.vectors_of_vessels: list[tuple[ti.Field, int, int, int]] = []
        self.matrices_of_vessels: list[tuple[ti.Field, int, int, int, int]] = []
        k = 0
        for name, field in fields.items():
            first = k
            n, m = (field.n, field.m) if isinstance(field, ti.MatrixField) else (0, 0)
            for vessel in range(field.shape[1]) if len(field.shape) == 2 else [None]:
                if vessel is None and n == 0:
                    self.scalars.append((field, k))
                elif vessel is None:
                    self.vectors += [(field, i, k + i) for i in range(n)]
                elif n == 0:
                    self.of_vessels.append((field, vessel, k))
                elif field.ndim == 1:
                    self.vectors_of_vessels += [(field, vessel, i, k + i) for i in range(n)]
                else:
                    places = [(i, j) for i in range(n) for j in range(m)]
                    self.matrices_of_vessels += [(field, vessel, i, j, k + i * m + j) for i, j in places]
                k += max(n, 1) * max(m, 1)
            self._begin[name] = first, k
        self._columns = k

    def rows(self, scenes: Sequence[Mapping[str, ArrayLike]]) -> NDArray[np.float64]:
        """The table of some scenes, (scenes, columns); what is not named is 0.

        Args:
            scenes: values by the field's name, with the shape of what the field has of one scene.

        Raises:
            KeyError: no such field.
            ValueError: a value of another size.
        """
        table = np.zeros((len(scenes), self._columns))
        for row, values in zip(table, scenes, strict=True):
            for name, value in values.items():
                begin, end = self._begin[name]
                row[begin:end] = np.reshape(value, end - begin)
        return table

    @ti.func
    def write(self, s, rows: ti.template()):
        """Give a scene what its row of the table says."""
        for field, k in ti.static(self.scalars):
            field[s] = rows[s, k]
        for field, i, k in ti.static(self.vectors):
            field[s][i] = rows[s, k]
        for field, b, k in ti.static(self.of_vessels):
            field[s, b] = rows[s, k]
        for field, b, i, k in ti.static(self.vectors_of_vessels):
            field[s, b][i] = rows[s, k]
        for field, b, i, j, k in ti.static(self.matrices_of_vessels):
            field[s, b][i, j] = rows[s, k]
