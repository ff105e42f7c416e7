"""The configuration refuses what cannot work, naming key, value and what was expected."""

import functools
import json
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner

from dine import config
from dine.cli import cli
from dine.errors import ConfigError
from dine.plan import EvidencePlan
from dine.reporting.names import METHODS
from dine.results import (
    NO_BACKBONE,
    backbone_and_seed,
    conditions,
    evidence_cells,
    evidence_conditions,
    figure_names,
    own_searches,
    replica,
    runs,
    strengths,
    table_names,
)

ROOT = Path(__file__).parents[2]
FILES = (ROOT / "config" / "evidence.yaml", ROOT / "config.yaml")  # as the Snakefile reads them
DEFAULT = functools.reduce(config.merge, map(config.read_yaml, FILES))


def changed(path, value):
    """The default configuration with one key set."""
    change = value
    for key in reversed(path.split(".")):
        change = {key: change}
    return config.merge(DEFAULT, change)


def test_default_is_valid_and_complete():
    loaded = config.load(*FILES)
    assert list(loaded.datasets) == ["deformedtissue", "synbench"]
    assert loaded.methods("deftransnet") == ["stage1", "lambda0", "pca", "pca_residual", "flow"]
    assert {"table1", "table2", "table3"} <= set(table_names(loaded))
    assert len(set(figure_names(loaded))) == len(figure_names(loaded))


@pytest.mark.parametrize("name", ["tiny", "full"])
def test_sizes_differ_in_numbers_only(name):
    change = yaml.safe_load((ROOT / "config" / f"{name}.yaml").read_text())
    results = change.pop("results")
    assert results == f"results/{name}"
    # Or only some of what there is.
    trials = (change.get(name, {}) for name in ("evidence", "organ"))
    for part in (*trials, *change.get("backbones", {}).values()):
        for key in ("only", "first_seed_only", "datasets", "questions"):
            (part or {}).pop(key, None)

    def leaves(value):
        if isinstance(value, dict):
            return [leaf for item in value.values() for leaf in leaves(item)]
        return (
            [leaf for item in value for leaf in leaves(item)]
            if isinstance(value, list)
            else [value]
        )

    # Null leaves out a method or backbone.
    assert all(leaf is None or isinstance(leaf, int | float) for leaf in leaves(change))
    config.load(*FILES, ROOT / "config" / f"{name}.yaml")


def test_the_schema_has_every_key():
    schema = json.loads(CliRunner().invoke(cli, ["config", "schema"]).output)
    assert set(schema["properties"]) == set(config.Config.model_fields)
    assert set(schema["$defs"]["Stage1"]["properties"]) == set(config.Stage1.model_fields)


