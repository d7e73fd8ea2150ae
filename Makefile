# Two commands from a fresh clone: `make demo` and `make test`.  Both set up what they need.
.DEFAULT_GOAL := help
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEV_STAMP := $(VENV)/.installed-dev
INSTALL := $(BIN)/pip install --quiet --disable-pip-version-check
LOCK := build/pip-tools
# Number of parallel test processes: one more than cores, because some tests wait for others.
WORKERS = $$(($$(nproc) + 1))
SKIPPED := $(CURDIR)/build/skipped.txt
SOURCES := flexsheet messages nodes launch benchmarks website
SITE_VENV := .venv-docs
SITE_STAMP := $(SITE_VENV)/.installed

.PHONY: help setup demo try test test-parallel test-long lint cached bench bench-gpu faults soak limits load \
	pages charts \
	docs lock release clean

# `make test` and `make lint` install the development packages.
setup: $(STAMP)  ## install what is needed to run, and start nothing
	@$(BIN)/python -m tests.system_packages

# List the targets with the texts after `##`.
help:  ## list all targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' Makefile | sort | expand -t 14

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; name it: make PYTHON=python3.11 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(STAMP): requirements.lock pyproject.toml | $(BIN)/python
	@echo "installing into $(VENV): 0.7 GB, a minute or two the first time"
	$(INSTALL) --require-hashes -r requirements.lock
	$(INSTALL) --no-deps --no-build-isolation -e .
	@touch $@

$(DEV_STAMP): requirements-dev.lock $(STAMP)
	$(INSTALL) --require-hashes -r requirements-dev.lock
	@touch $@

# The sources are pyproject.toml and website/requirements.in. Pinned versions are kept where possible.
lock:  ## write all lock files again, after a change of dependencies
	$(PYTHON) -m venv $(LOCK)
	$(LOCK)/bin/pip install --quiet --disable-pip-version-check pip-tools
	$(call compile,--all-build-deps $(EXTRAS),requirements.lock,pyproject.toml)
	$(call compile,--all-build-deps $(EXTRAS) --extra ros2 --extra dev,requirements-dev.lock,pyproject.toml)
	$(call compile,,website/requirements.lock,website/requirements.in)

# Those of the extra `all`; pip-tools would list this project itself for a reference to its extras.
EXTRAS = $(addprefix --extra ,projector console charts meshes cluster view)
compile = $(LOCK)/bin/pip-compile --quiet --generate-hashes --allow-unsafe $(1) \
	--strip-extras --no-header --no-annotate --no-emit-index-url --no-emit-trusted-host \
	--no-emit-find-links -o $(2) $(3)

demo: setup  ## run the experiments of the paper, and draw pictures
	$(BIN)/flexsheet demo

try: setup  ## open a page in the browser, and touch the object with the mouse
	$(BIN)/flexsheet launch demo --browser

lint: $(DEV_STAMP)  ## check style, words and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m tests.check_words
	$(BIN)/mypy

# Write the bytecode of the package and the tests, whose assertions pytest rewrites; each test process
# would otherwise compile them.
cached: $(DEV_STAMP)
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m compileall -q $(SOURCES)
	PYTHONDONTWRITEBYTECODE= $(BIN)/pytest --collect-only -qq > /dev/null || true  # the tests report errors

# BLAS uses one thread, because more would compete with the processes that tests start.
test-parallel: cached
	@mkdir -p build
	OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= SKIPPED_FILE=$(SKIPPED) \
		$(BIN)/pytest -m "not alone and not long" --durations=25 --numprocesses $(WORKERS) \
		--dist worksteal

