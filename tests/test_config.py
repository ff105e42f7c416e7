"""The configuration refuses what cannot work, naming key, value and what was expected."""

import json
from pathlib import Path

import pytest
import yaml

from dine import config
from dine.errors import ConfigError
from dine.results import (
    NO_BACKBONE,
    backbone_and_seed,
    evidence_cells,
    evidence_conditions,
    figure_names,
    replica,
    table_names,
)

ROOT = Path(__file__).parents[1]
DEFAULT = yaml.safe_load((ROOT / "config.yaml").read_text())


def changed(path, value):
    """The default configuration with one key set."""
    change = value
    for key in reversed(path.split(".")):
        change = {key: change}
    return config.merge(DEFAULT, change)


def test_default_is_valid_and_complete():
    loaded = config.load(ROOT / "config.yaml")
    assert list(loaded.datasets) == ["deformedtissue", "synbench"]
    assert loaded.methods("deftransnet") == ["stage1", "lambda0", "pca", "flow"]
    assert {"table1", "table2", "table3"} <= set(table_names(loaded))
    assert len(set(figure_names(loaded))) == len(figure_names(loaded))


@pytest.mark.parametrize("name", ["tiny", "full"])
def test_sizes_differ_in_numbers_only(name):
    change = yaml.safe_load((ROOT / "config" / f"{name}.yaml").read_text())
    results = change.pop("results")
    assert results == f"results/{name}"

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
    config.load(ROOT / "config.yaml", ROOT / "config" / f"{name}.yaml")


def test_schema_file_is_in_step_with_the_code():
    stored = json.loads((ROOT / "workflow" / "schemas" / "config.schema.json").read_text())
    assert stored == config.Config.model_json_schema(), (
        "run: dine config schema > workflow/schemas/config.schema.json"
    )


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
        ("datasets.synbench.recipe.pairs_per_level", 10, "only 9 different deformations"),
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
    values = config.merge(
        config.read_yaml(ROOT / "config.yaml"), {"evidence": {"methods": {}, **changes}}
    )
    return config.validate(values)


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
    assert {c.dataset for c in cells if c.backbone == "robust_defreg_default"} == {"synbench"}
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
        "backbones": {"robust_defreg": {"priors": []}, "deftransnet": None},
        "lambda_search": {"priors": ["flow"]},
    }
    loaded = config.validate(config.merge(DEFAULT, change))
    evidence = loaded.evidence
    assert "smoothness" not in evidence.methods
    assert "map_pca" not in evidence.methods
    assert evidence.backbones["robust_defreg_default"].priors == []
    assert {cell.dataset for cell in evidence_cells(loaded)} == {"synbench"}
    without = config.merge(
        DEFAULT, {"datasets": {"synbench": None}, "lambda_search": {"dataset": "deformedtissue"}}
    )
    loaded = config.validate(without)
    # Both are for that dataset alone.
    assert "robust_defreg_default" not in loaded.evidence.backbones
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