@pytest.mark.parametrize(
    ("path", "value", "match"),
    [
        ("stage1.stps", 3, r"`stage1\.stps` is not a known key \(value 3\)"),
        ("stage1.steps", 0, r"`stage1\.steps` is 0: .*greater than or equal to 1"),
        ("stage1.steps", "many", r"`stage1\.steps`: expected a number, found the text 'many'"),
        ("stage1.learning_rate", "1e-4", r"YAML wants 1\.0e-4"),
        ("stage1.learning_rate", -1.0, r"`stage1\.learning_rate` is -1\.0: .*greater than 0"),
        ("seed", True, "`seed`: expected a number, found True"),
        ("device", "gpu", r"`device` is 'gpu': .*'auto', 'cpu' or 'cuda'"),
        ("precision", "half", r"`precision` is 'half': .*'float32' or 'bf16'"),
        ("processes", 2, r"`stage1\.batch_size` is 1, which 2 processes cannot share equally"),
        ("datasets.synbench.recipe.levels", [], r"levels` is \[\]"),
        ("datasets.synbench.recipe.levels", [0.1, "x"], r"levels\.1`: expected a number"),
        (
            "datasets.synbench.recipe",
            {"control_percents": [5], "widths": [0.3], "pairs_per_level": 2},
            "`pairs_per_level` is 2, but .* give only 1 different deformations; give one of them",
        ),
        ("datasets.synbench.pairs.split.by", "level", "'object' or 'deformation'"),
        ("datasets.synbench.source", {"kind": "path", "folder": "x"}, "`unseen.folder` is needed"),
        ("datasets.synbench.unseen.folder", "x", "`unseen.folder` is not used when"),
        ("datasets.synbench.unseen.objects", 0, r"`datasets\.synbench\.unseen\.objects` is 0"),
        ("datasets.liver_unseen", {}, "cannot be called 'liver_unseen'; the ending stands for"),
        (
            "evidence.test_sets.real_unseen",
            {"folder": "pairs.csv", "networks": "synbench"},
            "cannot be called 'real_unseen'; the ending stands for",
        ),
        ("lambda_search.candidates", [1.0e-4], "holds the single value 0.0001, which nothing is"),
        ("lambda_search.candidates", [1.0e-4, 1.0e-4], "`candidates` holds a value twice"),
        ("lambda_search.extend", -1, r"`lambda_search\.extend` is -1"),
        (
            "evidence.choice.candidates",
            [1.0e-4],
            r"`evidence\.choice`: `candidates` holds the sing",
        ),
        ("evaluation.training_spread", 10, r"`evaluation\.training_spread` is 10"),
        ("backbones.deftransnet.datasets", ["liver"], r"deftransnet\.datasets` names 'liver'"),
        (
            "backbones.robust_defreg.datasets",
            ["deformedtissue"],
            "backbone 'robust_defreg' on `lambda_search.dataset`, 'synbench', which is not under",
        ),
        (
            "evidence.backbones.robust_defreg_pretrained.own_lambda",
            True,
            r"robust_defreg_pretrained\.own_lambda` cannot be set",
        ),
        ("datasets.synbench.pairs.convention", "spehre", "'sphere', 'disc', 'lexicographic'"),
        ("datasets.synbench.pairs.split.train", 0.9, "add up to 1, found 1.2"),
        ("datasets.synbench.source.kind", "path", "`folder` is needed when `kind` is path"),
        ("datasets.Bad-Name", {}, "the name 'Bad-Name' under `datasets`"),
        (
            "backbones.deftransnet.priors",
            ["pcaa"],
            r"`backbones\.deftransnet\.priors` names 'pcaa'",
        ),
        ("lambda_search.dataset", "nowhere", r"`lambda_search\.dataset` names 'nowhere'"),
        ("priors.pca.kind", "pcaa", r"`priors\.pca\.kind` is 'pcaa'; expected one of pca, flow"),
        (
            "priors.pca.arguments.componets",
            3,
            r"`priors\.pca\.arguments\.componets` is not",
        ),
        ("priors.flow.arguments.hidden", 0, r"`priors\.flow\.arguments\.hidden` is 0"),
        ("priors.lambda0", {"kind": "pca"}, "cannot be called 'lambda0'"),
    ],
)
def test_faults_are_named(path, value, match):
    with pytest.raises(ConfigError, match=match):
        config.validate(changed(path, value))


def test_all_faults_are_listed_at_once():
    values = config.merge(changed("stage1.stps", 3), {"seed": -1})
    with pytest.raises(ConfigError, match=r"stage1\.stps.*;|seed.*;"):
        config.validate(values)


def test_null_takes_an_entry_away():
    values = changed("datasets.deformedtissue", None)
    assert list(config.validate(values).datasets) == ["synbench"]
    with pytest.raises(ConfigError, match=r"lambda_search\.dataset` names 'synbench'"):
        config.validate(changed("datasets.synbench", None))


