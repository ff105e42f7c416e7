"""What each edit of configuration, files or code makes again: that, and nothing else. And a small
version of ``make kill-test``: some kills, then the files of an undisturbed run."""

import json
import re
import shutil
import signal
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import yaml
from kills import Kill, finish, perform
from workplace import ROOT, Workplace, command_of, differences

from dine import provenance

ALL = Counter(
    stage1=1,
    fields=1,
    fit_prior=2,
    search_lambda=1,
    stage2_control=1,
    stage2_prior=2,
    predict=4,
    evaluate=4,
    tables=1,
    figures=1,
    html=1,
)
DATA = Counter(pairs=1, agreement=1, corrupt=1)
STAGE2 = ALL - Counter(stage1=1, fields=1, fit_prior=2, predict=1, evaluate=1)
SHOWN = Counter(tables=1, figures=1, html=1)
ONE_PRIOR = Counter(fit_prior=1, stage2_prior=1, predict=1, evaluate=1) + SHOWN
# λ is searched with the PCA prior and taken by the other one, too.
WEIGHT = Counter(search_lambda=1, stage2_prior=2, predict=2, evaluate=2) + SHOWN
TESTED = Counter(predict=4, evaluate=4) + SHOWN
CONFIG = Counter(resolved_config=1)

EGGS = ("datasets", "eggs")
SETTINGS = {
    "Stage 1": (("stage1", "steps"), 201, ALL),
    "Stage 2": (("stage2", "steps"), 101, STAGE2),
    "values of λ": (("lambda_search", "candidates"), [1.0e-4, 1.0e-3], WEIGHT),
    "how far the values of λ go on": (("lambda_search", "extend"), 0, WEIGHT),
    "a search of λ that is there already": (
        ("backbones", "affine", "own_lambda"),
        True,
        Counter(figures=1, html=1),
    ),
    "the only dataset of a backbone": (
        ("backbones", "affine", "datasets"),
        ["eggs"],
        Counter(figures=1, html=1),
    ),
    "the PCA prior": (
        ("priors", "pca", "arguments", "components"),
        1,
        WEIGHT + Counter(fit_prior=1),
    ),
    "one's own prior": (("priors", "vectors", "arguments"), {"epsilon": 1.0e-5}, ONE_PRIOR),
    # Fields of the training split are predictions, too.
    "pairs per prediction": (
        ("evaluation", "batch_size"),
        3,
        ALL - Counter(stage1=1, stage2_control=1),
    ),
    "one more noise level": (
        (*EGGS, "corruption", "noise"),
        [0.03, 0.05],
        TESTED + Counter(corrupt=1),
    ),
    "the recipe": ((*EGGS, "recipe", "amplitude"), 0.2, ALL + DATA + Counter(raw=1)),
    "more deformations": ((*EGGS, "recipe", "pairs_per_level"), 2, ALL + DATA + Counter(raw=1)),
    "a split by deformation": ((*EGGS, "pairs", "split", "by"), "deformation", ALL + DATA),
    "unseen objects": ((*EGGS, "unseen"), {"folder": "meshes"}, ALL + DATA + Counter(raw_unseen=1)),
    "targets of other points": (
        (*EGGS, "corruption", "resampled"),
        True,
        TESTED + Counter(resample=1),
    ),
    "fewer corrupted pairs": ((*EGGS, "corruption", "pairs"), 1, TESTED + Counter(corrupt=1)),
    "the chance of a training": (
        ("evaluation", "training_spread"),
        0.2,
        Counter(tables=1, html=1),
    ),
    "the same under outliers": (
        ("evaluation", "training_spread_outliers"),
        0.2,
        Counter(tables=1, html=1),
    ),
    "the index convention": ((*EGGS, "pairs", "convention"), "none", ALL + DATA),
    "another target": (("pretraining", "steps"), 7, Counter(html=1)),
    "threads": (("threads",), 2, Counter(html=1)),
}

CODE = {
    "dine/geometry/graph.py": ALL,
    "dine/models/features.py": ALL,
    "dine/training/loop.py": ALL,
    "dine/training/stage2.py": STAGE2,
    "dine/data/corruption.py": TESTED + Counter(corrupt=1),
    "dine/priors/pca.py": WEIGHT + Counter(fit_prior=1),
    "dine/evaluation/conditions.py": TESTED,
    "dine/evaluation/metrics.py": Counter(evaluate=4) + SHOWN,
    "dine/evaluation/statistics.py": SHOWN,
    "dine/data/names.py": ALL + DATA + Counter(raw=1),
    "dine/reporting/tables.py": SHOWN,
    "dine/reporting/comparisons.py": SHOWN,
    "dine/reporting/run.py": Counter(figures=1, html=1),
    "dine/reporting/figures.py": Counter(figures=1, html=1),
    "dine/reporting/report.html": Counter(html=1),
    "code/my_package/backbones.py": ALL,
    "code/my_package/terms.py": STAGE2,
    "code/my_package/priors.py": ONE_PRIOR,
    # Not used here.
    "dine/priors/flow.py": Counter(),
    "dine/viewer/view.py": Counter(),
    "code/my_package/data.py": Counter(),
    # Used by all.
    "dine/files.py": ALL + DATA + Counter(raw=1),
}


def with_setting(keys, value):
    def edit(place: Workplace):
        path = place.folder / "smallest.yaml"
        settings = yaml.safe_load(path.read_text())
        section = settings
        for key in keys[:-1]:
            section = section.setdefault(key, {})
        section[keys[-1]] = value
        path.write_text(yaml.safe_dump(settings))

    return edit


