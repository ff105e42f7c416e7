"""The workflow as a user runs it: one tiny run of everything, then what each change reruns."""

import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from click.testing import CliRunner
from workplace import warm

from dine import config
from dine.cli import cli
from dine.data.deformation import rbf_displacement
from dine.data.pairs import read_pairs, read_variant
from dine.data.synthetic import primitive
from dine.geometry.surface import Surface
from dine.io.readers import read_surface
from dine.io.writers import write_surface
from dine.results import Results, table_names

ROOT = Path(__file__).parents[2]
TINY = "config/tiny.yaml"
FINISHED = ("--configfile", TINY)
# A space and more than ASCII, since people have such folders.
RESULTS = "results/tiny rün – 1"


def snakemake(folder, *arguments, check=True):
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", "-j2", *map(str, arguments)],
        cwd=folder,
        env=os.environ | warm(),
        capture_output=True,
        text=True,
    )
    if check and done.returncode:
        raise AssertionError(done.stdout[-3000:] + done.stderr[-3000:])
    return done


def copy_workflow(folder):
    """The workflow's files without results or Snakemake's own records."""
    for name in ("Snakefile", "config.yaml"):
        shutil.copy(ROOT / name, folder)
    for name in ("workflow", "config", "profiles"):
        shutil.copytree(ROOT / name, folder / name)
    tiny = folder / TINY
    tiny.write_text(tiny.read_text().replace("results: results/tiny", f"results: {RESULTS}"))
    return folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run of ``all`` with each kind of job, and all priors; DefTransNet on one dataset only."""
    folder = copy_workflow(tmp_path_factory.mktemp("workflow run"))
    snakemake(folder, "all", *FINISHED)
    return folder


def planned(folder, *arguments):
    """Number of jobs by rule that a dry run would start; nothing for a finished target."""
    return counted(snakemake(folder, "-n", *arguments).stdout)


def counted(output):
    """Number of jobs by rule, from what a dry run says."""
    table = output.partition("Job stats:")[2].partition("\n\n")[0]
    jobs = dict(re.findall(r"^(\w+)\s+(\d+)$", table, re.MULTILINE))
    jobs.pop("total", None)
    return {rule: int(count) for rule, count in jobs.items()}


def changed(folder, changes):
    """Arguments for a run of everything with some settings changed."""
    path = folder / "changes.yaml"
    path.write_text(yaml.safe_dump(changes))
    return ("all", "--configfile", TINY, path)


def test_everything_is_there(finished):
    results = finished / RESULTS
    tables = {path.stem for path in (results / "tables").glob("*.csv")}
    assert {"table1", "table2", "table3", "gains_synbench", "correspondence_synbench"} <= tables
    # What is written is what is expected: the rule's own outputs, and nothing beside.
    configs = [finished / name for name in ("config.yaml", TINY)]
    assert tables == set(table_names(config.load(*configs)))
    assert "deformation_synbench_unseen" in tables
    for table in tables:
        assert (results / "tables" / f"{table}.md").stat().st_size > 0
        assert (results / "tables" / f"{table}.tex").stat().st_size > 0
    assert len(list((results / "figures").glob("*.png"))) == 20
    report = (results / "report.html").read_text()
    assert "synthetic" in report
    assert not re.search(r"(src|href)=.https?:", report)
    resolved = yaml.safe_load((results / "config.yaml").read_text())
    assert resolved["stage1"]["steps"] == 12


def test_tables_follow_from_the_metrics(finished):
    results = finished / RESULTS
    table = pd.read_csv(results / "tables" / "table2.csv")
    metrics = pd.read_csv(results / "synbench" / "deftransnet" / "stage2" / "flow" / "metrics.csv")
    row = table[(table["backbone"] == "deftransnet") & (table["method"] == "flow")]
    row = row[row["level"] == 0.6].iloc[0]
    rows = (metrics["level"] == 0.6) & (metrics["objects"] == "known")
    expected = 1e4 * metrics.loc[rows & (metrics["condition"] == "deformation"), "cd"].mean()
    assert row["mean_1e-4"] == pytest.approx(expected, rel=1e-4)


def test_every_run_has_its_control(finished):
    results = finished / RESULTS
    folders = sorted(results.glob("*/*/stage2"))
    trained = [folder.parent.relative_to(results).as_posix() for folder in folders]
    assert trained == [
        "deformedtissue/robust_defreg",
        "synbench/deftransnet",
        "synbench/robust_defreg",
    ]
    for folder in folders:
        control = json.loads((folder / "lambda0" / "run.json").read_text())
        prior = json.loads((folder / "pca" / "run.json").read_text())
        assert control["lambda"] == 0 < prior["lambda"]
        for key in ("seed", "settings", "train_pairs"):
            assert control[key] == prior[key]
        assert control["inputs"]["model"] == prior["inputs"]["model"]


def test_a_second_run_has_nothing_to_do(finished):
    done = snakemake(finished, "all", *FINISHED)
    assert "Nothing to be done" in done.stdout + done.stderr


REPORTING = {"resolved_config", "tables", "figures", "html", "all"}

CHANGES = {
    # λ is searched with the priors, so all Stage 2 runs that take a λ of that search follow.
    "flow": (
        {"priors": {"flow": {"arguments": {"steps": 51}}}},
        {"fit_prior": 2, "search_lambda": 1, "stage2_prior": 7, "predict": 7, "evaluate": 7},
    ),
    "pca": (
        {"priors": {"pca": {"arguments": {"shrinkage": 0.1}}}},
        {"fit_prior": 3, "search_lambda": 1, "stage2_prior": 7, "predict": 7, "evaluate": 7},
    ),
    "stage 2": (
        {"stage2": {"steps": 7}},
        {
            "search_lambda": 1,
            "stage2_control": 3,
            "stage2_prior": 7,
            "predict": 10,
            "evaluate": 10,
        },
    ),
    "one more noise level": (
        {"datasets": {"deformedtissue": {"corruption": {"noise": [0.03, 0.05]}}}},
        {"corrupt": 1, "predict": 4, "evaluate": 4},
    ),
    "one dataset": (
        {"datasets": {"deformedtissue": {"pairs": {"convention": "none"}}}},
        {
            "pairs": 1,
            "agreement": 1,
            "corrupt": 2,
            "resample": 1,
            "stage1": 1,
            "fields": 1,
            "fit_prior": 2,
            "stage2_control": 1,
            "stage2_prior": 2,
            "predict": 4,
            "evaluate": 4,
        },
    ),
}


ENORMOUS = {"resources": {"reporting": {"memory_mb": 10**9, "minutes": 10**6}}}


def test_requests_reach_the_jobs_and_stop_nothing_here(tmp_path):
    folder = copy_workflow(tmp_path)
    target = Path(RESULTS) / "config.yaml"
    arguments = (target, *changed(folder, ENORMOUS)[1:])
    assert f"mem_mb={10**9}" in snakemake(folder, "-n", *arguments).stdout
    snakemake(folder, *arguments)
    assert (folder / target).is_file()


def test_every_job_has_its_requests():
    for path in (ROOT / "workflow" / "rules").glob("*.smk"):
        text = path.read_text()
        assert text.count("    shell:") == text.count("**request("), path.name


def test_requests_make_nothing_again_but_the_record_of_them(finished):
    requests = {kind: {"minutes": 5} for kind in ("data", "training", "prior", "reporting")}
    jobs = planned(finished, *changed(finished, {"resources": requests}))
    assert jobs == {"resolved_config": 1, "html": 1, "all": 1}


@pytest.mark.parametrize("change", CHANGES)
def test_a_change_reruns_what_depends_on_it(finished, change):
    settings, expected = CHANGES[change]
    jobs = planned(finished, *changed(finished, settings))
    assert {rule: n for rule, n in jobs.items() if rule not in REPORTING} == expected


def test_one_ablation_uses_what_is_cached(finished):
    assert planned(finished, "prior_flow", *FINISHED) == {"prior_flow": 1}
    snakemake(finished, "prior_flow", *FINISHED)
    gains = pd.read_csv(finished / RESULTS / "ablation" / "flow" / "gains_synbench.csv")
    assert set(gains["method"]) == {"flow"}


def test_one_ablation_alone_runs_only_what_it_needs(tmp_path):
    jobs = planned(copy_workflow(tmp_path), "prior_flow", "--configfile", TINY)
    # Two Stage-2 runs on DefTransNet; of Robust-DefReg only what the search of λ needs.
    assert jobs["stage1"] == 2
    assert (jobs["stage2_control"], jobs["stage2_prior"]) == (1, 1)
    assert jobs["fit_prior"] == 4
    assert "figures" not in jobs
    assert "html" not in jobs


def test_the_evidence_is_planned_from_its_config(tmp_path):
    folder = copy_workflow(tmp_path)
    seeds = folder / "seeds.yaml"
    seeds.write_text("evidence: {seeds: [0, 1]}")
    jobs = planned(folder, "evidence", "--configfile", TINY, seeds)
    # Two seeds of three networks; a group of methods without a backbone for each dataset.
    assert jobs["stage1"] == jobs["stage2_control"] == 6
    assert jobs["evidence_evaluate"] == 8
    assert jobs["evidence_classical"] == 4
    assert jobs["search_lambda"] == 1
    # The test pairs are those of `all`, of known objects and unseen ones; or of further objects.
    assert jobs["pairs"] == jobs["raw_unseen"] == 2
    assert "evidence_pairs" not in jobs
    changes = folder / "changes.yaml"
    changes.write_text("evidence: {seeds: [0], methods: {cpd: null, map: null}, test_objects: 2}")
    fewer = planned(folder, "evidence", "--configfile", TINY, changes)
    assert fewer["evidence_raw"] == fewer["evidence_pairs"] == 2
    assert fewer["stage1"] == 3
    assert fewer["evidence_classical"] == 2
    assert fewer["evidence_refine"] < jobs["evidence_refine"]


def test_the_evidence_joins_its_seeds(finished, tmp_path):
    """On top of what `all` has made with the first one; fewer methods than in the tiny run."""
    folder = Path(shutil.copytree(finished, tmp_path / "evidence", symlinks=True))
    changes = folder / "seeds.yaml"
    changes.write_text(
        "backbones: {deftransnet: null}\n"
        "evidence: {seeds: [0, 1], only: [unregistered, map], first_seed_only: [pca_residual]}\n"
    )
    snakemake(folder, "evidence", "--configfile", TINY, changes)
    table = pd.read_csv(Results(folder / RESULTS).evidence.folder / "tables" / "comparisons.csv")
    table = table[table["backbone"] == "robust_defreg"]
    counts = table[["method", "seeds_method", "seeds_reference"]].drop_duplicates()
    assert sorted(counts.itertuples(index=False, name=None)) == [
        ("map", 2, 2),
        ("pca", 2, 2),
        ("pca_residual", 1, 1),
        ("stage1", 2, 2),
        ("unregistered", 1, 2),
    ]


def test_searches_of_lambda_get_the_files_of_the_priors_that_they_name(tmp_path):
    folder = copy_workflow(tmp_path)
    own = {"kind": "robust_defreg", "priors": ["pca", "pca_residual"], "own_lambda": True}
    search = {
        "lambda_search": {"priors": ["pca", "flow", "pca_residual"]},
        "backbones": {"robust_defreg_geometric": own},
    }
    said = snakemake(folder, "-n", "-p", *changed(folder, search)).stdout
    commands = [line for line in said.splitlines() if " search-lambda " in line]
    assert len(commands) == 2
    for line in commands:
        words = shlex.split(line.partition(": ")[2])
        places = [place for place, word in enumerate(words) if word == "--prior"]
        given = [(words[place + 1], Path(words[place + 2]).stem) for place in places]
        expected = ["pca", "flow", "pca_residual"]
        if "geometric" in line:  # it has no flow
            expected.remove("flow")
        assert given == [(name, name) for name in expected]


def test_calibrations_are_of_all_pairs(tmp_path):
    folder = copy_workflow(tmp_path)
    target = Path(RESULTS) / "synbench" / "resampled.h5"
    snakemake(folder, target, "--configfile", TINY)
    place = (folder / target).parent
    targets = read_variant(place / "resampled.h5", read_pairs(place / "pairs.h5"))
    assert len(targets) == 24  # five of two objects and levels, and one of two unseen objects


def test_the_evidence_draws_targets_of_unseen_objects_anew_too(tmp_path):
    folder = copy_workflow(tmp_path)
    for number in range(4):
        place = folder / f"{'seen' if number else 'others'}"
        write_surface(place / f"organ{number}.ply", primitive(number, 0))
    mine = {"source": {"kind": "path", "folder": "seen"}, "unseen": {"folder": "others"}}
    mine |= {"pairs": {"points": 64, "convention": "sphere"}}
    settings = {"datasets": {"mine": mine}, "evidence": {"resampled": True}}
    target = Path(RESULTS) / "evidence" / "mine" / "variants" / "resampled_1.h5"
    said = snakemake(folder, "-n", "-p", target, *changed(folder, settings)[1:]).stdout
    (line,) = [line for line in said.splitlines() if " resample " in line]
    assert line.count("--raw ") == 2
    assert "mine/unseen/raw.json" in line


@pytest.mark.parametrize(
    "rule", ["pairs", "resample", "search_lambda", "tables", "figures", "html"]
)
def test_a_step_finds_all_that_it_reads_among_its_inputs(finished, tmp_path, rule):
    """Run where nothing else is: what it is given to look for files in holds its inputs alone."""
    said = snakemake(finished, "all", *FINISHED, "--detailed-summary").stdout
    jobs = pd.read_csv(io.StringIO(said), sep="\t").set_index("rule").loc[[rule]]
    inputs, command = jobs.iloc[0][["input-file(s)", "shellcmd"]]
    for name in inputs.split(","):
        copy = tmp_path / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(finished / name, copy)
    # The meshes lie where the record of them says, which may be anywhere.
    for folder in Path(finished).glob(f"{RESULTS}/*/**/raw"):
        shutil.copytree(folder, tmp_path / folder.relative_to(finished))
    wanted = jobs[jobs["shellcmd"] == command]["output_file"]
    for name in wanted:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | warm() | {"PATH": path}
    done = subprocess.run(
        command, shell=True, cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert not done.returncode, done.stderr
    assert all((tmp_path / name).is_file() for name in wanted)


def test_a_finished_model_is_restored_bit_for_bit(finished):
    model = finished / RESULTS / "synbench/robust_defreg/stage1/model.safetensors"
    before = model.read_bytes()
    state = model.parent / "training" / "state.pt"
    assert state.is_file()
    # As if the job had been killed before its end: no outputs, and no usable state.
    model.unlink()
    state.unlink()
    snakemake(finished, model.relative_to(finished), *FINISHED)
    assert model.read_bytes() == before


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"stage1": {"stps": 5}}, "`stage1.stps` is not a known key"),
        ({"backbones": {"deftransnet": {"priors": ["pcaa"]}}}, "names 'pcaa'"),
        ({"seed": "zero"}, "`seed`: expected a number"),
    ],
)
def test_a_config_typo_stops_before_anything_runs(tmp_path, changes, match):
    folder = copy_workflow(tmp_path)
    done = snakemake(folder, *changed(folder, changes), check=False)
    assert done.returncode != 0
    assert match in done.stdout + done.stderr
    assert not (folder / "results").exists()


def test_the_dag_can_be_drawn(tmp_path):
    folder = copy_workflow(tmp_path)
    assert snakemake(folder, "all", "--dag").stdout.startswith("digraph")
    assert "stage2_prior" in snakemake(folder, "all", "--rulegraph", "mermaid-js").stdout


def test_a_list_of_pairs_is_a_test_set(tmp_path):
    folder = copy_workflow(tmp_path)
    shape = primitive(0, 0)
    write_surface(folder / "before.ply", shape)
    write_surface(folder / "after.ply", Surface(shape.vertices * [1.1, 1, 1], shape.faces))
    (folder / "pairs.csv").write_text("source,target,level\nbefore.ply,after.ply,0.1\n")
    mine = {"folder": "pairs.csv", "networks": "synbench"}
    arguments = changed(folder, {"evidence": {"test_sets": {"mine": mine}}})[1:]
    made = Path(RESULTS) / "evidence" / "mine"
    snakemake(folder, made / "variants" / "resampled_1.h5", *arguments)
    pairs = read_pairs(folder / made / "pairs.h5", split="test")
    assert pairs.attributes["origin"] == "path"
    assert pairs.level.tolist() == [0.1]
    assert np.abs(pairs.target[..., 1:] - pairs.source[..., 1:]).max() < 1e-6
    # Evaluated with the networks of the other dataset; corrupted by nothing.
    jobs = planned(folder, made / "examples.png", *arguments)
    assert jobs["stage1"] == 1
    assert "evidence_corrupt" not in jobs
    assert "evidence_raw" not in jobs
    # A change of a listed file is seen.
    write_surface(folder / "after.ply", Surface(shape.vertices * [1.2, 1, 1], shape.faces))
    assert planned(folder, made / "pairs.h5", *arguments)["evidence_raw"] == 1


@pytest.mark.parametrize("target", ["all", "evidence", "pretrained", "calibrations", "organ"])
def test_a_target_names_what_it_makes_on_its_way(tmp_path, target):
    """Snakemake makes a deleted file again only where the target itself, or a job to run, asks."""
    folder = copy_workflow(tmp_path)
    output = snakemake(folder, target, "-n", "--forceall", "--configfile", TINY).stdout
    found = r"rule (\w+):\n(?:    input: (.*)\n)?(?:    output: (.*)\n)?"
    jobs = [
        (rule, set(inputs.split(", ")), set(outputs.split(", ")))
        for rule, inputs, outputs in re.findall(found, output)
    ]
    assert len(jobs) == sum(counted(output).values())
    named = next(inputs for rule, inputs, _ in jobs if rule == target)
    for rule, _, outputs in jobs:
        assert rule == target or outputs & named, f"{target} does not name {outputs}"


def test_no_examples_are_drawn_where_none_are_asked_for(tmp_path):
    folder = copy_workflow(tmp_path)
    arguments = changed(folder, {"evidence": {"examples": []}})[1:]
    jobs = planned(folder, "evidence", *arguments)
    assert jobs["evidence"] == 1
    assert "evidence_examples" not in jobs


def commands(page):
    """Shell commands of a page's blocks, as lists of words."""
    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(), re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines() if line.strip()]
    return [shlex.split(line) for line in lines]


