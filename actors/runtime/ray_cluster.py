"""A laboratory on a Ray cluster: which nodes simulate, which node has the bench, and how their losses are reported.

`JoinedCluster` reserves the bench and polls the nodes. It does not join the cluster; `actors.runtime.ray_runtime` does.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from actors.interfaces import LaboratoryError, Notice
from actors.laboratory_settings import RaySettings
from actors.runtime.cluster_nodes import Node, PinnedNode, living_nodes, this_node

LOOK_INTERVAL = 2.0
"""Time between two polls of the nodes [s]."""

RESERVE_DEADLINE = 20.0
"""Longest time to reserve the bench [s]."""

CLOSE_DEADLINE = 10.0
"""Longest time to release the bench [s]."""


@dataclass
class JoinedCluster:
    """The cluster that this program has joined, until it leaves.

    Args:
        spec: the cluster.
        tell: called with a message when nodes join or leave.
        bench_lost: called with the reason when the bench's node has died.
        here_lost: called with the reason when the node that this program is connected to has died. Ray may end the
            program earlier.
        grown: called with the number of cores when it increases.
    """

    spec: RaySettings
    tell: Callable[[Notice], None]
    bench_lost: Callable[[str], None]
    here_lost: Callable[[str], None]
    grown: Callable[[int], None] = lambda cpus: None
    bench: PinnedNode | None = None
    here: PinnedNode = field(init=False)
    _nodes: dict[str, Node] = field(default_factory=dict)
    _dead: set[str] = field(default_factory=set)
    _bundle: Any = None
    _polling: asyncio.Task[None] | None = None

    @property
    def cpus(self) -> int:
        """Cores of all nodes."""
        return sum(node.cpus for node in self._nodes.values())

    async def open(self, *, need_bench: bool) -> None:
        """Read the nodes, and reserve the bench for this program if it is needed.

        Raises:
            LaboratoryError: no node has the bench's resource, or another program has reserved it.
        """
        self.here = await asyncio.to_thread(this_node)
        bench_node, options = await self._reserve() if need_bench else (None, {})
        self._nodes = await asyncio.to_thread(living_nodes)
        if bench_node is not None:
            if bench_node not in self._nodes:
                raise LaboratoryError(f"Ray cluster at {self.spec.address}: the bench's machine was lost; try again")
            self.bench = PinnedNode(self._nodes[bench_node], options)
        self._polling = asyncio.create_task(self._poll())
        bench = "" if self.bench is None else f"; the bench is on {self.bench.node.host}"
        nodes = f"{len(self._nodes)} node(s), {self.cpus} core(s)"
        self.tell(Notice("info", f"on the Ray cluster at {self.spec.address}: {nodes}{bench}"))

    async def close(self) -> None:
        """Release the bench."""
        if self._polling is not None:
            self._polling.cancel()
            await asyncio.wait({self._polling})
        if self._bundle is not None:
            from ray.util.placement_group import remove_placement_group

            with contextlib.suppress(Exception):  # Ray releases it in any case when this program ends
                await asyncio.wait_for(asyncio.to_thread(remove_placement_group, self._bundle), CLOSE_DEADLINE)

    async def _reserve(self) -> tuple[str, dict[str, Any]]:
        """Reserve all of the bench's resource on one node, so that a second program cannot move the same arm.

        Returns:
            The node's id, and Ray's options that place an actor there.
        """
        from ray.util.placement_group import placement_group, placement_group_table
        from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy

        name = self.spec.bench_resource
        self._bundle = placement_group([{name: 1.0}], strategy="STRICT_PACK")
        if not await asyncio.to_thread(self._bundle.wait, RESERVE_DEADLINE):
            raise LaboratoryError(
                f"Ray cluster at {self.spec.address}: '{name}' can't be had; no node offers it, or another program has "
                "the bench"
            )
        node: str = (await asyncio.to_thread(placement_group_table, self._bundle))["bundles_to_node_id"][0]
        strategy = PlacementGroupSchedulingStrategy(self._bundle, placement_group_bundle_index=0)
        return node, {"scheduling_strategy": strategy}

    async def _poll(self) -> None:
        """Compare the nodes with those of the previous poll."""
        while True:
            await asyncio.sleep(LOOK_INTERVAL)
            try:
                now = await asyncio.to_thread(living_nodes)
                for pinned in [pinned for pinned in (self.here, self.bench) if pinned is not None]:
                    if pinned.node.id in self._nodes and await pinned.is_gone():
                        self._dead.add(pinned.node.id)  # Ray still lists it for some time
            except Exception:
                continue  # the head may be busy; if it is dead, Ray ends this program
            self._compare({id_: node for id_, node in now.items() if id_ not in self._dead})

    def _compare(self, now: dict[str, Node]) -> None:
        before, self._nodes = self._nodes, now
        for id_ in before.keys() - now.keys():
            host = before[id_].host
            if id_ == self.here.node.id:
                reason = f"Ray on this machine, {host}, has died; start it again with 'ray start', then resume the run"
                self.tell(Notice("error", reason))
                self.here_lost(reason)
                continue
            left = f"simulations go on with {self.cpus} core(s) on {len(now)} node(s)"
            if self.bench is not None and id_ == self.bench.node.id:
                reason = f"the bench's machine {host} is lost; no pour can be made until it is back"
                self.tell(Notice("error", f"{reason}; {left}"))
                self.bench_lost(reason)
            else:
                self.tell(Notice("warning", f"machine {host} is lost; {left}"))
        for id_ in now.keys() - before.keys():
            self.tell(Notice("info", f"machine {now[id_].host} has joined with {now[id_].cpus} core(s)"))
        if now.keys() - before.keys():
            self.grown(self.cpus)