def test_unreadable_files(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        config.load(tmp_path / "none.yaml")
    (tmp_path / "broken.yaml").write_text("a: [1")
    with pytest.raises(ConfigError, match="not valid YAML"):
        config.load(tmp_path / "broken.yaml")
    (tmp_path / "list.yaml").write_text("- 1")
    with pytest.raises(ConfigError, match="expected keys and values, found list"):
        config.load(tmp_path / "list.yaml")
    (tmp_path / "code.yaml").write_text("seed: !!python/object/apply:os.getpid []")
    with pytest.raises(ConfigError, match="not valid YAML"):
        config.load(tmp_path / "code.yaml")


def test_a_prior_by_import_path_takes_any_arguments():
    values = changed("priors.mine", {"kind": "my_package:Prior", "arguments": {"anything": 1}})
    loaded = config.validate(values)
    assert config.check_arguments(loaded.priors["mine"]) == {"anything": 1}


# --- evidence -------------------------------------------------------------------------------------


def with_evidence(**changes):
    return config.validate(config.merge(DEFAULT, {"evidence": {"methods": {}, **changes}}))


def test_every_seed_trains_what_the_config_says():
    loaded = with_evidence(seeds=[0, 5, 7])
    cells = evidence_cells(loaded)
    assert len(set(cells)) == len(cells)
    seeds = {
        name: {c.seed for c in cells if c.method == name and c.backbone == "deftransnet"}
        for name in ("stage1", "lambda0", "pca", "flow", "map")
    }
    every = {0, 5, 7}
    assert seeds == dict.fromkeys(seeds, every) | {"flow": {0}}
    assert {c.dataset for c in cells if c.backbone == "robust_defreg_geometric"} == {"synbench"}
    # Without a backbone there is nothing to train, so there is one seed.
    cpd = [c for c in cells if c.method == "cpd"]
    assert [(c.dataset, c.backbone, c.seed) for c in cpd] == [
        ("deformedtissue", NO_BACKBONE, 0),
        ("synbench", NO_BACKBONE, 0),
    ]
    # A method for some backbones is not evaluated with others.
    assert {c.backbone for c in cells if c.method == "pca_shuffled"} == {"robust_defreg"}


def test_a_null_method_is_left_out():
    loaded = with_evidence(methods={"cpd": None})
    assert "cpd" not in loaded.evidence.methods
    assert "bcpd" in loaded.evidence.methods


def test_what_is_taken_away_is_forgotten_by_the_evidence():
    change = {
        "datasets": {"deformedtissue": None},
        "priors": {"pca": None, "smoothness": None},
        "backbones": {
            **{"robust_defreg": {"priors": []}, "robust_defreg_geometric": {"priors": []}},
            "deftransnet": None,
        },
        "lambda_search": {"priors": ["flow"]},
    }
    loaded = config.validate(config.merge(DEFAULT, change))
    evidence = loaded.evidence
    assert "smoothness" not in evidence.methods
    assert "map_pca" not in evidence.methods
    assert evidence.backbones["robust_defreg_pretrained"].priors == []
    assert {cell.dataset for cell in evidence_cells(loaded)} == {"synbench"}
    without = config.merge(
        DEFAULT, {"datasets": {"synbench": None}, "lambda_search": {"dataset": "deformedtissue"}}
    )
    loaded = config.validate(without)
    # Both are for that dataset alone.
    assert "robust_defreg_geometric" not in loaded.backbones
    assert "latent_flow" not in loaded.evidence.methods


def test_test_sets_are_evaluated_with_the_networks_of_another_dataset():
    test_sets = {"real": {"folder": "pairs.csv", "networks": "synbench"}}
    loaded = with_evidence(test_sets=test_sets)
    cells = evidence_cells(loaded)
    on = {name: {c[1:] for c in cells if c.dataset == name} for name in ("real", "synbench")}
    assert on["real"] == on["synbench"]
    assert loaded.networks("real") == loaded.networks("synbench") == "synbench"
    # Corruption is for levels that test sets need not have.
    assert evidence_conditions(loaded, "real") == [("resampled", 1.0)]
    assert evidence_conditions(loaded, "synbench")[0] == ("noise", 0.03)
    with pytest.raises(ConfigError, match=r"test_sets\.real\.networks` names 'other'"):
        with_evidence(test_sets={"real": {"folder": "x", "networks": "other"}})
    with pytest.raises(ConfigError, match="name of its own"):
        with_evidence(test_sets={"synbench": {"folder": "x", "networks": "synbench"}})
    assert with_evidence(test_sets={"real": None}).evidence.test_sets == {}
    without = {
        "datasets": {"synbench": None},
        "lambda_search": {"dataset": "deformedtissue"},
        "evidence": {"test_sets": test_sets},
    }
    assert config.validate(config.merge(DEFAULT, without)).evidence.test_sets == {}


def test_examples_name_methods():
    with pytest.raises(ConfigError, match="examples` names 'cdp', which is no method"):
        with_evidence(examples=["cdp"])
    # What was taken away is not missed.
    loaded = with_evidence(methods={"cpd": None}, examples=["lambda0", "cpd", "map"])
    assert loaded.evidence.examples == ["lambda0", "map"]
    change = {"priors": {"smoothness": None}, "evidence": {"examples": ["smoothness", "map"]}}
    assert config.validate(config.merge(DEFAULT, change)).evidence.examples == ["map"]


def test_folders_of_seeds_go_there_and_back():
    loaded = with_evidence()
    assert replica(loaded, "deftransnet", loaded.seed) == "deftransnet"
    for seed in (loaded.seed, 3):
        folder = replica(loaded, "deftransnet", seed)
        assert backbone_and_seed(loaded, folder) == ("deftransnet", seed)


@pytest.mark.parametrize(
    ("methods", "match"),
    [
        ({"pca": {"kind": "stage2"}}, "must have a name of its own"),
        ({"new": {"kind": "stage2", "prior": "magic"}}, "names 'magic'"),
        ({"new": {"kind": "stage2", "backbones": ["magic"]}}, "neither under `backbones`"),
        ({"new": {"kind": "refined", "of": "magic"}}, "expected one of"),
        ({"new": {"kind": "classical", "algorithm": "cpd", "datasets": ["x"]}}, "names 'x'"),
        ({"new": {"kind": "magic"}}, "magic"),
        ({"New": {"kind": "stage2"}}, "lower-case"),
    ],
)
def test_faults_of_methods_are_named(methods, match):
    with pytest.raises(ConfigError, match=match):
        with_evidence(methods=methods)


# --- known and unseen objects, and searches of λ --------------------------------------------------


def test_recipes_may_go_beyond_their_lists():
    recipe = {"control_percents": [5], "widths": [0.3, 0.5], "pairs_per_level": 500}
    assert config.validate_section(config.Recipe, recipe, "recipe").pairs_per_level == 500
    assert config.most_pairs_per_level([5, 5], [0.3]) == 1
    assert config.most_pairs_per_level([5, 6], [0.3]) == float("inf")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({}, "levels"),
        ({"levels": [0.1], "shape": "tissue"}, "open patches"),
        ({"levels": [0.1, 0.1]}, "different ones"),
        ({"levels": [0.1], "elastic": {"patch": [0.5, 0.2]}}, "`patch` goes from 0.5 down to 0.2"),
        ({"levels": [0.1], "elastic": {"fields": 3}}, "fields"),
    ],
)
def test_elastic_recipes_that_cannot_be(change, match):
    recipe = {"kind": "elastic", **change}
    with pytest.raises(ConfigError, match=match):
        config.validate_section(config.Recipe, recipe, "recipe")