# Tests marked `alone` depend on timing and run one at a time; the others run in parallel, beside the
# linters. Both parts run, even if the first fails. The last lines list the skipped tests with the
# reasons.
test: $(DEV_STAMP)  ## run the linters and all tests except the long ones
	@$(BIN)/python -m tests.system_packages --tests
	@mkdir -p build && : > $(SKIPPED)
	@status=0; \
	$(MAKE) --no-print-directory --keep-going --jobs=2 --output-sync=none lint test-parallel \
		|| status=$$?; \
	export OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= SKIPPED_FILE=$(SKIPPED); set -x; \
	$(BIN)/pytest -m "alone and not long" --durations=15 $$(grep -l mark.alone tests/test_*.py) \
		|| status=$$?; \
	{ set +x; } 2> /dev/null; \
	if [ -s $(SKIPPED) ]; then echo "skipped tests:"; sort $(SKIPPED) | uniq -c; \
	else echo "no test was skipped"; fi; \
	exit $$status

test-long: $(DEV_STAMP) cached  ## run the long tests: studies, and property tests with more random examples
	@status=0; \
	export OPENBLAS_NUM_THREADS=1; set -x; \
	$(BIN)/pytest -m long --durations=15 || status=$$?; \
	$(BIN)/pytest -m "not alone and not long" --hypothesis-profile long --timeout=3600 \
		--numprocesses $(WORKERS) --dist worksteal $$(grep -l @given tests/test_*.py) || status=$$?; \
	exit $$status

bench: setup $(DEV_STAMP)  ## measure the figures in docs/results.md
	$(BIN)/python -m benchmarks.messaging
	$(BIN)/python -m benchmarks.image_correction
	$(BIN)/python -m benchmarks.scenes
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.soft_body
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.soft_body_size --output docs/charts
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.tracking_endurance
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.tracking_regret --output docs/charts

# Exit code 3: the machine has no graphics card.
bench-gpu: setup  ## measure frame time, frame rate and lag with the graphics card, for docs/charts
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.frame_rate --output docs/charts

faults: setup $(DEV_STAMP)  ## kill processes, and disturb connections between three simulated computers (requires root)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.faults

soak: setup  ## run strokes and pushes for an hour, to find leaks, drift and losses (docs/soak.md)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.soak

limits: setup $(DEV_STAMP)  ## measure the disturbances of the fingertip in docs/limits.md
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.tracking_limits

pages: setup  ## insert figures from docs/results into the pages, and draw docs/images
	$(BIN)/python -m website.pages

charts: setup  ## measure every method of every family for docs/charts
	$(BIN)/flexsheet chart --output docs/charts

# An interrupted command continues.
load: setup $(DEV_STAMP)  ## measure errors, latency and safety against load (requires root)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.load --output runs/load

# The generator of the documentation site has a separate virtual environment.
$(SITE_STAMP): website/requirements.lock
	$(PYTHON) -m venv $(SITE_VENV)
	$(SITE_VENV)/bin/pip install --quiet --disable-pip-version-check --require-hashes \
		-r website/requirements.lock
	@touch $@

docs: setup $(SITE_STAMP)  ## build the documentation site, site/index.html
	$(BIN)/python -m website.pages site
	$(SITE_VENV)/bin/python -m zensical build --clean --strict
	$(SITE_VENV)/bin/python -m website.finish site

# The wheel is built from the source archive, which shows that the archive is complete.
BUILD = $(CURDIR)/$(BIN)/python -c "import sys; from setuptools import build_meta; \
	getattr(build_meta, sys.argv[1])(sys.argv[2])"
release: setup  ## write source archive, wheel and checksums to dist/
	rm -rf dist build/source
	mkdir -p build/source dist
	$(BUILD) build_sdist dist > build/release.log
	tar --extract --directory build/source --strip-components 1 --file dist/*.tar.gz
	cd build/source && $(BUILD) build_wheel $(CURDIR)/dist >> $(CURDIR)/build/release.log
	cd dist && sha256sum *.tar.gz *.whl > SHA256SUMS
	@version=$$($(BIN)/flexsheet --version | cut -d' ' -f2); \
	grep -q "^## \[$$version\]" CHANGELOG.md || \
		echo "note: CHANGELOG.md has no section [$$version]; this build is not a release" >&2
	@ls -1 dist

clean:  ## remove everything that the other targets have made
	rm -rf $(VENV) $(SITE_VENV) site .cache build dist runs *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
