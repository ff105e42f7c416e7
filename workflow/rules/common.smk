# Shared by all rules. The checked configuration, paths, names and parameters.

import json
import os
import shlex
import shutil
import sys
from argparse import Namespace
from pathlib import Path

from snakemake.exceptions import WorkflowError

from dine import config as dine_config
from dine.errors import ConfigError
from dine.provenance import COMMAND, code_digest, folder_signature
from dine.results import (
    Results,
    NO_BACKBONE,
    backbone_and_seed,
    conditions,
    evidence_conditions,
    evidence_groups,
    evidence_names,
    figure_names,
    own_searches,
    pca_priors,
    replica,
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
SEARCH = CONFIG.lambda_search
SEARCHES = [FILES.search, *(FILES.search_of(name) for name in own_searches(CONFIG))]
# Once: to look through all of them for each job would take minutes for thousands of jobs.
GROUPS = evidence_groups(CONFIG)

# Rules call the `dine` that belongs to the Python that runs Snakemake.
shell.prefix(
    f"set -euo pipefail; export PATH={str(Path(sys.executable).parent)!r}:$PATH; "
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

# Where rule logs, benchmarks and the run folder of a method lie.
LOGS = RESULTS / "logs"
BENCHMARKS = RESULTS / "benchmarks"


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
    condition="noise|outliers|resampled",
    corruption=r"\d+(?:\.\d+)?",
    shape="primitives|tissue",


def section(model):
    """One narrow section of the configuration as text, for a rule's params and command line."""
    return json.dumps(model.model_dump(mode="json", exclude_none=True), sort_keys=True)


def drawn_settings():
    """What the figures need to know; other settings reach them through files, or not at all."""
    drawn = {"datasets", "backbones", "priors", "lambda_search"}
    return json.dumps(
        CONFIG.model_dump(mode="json", exclude_none=True, include=drawn), sort_keys=True
    )


def whole_config():
    """All of the configuration that can change a result, as text."""
    everywhere = {"resources": dine_config.Resources()}
    return section(CONFIG.model_copy(update=everywhere))


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


def unseen_settings(wildcards):
    """As ``raw_settings``, of the further objects."""
    dataset = CONFIG.datasets[wildcards.dataset]
    unseen = dataset.unseen
    settings = {"pairs": {"points": dataset.pairs.points}}
    changes = {"pairs_per_level": unseen.pairs_per_level}
    if unseen.folder is None:
        changes["objects"] = unseen.objects
    else:
        settings["source"] = {"kind": "path", "folder": unseen.folder}
    settings["recipe"] = dataset.recipe.model_copy(update=changes).model_dump()
    return json.dumps(settings, sort_keys=True)


def unseen_signature(wildcards):
    folder = CONFIG.datasets[wildcards.dataset].unseen.folder
    return folder_signature(Path(folder).expanduser()) if folder else ""


def raw_files(wildcards):
    """The raw files of a dataset, and of its further objects."""
    found = {"raw": FILES.dataset(wildcards.dataset, "raw.json")}
    if CONFIG.datasets[wildcards.dataset].unseen:
        found["unseen"] = FILES.dataset(wildcards.dataset, "unseen/raw.json")
    return found


def raw_options(wildcards):
    return options("--raw", raw_files(wildcards).values())


def unseen_option(wildcards, input):
    return options("--unseen", [input.unseen]) if "unseen" in input.keys() else ""


def most_option(wildcards):
    most = CONFIG.datasets[wildcards.dataset].corruption.pairs
    return options("--most", [most]) if most else ""


def raw_signature(wildcards):
    """Changes when a user's own folder does; Snakemake cannot know which files will be read."""
    source = CONFIG.datasets[wildcards.dataset].source
    return (
        folder_signature(Path(source.folder).expanduser())
        if source.kind == "path"
        else ""
    )


def backbone_config(wildcards):
    return CONFIG.every_backbone[backbone_and_seed(CONFIG, wildcards.backbone)[0]]


def training_seed(wildcards):
    return backbone_and_seed(CONFIG, wildcards.backbone)[1]


def code_of(step, backbone=None, *, data_term=None, priors=()):
    """Digest of the code behind a step, and of what the configuration picks for it by name.

    A backbone and priors are named as in the configuration, or as a folder is.
    """
    picked = [CONFIG.priors[prior].kind for prior in priors]
    if backbone:
        name, _ = backbone_and_seed(CONFIG, backbone)
        picked.append(CONFIG.every_backbone[name].kind)
    if data_term:
        picked.append(data_term)
    return code_digest(step, *picked)


def stage1_settings(wildcards):
    start = backbone_config(wildcards).start
    changes = {"start": start} if start else {}
    return section(CONFIG.stage1.model_copy(update=changes))


def backbone_settings(wildcards):
    backbone = backbone_config(wildcards)
    return json.dumps(
        {"kind": backbone.kind, "arguments": backbone.arguments}, sort_keys=True
    )


def search_settings(backbone):
    changes = {"backbone": backbone, "priors": CONFIG.searched(backbone)}
    return section(SEARCH.model_copy(update=changes))


def searched_priors(backbone):
    """Files of the priors, in the order in which they are searched."""
    return [
        FILES.prior(SEARCH.dataset, backbone, prior)
        for prior in CONFIG.searched(backbone)
    ]


def search_file(wildcards):
    """The search of λ that counts for a backbone."""
    name, _ = backbone_and_seed(CONFIG, wildcards.backbone)
    searching = CONFIG.searching(name)
    if searching == CONFIG.lambda_search.backbone:
        return FILES.search
    return FILES.search_of(searching)


def prior_settings(wildcards):
    prior = CONFIG.priors[wildcards.prior]
    return json.dumps(
        {
            "kind": prior.kind,
            "arguments": dine_config.check_arguments(prior),
            "fields": prior.fields,
        },
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


def calibrating_priors(wildcards):
    """The backbone's first PCA prior, if any: what the trust score measures fields with."""
    name, _ = backbone_and_seed(CONFIG, wildcards.backbone)
    return pca_priors(CONFIG, name)[:1]


def calibrating_prior(wildcards):
    return [
        FILES.prior(wildcards.dataset, wildcards.backbone, prior)
        for prior in calibrating_priors(wildcards)
    ]


def searches_from():
    """The searches of λ, and all that lies between them and their networks."""
    found = [*SEARCHES]
    dataset = CONFIG.lambda_search.dataset
    for backbone in (CONFIG.lambda_search.backbone, *own_searches(CONFIG)):
        found.append(FILES.dataset(dataset, f"{backbone}/dvf.h5"))
        found += [
            FILES.prior(dataset, backbone, prior) for prior in CONFIG.searched(backbone)
        ]
    return found


def priors_from(*names):
    """Some files of each dataset, and all that lies between them and the priors."""
    found = searches_from()
    for dataset in CONFIG.datasets:
        found += [FILES.dataset(dataset, name) for name in names]
        found += raw_files(Namespace(dataset=dataset)).values()
        for backbone in CONFIG.backbones_of(dataset):
            settings = CONFIG.backbones[backbone]
            if settings.priors:
                found.append(FILES.dataset(dataset, f"{backbone}/dvf.h5"))
            found += [
                FILES.prior(dataset, backbone, prior) for prior in settings.priors
            ]
    return found


def kept_files():
    """What `all` makes on its way; named as its inputs so that a deleted file is made again."""
    found = [RESULTS / "config.yaml"]
    found += priors_from("pairs.h5", "agreement.json")
    found += [
        FILES.variant(dataset, *condition)
        for dataset in CONFIG.datasets
        for condition in conditions(CONFIG, dataset)
    ]
    names = ("model.safetensors", "predictions.h5", "metrics.csv")
    return found + [FILES.run(*run, name) for run in RUNS for name in names]


# --- evidence: a method's files depend on what the configuration says of it ---


def has_own_pairs(dataset):
    """Whether the evidence makes pairs of its own; otherwise the dataset's test split is used."""
    test_sets = CONFIG.evidence.test_sets
    return dataset in test_sets or CONFIG.datasets[dataset].source.kind == "synthetic"


def evidence_raw_settings(wildcards):
    test_set = CONFIG.evidence.test_sets.get(wildcards.dataset)
    dataset = CONFIG.datasets[CONFIG.networks(wildcards.dataset)]
    settings = {"pairs": {"points": dataset.pairs.points}}
    if test_set:
        settings["source"] = {"kind": "path", "folder": test_set.folder}
    else:
        changes = {"objects": CONFIG.evidence.test_objects, "pairs_per_level": 1}
        settings["recipe"] = dataset.recipe.model_copy(update=changes).model_dump()
    return json.dumps(settings, sort_keys=True)


def evidence_raw_signature(wildcards):
    test_set = CONFIG.evidence.test_sets.get(wildcards.dataset)
    return folder_signature(Path(test_set.folder).expanduser()) if test_set else ""


def evidence_pair_settings(wildcards):
    return section(CONFIG.datasets[CONFIG.networks(wildcards.dataset)].pairs)


def evidence_raw_files(wildcards):
    """The raw files that the pairs of the evidence are made of."""
    if has_own_pairs(wildcards.dataset):
        return [FILES.evidence(wildcards.dataset, "raw.json")]
    return list(raw_files(wildcards).values())


def evidence_pairs_file(wildcards):
    if has_own_pairs(wildcards.dataset):
        return FILES.evidence(wildcards.dataset, "pairs.h5")
    return FILES.dataset(wildcards.dataset, "pairs.h5")


def evidence_levels(wildcards):
    if wildcards.dataset in CONFIG.evidence.test_sets:
        return ""
    return options("--at", CONFIG.evidence.at_levels)


def evidence_variants(wildcards):
    return [
        FILES.evidence(wildcards.dataset, "variants", f"{condition}_{level:g}.h5")
        for condition, level in evidence_conditions(CONFIG, wildcards.dataset)
    ]


def evidence_model(wildcards):
    folder = replica(CONFIG, wildcards.cell_backbone, int(wildcards.seed))
    trained_on = CONFIG.networks(wildcards.dataset)
    return FILES.run(trained_on, folder, wildcards.network, "model.safetensors")


def searched_prior(wildcards):
    prior = CONFIG.evidence.methods[wildcards.trained].prior
    search = CONFIG.lambda_search
    return FILES.prior(search.dataset, search.backbone, prior)


def method_code(wildcards):
    method = CONFIG.evidence.methods[wildcards.trained]
    return code_of(
        "stage2",
        wildcards.backbone,
        data_term=method.data_term,
        priors=[method.prior] if method.prior else [],
    )


def searched_code(wildcards):
    method = CONFIG.evidence.methods[wildcards.trained]
    return code_of(
        "search-lambda",
        CONFIG.lambda_search.backbone,
        data_term=method.data_term,
        priors=[method.prior],
    )


def method_inputs(wildcards):
    """The prior of a Stage-2 method, and the search of its λ unless that is given."""
    method = CONFIG.evidence.methods[wildcards.trained]
    found = {}
    if method.prior:
        found["prior"] = FILES.prior(
            wildcards.dataset, wildcards.backbone, method.prior
        )
        if method.weight is None:
            found["weight"] = FILES.evidence("lambda", f"{wildcards.trained}.json")
    return found


def method_prior_options(wildcards, input):
    method = CONFIG.evidence.methods[wildcards.trained]
    if not method.prior:
        return ""
    weight = input.weight if method.weight is None else method.weight
    return shlex.join(["--prior", str(input.prior), "--lambda", str(weight)])


def method_stage2(wildcards):
    data_term = CONFIG.evidence.methods[wildcards.trained].data_term
    return section(CONFIG.stage2.model_copy(update={"data_term": data_term}))


def evidence_search(wildcards):
    search = CONFIG.lambda_search
    named = {"dataset": search.dataset, "backbone": search.backbone}
    choice = CONFIG.evidence.choice.model_dump()
    return json.dumps(
        {**named, **choice, "priors": [wildcards.trained]}, sort_keys=True
    )


def refined_code(wildcards):
    method = CONFIG.evidence.methods[wildcards.refined]
    return code_of(
        "refine-predictions",
        data_term=method.data_term,
        priors=[method.prior] if method.prior else [],
    )


def refined_inputs(wildcards):
    method = CONFIG.evidence.methods[wildcards.refined]
    found = {
        "predictions": FILES.evidence(
            wildcards.dataset,
            wildcards.cell_backbone,
            f"seed{wildcards.seed}",
            method.of,
            "predictions.h5",
        )
    }
    if method.prior:
        folder = replica(CONFIG, wildcards.cell_backbone, int(wildcards.seed))
        fitted_on = CONFIG.networks(wildcards.dataset)
        found["prior"] = FILES.prior(fitted_on, folder, method.prior)
    return found


def refined_prior_options(wildcards, input):
    return (
        options("--prior", [input.prior])
        if CONFIG.evidence.methods[wildcards.refined].prior
        else ""
    )


def group_cells(wildcards):
    return GROUPS[wildcards.dataset, wildcards.group, int(wildcards.seed)]


def cell_predictions(cells):
    return [
        FILES.evidence(
            cell.dataset,
            cell.backbone,
            f"seed{cell.seed}",
            cell.method,
            "predictions.h5",
        )
        for cell in cells
    ]


def evidence_kept():
    """What `evidence` makes on its way; named as its inputs, as those of `all` are."""
    found = searches_from() + [FILES.prior(*prior) for prior in diagnosed_priors()]
    for (dataset, backbone, seed), cells in GROUPS.items():
        place = Namespace(dataset=dataset)
        found += [*evidence_raw_files(place), evidence_pairs_file(place)]
        found += [*evidence_variants(place), *cell_predictions(cells)]
        if backbone == NO_BACKBONE:
            continue
        trained, folder = CONFIG.networks(dataset), replica(CONFIG, backbone, seed)
        for cell in cells:
            method = CONFIG.evidence.methods.get(cell.method)
            refined = isinstance(method, dine_config.RefinedMethod)
            network = method.of if refined else cell.method
            found += cell_predictions([cell._replace(method=network)])
            found.append(FILES.run(trained, folder, network, "model.safetensors"))
            prior = method.prior if method else cell.method
            if prior in CONFIG.priors:
                found.append(FILES.dataset(trained, f"{folder}/dvf.h5"))
                found.append(FILES.prior(trained, folder, prior))
        found += raw_files(Namespace(dataset=trained)).values()
        found.append(FILES.dataset(trained, "pairs.h5"))
    return list(dict.fromkeys(found))


def cell_options(cells, predictions):
    methods = [cell.method for cell in cells]
    return f"{options('--method', methods)} {options('--predictions', predictions)}"


def example_cells(dataset):
    """What is drawn of a dataset: with the backbone of the search and the first seed."""
    place = (CONFIG.lambda_search.backbone, CONFIG.evidence.seeds[0])
    some = [
        cell
        for backbone, seed in (place, (NO_BACKBONE, 0))
        for cell in GROUPS.get((dataset, backbone, seed), ())
    ]
    found = {cell.method: cell for cell in some}
    return [found[name] for name in CONFIG.evidence.examples if name in found]


def evidence_examples():
    datasets = dict.fromkeys(dataset for dataset, _, _ in GROUPS)
    return [
        FILES.evidence(dataset, "examples.png")
        for dataset in datasets
        if example_cells(dataset)
    ]


def evidence_example_options(wildcards, input):
    rows = [
        (Path(path).parent.name, path, "typical pairs under each condition.")
        for path in input.examples
    ]
    return options("--example", *zip(*rows)) if rows else ""


def evidence_metrics():
    return [
        FILES.evidence(dataset, backbone, f"seed{seed}", "metrics.csv")
        for dataset, backbone, seed in GROUPS
    ]


def evidence_searches():
    searched = [
        name
        for name in evidence_names(CONFIG, dine_config.Stage2Method)
        if CONFIG.evidence.methods[name].prior
        and CONFIG.evidence.methods[name].weight is None
    ]
    found = [FILES.evidence("lambda", f"{name}.json") for name in searched]
    return [FILES.search, *found]


def diagnosed_priors():
    """Every prior of the evidence on every dataset, for the backbone of the search."""
    used = set(CONFIG.priors_of_stage2)
    for method in CONFIG.evidence.methods.values():
        used |= {getattr(method, "prior", None)} - {None}
    return [
        (dataset, CONFIG.lambda_search.backbone, prior)
        for dataset in CONFIG.datasets
        for prior in CONFIG.priors
        if prior in used
    ]


def evidence_diagnostics():
    return [
        FILES.evidence("diagnostics", dataset, backbone, f"{prior}.json")
        for dataset, backbone, prior in diagnosed_priors()
    ]


def evidence_method_texts():
    """Title, group and description of every method, for the report."""
    known = {
        dine_config.STAGE1: {
            "title": "Stage 1",
            "group": "network",
            "description": "The network trained on the Chamfer distance alone.",
        },
        dine_config.CONTROL: {
            "title": "Control (λ = 0)",
            "group": "network",
            "description": "Stage 2 without a prior: same start, steps and seed.",
        },
    }
    for prior in CONFIG.priors_of_stage2:
        kind = CONFIG.priors[prior].kind
        known[prior] = {
            "title": f"DINE-{ {'pca': 'PCA', 'flow': 'Flow'}.get(prior, prior) }",
            "group": "prior",
            "description": f"Stage 2 with the prior {kind}, and the λ of the search for `all`.",
        }
    for name, method in CONFIG.evidence.methods.items():
        known[name] = {
            "title": method.title or name,
            "group": method.group,
            "description": method.description,
        }
    return json.dumps(known, sort_keys=True)
