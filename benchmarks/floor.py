"""Arithmetic that the backbones cannot do without, in floating-point operations (two per
multiply-add), for one pair of N source and M target points."""

from __future__ import annotations

CHANNELS, HIDDEN = 64, 1024
LAYERS = ((3, 32), (32, 32), (32, 64))
EDGES_PER_POINT = 11.4
"""Directed edges of the symmetrised 10-neighbour graph; 11–13 on surfaces."""


def features(points: int, k: int) -> float:
    """One cloud through T-Net, edge convolutions and head; the products on points and edges."""
    tnet = 3 * 64 + 64 * 128 + 128 * 1024
    convolutions = sum(2 * before * after + 2 * k * after**2 for before, after in LAYERS)
    return 2.0 * points * (tnet + convolutions + 2 * CHANNELS**2)


def transformer(points: int, other: int) -> float:
    """One cloud through encoder and decoder: attention to itself twice and to the other once."""
    linear = 3 * 4 * CHANNELS**2 + 2 * 2 * CHANNELS * HIDDEN
    scores = 2 * CHANNELS * (2 * points + other)
    return 2.0 * points * (linear + scores)


def candidates(points: int, targets: int) -> float:
    return 2.0 * points * targets * CHANNELS


def message_update(points: int, count: int) -> float:
    """Three multiply-adds, an addition and a comparison per pair of candidates and edge."""
    return 8.0 * EDGES_PER_POINT * points * count**2


def registration(backbone: str, points: int = 1024, count: int = 128, updates: int = 2) -> float:
    learned = features(points, 10) + features(points, 30) + candidates(points, points)
    if backbone == "deftransnet":
        learned += 2 * transformer(points, points)
    return learned + updates * message_update(points, count)


def training_step(backbone: str, points: int = 1024, count: int = 128, updates: int = 2) -> float:
    """The backward pass costs twice the forward pass, except that messages only scatter there."""
    messages = updates * message_update(points, count)
    return 3 * (registration(backbone, points, count, updates) - messages) + messages