def with_code(name, added="\nADDED = 1\n"):
    def edit(place: Workplace):
        if name.startswith("dine/"):
            place.package = place.folder / "package"
            ignored = shutil.ignore_patterns("__pycache__", "weights")
            shutil.copytree(ROOT / "dine", place.package / "dine", ignore=ignored)
        path = (place.package if name.startswith("dine/") else place.folder) / name
        path.write_text(path.read_text() + added)

    return edit


def touched_mesh(place):
    (place.folder / "meshes" / "egg1.ply").touch()


def without(name):
    return lambda place: (place.results / name).unlink()


EDITS = {name: (with_setting(*edit), CONFIG + jobs) for name, (*edit, jobs) in SETTINGS.items()}
EDITS |= {name: (with_code(name), jobs) for name, jobs in CODE.items()}
EDITS |= {
    "nothing": (lambda place: None, Counter()),
    "a remark in code": (with_code("dine/geometry/graph.py", "\n# A remark.\n"), Counter()),
    "a touched mesh": (touched_mesh, ALL + DATA + Counter(raw=1)),
    "a lost table of metrics": (
        without("eggs/affine/stage2/vectors/metrics.csv"),
        Counter(evaluate=1) + SHOWN,
    ),
    "lost weights": (
        without("eggs/affine/stage2/vectors/model.safetensors"),
        Counter(stage2_prior=1, predict=1, evaluate=1) + SHOWN,
    ),
    "a lost figure": (without("figures/lambda.png"), Counter(figures=1, html=1)),
}


def planned(place: Workplace) -> Counter:
    """Number of jobs by rule that a dry run would start."""
    table = place.run("all", "-n").partition("Job stats:")[2].partition("\n\n")[0]
    jobs = Counter(
        {rule: int(count) for rule, count in re.findall(r"^(\w+)\s+(\d+)$", table, re.MULTILINE)}
    )
    for rule in ("all", "total"):
        jobs.pop(rule, None)
    return jobs


@pytest.fixture(scope="module")
def plans(undisturbed, tmp_path_factory) -> dict[str, Counter]:
    """What a dry run would do after each edit, found for two edits at a time."""

    def plan(name):
        place = undisturbed.finished.copy(tmp_path_factory.mktemp("edited"))
        place.warm = True
        EDITS[name][0](place)
        jobs = planned(place)
        shutil.rmtree(place.folder)
        return jobs

    with ThreadPoolExecutor(2) as threads:
        return dict(zip(EDITS, threads.map(plan, EDITS), strict=True))


@pytest.mark.parametrize("edit", EDITS)
def test_an_edit_reruns_what_depends_on_it_and_nothing_else(plans, edit):
    assert plans[edit] == EDITS[edit][1]


BACKBONE = "my_package.backbones:AffineNet"
TERM = "my_package.terms:PartialTarget"
PRIOR = "my_package.priors:VectorGaussian"
CLASSES = {
    "stage1": (BACKBONE, "chamfer"),
    "fields": (BACKBONE,),
    "fit-prior": ("pca", PRIOR),
    "search-lambda": (BACKBONE, TERM, "pca"),
    "stage2": (BACKBONE, TERM, "pca", PRIOR),
    "predict": (BACKBONE,),
}


def test_the_digest_of_a_step_covers_all_that_it_runs(undisturbed, monkeypatch, fresh):
    monkeypatch.syspath_prepend(undisturbed.place.folder / "code")
    neutral = {name.partition(".")[2] or "__init__" for name in provenance.NEUTRAL}
    seen = set()
    for path in undisturbed.traces.glob("*.json"):
        trace = json.loads(path.read_text())
        step = command_of(trace["arguments"][1:])
        if step == "config":
            continue
        covered = set(provenance.code_files(step, *CLASSES.get(step, ())).values())
        for name in map(Path, trace["ran"]):
            own = name.is_relative_to(undisturbed.place.folder / "code")
            if name.is_relative_to(ROOT / "dine"):
                module = name.relative_to(ROOT / "dine").with_suffix("")
                # Of commands, the body of the step's own counts.
                own = module.parts[0] != "cli" and module.as_posix() not in neutral
            assert not own or name in covered, f"{step} runs {name}"
        seen.add(step)
    assert {*CLASSES, "raw", "pairs", "agreement", "corrupt", "evaluate", "report"} <= seen


# --- kills ------------------------------------------------------------------------------------

# Each at another stage of a job: Python starting, computing, writing.
KILLS = [
    Kill("raw", "group", signal.SIGKILL, 1.0),
    Kill("stage1", "job", signal.SIGKILL, 2.2),
    Kill("stage1", "group", signal.SIGTERM, 2.5),
    Kill("stage2", "snakemake", signal.SIGKILL, 1.5, at_once=True),
    Kill("predict", "group", signal.SIGINT, 0.5),
]


@pytest.fixture(scope="module")
def killed(undisturbed):
    """The run of ``undisturbed`` again, one job at a time, with kills; the command's last words."""
    for kill in KILLS:
        assert perform(undisturbed.place, kill, ["all"], cores=1), kill
    undisturbed.place.warm = True  # nothing is killed any more
    return finish(undisturbed.place, ["all"], cores=1)


def test_a_killed_run_gives_the_files_of_an_undisturbed_one(undisturbed, killed):
    assert differences(undisturbed.finished.results, undisturbed.place.results) == []


def test_nothing_is_left_to_do(undisturbed, killed):
    assert "Nothing to be done" in undisturbed.place.run("all")
