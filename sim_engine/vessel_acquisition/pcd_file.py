"""Points of a PCD file (Point Cloud Library), in all three encodings.

A header of text names the fields of each point with their sizes, types and counts; the points follow as text, as
records, or compressed. Compressed files store one field after the other, and are compressed by LZF; some writers store
them uncompressed if that is not larger. Fields called `_` are padding. Points without a measurement are NaN.

Sources: The PCD file format, pointclouds.org; LibLZF by M. Lehmann, for the compression.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.shapes import VesselError

Floats = NDArray[np.float64]

LONGEST_HEADER = 10_000
"""Bytes in which a header has to end."""

MOST_POINTS = 20_000_000

KINDS = {"F": "f", "I": "i", "U": "u"}
"""Type in the header → kind of a NumPy type."""


@dataclass(frozen=True)
class _Header:
    names: list[str]
    sizes: list[int]
    kinds: list[str]
    counts: list[int]
    points: int
    encoding: str

    def record(self) -> np.dtype[np.void]:
        """Type of one point."""
        return np.dtype(
            [
                (f"{k}:{name}", f"<{KINDS[kind]}{size}", (count,))
                for k, (name, size, kind, count) in enumerate(
                    zip(self.names, self.sizes, self.kinds, self.counts, strict=True)
                )
            ]
        )

    def axes(self) -> list[int]:
        """Places of x, y and z among the fields."""
        return [self.names.index(axis) for axis in "xyz"]


def read_pcd(path: Path) -> Floats:
    """Read the positions, shape (n, 3) in the file's unit; NaN for points without a measurement.

    Raises:
        VesselError: it is not a complete PCD file with x, y and z.
        OSError: it cannot be read.
    """
    content = path.read_bytes()
    try:
        header, start = _header(content)
        body = content[start:]
        if header.encoding == "ascii":
            return _from_text(header, body)
        if header.encoding == "binary":
            return _from_records(header, body)
        return _from_columns(header, body)
    except (ValueError, IndexError, KeyError, struct.error, TypeError) as problem:
        if isinstance(problem, VesselError):
            raise VesselError(f"{path.name}: {problem}") from None
        raise VesselError(f"{path.name}: is a damaged PCD file ({problem})") from problem


def _header(content: bytes) -> tuple[_Header, int]:
    entries: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in entries:
        end = content.find(b"\n", start, LONGEST_HEADER)
        if end < 0:
            raise VesselError("is not a PCD file: its header has no line 'DATA'")
        words = content[start:end].decode("ascii", errors="replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    names = entries.get("FIELDS") or entries.get("COLUMNS") or []
    if not set("xyz") <= set(names):
        raise VesselError(f"has the fields {', '.join(names) or 'none'}; should have x, y and z")
    sizes = [int(size) for size in entries.get("SIZE", ["4"] * len(names))]
    kinds = entries.get("TYPE", ["F"] * len(names))
    counts = [int(count) for count in entries.get("COUNT", ["1"] * len(names))]
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise VesselError("its header gives FIELDS, SIZE, TYPE and COUNT of different lengths")
    encoding = (entries["DATA"] or ["nothing"])[0].lower()
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise VesselError(f"has DATA {encoding}; should be ascii, binary or binary_compressed")
    points = int(entries["POINTS"][0]) if "POINTS" in entries else int(entries["WIDTH"][0]) * int(entries["HEIGHT"][0])
    if not 0 <= points <= MOST_POINTS:
        raise VesselError(f"has {points:,} points; at most {MOST_POINTS:,} are read")
    return _Header(names, sizes, kinds, counts, points, encoding), start


def _from_text(header: _Header, body: bytes) -> Floats:
    first = np.cumsum([0, *header.counts])
    rows = np.loadtxt(
        body.decode("ascii", errors="replace").splitlines(),
        usecols=[int(first[k]) for k in header.axes()],
        ndmin=2,
    )
    if len(rows) < header.points:
        raise VesselError(f"has {len(rows):,} of {header.points:,} points: it was cut off")
    return rows[: header.points]


def _from_records(header: _Header, body: bytes) -> Floats:
    record = header.record()
    if len(body) < header.points * record.itemsize:
        raise VesselError(f"has {len(body) // record.itemsize:,} of {header.points:,} points: it was cut off")
    rows = np.frombuffer(body, dtype=record, count=header.points)
    assert record.names is not None
    return np.column_stack([rows[record.names[k]][:, 0].astype(float) for k in header.axes()])


def _from_columns(header: _Header, body: bytes) -> Floats:
    small, large = struct.unpack_from("<II", body)
    widths = [size * count for size, count in zip(header.sizes, header.counts, strict=True)]
    if large != header.points * sum(widths):
        raise VesselError(
            f"has {large:,} bytes of points; {header.points:,} points need {header.points * sum(widths):,}"
        )
    if len(body) < 8 + small:
        raise VesselError(f"has {len(body) - 8:,} of {small:,} compressed bytes: it was cut off")
    data = body[8 : 8 + small] if small == large else _expanded(body[8 : 8 + small], large)
    starts = np.cumsum([0, *widths]) * header.points
    columns = []
    for k in header.axes():
        kind = np.dtype(f"<{KINDS[header.kinds[k]]}{header.sizes[k]}")
        column = np.frombuffer(data, dtype=kind, count=header.points * header.counts[k], offset=int(starts[k]))
        columns.append(column[:: header.counts[k]].astype(float))
    return np.column_stack(columns)


def _expanded(data: bytes, size: int) -> bytes:
    """Decompress LZF: runs of literals, and copies of what came before."""
    out = bytearray()
    at, end = 0, len(data)
    while at < end:
        control = data[at]
        at += 1
        if control < 32:
            out += data[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[at]
            at += 1
        back = ((control & 31) << 8) + data[at] + 1
        at += 1
        length += 2
        start = len(out) - back
        if start < 0:
            raise VesselError("its compressed points refer to a place before their beginning")
        if length <= back:
            out += out[start : start + length]
        else:  # the copy overlaps itself: it repeats what it has just written
            piece = bytes(out[start:])
            out += (piece * (length // back + 1))[:length]
        if len(out) > size:
            break
    if len(out) != size:
        raise VesselError(f"its compressed points have {len(out):,} bytes instead of {size:,}")
    return bytes(out)
