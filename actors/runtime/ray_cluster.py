"""A Ray cluster that the user has started: its nodes, the software on them, the check before a run, and their losses.

- `check_cluster` finds out whether a cluster is suitable, before anything starts. It reserves nothing.
- `JoinedCluster` reserves the bench and polls the nodes, from when the program has joined until it leaves.
- `PinnedNode` places an actor on one node and reports whether that node has died.
- `Versions` must be the same on every machine, so that a task has the same outcome on each of them.

The check runs in a separate process, `python -m actors.runtime.ray_cluster ADDRESS`. It joins the cluster, reads its
nodes, prints them as JSON and leaves. Ray waits for minutes if an address does not respond, and it may end a process
that it cannot connect. Neither may happen to the program itself.

`actors.runtime.ray_runtime` joins and leaves.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import importlib.metadata
import json
import socket
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from actors.interfaces import LaboratoryError, Notice, RaySettings
from actors.runtime.child_process import python_module, run
from sim_engine.engine_package import engine_version
from sim_engine.settings.plugin_registry import DISTRIBUTION
from sim_engine.solver_fingerprint import ROOT, folder_digest

LOOK_INTERVAL = 2.0
"""Time between two polls of the nodes [s]."""

RESERVE_DEADLINE = 20.0
"""Longest time to reserve the bench [s]."""

CLOSE_DEADLINE = 10.0
"""Longest time to release the bench [s]."""

CONNECT_DEADLINE = 5.0
"""Longest time for the head to accept a connection [s]."""

JOIN_DEADLINE = 60.0
"""Longest time to join, read the nodes and leave [s]."""

WORKER_DEADLINE = 40.0
"""Longest time for a node to start a Python process [s]."""

_PATIENCE = 2.0
"""Longest time for a node's own process to accept a connection [s]."""

_SHORT_TIMEOUTS = {
    "RAY_NUM_REDIS_GET_RETRIES": "3",
    "RAY_gcs_server_request_timeout_seconds": "10",
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
}
"""Shorter timeouts for Ray; its own are minutes long."""


@dataclass(frozen=True)
class Node:
    """A node, as listed by Ray.

    Attributes:
        id: Ray's id of the node.
        host: name and address, for messages.
        address, port: of the node's raylet, a process that every node has.
        resources: by name; 'CPU' is the number of cores that Ray assigns.
        versions: as the check has found them. None if no process could be started, or Decant is missing there.
        problem: why the check has found no versions.
    """

    id: str
    host: str
    address: str
    port: int
    resources: Mapping[str, float]
    versions: Versions | None = None
    problem: str = ""

    @property
    def cpus(self) -> int:
        """Cores that Ray assigns."""
        return int(self.resources.get("CPU", 0.0))


