# Two commands are all that a fresh machine needs: `make run` and `make test`.
# Both install everything into .venv first, from the versions in requirements.lock.

PYTHON ?= python3
JOBS ?= 2
INPUTS ?= 12000
SEED ?= 0
BIN := .venv/bin

.PHONY: install run tiny organ test test-cpus kill-test fuzz test-oldest check format docs wheel-check slurm-test profiles-check audit lock

install: .venv/installed

run: .venv/installed
	$(BIN)/snakemake -j$(JOBS) all

tiny: .venv/installed
	$(BIN)/snakemake -j$(JOBS) all evidence --configfile config/tiny.yaml

# What a prior of one organ is worth, by default of the shipped synthetic scan. Of other meshes:
# make organ CONFIG=my.yaml, with names and files under `organ.templates`.
organ: .venv/installed
	$(BIN)/snakemake -j$(JOBS) organ $(if $(CONFIG),--configfile $(CONFIG))

# Two workers, on a core each, and whole files for each: what the tests of one share is made once.
PYTEST := $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

test: .venv/installed
	OMP_NUM_THREADS=1 $(PYTEST)

# What may come out otherwise on another CPU, under each of several; `.ci/cpus.py list` names them.
test-cpus: .venv/installed
	.ci/cpus.py all -- $(PYTEST) -m numerical

# The workflow killed at random moments in every step, and run again: some twenty minutes.
kill-test: .venv/installed
	$(BIN)/python tests/workflow/kills.py --record results/kills.csv

# What must hold before a commit, tests apart.
check: .venv/installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/snakefmt --check Snakefile workflow/Snakefile workflow/rules
	$(BIN)/snakemake --lint
	$(BIN)/dine config check config.yaml
	$(BIN)/dine config check config/evidence.yaml config.yaml config/tiny.yaml
	$(BIN)/dine config check config.yaml config/full.yaml
	$(BIN)/dine config check config.yaml config/large.yaml
	$(BIN)/dine config check config/evidence.yaml config.yaml config/unseen.yaml
	$(BIN)/dine config check config/evidence.yaml config.yaml config/evidence-short.yaml
	$(BIN)/snakemake all -n --quiet

format: .venv/installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/snakefmt Snakefile workflow/Snakefile workflow/rules

# The documentation site, in site/; a link that leads nowhere is an error.
docs: .venv/installed
	$(BIN)/properdocs build --quiet --strict --config-file mkdocs.yml

# The package as a user installs it, in an environment of its own outside the checkout. WHOLE=1: all
# that it needs from the index, too, which takes minutes.
wheel-check: .venv/installed
	PYTHON=$(PYTHON) WHOLE=$(WHOLE) .ci/wheel

# The workflow through Slurm, which is installed and started for it: Debian or Ubuntu, and root.
slurm-test: .venv/installed
	.ci/slurm

# Profiles of other clusters, by dry runs, and a run with all files in a storage; needs rsync.
profiles-check: .venv/installed
	.ci/profiles

# Many damaged files for every reader; failing ones are kept in fuzz-failures/. For a nightly run.
fuzz: .venv/installed
	cd tests && ../$(BIN)/python -m fuzz --inputs $(INPUTS) --seed $(SEED) --out ../fuzz-failures

# The lowest versions that pyproject.toml allows; TORCH=2.13.0 for another PyTorch than the lowest.
test-oldest: .tools/installed
	PYTHON=$(PYTHON) TORCH=$(TORCH) .ci/oldest

# Known vulnerabilities of the locked versions; needs the network.
audit: .tools/installed
	.tools/bin/pip-audit --strict --require-hashes --disable-pip --requirement requirements.lock
	.tools/bin/pip-audit --strict --no-deps --disable-pip --requirement requirements-torch.lock

# The locks anew from pyproject.toml; UPGRADE="--upgrade" for the newest versions of everything.
lock: .tools/installed
	.ci/lock $(UPGRADE)

# Everything comes with a hash, but for PyTorch, whose CPU and CUDA builds share a version; what it
# needs beyond the lock are the CUDA libraries of its build, in the versions that it names.
# Python compiles what it imports when it does; all of it at once takes a third of the time.
.venv/installed: requirements.lock requirements-torch.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed; set PYTHON=")'
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --no-compile --require-hashes --no-deps --requirement requirements.lock
	$(BIN)/pip install --quiet --no-compile --requirement requirements-torch.lock
	$(BIN)/pip install --quiet --no-deps --no-build-isolation --editable .
	$(BIN)/pip check
	touch $@

.tools/installed: requirements-tools.lock
	$(PYTHON) -m venv .tools
	.tools/bin/pip install --quiet --require-hashes --no-deps --requirement requirements-tools.lock
	touch $@
