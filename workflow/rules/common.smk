# Shared by all rules. The checked configuration, paths, names and parameters.

import json
import shlex
import shutil
import sys
from pathlib import Path

from snakemake.exceptions import WorkflowError

from dine import config as dine_config
from dine.errors import ConfigError
from dine.provenance import code_digest, folder_signature
from dine.results import (
    Results,
    conditions,
    figure_names,
    pca_priors,
    runs,
    table_names,
)

try:
    CONFIG = dine_config.validate(config)
except ConfigError as error:
    raise WorkflowError(str(error))

RESULTS = Path(CONFIG.results)
FILES = Results(RESULTS)
FIGURES = figure_names(CONFIG)
TABLES = table_names(CONFIG)
RUNS = runs(CONFIG)

# Rules call the `dine` that belongs to the Python that runs Snakemake.
shell.prefix(
    f"set -euo pipefail; export PATH={str(Path(sys.executable).parent)!r}:$PATH; "
)

GPUS = int(
    CONFIG.device == "cuda"
    or (CONFIG.device == "auto" and shutil.which("nvidia-smi") is not None)
)
THREADS = CONFIG.threads
# A training is one job, whatever the number of its processes. Their number changes results by
# rounding only, so it is a resource and no parameter: nothing finished is made again for it.
PROCESSES = CONFIG.processes
COMPUTE = f"--device {CONFIG.device} --precision {CONFIG.precision}"

# Where rule logs, benchmarks and the run folder of a method lie.
LOGS = RESULTS / "logs"
BENCHMARKS = RESULTS / "benchmarks"


wildcard_constraints:
    dataset="|".join(CONFIG.datasets),
    backbone="|".join(CONFIG.backbones),
    prior="|".join(CONFIG.priors),
    run="stage1|stage2/(?:" + "|".join([dine_config.CONTROL, *CONFIG.priors]) + ")",
    condition="noise|outliers",
    corruption=r"\d+(?:\.\d+)?",
    shape="primitives|tissue",


def section(model):
    """One narrow section of the configuration as text, for a rule's params and command line."""
    return json.dumps(model.model_dump(mode="json", exclude_none=True), sort_keys=True)


def options(flag, *columns):
    """A repeated command-line option, quoted for the shell: one for each row of the columns."""
    return " ".join(shlex.join([flag, *map(str, row)]) for row in zip(*columns))


def variant_files(wildcards):
    return [
        FILES.variant(wildcards.dataset, *condition)
        for condition in conditions(CONFIG, wildcards.dataset)
    ]


def raw_settings(wildcards):
    dataset = CONFIG.datasets[wildcards.dataset]
    # Not the split, nor the convention: changing those does not change the raw files.
    return json.dumps(
        {
            "source": dataset.source.model_dump(exclude_none=True),
            "recipe": dataset.recipe.model_dump(),
            "pairs": {"points": dataset.pairs.points},
        },
        sort_keys=True,
    )


def raw_signature(wildcards):
    """Changes when a user's own folder does; Snakemake cannot know which files will be read."""
    source = CONFIG.datasets[wildcards.dataset].source
    return (
        folder_signature(Path(source.folder).expanduser())
        if source.kind == "path"
        else ""
    )


def backbone_settings(wildcards):
    backbone = CONFIG.backbones[wildcards.backbone]
    return json.dumps(
        {"kind": backbone.kind, "arguments": backbone.arguments}, sort_keys=True
    )


def prior_settings(wildcards):
    prior = CONFIG.priors[wildcards.prior]
    return json.dumps(
        {"kind": prior.kind, "arguments": dine_config.check_arguments(prior)},
        sort_keys=True,
    )


def stage2_outputs(variant):
    folder = RESULTS / "{dataset}" / "{backbone}" / "stage2" / variant
    return {
        "model": folder / "model.safetensors",
        "history": folder / "history.csv",
        "record": folder / "run.json",
    }


def variant_options(wildcards, input):
    return options("--variant", input.variants)


def calibrating_prior(wildcards):
    """The backbone's first PCA prior, if any: what the trust score measures fields with."""
    return [
        FILES.prior(wildcards.dataset, wildcards.backbone, prior)
        for prior in pca_priors(CONFIG, wildcards.backbone)[:1]
    ]
