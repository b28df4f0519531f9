"""What a controller puts into its frames of real-time data exchange: messages, and the recipes that clients set up.

Source: the manufacturer's RTDE guide; what real clients send was measured.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from actors.arm.ur.rtde import DATA_PACKAGE, FORMATS, TEXT_MESSAGE, package


def text_message(protocol: int, message: str, source: str, level: int) -> bytes:
    """A message for people.

    Args:
        protocol: 1 or 2.
        message, source: text.
        level: 0 exception, 1 error, 2 warning, 3 info.
    """
    body, origin = message.encode()[:255], source.encode()[:255]
    if protocol < 2:
        return package(TEXT_MESSAGE, bytes([level]) + body)
    return package(TEXT_MESSAGE, bytes([len(body)]) + body + bytes([len(origin)]) + origin + bytes([level]))


@dataclass(frozen=True)
class Field:
    """A value that can be read.

    Attributes:
        kind: RTDE type.
        read: the value, a number or a sequence of the type's length.
    """

    kind: str
    read: Callable[[], Any]


class OutputRecipe:
    """What one client is sent.

    Args:
        number: of the recipe; 0 leaves it out, as protocol 1 does.
        fields: in order.
    """

    def __init__(self, number: int, fields: Sequence[Field]) -> None:
        formats = "".join(FORMATS[field.kind][0] for field in fields)
        self._struct = struct.Struct(">HB" + ("B" if number else "") + formats)
        self._head = (self._struct.size, DATA_PACKAGE, *((number,) if number else ()))
        self._single = [FORMATS[field.kind][1] == 1 for field in fields]
        self._read = [field.read for field in fields]

    def package(self) -> bytes:
        """The values now, as a package."""
        values = list(self._head)
        for read, single in zip(self._read, self._single, strict=True):
            if single:
                values.append(read())
            else:
                values.extend(read())
        return self._struct.pack(*values)


class InputRecipe:
    """What one client sends.

    Args:
        fields: names in order.
        kinds: their RTDE types.
    """

    def __init__(self, fields: Sequence[str], kinds: Sequence[str]) -> None:
        self.fields = tuple(fields)
        self._counts = [FORMATS[kind][1] for kind in kinds]
        self._struct = struct.Struct(">" + "".join(FORMATS[kind][0] for kind in kinds))

    def read(self, payload: bytes) -> dict[str, Any] | None:
        """Values by name; None if there are too few or too many bytes for them."""
        if len(payload) != self._struct.size:
            return None
        values = self._struct.unpack(payload)
        found: dict[str, Any] = {}
        place = 0
        for name, count in zip(self.fields, self._counts, strict=True):
            found[name] = values[place] if count == 1 else values[place : place + count]
            place += count
        return found
