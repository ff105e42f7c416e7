"""Methods without a network and refinement at test time, from files to files."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from samples import POINTS, make_pairs, write_predictions

from dine.classical.predictions import classical_predictions
from dine.cli import cli
from dine.config import RefinedMethod
from dine.data.corruption import make_variant
from dine.data.fields import TrainingFields, write_training_fields
from dine.data.pairs import at_levels, read_pairs, write_pairs, write_variant
from dine.errors import ConfigError, DataError
from dine.evaluation.conditions import evaluation_conditions
from dine.evaluation.predictions import Prediction, read_predictions
from dine.evaluation.refined import refine_predictions
from dine.files import read_json
from dine.priors import PRIORS
from dine.reporting.examples import typical

pytestmark = pytest.mark.numerical


def dine(*arguments):
    done = CliRunner().invoke(cli, [str(a) for a in arguments], catch_exceptions=False)
    assert done.exit_code == 0, done.output


@pytest.fixture
def stored(tmp_path):
    """Three test pairs, noise for two of them, and fields of a network that is half right."""
    pairs = make_pairs()
    pairs.level[2] = 0.8
    write_pairs(tmp_path / "pairs.h5", pairs)
    pairs = read_pairs(tmp_path / "pairs.h5")
    some = at_levels(pairs, [0.5])
    write_variant(tmp_path / "noise.h5", make_variant(some, "noise", 0.01, 0), pairs.checksum)
    half = 0.5 * pairs.displacement
    spread = np.full(half.shape[:2], 0.05, np.float32)
    seconds = np.full(len(half), 100.0)
    write_predictions(
        tmp_path / "network.h5",
        [
            Prediction("deformation", 0.0, pairs.name, half, spread, seconds),
            Prediction("noise", 0.01, some.name, half[:2], spread[:2], seconds[:2]),
        ],
    )
    return pairs


def errors(path, pairs):
    found = read_predictions(path)
    assert [p.condition for p in found] == ["deformation", "noise"]
    assert [len(p.displacement) for p in found] == [3, 2]
    assert all((p.seconds > 0).all() for p in found)
    return np.linalg.norm(found[0].displacement - pairs.displacement, axis=2).mean(axis=1), found


def test_levels_are_chosen(stored):
    assert len(at_levels(stored, [])) == 3
    assert at_levels(stored, [0.8]).name.tolist() == [stored.name[2]]
    with pytest.raises(DataError, match=r"levels 0\.7; there are 0\.5, 0\.8"):
        at_levels(stored, [0.7])


def test_conditions_may_cover_some_pairs(stored, tmp_path):
    clean, noise = evaluation_conditions(tmp_path / "pairs.h5", [tmp_path / "noise.h5"])
    assert (clean.key, noise.key) == ("deformation", "noise_0.01")
    assert (len(clean.pairs), len(noise.pairs)) == (3, 2)
    assert noise.targets.shape == (2, POINTS, 3)


def test_classical_predictions(stored, tmp_path):
    files = (tmp_path / "pairs.h5", [tmp_path / "noise.h5"], tmp_path / "out.h5")
    classical_predictions(*files, algorithm="smooth", arguments={"rounds": 20}, name="smooth")
    found, _ = errors(tmp_path / "out.h5", stored)
    before = np.linalg.norm(stored.displacement, axis=2).mean(axis=1)
    assert (found < 0.5 * before).all()
    with pytest.raises(ConfigError, match="does not take these arguments"):
        classical_predictions(*files, algorithm="icp", arguments={"beta": 1}, name="icp")
    with pytest.raises(ConfigError, match="Unknown classical method"):
        classical_predictions(*files, algorithm="magic", arguments={}, name="magic")


@pytest.mark.parametrize("algorithm", ["closed_form", "gradient"])
def test_refined_predictions_are_closer(stored, tmp_path, algorithm):
    prior = tmp_path / "prior.safetensors"
    PRIORS.get("gaussian_process").fit(
        np.concatenate([stored.displacement] * 4), source=np.concatenate([stored.source] * 4)
    ).save(prior)
    settings = {"kind": "refined", "algorithm": algorithm, "weight": 1e-6}
    dine(
        *("refine-predictions", "--predictions", tmp_path / "network.h5"),
        *("--pairs", tmp_path / "pairs.h5", "--variant", tmp_path / "noise.h5"),
        *("--prior", prior, "--settings", json.dumps(settings), "--out", tmp_path / "out.h5"),
    )
    found, predictions = errors(tmp_path / "out.h5", stored)
    network = np.linalg.norm(0.5 * stored.displacement, axis=2).mean(axis=1)
    assert (found < 0.8 * network).all()
    # The network's own time is part of it.
    assert (predictions[0].seconds > 100).all()


def test_refinement_needs_what_it_refines(stored, tmp_path):
    settings = RefinedMethod(kind="refined")
    files = [tmp_path / "network.h5", tmp_path / "pairs.h5", [], tmp_path / "out.h5"]
    write_variant(tmp_path / "other.h5", make_variant(stored, "outliers", 5.0, 0), stored.checksum)
    lacking = [*files[:2], [tmp_path / "other.h5"], files[3]]
    with pytest.raises(DataError, match="lacks pairs of the condition outliers_5"):
        refine_predictions(*lacking, settings=settings, prior=None, name="map")
    wrong = RefinedMethod(kind="refined", arguments={"turns": 3})
    with pytest.raises(ConfigError, match="does not take the arguments"):
        refine_predictions(*files, settings=wrong, prior=None, name="map")
    assert not (tmp_path / "out.h5").exists()
    flow = tmp_path / "flow.safetensors"
    fields = np.random.default_rng(0).normal(size=(4, POINTS, 3))
    PRIORS.get("flow").fit(fields, steps=2, hidden=8, transforms=2).save(flow)
    with pytest.raises(ConfigError, match="not Gaussian"):
        refine_predictions(*files, settings=settings, prior=flow, name="map")


def test_a_prior_is_diagnosed_and_drawn(tmp_path):
    pairs = make_pairs()
    pairs.split[:] = "val"
    write_pairs(tmp_path / "pairs.h5", pairs)
    rng = np.random.default_rng(1)
    source = np.repeat(pairs.source, 4, axis=0)
    fields = rng.normal(size=(12, 1, 1)) * source + 0.01 * rng.normal(size=source.shape)
    names = np.array([str(i) for i in range(12)])
    training = TrainingFields(*(x.astype(np.float32) for x in (fields, source, fields)))
    write_training_fields(tmp_path / "dvf.h5", names, training)
    dine(
        *("fit-prior", "--fields", tmp_path / "dvf.h5", "--settings", '{"kind": "pca_residual"}'),
        *("--out", tmp_path / "prior.safetensors"),
    )
    dine(
        *("diagnose", "--prior", tmp_path / "prior.safetensors", "--fields", tmp_path / "dvf.h5"),
        *("--pairs", tmp_path / "pairs.h5", "--dataset", "d", "--backbone", "b"),
        *("--name", "residual", "--out", tmp_path / "residual.json"),
    )
    found = read_json(tmp_path / "residual.json")
    assert (found["dataset"], found["backbone"], found["prior"]) == ("d", "b", "residual")
    assert np.isfinite(found["nll_per_coordinate"])
    assert (tmp_path / "residual.png").read_bytes().startswith(b"\x89PNG")
    write_pairs(tmp_path / "test.h5", make_pairs())
    with pytest.raises(DataError, match="no validation pairs"):
        dine(
            *("diagnose", "--prior", tmp_path / "prior.safetensors", "--pairs"),
            *(tmp_path / "test.h5", "--fields", tmp_path / "dvf.h5", "--out", tmp_path / "x.json"),
        )


# --- views ----------------------------------------------------------------------------------------


def test_views_show_the_median_pair_of_the_first_method(stored, tmp_path):
    """One row for each condition; the same pair for every method, coloured by its true error."""
    write_pairs(tmp_path / "equal.h5", make_pairs(count=5))
    pairs = read_pairs(tmp_path / "equal.h5")
    offset = np.array([0.05, 0.01, 0.02, 0.04, 0.03])[:, None, None] * [1.0, 0, 0]
    condition = evaluation_conditions(tmp_path / "equal.h5", [])[0]
    fields = {
        name: Prediction("deformation", 0.0, pairs.name, pairs.displacement + factor * offset)
        for name, factor in (("first", 1), ("second", 2))
    }
    example = typical(condition, fields)
    np.testing.assert_array_equal(example.source, pairs.source[4])
    np.testing.assert_allclose(example.errors["first"], 0.03, atol=1e-6)
    np.testing.assert_allclose(example.errors["second"], 0.06, atol=1e-6)
    assert example.label == "Clean\nlevel 0.5"
    assert example.seen is None


def test_views_of_every_condition(stored, tmp_path):
    out = tmp_path / "views" / "examples.png"
    arguments = ("examples", "--pairs", tmp_path / "pairs.h5", "--method", "net")
    arguments += ("--predictions", tmp_path / "network.h5", "--dataset", "synbench", "--out", out)
    dine(*arguments, "--variant", tmp_path / "noise.h5", "--methods", '{"net": {"title": "Half"}}')
    assert out.stat().st_size > 10_000
    assert out.with_suffix(".pdf").exists()
    write_variant(tmp_path / "more.h5", make_variant(stored, "noise", 0.02, 0), stored.checksum)
    with pytest.raises(DataError, match=r"network\.h5 has not predicted these pairs under noise_0"):
        dine(*arguments, "--variant", tmp_path / "more.h5")
