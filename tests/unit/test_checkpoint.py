"""Weights survive the round trip, and nothing else passes for weights."""

import pickle
import zipfile

import pytest
import torch

from dine.errors import CheckpointError, ConfigError
from dine.models.backbones import BACKBONES, Backbone
from dine.models.checkpoint import load_backbone, save_backbone
from dine.priors import load_prior
from dine.training.stages import new_backbone


@pytest.mark.parametrize("name", BACKBONES.names())
def test_round_trip(tmp_path, name):
    backbone = new_backbone(name, {"candidates": 32}, seed=1)
    save_backbone(tmp_path / "a.safetensors", backbone, steps=3)
    again, facts = load_backbone(tmp_path / "a.safetensors")
    assert type(again) is type(backbone)
    assert again.arguments == backbone.arguments
    assert facts["steps"] == 3
    for key, value in backbone.state_dict().items():
        assert torch.equal(again.state_dict()[key], value)
    save_backbone(tmp_path / "b.safetensors", again, steps=3)
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_random_weights_depend_on_the_seed_alone():
    torch.manual_seed(5)
    first = new_backbone("robust_defreg", {}, seed=1).state_dict()
    torch.manual_seed(6)
    before = torch.random.get_rng_state()
    second = new_backbone("robust_defreg", {}, seed=1).state_dict()
    assert torch.equal(before, torch.random.get_rng_state())
    other = new_backbone("robust_defreg", {}, seed=2).state_dict()
    key = "conv2.conv.0.weight"
    assert torch.equal(first[key], second[key])
    assert not torch.equal(first[key], other[key])


@pytest.mark.parametrize("name", BACKBONES.names())
def test_published_state_dicts_are_told_apart_by_content(tmp_path, name):
    torch.save(new_backbone(name, {}, seed=1).state_dict(), tmp_path / "weights.pth")
    backbone, facts = load_backbone(tmp_path / "weights.pth")
    assert backbone.registered_name == name
    assert facts["published"]


def test_damage_is_noticed(tmp_path):
    path = tmp_path / "model.safetensors"
    with pytest.raises(CheckpointError, match="does not exist"):
        load_backbone(path)
    save_backbone(path, new_backbone("robust_defreg", {}, seed=1))
    whole = path.read_bytes()
    for cut in (0, 5, 200, len(whole) - 10):
        path.write_bytes(whole[:cut])
        with pytest.raises(CheckpointError, match=r"model\.safetensors"):
            load_backbone(path)
    path.write_bytes(b"PK not really a zip")
    with pytest.raises(CheckpointError, match="not a readable PyTorch state dict"):
        load_backbone(path)


def test_weights_that_do_not_fit_are_refused(tmp_path):
    path = tmp_path / "weights.pth"
    state = new_backbone("robust_defreg", {}, seed=1).state_dict()
    del state["conv4.2.bias"]
    torch.save(state, path)
    with pytest.raises(
        CheckpointError, match=r"do not fit RobustDefReg: conv4\.2\.bias is missing"
    ):
        load_backbone(path)
    state = new_backbone("robust_defreg", {}, seed=1).state_dict()
    state["conv4.2.bias"][0] = torch.nan
    torch.save(state, path)
    with pytest.raises(CheckpointError, match=r"conv4\.2\.bias holds NaN"):
        load_backbone(path)


def test_loading_never_runs_code(tmp_path):
    class Attack:
        def __reduce__(self):
            return (open, (str(tmp_path / "owned"), "w"))

    path = tmp_path / "weights.pth"
    torch.save({"a": Attack()}, path)
    with pytest.raises(CheckpointError):
        load_backbone(path)
    path.write_bytes(pickle.dumps({"a": Attack()}, protocol=2))
    with pytest.raises(CheckpointError):
        load_backbone(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x/data.pkl", pickle.dumps(Attack()))
    with pytest.raises(CheckpointError):
        load_backbone(path)
    assert not (tmp_path / "owned").exists()


def test_a_prior_is_no_backbone_and_the_reverse(tmp_path):
    path = tmp_path / "model.safetensors"
    save_backbone(path, new_backbone("robust_defreg", {}, seed=1))
    with pytest.raises(CheckpointError, match="expected 'dine-prior'"):
        load_prior(path)


class Outside(Backbone):
    """A backbone that lives outside the package."""

    def __init__(self, width: int = 2):
        super().__init__(width=width)
        self.layer = torch.nn.Linear(3, width)


def test_a_backbone_by_import_path(tmp_path):
    name = f"{__name__}:Outside"
    backbone = new_backbone(name, {"width": 4}, seed=1)
    assert backbone.layer.out_features == 4
    save_backbone(tmp_path / "mine.safetensors", backbone)
    again, facts = load_backbone(tmp_path / "mine.safetensors")
    assert facts["backbone"] == name
    assert torch.equal(again.layer.weight, backbone.layer.weight)
    with pytest.raises(ConfigError, match="does not take these arguments"):
        new_backbone(name, {"depth": 4}, seed=1)
