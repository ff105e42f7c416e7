#!/usr/bin/env bash
# Snakemake runs this in the new environment, from whatever folder it was started in. What is installed
# is what lies in the folder of this workflow, which common.smk names.
set -euo pipefail
cd "${DINE_SOURCES:-}" && [ -f requirements.lock ] || {
    echo "--sdm conda needs the workflow as a folder on this machine, with dine/ and requirements.lock." >&2
    exit 1
}
pip install --quiet --require-hashes --no-deps --requirement requirements.lock
pip install --quiet --requirement requirements-torch.lock
pip install --quiet --no-deps --no-build-isolation --editable .