def living_nodes() -> dict[str, Node]:
    """The nodes that Ray lists as alive, by id. Blocks for some milliseconds."""
    import ray

    return {
        node["NodeID"]: Node(
            node["NodeID"],
            f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})",
            node["NodeManagerAddress"],
            int(node["NodeManagerPort"]),
            node["Resources"],
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
            async with asyncio.timeout(_PATIENCE):
                _, writer = await asyncio.open_connection(self.node.address, self.node.port)
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
        engine: it compiles the solver, e.g. 'taichi 1.7.4'.
        numpy: it makes the initial positions.
    """

    python: str
    decant: str
    simulator: str
    engine: str
    numpy: str

    def difference(self, other: Versions) -> str | None:
        """The first version in which two machines differ, as a message; None if all are equal.

        Args:
            other: versions of the other machine.
        """
        for each in fields(self):
            ours, theirs = getattr(self, each.name), getattr(other, each.name)
            if ours != theirs:
                subject = "the simulator's code" if each.name == "simulator" else each.name.capitalize()
                return f"{subject}: {theirs} there, {ours} here"
        return None


@functools.cache
def versions() -> Versions:
    """The versions on this machine."""
    return Versions(
        python=sys.version.split()[0],
        decant=_installed(DISTRIBUTION),
        simulator=folder_digest(ROOT / "sim_engine"),
        engine=engine_version(),
        numpy=_installed("numpy"),
    )


def _installed(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def check_cluster(spec: RaySettings, *, pours: bool) -> list[Node]:
    """Check that a laboratory can be opened on a cluster. The check leaves nothing on the cluster.

    Args:
        spec: the cluster.
        pours: whether arm, balance and bench need their node.

    Returns:
        The nodes that are alive.

    Raises:
        LaboratoryError: with the problem and its remedy.
    """
    _check_answers(spec.address)
    cluster = _read_cluster(spec.address)
    if "error" in cluster:
        raise LaboratoryError(f"Ray cluster at {spec.address}: {cluster['error']}")
    nodes = [
        Node(**{**node, "versions": Versions(**node["versions"]) if node["versions"] else None})
        for node in cluster["nodes"]
    ]
    _check_nodes(spec, nodes)
    if pours:
        _check_bench(spec, nodes, cluster["available"])
    return nodes


def _check_answers(address: str) -> None:
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_DEADLINE).close()
    except OSError as error:
        reason = "no answer" if isinstance(error, TimeoutError) else (error.strerror or str(error))
        raise LaboratoryError(
            f"Ray cluster at {address}: nothing answers there ({reason}); is 'ray start --head' running on that "
            "machine, and is this its address and port?"
        ) from None


def _read_cluster(address: str) -> dict[str, Any]:
    try:
        command = python_module("actors.runtime.ray_cluster", address)
        process = run(command, timeout=JOIN_DEADLINE, environment=_SHORT_TIMEOUTS)
    except TimeoutError:
        return {
            "error": f"it could not be joined within {JOIN_DEADLINE:g} s; is it Ray that answers there, and can this "
            "machine and the cluster's reach each other on all of Ray's ports?"
        }
    for line in reversed(process.stdout.splitlines()):
        if line.startswith("{"):
            answer: dict[str, Any] = json.loads(line)
            return answer
    last = (process.stderr.strip().splitlines() or ["it ended without a word"])[-1]
    return {"error": f"it can't be joined: {last}"}


def _check_nodes(spec: RaySettings, nodes: list[Node]) -> None:
    where = f"Ray cluster at {spec.address}"
    if not any(node.cpus for node in nodes):
        raise LaboratoryError(f"{where}: none of its {len(nodes)} node(s) has a core to simulate on (--num-cpus)")
    for node in nodes:
        if not node.cpus and spec.bench_resource not in node.resources:
            continue  # no Decant process will run there
        if node.versions is None:
            raise LaboratoryError(f"{where}: node {node.host} can't run Decant: {node.problem}")
        if (difference := versions().difference(node.versions)) is not None:
            raise LaboratoryError(
                f"{where}: node {node.host} is not like this machine: {difference}. Outcomes would depend on where "
                "they are simulated; install the same on all machines"
            )


def _check_bench(spec: RaySettings, nodes: list[Node], available: dict[str, float]) -> None:
    where, name = f"Ray cluster at {spec.address}", spec.bench_resource
    if not any(node.resources.get(name, 0.0) >= 1.0 for node in nodes):
        hosts = ", ".join(node.host for node in nodes)
        raise LaboratoryError(
            f"{where}: no node offers '{name}', which arm, balance and bench need (nodes: {hosts}); start Ray on the "
            f"bench's machine with --resources='{{\"{name}\": 1}}', or name another resource with ray.bench_resource"
        )
    if available.get(name, 0.0) < 1.0:
        raise LaboratoryError(f"{where}: '{name}' is in use; another program has the bench")


def _collect(address: str) -> dict[str, Any]:
    """The facts that the separate process collects."""
    import logging

    import ray

    try:
        ray.init(address=address, namespace="decant", logging_level=logging.CRITICAL, log_to_driver=False)
    except Exception as error:
        return {"error": _why(error)}
    nodes = list(living_nodes().values())
    requested = [_request_versions(node.id) for node in nodes]
    ray.wait(requested, num_returns=len(requested), timeout=WORKER_DEADLINE)
    still = living_nodes()  # Ray needs some time to notice that a node is dead
    versions = [_with_versions(node, ref) for node, ref in zip(nodes, requested, strict=True) if node.id in still]
    answer = {"nodes": [dataclasses.asdict(node) for node in versions], "available": ray.available_resources()}
    ray.shutdown()
    return answer


def _request_versions(node: str) -> Any:
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    def there() -> dict[str, str]:
        import dataclasses

        from actors.runtime.ray_cluster import versions

        return dataclasses.asdict(versions())

    there_only = NodeAffinitySchedulingStrategy(node, soft=False)
    return ray.remote(num_cpus=0, max_retries=0, scheduling_strategy=there_only)(there).remote()


def _with_versions(node: Node, ref: Any) -> Node:
    import ray

    try:
        return dataclasses.replace(node, versions=Versions(**ray.get(ref, timeout=0.0)))
    except ray.exceptions.GetTimeoutError:
        problem = f"it did not start a Python process within {WORKER_DEADLINE:g} s"
    except ray.exceptions.RayTaskError as error:
        problem = f"{error.cause!r}; install Decant there, in the environment that Ray runs in"
    except Exception as error:
        problem = (str(error).strip().splitlines() or [repr(error)])[0]
    return dataclasses.replace(node, problem=problem)


def _why(error: BaseException) -> str:
    """Ray's reason, in words that help the user to fix it."""
    chain: list[str] = []
    link: BaseException | None = error
    while link is not None:
        chain.append(f"{type(link).__name__}: {link}")
        link = link.__cause__ or link.__context__
    text = "\n".join(chain)
    if "Version mismatch" in text:
        return " ".join(text[text.index("Version mismatch") :].split())
    if "AuthenticationError" in text or "InvalidAuthToken" in text:
        return (
            "it asks for a token that this program does not have; set RAY_AUTH_TOKEN_PATH to a copy of the file that "
            "the cluster was started with, and RAY_AUTH_MODE=token"
        )
    if "No node info found" in text:
        return (
            "this machine is not a node of it; run 'ray start' with its address here first (--num-cpus=0 if nothing "
            "should be simulated here)"
        )
    return f"it can't be joined: {(str(error).strip().splitlines() or [repr(error)])[0]}"


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

    async def open(self, *, pours: bool) -> None:
        """Read the nodes, and reserve the bench for this program if it is needed.

        Raises:
            LaboratoryError: no node has the bench's resource, or another program has reserved it.
        """
        self.here = await asyncio.to_thread(this_node)
        bench_node, options = await self._reserve() if pours else (None, {})
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
                async with asyncio.timeout(CLOSE_DEADLINE):
                    await asyncio.to_thread(remove_placement_group, self._bundle)

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


if __name__ == "__main__":
    print(json.dumps(_collect(sys.argv[1])), flush=True)