def test_a_single_value_of_lambda_needs_no_search():
    choice = {"candidates": [1.0e-4], "extend": 0}
    assert config.validate(changed("lambda_search", choice)).lambda_search.candidates == [1.0e-4]


def test_backbones_may_be_for_some_datasets():
    loaded = config.load(*FILES)
    assert loaded.backbones_of("deformedtissue") == ["robust_defreg", "deftransnet"]
    assert loaded.backbones_of("synbench") == list(loaded.backbones)
    places = {(dataset, backbone) for dataset, backbone, _ in runs(loaded)}
    assert len(places) == 5
    assert ("deformedtissue", "robust_defreg_geometric") not in places
    assert "histogram_synbench_robust_defreg_geometric" in figure_names(loaded)
    assert "histogram_deformedtissue_robust_defreg_geometric" not in figure_names(loaded)
    only = {name: {"datasets": ["synbench"]} for name in loaded.backbones}
    with pytest.raises(ConfigError, match="no backbone is trained on the dataset 'deformedtissue'"):
        config.validate(changed("backbones", only))


def with_own_search(priors=("pca", "pca_residual"), searched=("pca", "pca_residual", "flow")):
    change = {
        "backbones": {"robust_defreg_geometric": {"own_lambda": True, "priors": list(priors)}},
        "lambda_search": {"priors": list(searched)},
    }
    return config.validate(config.merge(DEFAULT, change))


def test_each_search_is_for_the_priors_that_it_counts_for():
    own = "robust_defreg_geometric"
    loaded = with_own_search()
    assert loaded.searched("robust_defreg") == ["pca", "pca_residual", "flow"]
    # The first one is searched whatever is used, as its λ is that of all others.
    values = with_own_search(searched=["flow", "pca_residual", "pca"])
    assert values.searched(own) == ["flow", "pca_residual", "pca"]
    assert with_own_search(["pca_residual"]).searched(own) == ["pca", "pca_residual"]
    assert loaded.searching("deftransnet") == "robust_defreg"
    assert loaded.searching(own) == own
    assert own_searches(loaded) == [own]
    assert f"lambda_{own}" in figure_names(loaded)
    # Without, that of all others counts.
    assert config.validate(DEFAULT).searching(own) == "robust_defreg"
    assert own_searches(config.validate(DEFAULT)) == []


