"""Metrics of the daemon in Prometheus' text format.

`measures` reads the current values of the daemon at each request, so that nothing is counted twice or stored.
"""

from __future__ import annotations

import os
import resource
import threading
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric

from orchestrator.daemon.supervisor import Supervisor
from orchestrator.journal.journal_file import free_space


class _Collector:
    """Reads the current values when Prometheus collects them."""

    def __init__(self, daemon: Supervisor) -> None:
        self._daemon = daemon

    def collect(self) -> Iterable[Metric]:
        """Yield the metrics, as prometheus_client's collectors do."""
        daemon = self._daemon
        campaigns = GaugeMetricFamily("decant_campaigns", "Campaigns in each state.", labels=["state"])
        for state, count in daemon.store.counts().items():
            campaigns.add_metric([state], count)
        yield campaigns
        busy = GaugeMetricFamily("decant_rig_busy", "Whether a campaign has the rig.", labels=["rig"])
        for name, worker in daemon.lanes.items():
            busy.add_metric([name], float(worker.running is not None))
        yield busy
        words = GaugeMetricFamily("decant_words", "Messages to people elsewhere.", labels=["receiver", "outcome"])
        for receiver, counts in daemon.words.items():
            for outcome, count in asdict(counts).items():
                words.add_metric([receiver, outcome], count)
        yield words
        single = {
            "decant_questions_open": ("Questions that wait for an answer.", len(daemon.store.questions())),
            "decant_emergency_stop": (
                "Whether an emergency stop is latched.",
                daemon.emergency is not None or bool(daemon.emergencies),
            ),
            "decant_queue_paused": ("Whether no campaign is begun.", daemon.queue_paused),
            "decant_simulators": ("Simulators in the pool.", daemon.warm.size),
            "decant_events_last": ("Number of the newest event.", daemon.feed.last),
            "decant_readers": ("Readers of events.", daemon.feed.readers),
            "decant_problems": ("Things that people should mend.", len(daemon.problems)),
            "decant_disk_free_bytes": ("Room on the state directory's disk.", free_space(daemon.settings.state)),
            "decant_threads": ("Threads of the daemon's process.", threading.active_count()),
            "decant_open_files": ("Open files of the daemon's process.", _open_files()),
            "decant_resident_bytes": ("Memory of the daemon's process.", _resident()),
            "decant_cpu_seconds_total": ("CPU time of the daemon's process.", _cpu()),
        }
        for name, (text, value) in single.items():
            yield GaugeMetricFamily(name, text, value=float(value))


def measures(daemon: Supervisor) -> bytes:
    """Return all metrics in Prometheus' text format."""
    registry = CollectorRegistry()
    registry.register(_Collector(daemon))
    return generate_latest(registry)


def _open_files() -> int:
    return len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").is_dir() else 0  # noqa: PTH208  no Path is made


def _resident() -> int:
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return 0


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
