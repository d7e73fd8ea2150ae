# Two commands from a fresh clone: `make demo` and `make test`.  Both set up what they need.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: setup demo try test lint bench limits docs clean

setup: $(STAMP)
	@$(BIN)/python -m launch.system

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; say which: make PYTHON=python3.11 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

demo: setup
	$(BIN)/flexsheet demo

# A page in the browser, to touch the object with the mouse.
try: setup
	$(BIN)/flexsheet try

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Threads of BLAS would only spin against the processes that tests start.  Tests that keep time with
# other processes have the machine for themselves; the others share its cores.
test: setup lint
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -m "not alone" --numprocesses auto --dist worksteal
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -m alone

# Longer than the tests: what docs/messaging.md, docs/image-correction.md and docs/results.md hold.
bench: setup
	$(BIN)/python -m benchmarks.messaging
	$(BIN)/python -m benchmarks.image_correction
	$(BIN)/python -m benchmarks.recovery
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.soft_body
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.soft_body_size --output docs/charts
	$(BIN)/python -m benchmarks.frame_cpu
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.fingertip_accuracy
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.tracking_endurance

# Kills, cuts and spoils everything between three computers (network namespaces: root).
faults: setup
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.faults

# What docs/limits.md and docs/limits-soft-body.md show: tables and pictures.
limits: setup
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.soft_body_limits
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.tracking_limits

docs: setup
	$(BIN)/python -m messages.reference > docs/messages.md
	$(BIN)/flexsheet chart --output docs/charts

clean:
	rm -rf $(VENV) build dist runs *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
