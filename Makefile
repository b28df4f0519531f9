# Everything that a fresh machine needs is Python 3.11 to 3.14, git and make.
#   make install   sets up, and nothing else
#   make demo      sets up and runs the quickstart campaign on the virtual bench
#   make test      sets up and runs all checks and the quick tests
#   make slow      the long tests
#   make physics   every criterion of the solver's full cases
#   make docs      the documentation as a site, in build/site
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Files of tests to workers, in the order in which they were collected.
BY_FILE := --dist loadfile --no-loadscope-reorder
# The tests start hundreds of Python processes: each module is compiled once, also where the environment says otherwise.
unexport PYTHONDONTWRITEBYTECODE
READY := $(VENV)/.ready

.PHONY: install demo test lint unit slow physics docs coverage oldest lock clean
.DEFAULT_GOAL := demo

# install.py says what each need installs, and continues what was interrupted.
$(READY): requirements.lock pyproject.toml
	@$(PYTHON) install.py program

$(READY)-%: requirements-%.lock $(READY)
	@$(PYTHON) install.py $*

install: $(READY)

demo: $(READY)
	$(BIN)/decant run configs/campaigns/quickstart.yaml

test: lint unit

lint: $(READY)-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	MYPYPATH=benchmarks $(BIN)/mypy benchmarks/*.py benchmarks/validation
	$(BIN)/lint-imports

unit: $(READY)-test
	$(BIN)/pytest -m "not slow and not physics" -n 4 --timeout 300 $(BY_FILE)

# Generates a client of the service from its description; its own environment, since it pins older packages.
GENERATOR := build/openapi/bin/openapi-python-client
$(GENERATOR): $(READY)
	$(BIN)/python -m venv build/openapi
	build/openapi/bin/python -m pip install --quiet --disable-pip-version-check openapi-python-client==0.29.1

# What takes long, and every property on four times as many examples. DECANT_TESTS_PART=2/8 runs every eighth file.
slow: $(READY)-test $(GENERATOR)
	DECANT_OPENAPI_CLIENT=$(abspath $(GENERATOR)) DECANT_THOROUGH=1 $(BIN)/pytest -m "(slow or hypothesis) and not physics" -n 2 $(BY_FILE)

# Every criterion of the solver's full cases, about half an hour. Near a limit the processor's rounding decides.
physics: $(READY)-test
	$(BIN)/pytest -m physics -n 2 --dist load

docs: $(READY)-docs
	$(BIN)/sphinx-build -W --keep-going -q -b html -c docs . build/site
	@echo "open build/site/index.html"

# Which lines the quick tests run, in this process and in those that they start.
coverage: $(READY)-test
	COVERAGE_FILE=build/.coverage $(BIN)/pytest -m "not slow and not physics" -n 4 $(BY_FILE) --cov --cov-report=term:skip-covered --cov-report=html:build/coverage

# The tests that start nothing, with the oldest dependencies that pyproject.toml allows (needs uv).
OLDEST := build/oldest
oldest:
	uv venv -q --python 3.11 $(OLDEST)
	uv pip install -q --python $(OLDEST)/bin/python --resolution lowest-direct --group dev -e .
	$(OLDEST)/bin/python -m pytest -q -m "not slow and not physics and not realtime and not ray" tests/orchestrator tests/sim_engine

# After a change of the dependencies in pyproject.toml (needs uv).
COMPILE := uv pip compile pyproject.toml --universal --python-version 3.11 --generate-hashes \
	--no-emit-index-url --no-emit-find-links --no-header --no-annotate -q
lock:
	$(COMPILE) --extra all --extra quadrants --extra sila --group build --group test -o requirements-test.lock
	$(COMPILE) -c requirements-test.lock --extra all --group build -o requirements.lock
	$(COMPILE) -c requirements-test.lock --extra all --group build --group docs -o requirements-docs.lock

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis build *.egg-info