def test_from_meshes_of_ones_own_to_a_registration(tmp_path, monkeypatch):
    """The commands of docs/guide/own-organ.md, in a smaller configuration."""
    folder = copy_workflow(tmp_path)
    monkeypatch.chdir(folder)
    organs = folder / "organs"
    organs.mkdir()
    for number in range(5):
        write_surface(organs / f"organ{number}.ply", primitive(number, 0))
    text = (ROOT / "config" / "own.yaml").read_text()
    assert text.count("path/to/meshes") == 1
    (folder / "my.yaml").write_text(text.replace("path/to/meshes", "organs"))
    small = yaml.safe_load((ROOT / TINY).read_text())
    pairs = {"recipe": {"levels": [0.2, 0.4]}, "pairs": small["datasets"]["synbench"]["pairs"]}
    kept = ("priors", "stage1", "stage2", "lambda_search")
    smaller = {name: small[name] for name in kept} | {"datasets": {"own": pairs}}
    (folder / "smaller.yaml").write_text(yaml.safe_dump(smaller))
    page = commands(ROOT / "docs" / "guide" / "own-organ.md")
    inspect, check, train, register = page[:4]
    for command, said in ((inspect, "5 undeformed objects"), (check, "is valid")):
        words = [word.replace("path/to/meshes", "organs") for word in command]
        assert words[0] == "dine"
        done = CliRunner().invoke(cli, words[1:], catch_exceptions=False)
        assert said in done.output
    assert train[:4] == ["snakemake", "-j2", "all", "calibrations"]
    used = dict(zip(register[7::2], register[8::2], strict=True))
    made = [used[option] for option in ("--weights", "--prior", "--calibration")]
    jobs = planned(folder, *train[2:], "smaller.yaml")
    assert jobs["stage1"] == jobs["calibration_targets"] == 1
    # Without tables and figures, which other tests make.
    snakemake(folder, *made, *train[4:], "smaller.yaml")
    facts = json.loads(Path(used["--calibration"]).read_text())["facts"]
    assert facts["resampled"]
    source = read_surface(organs / "organ0.ply")
    recipe = {"control_percent": 5, "width": 0.4, "amplitude": 0.1, "points": 256}
    moved = rbf_displacement(source, level=0.4, rng=np.random.default_rng(0), **recipe)
    write_surface(folder / "before.ply", source)
    write_surface(folder / "after.ply", Surface(source.vertices + moved, source.faces))
    done = CliRunner().invoke(cli, register[1:], catch_exceptions=False)
    assert done.exit_code == 0
    report = json.loads((folder / "moved.json").read_text())
    assert report["after"]["chamfer"] < 0.5 * report["before"]["chamfer"]
    assert report["trust"]["expected_error"] > 0
    assert (folder / "moved.html").is_file()
