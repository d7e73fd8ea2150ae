# Two commands from a fresh clone: `make demo` and `make test`.  Both set up what they need.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEV_STAMP := $(VENV)/.installed-dev
INSTALL := $(BIN)/pip install --quiet --disable-pip-version-check
LOCK := build/pip-tools
# Of the tests: one more than cores, because some tests wait for other processes.
WORKERS = $$(($$(nproc) + 1))
SKIPPED := $(CURDIR)/build/skipped.txt
SOURCES := flexsheet messages nodes launch benchmarks website
SITE_VENV := .venv-docs
SITE_STAMP := $(SITE_VENV)/.installed

.PHONY: setup demo try test test-long lint cached bench bench-gpu bench-peers faults deploy-trial soak fuzz limits load tune-scenes \
	pages charts \
	docs lock release clean

# What runs; what tests and checks comes with `make test` and `make lint`.
setup: $(STAMP)
	@$(BIN)/python -m tests.system_packages

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; say which: make PYTHON=python3.11 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(STAMP): requirements.lock pyproject.toml | $(BIN)/python
	@echo "installing into $(VENV): 0.7 GB, a minute or two the first time"
	$(INSTALL) --require-hashes -r requirements.lock
	$(INSTALL) --no-deps --no-build-isolation -e .
	@touch $@

$(DEV_STAMP): requirements-dev.lock $(STAMP)
	$(INSTALL) --require-hashes -r requirements-dev.lock
	@touch $@

# All locks anew, after a change of pyproject.toml or website/requirements.in; what is pinned stays
# where it may.
lock:
	$(PYTHON) -m venv $(LOCK)
	$(LOCK)/bin/pip install --quiet --disable-pip-version-check pip-tools
	$(call compile,--all-build-deps --extra export,requirements.lock,pyproject.toml)
	$(call compile,--all-build-deps --extra export --extra ros2 --extra parquet --extra dev,requirements-dev.lock,pyproject.toml)
	$(call compile,,website/requirements.lock,website/requirements.in)

compile = $(LOCK)/bin/pip-compile --quiet --generate-hashes --allow-unsafe $(1) \
	--strip-extras --no-header --no-annotate --no-emit-index-url --no-emit-trusted-host \
	--no-emit-find-links -o $(2) $(3)

demo: setup
	$(BIN)/flexsheet demo

# A page in the browser, to touch the object with the mouse.
try: setup
	$(BIN)/flexsheet try

