"""A client that openapi-python-client generates from the served description: submits, follows, answers, reads."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from actors.interfaces import OperatorQuestion
from actors.runtime.child_process import child_environment
from orchestrator.daemon.state.access_tokens import Role
from tests.support.browser import on_port
from tests.support.toy_campaign import ToyOptimizer, ToySimulators
from tests.support.toy_daemon import HeldBench, HeldLaboratory

pytestmark = pytest.mark.slow

CAMPAIGN = Path(__file__).parents[2] / "configs" / "campaigns" / "first-pour.yaml"
PROGRAM = Path(__file__).parents[1] / "support" / "generated_client.py"

# In the place of the campaign's own laboratory, which has a real arm.
AT_THE_BENCH = """\
name: virtual
arm: {kind: simulated}
balance: {kind: simulated}
operator: {answers: person}
bench: {liquid: {particles: 400}, time_scale: 50}
"""


def asking() -> HeldLaboratory:
    bench = HeldBench()
    bench.question = OperatorQuestion(about="refill", text="Fill the pourer", wants="done", hands=True)
    return HeldLaboratory(ToySimulators(), bench, ToyOptimizer())


def test_a_generated_client_submits_a_shipped_campaign_and_reads_its_verdict(tmp_path: Path) -> None:
    generator = os.environ.get("DECANT_OPENAPI_CLIENT") or shutil.which("openapi-python-client")
    if generator is None:
        pytest.skip("no client was generated: `make slow` installs the generator, or $DECANT_OPENAPI_CLIENT names it")
    laboratory = tmp_path / "at-the-bench.yaml"
    laboratory.write_text(AT_THE_BENCH, encoding="utf-8")
    (tmp_path / "name.json").write_text(
        json.dumps({"package_name_override": "decant_client", "post_hooks": [], "http_timeout": 120})
    )
    with on_port(tmp_path / "daemon", asking) as lab:
        described = f"{lab.url}/api/v1/openapi.json"
        made = [generator, "generate", "--url", described, "--meta", "none", "--config", str(tmp_path / "name.json")]
        made += ["--output-path", str(tmp_path / "decant_client")]
        subprocess.run(made, check=True, capture_output=True, env=child_environment())
        vessels = [f"../vessels/{name}.yaml" for name in ("beaker", "bowl")]
        files = {name: name for name in vessels} | {"../laboratories/ur10-kern.yaml": str(laboratory)}
        python = Path(generator).resolve().parent / "python"
        token = lab.served.tokens[Role.OPERATOR]
        command = [python, PROGRAM, lab.url, token, CAMPAIGN, json.dumps(files)]
        environment = {**child_environment(), "PYTHONPATH": str(tmp_path)}
        program = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=400)
    assert program.returncode == 0, program.stderr
    ended = json.loads(program.stdout.splitlines()[-1])
    assert ended["state"] == "finished", ended
    assert ended["answered"] >= 1
    assert ended["verdict"] in ("complete", "incomplete")
