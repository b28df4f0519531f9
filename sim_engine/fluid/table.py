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
        fields: by name, each of the shape (scenes,) or (scenes, vessels), of numbers, vectors or matrices.
    """

    def __init__(self, fields: Mapping[str, ti.Field]) -> None:
        self._begin: dict[str, tuple[int, int]] = {}
        self.columns: list[tuple[ti.Field, int, int, int, int]] = []
        """Field, vessel (−1: of the scene), row and column in a matrix (−1: none), column of the table."""
        for name, field in fields.items():
            first = len(self.columns)
            rows, columns = getattr(field, "n", -1), getattr(field, "m", -1)
            parts = [(-1, -1)] if rows < 0 else [(i, -1) for i in range(rows)]
            if isinstance(field, ti.MatrixField) and field.ndim == 2:
                parts = [(i, j) for i in range(rows) for j in range(columns)]
            for vessel in range(field.shape[1]) if len(field.shape) == 2 else [-1]:
                self.columns += [(field, vessel, i, j, len(self.columns) + k) for k, (i, j) in enumerate(parts)]
            self._begin[name] = first, len(self.columns)

    def rows(self, scenes: Sequence[Mapping[str, ArrayLike]]) -> NDArray[np.float64]:
        """The table of some scenes, (scenes, columns); what is not named is 0.

        Args:
            scenes: values by the field's name, with the shape of what the field has of one scene.

        Raises:
            KeyError: no such field.
            ValueError: a value of another size.
        """
        table = np.zeros((len(scenes), len(self.columns)))
        for row, values in zip(table, scenes, strict=True):
            for name, value in values.items():
                begin, end = self._begin[name]
                row[begin:end] = np.reshape(value, end - begin)
        return table

    @ti.func
    def write(self, s, rows: ti.template()):
        """Give a scene what its row of the table says."""
        for field, vessel, i, j, k in ti.static(self.columns):
            if ti.static(vessel < 0 and i < 0):
                field[s] = ti.cast(rows[s, k], field.dtype)
            elif ti.static(vessel < 0):
                field[s][i] = ti.cast(rows[s, k], field.dtype)
            elif ti.static(i < 0):
                field[s, vessel] = ti.cast(rows[s, k], field.dtype)
            elif ti.static(j < 0):
                field[s, vessel][i] = ti.cast(rows[s, k], field.dtype)
            else:
                field[s, vessel][i, j] = ti.cast(rows[s, k], field.dtype)
