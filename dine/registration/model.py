"""Weights to register with, and the prior and calibration that belong to them."""

from __future__ import annotations

from pathlib import Path

from dine.errors import ConfigError, DataError
from dine.files import file_digest
from dine.models.checkpoint import WEIGHTS, load_backbone, shipped_weights
from dine.priors.base import load_prior
from dine.registration.calibration import load_calibration
from dine.registration.types import Model


def load_model(
    backbone: str | None = None,
    *,
    weights: str | Path | None = None,
    prior: str | Path | None = None,
    calibration: str | Path | None = None,
) -> Model:
    """Weights, prior and calibration, by name or from files.

    Args:
        backbone: a backbone with shipped weights, by default ``robust_defreg``; must fit
            ``weights`` where these are given.
        weights: a file of weights, ours or as published by the authors of the backbones.
        prior: a file of a fitted prior; by default the shipped one with the shipped weights.
        calibration: a file of ``dine calibrate``, likewise.

    Raises:
        ConfigError: no shipped weights of this name, or other weights than the backbone's.
        CheckpointError: a file is missing, damaged, or something else.
        DataError: the calibration was made with other weights or another prior.
    """
    shipped = weights is None
    if shipped:
        backbone = backbone or "robust_defreg"
    path = shipped_weights(backbone) if shipped else Path(weights)
    network, facts = load_backbone(path)
    if backbone not in (None, network.registered_name):
        raise ConfigError(
            f"{path} holds weights of {network.registered_name}, not of {backbone}; leave out the "
            "backbone or name the right one."
        )
    if shipped:
        prior = prior or _beside(f"{backbone}.prior.safetensors")
        calibration = calibration or _beside(f"{backbone}.calibration.json")
    loaded = load_calibration(Path(calibration)) if calibration else None
    for what, file in (("model", path), ("prior", prior)):
        if loaded and loaded.facts.get(what) != (file_digest(Path(file)) if file else None):
            raise DataError(
                f"{calibration} was made with another {what} than {file or 'none'}; run "
                f"`dine calibrate` for this {what}."
            )
    return Model(
        network,
        path,
        facts,
        load_prior(prior) if prior else None,
        Path(prior) if prior else None,
        loaded,
    )


def _beside(name: str) -> Path | None:
    path = WEIGHTS / name
    return path if path.is_file() else None