lint: $(DEV_STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m tests.check_words
	$(BIN)/mypy

# Results that tests would otherwise compute in each of their processes: the sheet's deflection
# shapes, and the bytecode of the package and of the tests, whose assertions pytest rewrites.
cached: $(DEV_STAMP)
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m compileall -q $(SOURCES)
	$(BIN)/flexsheet precompute launch/scenes/cylinder.yaml
	PYTHONDONTWRITEBYTECODE= $(BIN)/pytest --collect-only -qq > /dev/null || true  # the tests report errors

# Threads of BLAS would only spin against the processes that tests start.  Tests that keep time with
# other processes have the machine for themselves; the others share its cores.  Both parts run, even
# if the first fails; the last lines say what was skipped in either, and why.
test: $(DEV_STAMP)
	@$(BIN)/python -m tests.system_packages --tests
	@mkdir -p build && : > $(SKIPPED)
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target lint cached
	@status=0; \
	export OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= SKIPPED_FILE=$(SKIPPED); set -x; \
	$(BIN)/pytest -m "not alone and not long" --durations=25 --numprocesses $(WORKERS) --dist worksteal \
		|| status=$$?; \
	$(BIN)/pytest -m "alone and not long" --durations=15 $$(grep -l mark.alone tests/test_*.py) \
		|| status=$$?; \
	{ set +x; } 2> /dev/null; \
	if [ -s $(SKIPPED) ]; then echo "skipped tests:"; sort $(SKIPPED) | uniq -c; \
	else echo "no test was skipped"; fi; \
	exit $$status

# What is too long for `make test`: studies, and property tests with more examples, drawn at
# random.
test-long: $(DEV_STAMP) cached
	@status=0; \
	export OPENBLAS_NUM_THREADS=1; set -x; \
	$(BIN)/pytest -m long --durations=15 || status=$$?; \
	$(BIN)/pytest -m "not alone and not long" --hypothesis-profile long --timeout=3600 \
		--numprocesses $(WORKERS) --dist worksteal $$(grep -l @given tests/test_*.py) || status=$$?; \
	exit $$status

# Longer than the tests: the figures of docs/results.md.
bench: setup $(DEV_STAMP)
	$(BIN)/python -m benchmarks.messaging
	$(BIN)/python -m benchmarks.image_correction
	$(BIN)/python -m benchmarks.recovery
	$(BIN)/python -m benchmarks.scenes --markdown
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.soft_body
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.soft_body_size --output docs/charts
	$(BIN)/python -m benchmarks.frame_cpu
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.fingertip_accuracy
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.tracking_endurance
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.tracking_regret --output docs/charts

# Frame time, frames per second and lag with this machine's graphics card, as a point of docs/charts;
# exit code 3 without one.
bench-gpu: setup
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.frame_rate --output docs/charts

# Other messaging libraries in turns with ours (a network of its own: root).
bench-peers: setup
	$(INSTALL) --no-build-isolation -e '.[peers]'
	$(BIN)/python -m benchmarks.messaging_peers

# Kills, cuts and spoils everything between three computers (network namespaces: root).
faults: setup $(DEV_STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.faults

# docs/deploy.md, typed on three computers that are namespaces (root).
deploy-trial: setup $(DEV_STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.deploy_trial

# An hour of strokes and pushes: what grows, drifts or is lost (docs/soak.md).
soak: setup
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.soak

# Five minutes for each of what reads bytes from outside; what it needs more is installed first.
fuzz: setup
	$(INSTALL) --no-build-isolation -e '.[fuzz]'
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.fuzz

# What docs/limits.md summarises: tables and pictures.
limits: setup $(DEV_STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.soft_body_limits
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.tracking_limits

# The figures of pages from docs/results, and the drawings of docs/images.
pages: setup
	$(BIN)/python -m website.pages

# docs/charts: every method of every family, on this machine; half an hour.
charts: setup
	$(BIN)/flexsheet chart --output docs/charts

# Tunes all shipped scenes, best on an idle machine; hours.  Scenes and strokes that are finished in
# runs/tune are not repeated, so an interrupted command continues.
tune-scenes: setup
	@mkdir -p runs/tune; status=0; \
	for scene in launch/scenes/*.yaml; do \
		folder=runs/tune/$$(basename $$scene .yaml); \
		[ ! -f $$folder.json ] || continue; \
		OPENBLAS_NUM_THREADS=1 $(BIN)/flexsheet tune $$scene --runs-folder $$folder --json \
			> $$folder.part; code=$$?; \
		case $$code in 0|3) mv $$folder.part $$folder.json ;; *) status=1 ;; esac; \
	done; exit $$status

# Errors, latency and safety against load; an interrupted command continues (network: root).
load: setup $(DEV_STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.load --output runs/load

# The site, with the generated reference tables and charts: open site/index.html.  Its generator is no part of the program, so it has an environment
# of its own.
$(SITE_STAMP): website/requirements.lock
	$(PYTHON) -m venv $(SITE_VENV)
	$(SITE_VENV)/bin/pip install --quiet --disable-pip-version-check --require-hashes \
		-r website/requirements.lock
	@touch $@

docs: setup $(SITE_STAMP)
	$(BIN)/python -m website.pages site
	$(SITE_VENV)/bin/python -m zensical build --clean --strict
	$(SITE_VENV)/bin/python -m website.finish site

# dist/: source archive, wheel and checksums of the version in pyproject.toml.  The wheel is built
# from the archive, so that both are complete.
BUILD = $(CURDIR)/$(BIN)/python -c "import sys; from setuptools import build_meta; \
	getattr(build_meta, sys.argv[1])(sys.argv[2])"
release: setup
	rm -rf dist share build/source
	mkdir -p share/man/man1 build/source dist
	$(BIN)/flexsheet man > share/man/man1/flexsheet.1
	$(BUILD) build_sdist dist > build/release.log
	tar --extract --directory build/source --strip-components 1 --file dist/*.tar.gz
	cd build/source && $(BUILD) build_wheel $(CURDIR)/dist >> $(CURDIR)/build/release.log
	cd dist && sha256sum *.tar.gz *.whl > SHA256SUMS
	@version=$$($(BIN)/flexsheet --version | cut -d' ' -f2); \
	grep -q "^## \[$$version\]" CHANGELOG.md || \
		echo "note: CHANGELOG.md has no section [$$version]; this build is not a release" >&2
	@ls -1 dist

clean:
	rm -rf $(VENV) $(SITE_VENV) site .cache build dist share runs *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