def tables_of(**changes):
    """Names of the tables of SynBench's unseen objects, after changes of that dataset."""
    found = table_names(config.validate(changed("datasets.synbench", changes)))
    return [name for name in found if name.endswith("synbench_unseen")]


def test_tables_of_unseen_objects_are_expected_where_they_are_sure():
    three = ["deformation", "correspondence", "gains"]
    assert tables_of() == [f"{name}_synbench_unseen" for name in three]
    assert tables_of(unseen=None) == []
    # All test pairs are of unseen objects then, and stand under the dataset's own name.
    assert tables_of(pairs={"split": {"by": "object"}}) == []
    # A published split decides, if there is one.
    folders = {"source": {"kind": "path", "folder": "x"}, "unseen": {"folder": "y"}}
    assert tables_of(**folders) == []
    # Without a number of pairs, those of unseen objects are corrupted, too.
    more = ["deformation", "corruption", "observed", "correspondence", "gains"]
    assert tables_of(corruption={"pairs": None}) == [f"{name}_synbench_unseen" for name in more]


def test_gains_are_expected_of_datasets_whose_backbones_have_priors():
    backbones = {
        "robust_defreg": {"priors": []},
        "deftransnet": {"priors": [], "datasets": ["deformedtissue"]},
    }
    loaded = config.validate(changed("backbones", backbones))
    assert "gains_synbench" in table_names(loaded)
    assert "gains_deformedtissue" not in table_names(loaded)


def test_conditions_hold_targets_of_other_points():
    loaded = config.load(*FILES)
    assert conditions(loaded, "synbench") == [("resampled", 1.0)]
    assert [name for name, _ in conditions(loaded, "deformedtissue")] == [
        *["noise"] * 3,
        *["outliers"] * 3,
        "resampled",
    ]
    # No figure is drawn over a condition of one strength.
    assert strengths(loaded, "synbench") == []
    assert strengths(loaded, "deformedtissue") == ["noise", "outliers"]
    plain = config.validate(changed("datasets.synbench.corruption.resampled", False))
    assert conditions(plain, "synbench") == []


def test_the_evidence_may_show_priors_that_no_backbone_has():
    backbones = {name: {"priors": ["pca"]} for name in DEFAULT["backbones"]}
    loaded = config.validate(changed("backbones", backbones))
    assert "pca_residual" in loaded.evidence.examples


def test_the_evidence_may_be_of_some_methods_only():
    loaded = config.validate(changed("evidence.only", ["map", "cpd"]))
    assert list(loaded.evidence.methods) == ["cpd", "map"]
    assert loaded.evidence.examples == ["lambda0", "pca", "pca_residual", "cpd", "map"]
    fewer = config.validate(changed("evidence.only", ["map"]))
    assert "cpd" not in fewer.evidence.examples
    with pytest.raises(ConfigError, match=r"`evidence\.only` names 'mop', which is not under"):
        config.validate(changed("evidence.only", ["mop"]))
    with pytest.raises(ConfigError, match=r"`evidence\.only` names \['map'\]"):
        config.validate(changed("evidence.only", [["map"]]))


def test_the_default_run_needs_nothing_of_the_evidence():
    plain = config.load(ROOT / "config.yaml")
    assert runs(plain) == runs(config.load(*FILES))
    assert not plain.evidence.methods


# --- the evidence ---------------------------------------------------------------------------------


def test_the_evidence_calls_priors_what_their_tables_do():
    texts = json.loads(EvidencePlan(config.load(*FILES)).method_texts())
    titles = {name: texts[name]["title"] for name in ("pca", "flow", "pca_residual")}
    assert titles == {name: METHODS[name] for name in titles}


def test_test_pairs_of_the_evidence_are_those_of_all_or_its_own():
    found = config.load(*FILES)
    for number, own in ((None, False), (10, True)):
        evidence = found.evidence.model_copy(update={"test_objects": number})
        plan = EvidencePlan(found.model_copy(update={"evidence": evidence}))
        assert plan.has_own_pairs("synbench") is own
        place = plan.files.evidence if own else plan.files
        assert plan.test_pairs_file("synbench") == place.data("synbench").pairs
        files = plan.test_raw_files("synbench")
        assert len(files) == (1 if own else 2)
