"""Checks whether a Ray cluster is suitable, before anything starts.

The check runs in a separate process. Ray waits for minutes if an address does not respond, and it may end a process
that it cannot connect. Neither may happen to the program itself.

Run as a module, this file is that process. It joins the cluster, reads its nodes, prints them as JSON and leaves.

`check_cluster` returns `NodeFacts`. It reserves nothing; `actors.runtime.ray_cluster` does that.
"""

from __future__ import annotations

import dataclasses
import json
import socket
import sys
from dataclasses import dataclass
from typing import Any

from actors.interfaces import LaboratoryError
from actors.laboratory_settings import RaySettings
from actors.runtime.child_process import python_module, run
from actors.runtime.cluster_nodes import Versions, versions

ANSWER_DEADLINE = 5.0
"""Longest time for the head to accept a connection [s]."""

JOIN_DEADLINE = 60.0
"""Longest time to join, read the nodes and leave [s]."""

WORKER_DEADLINE = 40.0
"""Longest time for a node to start a Python process [s]."""

_SHORT_TIMEOUTS = {
    "RAY_NUM_REDIS_GET_RETRIES": "3",
    "RAY_gcs_server_request_timeout_seconds": "10",
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
}
"""Shorter timeouts for Ray; its own are minutes long."""


@dataclass(frozen=True)
class NodeFacts:
    """A node of a cluster.

    Attributes:
        id: Ray's id of the node.
        host: name and address, for messages.
        cpus: cores that Ray assigns.
        total: its resources by name.
        versions: of everything that affects outcomes. None if no process could be started or Decant is missing there.
        problem: why there are no versions.
    """

    id: str
    host: str
    cpus: int
    total: dict[str, float]
    versions: Versions | None = None
    problem: str = ""


def check_cluster(spec: RaySettings, *, need_bench: bool) -> list[NodeFacts]:
    """Check that a laboratory can be opened on a cluster. The check leaves nothing on the cluster.

    Args:
        spec: the cluster.
        need_bench: whether arm, balance and bench need their node.

    Returns:
        The nodes that are alive.

    Raises:
        LaboratoryError: with the problem and its remedy.
    """
    _check_answers(spec.address)
    found = _read_cluster(spec.address)
    if "error" in found:
        raise LaboratoryError(f"Ray cluster at {spec.address}: {found['error']}")
    nodes = [
        NodeFacts(**{**node, "versions": Versions(**node["versions"]) if node["versions"] else None})
        for node in found["nodes"]
    ]
    _check_nodes(spec, nodes)
    if need_bench:
        _check_bench(spec, nodes, found["available"])
    return nodes


def _check_answers(address: str) -> None:
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), ANSWER_DEADLINE).close()
    except OSError as error:
        reason = "no answer" if isinstance(error, TimeoutError) else (error.strerror or str(error))
        raise LaboratoryError(
            f"Ray cluster at {address}: nothing answers there ({reason}); is 'ray start --head' running on that "
            "machine, and is this its address and port?"
        ) from None


def _read_cluster(address: str) -> dict[str, Any]:
    try:
        command = python_module("actors.runtime.cluster_check", address)
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


def _check_nodes(spec: RaySettings, nodes: list[NodeFacts]) -> None:
    where = f"Ray cluster at {spec.address}"
    if not any(node.cpus for node in nodes):
        raise LaboratoryError(f"{where}: none of its {len(nodes)} node(s) has a core to simulate on (--num-cpus)")
    for node in nodes:
        if not node.cpus and spec.bench_resource not in node.total:
            continue  # no Decant process will run there
        if node.versions is None:
            raise LaboratoryError(f"{where}: node {node.host} can't run Decant: {node.problem}")
        if (difference := versions().difference(node.versions)) is not None:
            raise LaboratoryError(
                f"{where}: node {node.host} is not like this machine: {difference}. Outcomes would depend on where "
                "they are simulated; install the same on all machines"
            )


def _check_bench(spec: RaySettings, nodes: list[NodeFacts], available: dict[str, float]) -> None:
    where, name = f"Ray cluster at {spec.address}", spec.bench_resource
    if not any(node.total.get(name, 0.0) >= 1.0 for node in nodes):
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
    nodes = _living()
    requested = [_request_versions(node.id) for node in nodes]
    ray.wait(requested, num_returns=len(requested), timeout=WORKER_DEADLINE)
    still = {node.id for node in _living()}  # Ray needs some time to notice that a node is dead
    found = [_with_versions(node, ref) for node, ref in zip(nodes, requested, strict=True) if node.id in still]
    answer = {"nodes": [dataclasses.asdict(node) for node in found], "available": ray.available_resources()}
    ray.shutdown()
    return answer


def _living() -> list[NodeFacts]:
    import ray

    return [
        NodeFacts(
            node["NodeID"],
            f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})",
            int(node["Resources"].get("CPU", 0.0)),
            node["Resources"],
        )
        for node in ray.nodes()
        if node["Alive"]
    ]


def _request_versions(node: str) -> Any:
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    def there() -> dict[str, str]:
        import dataclasses

        from actors.runtime.cluster_nodes import versions

        return dataclasses.asdict(versions())

    there_only = NodeAffinitySchedulingStrategy(node, soft=False)
    return ray.remote(num_cpus=0, max_retries=0, scheduling_strategy=there_only)(there).remote()


def _with_versions(node: NodeFacts, ref: Any) -> NodeFacts:
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


if __name__ == "__main__":
    print(json.dumps(_collect(sys.argv[1])), flush=True)
