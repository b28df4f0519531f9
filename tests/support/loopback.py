"""Loopback addresses that no other process of any test run uses."""

from __future__ import annotations

import random
import socket

_CLAIM = 29000
"""Port that a process binds on each of its addresses, for as long as it lives; no device of the tests uses it."""

_claims: list[socket.socket] = []


def free_address() -> str:
    """An address in 127/8 that belongs to this process from now on, also when several test runs share the machine."""
    chance = random.SystemRandom()  # not the seeded generator: tests may have set it
    while True:
        address = f"127.{chance.randint(64, 254)}.{chance.randint(0, 255)}.{chance.randint(2, 254)}"
        claim = socket.socket()
        try:
            claim.bind((address, _CLAIM))
        except OSError:
            claim.close()
            continue
        _claims.append(claim)
        return address
