"""Threads of one process share its engine: their pours have the outcomes that they have one after the other."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace

import pytest

from sim_engine.engine_package import check_task
from sim_engine.errors import SimulationCancelled
from sim_engine.outcome import PourOutcome
from sim_engine.scene import PourTask
from sim_engine.shared_simulator import SharedSimulator
from sim_engine.simulator import PourSimulator


def counted(outcome: PourOutcome) -> PourOutcome:
    """An outcome without its computing time."""
    return replace(outcome, cpu_s=0.0)


def test_pours_of_several_threads_have_the_outcomes_that_they_have_alone(simulator: PourSimulator) -> None:
    tasks = [replace(check_task(), seed=seed) for seed in range(6)]
    alone = [counted(simulator.simulate(task).outcome) for task in tasks]

    def in_a_thread(task: PourTask) -> PourOutcome:
        with closing(SharedSimulator()) as own:  # as `decant.plan` in each thread has
            return counted(own.simulate(task).outcome)

    with ThreadPoolExecutor(3) as threads:
        assert list(threads.map(in_a_thread, tasks)) == alone


def test_a_pour_that_waits_for_another_one_can_be_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    running, done = threading.Event(), threading.Event()

    def slow(self: PourSimulator, task: PourTask, **options: object) -> None:
        running.set()
        assert done.wait(60.0)

    monkeypatch.setattr(PourSimulator, "simulate", slow)
    with ThreadPoolExecutor(1) as thread:
        first = thread.submit(SharedSimulator().simulate, check_task())
        assert running.wait(60.0)
        try:
            with pytest.raises(SimulationCancelled):
                SharedSimulator().simulate(check_task(), cancelled=lambda: True)
        finally:
            done.set()
        first.result()
