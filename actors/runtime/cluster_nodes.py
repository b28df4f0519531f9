"""Nodes of a Ray cluster, and the software versions on them.

`PinnedNode` places an actor on one node and reports whether that node has died. `Versions` holds the versions that must
be the same on every machine of a cluster, so that a task has the same outcome on each of them.

This module does not check a cluster before it is used; `actors.runtime.cluster_check` does.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hashlib
import importlib.metadata
import sys
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

_PATIENCE = 2.0
"""Longest time for a node's own process to accept a connection [s]."""


@dataclass(frozen=True)
class Node:
    """A node, as listed by Ray.

    Attributes:
        id: Ray's id of the node.
        host: name and address, for messages.
        address, port: of the node's raylet, a process that every node has.
        cpus: cores that Ray assigns.
    """

    id: str
    host: str
    address: str
    port: int
    cpus: int


def living_nodes() -> dict[str, Node]:
    """The nodes that Ray lists as alive, by id. Blocks for some milliseconds."""
    import ray

    return {
        node["NodeID"]: Node(
            node["NodeID"],
            f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})",
            node["NodeManagerAddress"],
            int(node["NodeManagerPort"]),
            int(node["Resources"].get("CPU", 0.0)),
        )
        for node in ray.nodes()
        if node["Alive"]
    }


@dataclass(frozen=True)
class PinnedNode:
    """One node, for actors that may run only there.

    Attributes:
        node: the node.
        options: Ray's options that place an actor there.
    """

    node: Node
    options: Mapping[str, Any]

    async def is_gone(self) -> bool:
        """Whether the node has died.

        Ray itself needs fifteen seconds to detect this; a dead node's raylet refuses connections at once. If a
        connection times out, a packet may have been lost: then Ray decides."""
        try:
            _, writer = await asyncio.wait_for(
                asyncio.open_connection(self.node.address, self.node.port), timeout=_PATIENCE
            )
            writer.close()
            await writer.wait_closed()
            return False
        except ConnectionRefusedError:
            return True
        except (OSError, TimeoutError):
            with contextlib.suppress(Exception):  # the head may have died, too
                return self.node.id not in await asyncio.to_thread(living_nodes)
            return False


def this_node() -> PinnedNode:
    """The node that this program is connected to; the program cannot continue without it."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    id_ = ray.get_runtime_context().get_node_id()
    strategy = NodeAffinitySchedulingStrategy(id_, soft=False)
    return PinnedNode(living_nodes()[id_], {"scheduling_strategy": strategy})


@dataclass(frozen=True)
class Versions:
    """The versions on one machine.

    Attributes:
        python: e.g. '3.11.7'.
        decant: the installed package's.
        simulator: digest of the simulator's sources; a checkout may have changed without a new version.
        taichi: it compiles the solver.
        numpy: it makes the initial positions.
    """

    python: str
    decant: str
    simulator: str
    taichi: str
    numpy: str

    def difference(self, other: Versions) -> str | None:
        """The first version in which two machines differ, as a message; None if all are equal.

        Args:
            other: versions of the other machine.
        """
        for field in fields(self):
            ours, theirs = getattr(self, field.name), getattr(other, field.name)
            if ours != theirs:
                what = "the simulator's code" if field.name == "simulator" else field.name.capitalize()
                return f"{what}: {theirs} there, {ours} here"
        return None


@functools.cache
def versions() -> Versions:
    """The versions on this machine."""
    return Versions(
        python=sys.version.split()[0],
        decant=_installed("decant"),
        simulator=sources(Path(__file__).parents[2] / "sim_engine"),
        taichi=_installed("taichi"),
        numpy=_installed("numpy"),
    )


def _installed(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def sources(folder: Path) -> str:
    """Digest of a folder's Python sources."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        if path.parent.name == "validation":
            continue  # it evaluates outcomes but does not produce any
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]
