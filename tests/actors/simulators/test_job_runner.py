"""`job_runner`: one simulator as the pools use it: when its kernels reach the cache."""

from __future__ import annotations

import threading

import pytest

from actors.simulators.job_runner import JobCancelledError, JobRunner
from sim_engine.resources import ENVIRONMENT_VARIABLE
from tests.support.waiting import PATIENCE, wait_for


def never() -> bool:
    return False


def notes(log) -> list[str]:
    return [line.split()[0] for line in log.read_text().splitlines()]


def test_kernels_are_written_after_a_first_job_that_may_have_compiled_them(fake, task, tmp_path):
    log = tmp_path / "log"
    worker = JobRunner(fake(0.0, log), long_first_job=-1.0)
    for seed in range(3):
        assert worker.simulate(task(seed=seed), never).outcome.seed == seed
    assert notes(log) == ["made", "begin", "end", "closed", "made", "begin", "end", "begin", "end"]


def test_a_warm_process_keeps_its_simulator(fake, task, tmp_path):
    log = tmp_path / "log"
    worker = JobRunner(fake(0.0, log))
    for seed in range(2):
        worker.simulate(task(seed=seed), never)
    assert notes(log) == ["made", "begin", "end", "begin", "end"]


def test_a_job_given_up_before_it_began_costs_nothing(fake, task, tmp_path):
    log = tmp_path / "log"
    with pytest.raises(JobCancelledError):
        JobRunner(fake(0.0, log)).simulate(task(), lambda: True)
    assert not log.exists()


def test_simulators_that_start_together_compile_one_after_the_other(fake, task, tmp_path, monkeypatch):
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(tmp_path / "cache"))
    logs = [tmp_path / "first", tmp_path / "second"]
    given_up = threading.Event()
    first = threading.Thread(target=in_vain, args=(JobRunner(fake(PATIENCE, logs[0])), task(seed=1), given_up.is_set))
    first.start()
    wait_for(lambda: logs[0].exists() and "begin" in notes(logs[0]), "first job")
    polled = []

    def tired() -> bool:
        polled.append(1)
        return len(polled) > 3

    in_vain(JobRunner(fake(0.0, logs[1])), task(seed=2), tired)
    assert not logs[1].exists() or "end" not in notes(logs[1]), "it waits for the kernels of the first"
    given_up.set()
    first.join(PATIENCE)
    JobRunner(fake(0.0, logs[1])).simulate(task(seed=3), never)
    assert notes(logs[1])[-1] == "end"


def in_vain(runner, job, cancelled) -> None:
    with pytest.raises(JobCancelledError):
        runner.simulate(job, cancelled)
