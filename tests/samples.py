"""Small pairs, predictions and metrics that several test files need."""

import h5py
import numpy as np

from dine.data.pairs import PairSet
from dine.evaluation.predictions import FORMAT, put_prediction

POINTS = 200


def sphere(count, seed=0):
    """Points (count, 3) drawn on the unit sphere."""
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def ball(rng, count):
    points = rng.normal(size=(count, 3))
    points *= rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
    points -= points.mean(axis=0)
    return points / np.linalg.norm(points, axis=1).max()


def make_pairs(points=POINTS, count=3):
    rng = np.random.default_rng(0)
    source = np.stack([ball(rng, points) for _ in range(count)])
    names = np.array([f"0.5/{i}_1_0.5" for i in range(count)])
    return PairSet(
        source=source,
        target=source + 0.1 * np.sin(3 * source[..., ::-1]),
        center=np.zeros((count, 3)),
        scale=np.arange(1.0, count + 1) * 10,
        level=np.full(count, 0.5),
        name=names,
        object=np.array([str(i) for i in range(count)]),
        split=np.array(["test"] * count),
        source_file=names,
        target_file=names,
        vertex_index=np.zeros((count, points, 3)),
        vertex_weight=np.zeros((count, points, 3)),
        attributes={"origin": "synthetic"},
    )


def write_predictions(path, predictions):
    with h5py.File(path, "w") as file:
        file.attrs["format"] = FORMAT
        for number, prediction in enumerate(predictions):
            put_prediction(file.create_group(str(number)), prediction)


def evaluation(**changes):
    """One made-up row of metrics."""
    values = {
        "dataset": "deformedtissue",
        "backbone": "robust_defreg",
        "method": "stage1",
        "seed": 0,
        "origin": "synthetic",
        "pair": "a",
        "object": "made-up",
        "objects": "known",
        "level": 0.7,
        "condition": "deformation",
        "corruption": 0.0,
        "cd": 1e-3,
        "cd_unregistered": 0.01,
        "mce": 0.1,
        "roughness_true": 0.25,
        **dict.fromkeys(("hd95", "accuracy_2_5", "accuracy_5", "far_points"), 0.5),
        **dict.fromkeys(("folding", "roughness", "seconds"), 0.5),
    } | changes
    derived = {"cluster": f"{values['object']}/{values['pair']}", "cd_observed": 2 * values["cd"]}
    return {**derived, **values}


def only(table, **where):
    """The one row of a table with these values."""
    for name, value in where.items():
        number = isinstance(value, float)
        found = np.isclose(table[name], value, equal_nan=True) if number else table[name] == value
        table = table[found]
    assert len(table) == 1
    return table.iloc[0]
