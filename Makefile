# make        the environment, then every figure, number, notebook and page of the default dataset
# make quick  the environment, then the tests that take no time: library, rules, architecture; no whole runs
# make test   the environment, then every test

PYTHON ?= python3
CORES  ?= 2
BIN    := .venv/bin
READY  := .venv/.ready
BENCH  := .venv-bench
CHECK  := results/check
WHEEL  := build/wheel

.PHONY: all quick test docs wheel load load-kills load-hostile load-scale load-rules test-slurm newest licences lint check-numbers bench rivals \
    validate validate-real snakemake-report lock lock-bench clean

all: $(READY)
	$(BIN)/snakemake --cores $(CORES) --workflow-profile workflow/profiles/default
	@$(BIN)/spotcheck where results/virtual-rig

quick: $(READY)
	$(BIN)/python -m pytest --numprocesses $(CORES) --dist loadgroup -m "not slow"

test: $(READY)
	$(BIN)/python -m pytest --numprocesses $(CORES) --dist loadgroup

# The environment is complete when .ready is there: a stopped installation starts again.
$(READY): requirements.lock pyproject.toml workflow/rig/pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --require-hashes -r requirements.lock
	$(BIN)/pip install --quiet --no-deps --no-build-isolation --editable . --editable workflow/rig
	@touch $@

# The documentation site, build/docs/index.html; a warning, such as a link that leads nowhere, is an error.
docs: $(READY)
	$(BIN)/python -m sphinx --quiet --fresh-env --fail-on-warning --keep-going -d build/docs-read -c workflow/docs/site workflow/docs build/docs

# The sdist, and the wheel that is built from it, in an environment of its own, as a user installs it: without Snakemake,
# papermill and the rig it fits a spot and characterises a sensor.
wheel: $(READY)
	rm -rf $(WHEEL)
	$(BIN)/python -m build --outdir $(WHEEL)/dist .
	$(BIN)/python -m twine check --strict $(WHEEL)/dist/*
	$(PYTHON) -m venv $(WHEEL)/venv
	$(WHEEL)/venv/bin/pip install --quiet $(WHEEL)/dist/*.whl
	cd $(WHEEL) && venv/bin/python -I ../../tests/check_wheel.py

# Load and failure tests, about three hours in all: each programme writes its rows of workflow/docs/load.md.
LOAD_PAGE := $(BIN)/python -m tests.load.table
load: load-kills load-hostile load-scale load-rules test-slurm

load-kills: $(READY)
	$(BIN)/python -m tests.load.kills
	$(LOAD_PAGE)

load-hostile: $(READY)
	$(BIN)/python -m tests.load.hostile --inputs 15000
	$(LOAD_PAGE)

load-scale: $(READY)
	$(BIN)/python -m tests.load.scale
	$(LOAD_PAGE)

load-rules: $(READY)
	$(BIN)/python -m tests.load.rules
	$(LOAD_PAGE)

# The workflow on a real Slurm of two nodes, which Debian's packages bring; as root, in a mount namespace of its own.
test-slurm: $(READY)
	@if [ "$$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then echo "skipped: needs root and apt-get"; else \
	    apt-get install --quiet --yes --no-install-recommends slurmctld slurmd slurm-client munge && \
	    unshare --mount $(BIN)/python -m tests.load.slurm && $(LOAD_PAGE); fi

# The newest versions that pyproject.toml allows, in an environment of their own, and the tests that take little time.
newest:
	$(PYTHON) -m venv .venv-newest
	.venv-newest/bin/pip install --quiet --upgrade --editable ".[workflow,dev]" --editable workflow/rig
	.venv-newest/bin/python -m pytest --numprocesses $(CORES) --dist loadgroup -m "not slow"

# The licence of every package that the lock installs.
licences: $(READY)
	$(BIN)/pip-licenses --order license

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/snakefmt --check Snakefile workflow/rules
	$(BIN)/mypy

# Of the default dataset's last run: no number of the paper left its tolerance, and pages quote what was computed.
# QUOTE=--write mends the pages instead.
QUOTED := $(BIN)/python tests/check_readme.py
check-numbers: $(READY)
	$(BIN)/spotcheck paper data/published.yaml --seeds data/published_seeds.csv --strict \
	    --dataset data/virtual-rig --results results/virtual-rig \
	    --table $(CHECK)/numbers.csv --page $(CHECK)/numbers.html --summary $(CHECK)/numbers.md
	$(QUOTED) workflow/docs/paper.md numbers $(CHECK)/numbers.md $(QUOTE)
	$(QUOTED) README.md numbers workflow/docs/paper.md --first $(QUOTE)
	$(QUOTED) README.md missing-answer results/virtual-rig/figures/index.json $(QUOTE)
	$(QUOTED) README.md $(QUOTE)

# Ours and other packages side by side, in an environment of their own: they need 3 GB of disk.
# PARTS="estimator simulator" runs just these; tests/validation/benchmarks/run.py lists all. At a release its table is published:
# tests/check_readme.py workflow/docs/benchmarks.md benchmarks results/benchmarks/summary.md --write
bench: $(BENCH)/.ready
	$(BENCH)/bin/python -m tests.validation.benchmarks.run $(PARTS)

# The lock is complete; pip itself would ask for hashes of `pandas[excel]`, which it takes for another package than pandas.
$(BENCH)/.ready: requirements-bench.lock pyproject.toml workflow/rig/pyproject.toml
	$(PYTHON) -m venv $(BENCH)
	$(BENCH)/bin/pip install --quiet --no-deps --require-hashes -r requirements-bench.lock
	$(BENCH)/bin/pip install --quiet --no-deps --no-build-isolation --editable . --editable workflow/rig
	@touch $@

# Rival explanations of the printed numbers of the paper, about an hour and a half of one core: data/rival_worlds.json and results/rivals.
rivals: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.validation.rivals

# Data sets with hidden effects, judged for two hours; each call adds to those of the earlier ones at a commit. Real beams and
# frames lie beside the repository; without them their sets are left out. VALIDATE="--hours 1 --jobs 40" changes that;
# `VALIDATE="--report --publish"` writes the table into workflow/docs/.
VALIDATE ?= --hours 2
validate: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.validation.run light --workers $(CORES) $(VALIDATE)

# Flats of a real sensor, as they are and with a known effect put into their readings, and their page. Needs the frames beside
# the repository. REAL=--publish writes the page into workflow/docs/.
validate-real: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.validation.run real --workers $(CORES) $(REAL)

lock-bench:
	uv pip compile pyproject.toml --extra workflow --extra dev --extra bench --universal --generate-hashes --no-header --no-annotate \
	    --python-version 3.11 --output-file requirements-bench.lock

# Snakemake's own report of the last run, with captions and categories.
snakemake-report: $(READY)
	$(BIN)/snakemake --report results/snakemake-report.html

# Needs `uv` on PATH; writes hashes, no host and no path.
lock:
	uv pip compile pyproject.toml --extra workflow --extra dev --universal --generate-hashes --no-header --no-annotate \
	    --python-version 3.11 --output-file requirements.lock

clean:
	rm -rf build results .snakemake data/virtual-rig/frames data/virtual-rig/truth.json
