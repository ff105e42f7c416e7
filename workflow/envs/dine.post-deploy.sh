#!/usr/bin/env bash
# Snakemake runs this in the new environment, from the folder that it was started in: the checkout.
set -euo pipefail
pip install --quiet --require-hashes --no-deps --requirement requirements.lock
pip install --quiet --requirement requirements-torch.lock
pip install --quiet --no-deps --no-build-isolation --editable .
