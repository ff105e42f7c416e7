"""Both backbones against numbers that the published code printed."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from dine.data.batch import make_batch
from dine.errors import ConfigError
from dine.models import compiled
from dine.models.backbones import BACKBONES

pytestmark = pytest.mark.numerical
DATA = Path(__file__).parents[1] / "data"
SEEDS = {"robust_defreg": 1, "deftransnet": 2}
SIZES = ("256x256", "200x330")


def golden_state(name):
    """Weights as the golden numbers were made with (see backbones.md of the reference)."""
    rng = np.random.RandomState(SEEDS[name])
    state = {}
    for key, shape in sorted(json.loads((DATA / "checkpoint_keys.json").read_text())[name].items()):
        value = rng.standard_normal(shape)
        if key.endswith("a_2"):
            value = 1 + 0.1 * value
        elif value.ndim == 1:
            value = 0.1 * value
        else:
            value = value / np.sqrt(np.prod(shape[1:]))
        state[key] = torch.from_numpy(value)
    return state


def golden_backbone(name):
    backbone = BACKBONES.get(name)().double()
    backbone.load_state_dict(golden_state(name))
    return backbone


@pytest.fixture(scope="module")
def golden():
    with np.load(DATA / "golden.npz") as data:
        return dict(data)


@pytest.mark.parametrize("path", ["compiled", "eager"])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", SEEDS)
def test_golden_numbers(golden, name, size, path, monkeypatch):
    if path == "eager":  # what runs on a GPU
        monkeypatch.setattr(compiled, "supported", lambda *tensors: False)
    expected = {
        key.removeprefix(f"{name}/{size}/"): value
        for key, value in golden.items()
        if key.startswith(f"{name}/{size}/")
    }
    backbone = golden_backbone(name)
    batch = make_batch([expected["source"]], [expected["target"]], dtype=torch.float64)
    for cloud in ("source", "target"):
        transform = backbone.input_transform(getattr(batch, cloud))[0]
        assert np.abs(transform.detach().numpy() - expected[f"tnet_{cloud}"]).max() < 1e-9
    source_features, target_features = backbone.features(batch)
    assert np.abs(source_features[0].detach().numpy() - expected["features_source"]).max() < 1e-9
    assert np.abs(target_features[0].detach().numpy() - expected["features_target"]).max() < 1e-9
    displacement = backbone(batch).displacement
    assert np.abs(displacement[0].detach().numpy() - expected["displacement"]).max() < 1e-9
    displacement.square().sum().backward()
    gradients = {key for key in expected if key.startswith("grad/")}
    assert len(gradients) == 3
    parameters = dict(backbone.named_parameters())
    for key in gradients:
        gradient = parameters[key.removeprefix("grad/")].grad.numpy()
        # Relative to the largest entry, which reaches 8.6e3.
        error = np.abs(gradient.reshape(expected[key].shape) - expected[key]).max()
        assert error < 1e-9 * np.abs(expected[key]).max()


@pytest.mark.parametrize("name", SEEDS)
def test_published_keys_and_shapes(name):
    expected = json.loads((DATA / "checkpoint_keys.json").read_text())[name]
    state = BACKBONES.get(name)().state_dict()
    assert {key: list(value.shape) for key, value in state.items()} == expected


@pytest.mark.parametrize("name", SEEDS)
def test_batch_of_unequal_sizes_equals_one_by_one(golden, name):
    backbone = golden_backbone(name)
    pairs = [(golden[f"{name}/{s}/source"], golden[f"{name}/{s}/target"]) for s in SIZES]
    # Smaller than the target's neighbourhood (30) and than the candidate count (128).
    pairs.append((pairs[0][0][:60], pairs[0][1][:25]))
    pairs.append((pairs[1][0][:7], pairs[1][1][:90]))

    def run(chosen):
        batch = make_batch(*zip(*chosen, strict=True), dtype=torch.float64)
        backbone.zero_grad()
        displacement = backbone(batch).displacement
        displacement.square().sum().backward()
        gradient = torch.cat([p.grad.flatten() for p in backbone.parameters()])
        return displacement.detach(), gradient

    together, gradient = run(pairs)
    total = 0
    for index, pair in enumerate(pairs):
        alone, part = run([pair])
        total = total + part
        size = len(pair[0])
        assert (together[index, :size] - alone[0]).abs().max() < 1e-9
        assert (together[index, size:] == 0).all()
    assert (gradient - total).abs().max() < 1e-9 * gradient.abs().max()


def test_published_checkpoint_reproduces_published_predictions(shared):
    backbone = BACKBONES.get("robust_defreg")()
    state = torch.load(
        shared / "published" / "robust_defreg_modelnet10.pth", map_location="cpu", weights_only=True
    )
    backbone.load_state_dict(state)
    with np.load(shared / "published" / "robust_defreg_modelnet10_predictions.npz") as data:
        stored = dict(data)
    meshes = sorted({key.split("/")[0] for key in stored})
    assert len(meshes) == 5
    for mesh in meshes:
        batch = make_batch([stored[f"{mesh}/source"]], [stored[f"{mesh}/target"]])
        with torch.no_grad():
            displacement = backbone(batch).displacement[0].numpy()
        assert np.abs(displacement - stored[f"{mesh}/displacement"]).max() < 1e-4


@pytest.mark.parametrize("name", SEEDS)
def test_geometric_start_finds_small_deformations_before_any_training(name):
    rng = np.random.default_rng(0)
    source = rng.normal(size=(300, 3))
    source /= np.linalg.norm(source, axis=1, keepdims=True)
    truth = 0.05 * np.sin(2 * source[:, [1, 2, 0]])
    batch = make_batch([source], [source + truth], dtype=torch.float64)
    errors = {}
    for initialisation in ("geometric", "default"):
        torch.manual_seed(0)
        backbone = BACKBONES.get(name)(initialisation=initialisation).double()
        with torch.no_grad():
            found = backbone(batch).displacement[0].numpy()
        errors[initialisation] = np.linalg.norm(found - truth, axis=1).mean()
    assert errors["geometric"] < 0.02
    assert errors["default"] > 5 * errors["geometric"]


def test_unknown_initialisation_is_refused():
    with pytest.raises(ConfigError, match="expected geometric or default"):
        BACKBONES.get("robust_defreg")(initialisation="magic")
