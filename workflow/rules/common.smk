# Shared by all rules: the checked configuration, what follows from it, and how jobs are asked for.

import os
import shlex
import shutil
import sys
from pathlib import Path

from snakemake.exceptions import WorkflowError

from dine import config as dine_config
from dine.errors import ConfigError
from dine.plan import (
    FIRST_PRETRAINING_OBJECT,
    FIRST_TEST_OBJECT,
    EvidencePlan,
    section,
    text,
)
from dine.provenance import COMMAND, code_digest
from dine.results import (
    NO_BACKBONE,
    evidence_names,
    figure_names,
    own_searches,
    pca_priors,
    runs,
    table_names,
)

try:
    CONFIG = dine_config.validate(config)
except ConfigError as error:
    raise WorkflowError(str(error))

# Which settings each step gets, and which files it needs.
PLAN = EvidencePlan(CONFIG)
# Where everything lies.
FILES = PLAN.files
EVIDENCE = FILES.evidence

FIGURES = figure_names(CONFIG)
TABLES = table_names(CONFIG)
RUNS = [FILES.run(*run) for run in runs(CONFIG)]
SEARCH = CONFIG.lambda_search

EXAMPLE_TEXTS = ["typical pairs under each condition."] * len(PLAN.examples())

# What lies in the folders of a dataset, a backbone and a run of it.
DATA = FILES.data("{dataset}")
STAGE1 = FILES.run("{dataset}", "{backbone}", "stage1")
NETWORK = FILES.network("{dataset}", "{backbone}", "{run}")

# Rules call the `dine` that belongs to the Python that runs Snakemake; with `--sdm conda` that of
# their environment, which is put before it, and installed from the sources of this workflow.
BIN = str(Path(sys.executable).parent)
FOLDERS = os.environ.get("PATH", os.defpath).split(os.pathsep)
os.environ.update(
    PATH=os.pathsep.join(dict.fromkeys([BIN, *FOLDERS])),
    DINE_SOURCES=str(ROOT or ""),
)

# What a user asked for, for the records of what it gave; jobs are started by other commands.
os.environ.setdefault(COMMAND, shlex.join(["snakemake", *sys.argv[1:]]))

GPUS = int(
    CONFIG.device == "cuda"
    or (CONFIG.device == "auto" and shutil.which("nvidia-smi") is not None)
)
THREADS = CONFIG.threads
# A training is one job, whatever the number of its processes. Their number changes results by
# rounding only, so it is a resource and no parameter: nothing finished is made again for it.
PROCESSES = CONFIG.processes
# Kinds of jobs that compute on CONFIG.device, and in how many processes.
ON_DEVICE = {"training": PROCESSES, "prediction": 1}
COMPUTE = f"--device {CONFIG.device} --precision {CONFIG.precision}"

# Matches no name.
NOTHING = "(?!)"
EVERY_BACKBONE = "|".join(CONFIG.every_backbone)


wildcard_constraints:
    dataset="|".join([*CONFIG.datasets, *CONFIG.evidence.test_sets]),
    # Trainings with other seeds than the configuration's lie in folders of their own.
    backbone=rf"(?:{EVERY_BACKBONE})(?:/seed\d+)?",
    prior="|".join(CONFIG.priors),
    prior_of_stage2="|".join(CONFIG.priors_of_stage2) or NOTHING,
    trained="|".join(evidence_names(CONFIG, dine_config.Stage2Method)) or NOTHING,
    run="stage1|stage2/[a-z0-9_]+",
    condition="noise|outliers",
    corruption=r"\d+(?:\.\d+)?",
    shape="|".join(CONFIG.pretraining.levels),


def request(kind):
    """Resources of a kind of job. Locally only `gpu` is counted; a cluster is asked for all."""
    asked = getattr(CONFIG.resources, kind)
    processes = ON_DEVICE.get(kind, 1)
    found = {"mem_mb": asked.memory_mb * processes, "runtime": asked.minutes}
    if kind in ON_DEVICE:
        found["processes"] = processes
        if GPUS:  # some executors ask for a GPU wherever the word stands, be it with 0
            found["gpu"] = GPUS * processes
    return found


def options(flag, *columns):
    """A repeated command-line option, quoted for the shell: one for each row of the columns."""
    return " ".join(shlex.join([flag, *map(str, row)]) for row in zip(*columns))


def trained(network):
    """The outputs of a training."""
    return {
        "model": network.model,
        "history": network.history,
        "record": network.record,
    }


def prior_options(prior, weight):
    """Of `dine stage2`: a prior's file, and its λ or the search that found it."""
    return shlex.join(["--prior", str(prior), "--lambda", str(weight)])


def method_options(name, input):
    """The same of a method of the evidence, whose λ may be given."""
    method = PLAN.method(name)
    if not method.prior:
        return ""
    return prior_options(
        input.prior, input.weight if method.weight is None else method.weight
    )


def calibration_options(input):
    """Of `dine calibrate`: pairs, their targets of other points, the meshes that both were drawn
    on, and a prior if there is one."""
    named = (
        ("--pairs", input.pairs),
        ("--targets", input.targets),
        ("--raw", input.raws),
    )
    return " ".join(options(*x) for x in (*named, ("--prior", input.priors)))


def group(wildcards):
    """The evaluations of the evidence that one job makes together."""
    return PLAN.groups[wildcards.dataset, wildcards.group, int(wildcards.seed)]


def cell_options(cells, predictions):
    methods = [cell.method for cell in cells]
    return f"{options('--method', methods)} {options('--predictions', predictions)}"
