# Two commands are all that a fresh machine needs: `make run` and `make test`.
# Both install everything into .venv first, from the versions in requirements.lock.

PYTHON ?= python3
JOBS ?= 2
BIN := .venv/bin

.PHONY: run tiny test kill-test check format docs wheel-check slurm-test

run: .venv/installed
	$(BIN)/snakemake -j$(JOBS) all

tiny: .venv/installed
	$(BIN)/snakemake -j$(JOBS) all evidence --configfile config/tiny.yaml

test: .venv/installed
	$(BIN)/pytest

# The workflow killed at random moments in every step, and run again: some twenty minutes.
kill-test: .venv/installed
	$(BIN)/python tests/workflow/kills.py --record results/kills.csv

# What must hold before a commit, tests apart.
check: .venv/installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/snakefmt --check Snakefile workflow/rules
	$(BIN)/snakemake --lint
	$(BIN)/dine config check config.yaml
	$(BIN)/dine config check config.yaml config/tiny.yaml
	$(BIN)/dine config check config.yaml config/full.yaml
	$(BIN)/snakemake all -n --quiet

format: .venv/installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/snakefmt Snakefile workflow/rules

# The documentation site, in site/; a link that leads nowhere is an error.
docs: .venv/installed
	$(BIN)/properdocs build --quiet --strict --config-file mkdocs.yml

# The package as a user installs it, in an environment of its own outside the checkout.
wheel-check:
	PYTHON=$(PYTHON) .ci/wheel

# The workflow through Slurm, which is installed and started for it: Debian or Ubuntu, and root.
slurm-test: .venv/installed
	.ci/slurm

.venv/installed: requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed; set PYTHON=")'
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --requirement requirements.lock
	$(BIN)/pip install --quiet --no-deps --editable .
	touch $@
