"""`job_runner`: one simulator as the pools use it: when its kernels reach the cache."""

from __future__ import annotations

import pytest

from actors.simulators.job_runner import JobCancelledError, JobRunner


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
