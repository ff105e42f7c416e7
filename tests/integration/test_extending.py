"""The examples of docs/guide/extending.md, treated as the built-in classes are."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import test_priors
import torch
from commands import dine

from dine import config
from dine.data.batch import make_batch
from dine.data.pairs import read_pairs
from dine.data.prepare import prepare_pairs
from dine.files import read_json
from dine.geometry.chamfer import chamfer_distance
from dine.models.backbones import BACKBONES
from dine.models.checkpoint import load_backbone, save_backbone
from dine.priors import load_prior
from dine.training.data_terms import DATA_TERMS

pytestmark = pytest.mark.numerical
ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples" / "extending"
CONFIGS = (ROOT / "config.yaml", EXAMPLES / "config.yaml")
BACKBONE = "my_package.backbones:AffineNet"
PRIOR = "my_package.priors:VectorGaussian"
DATA_TERM = "my_package.terms:PartialTarget"


@pytest.fixture(autouse=True, scope="module")
def on_the_python_path():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        yield


@pytest.fixture(scope="module")
def settings():
    return config.load(*CONFIGS)


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    from my_package import data

    folder = tmp_path_factory.mktemp("my data")
    data.write_bars(folder / "bars")
    data.write_eggs(folder / "eggs")
    return folder


def text(section, **changes):
    """A section of the configuration as a command's settings."""
    return json.dumps(section.model_dump(mode="json", exclude={"priors"}) | changes)


@pytest.fixture(scope="module")
def chain(settings, meshes, tmp_path_factory):
    """Every step for both datasets, with the settings of the example's configuration."""
    root = tmp_path_factory.mktemp("run")
    for name, dataset in settings.datasets.items():
        folder = root / name
        source = {"kind": "path", "folder": str(meshes / name)}
        dine("raw", "--settings", text(dataset, source=source), "--out", folder)
        prepare_pairs(folder / "raw.json", dataset.pairs, seed=0, out=folder / "pairs.h5")
    bars = root / "bars"
    pairs = ("--pairs", bars / "pairs.h5")
    model = bars / "stage1" / "model.safetensors"
    prior = bars / "vectors.safetensors"
    dine(
        *("stage1", *pairs, "--settings", text(settings.stage1), "--out", bars / "stage1"),
        *("--backbone", text(settings.backbones["affine"])),
    )
    dine("fields", "--model", model, *pairs, "--out", bars / "dvf.h5")
    dine(
        *("fit-prior", "--fields", bars / "dvf.h5", "--out", prior),
        *("--settings", text(settings.priors["vectors"])),
    )
    dine(
        *("stage2", *pairs, "--model", model, "--variant", "vectors", "--prior", prior),
        *("--lambda", 0.01, "--settings", text(settings.stage2), "--out", bars / "vectors"),
    )
    return root


def test_datasets(chain, settings):
    bars = read_pairs(chain / "bars" / "pairs.h5")
    assert sorted(set(bars.level)) == [0.3, 0.6]
    assert set(bars.split) == {"train", "val", "test"}
    assert read_json(chain / "bars" / "raw.json")["origin"] == "path"
    eggs = read_pairs(chain / "eggs" / "pairs.h5")
    assert read_json(chain / "eggs" / "raw.json")["origin"] == "bases"
    assert len(eggs) == 6 * len(settings.datasets["eggs"].recipe.levels)


def test_training(chain):
    record = read_json(chain / "bars" / "stage1" / "run.json")
    assert record["backbone"] == BACKBONE
    assert record["settings"]["data_term"] == DATA_TERM
    history = pd.read_csv(chain / "bars" / "stage1" / "history.csv")
    assert history["loss"].tail(5).mean() < 0.7 * history["loss"].head(5).mean()
    refined = pd.read_csv(chain / "bars" / "vectors" / "history.csv")
    assert (refined["penalty"] > 0).all()
    backbone, _ = load_backbone(chain / "bars" / "vectors" / "model.safetensors")
    assert backbone.arguments == {"width": 16}
    assert load_prior(chain / "bars" / "vectors.safetensors").notes["vectors"] == 6 * 256


def clouds(*sizes):
    rng = np.random.default_rng(0)
    return [rng.normal(size=(size, 3)) for size in sizes]


def moving_backbone():
    backbone = BACKBONES.get(BACKBONE)(width=8).double()
    torch.nn.init.normal_(backbone.read_out.weight, generator=torch.Generator().manual_seed(0))
    return backbone


def test_backbone_treats_padded_pairs_as_single_ones():
    backbone = moving_backbone()
    sources, targets = clouds(20, 9), clouds(15, 31)
    together = backbone(make_batch(sources, targets, dtype=torch.float64)).displacement
    for row, source, target in zip(together, sources, targets, strict=True):
        alone = backbone(
            make_batch([source], [np.roll(target, 3, axis=0)], dtype=torch.float64)
        ).displacement
        assert torch.allclose(row[: len(source)], alone[0])
        assert (row[len(source) :] == 0).all()


def test_backbone_survives_saving(tmp_path):
    backbone = moving_backbone().float()
    save_backbone(tmp_path / "model.safetensors", backbone)
    again, _ = load_backbone(tmp_path / "model.safetensors")
    batch = make_batch(clouds(20), clouds(15))
    assert torch.equal(backbone(batch).displacement, again(batch).displacement)


@pytest.mark.parametrize(
    "check",
    [
        test_priors.test_shapes_gradients_and_freezing,
        test_priors.test_penalty_is_minus_log_probability_up_to_scale_and_constant,
        test_priors.test_likely_fields_cost_less_than_unlikely_ones,
        test_priors.test_bad_fields,
    ],
)
def test_prior_passes_the_checks_of_the_built_in_ones(check):
    check(PRIOR)


def test_prior_survives_saving(tmp_path):
    test_priors.test_save_and_load(PRIOR, tmp_path)


def test_prior_samples_have_the_fitted_moments():
    prior = test_priors.fitted(PRIOR)
    vectors = prior.sample(2000, torch.Generator().manual_seed(0)).flatten(0, 1)
    assert torch.allclose(vectors.mean(0), prior.mean, atol=0.01)
    covariance = prior.factor @ prior.factor.T
    assert torch.allclose(vectors.T.cov(), covariance, atol=0.03 * covariance.max())


def test_data_term_ignores_what_the_target_does_not_show():
    term = DATA_TERMS.get(DATA_TERM)()
    (source,) = clouds(40)
    batch = make_batch([source, source], [source[:25], source + 1], dtype=torch.float64)
    field = torch.zeros_like(batch.source).requires_grad_()
    partial, whole = term(batch, field, None)
    assert partial == 0
    assert 0 < whole < chamfer_distance(batch.source, batch.target)[1]
    assert torch.autograd.gradcheck(lambda field: term(batch, field, None), (field + 0.01,))


def test_workflow_takes_the_example(meshes, tmp_path):
    """The whole graph of jobs, from the checkout, without running any."""
    changes = tmp_path / "folders.yaml"
    datasets = {name: {"source": {"folder": str(meshes / name)}} for name in ("bars", "eggs")}
    changes.write_text(json.dumps({"datasets": datasets}))
    done = subprocess.run(
        [
            *(sys.executable, "-m", "snakemake", "all", "-n", "--quiet", "rules"),
            *("--configfile", EXAMPLES / "config.yaml", changes),
        ],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(EXAMPLES)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for rule in ("raw", "stage1", "fit_prior", "stage2_prior", "html"):
        assert rule in done.stdout
