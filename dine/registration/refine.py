"""Refining one field at test time: maximum a posteriori by gradient descent."""

from __future__ import annotations

import numpy as np
import torch

from dine.geometry.chamfer import nearest_squared
from dine.geometry.graph import neighbour_graph
from dine.priors import Prior

_RATE = 5e-3
_NEIGHBOURS = 10


def refine(
    source: np.ndarray,
    target: np.ndarray,
    displacement: np.ndarray,
    prior: Prior,
    *,
    steps: int,
    supported: np.ndarray,
    device: torch.device,
    prior_weight: float = 1e-5,
    smoothness: float = 0.5,
) -> np.ndarray:
    """Minimise Chamfer distance + weight · prior penalty + smoothness over the field (N, 3).

    A penalty such as PCA's leaves free what lies outside its span, and the Chamfer distance alone
    would tear neighbours apart there; so does nothing that differs between neighbours: the
    smoothness is the mean squared difference of the change to the network's field along the
    source's neighbour graph. Points that are not ``supported`` (N,) do not count in the distance.
    A prior fitted to another number of points is left out.
    """
    start = torch.as_tensor(displacement, dtype=torch.float32, device=device)[None]
    x = torch.as_tensor(source, dtype=torch.float32, device=device)[None]
    y = torch.as_tensor(target, dtype=torch.float32, device=device)[None]
    mask = torch.as_tensor(supported, device=device)[None]
    graph = neighbour_graph(source, _NEIGHBOURS).to(device)
    fits = prior.shape.get("points") in (None, len(source))
    prior = prior.to(device)
    change = torch.zeros_like(start, requires_grad=True)
    optimiser = torch.optim.Adam([change], lr=_RATE)
    for _ in range(steps):
        field = start + change
        from_source, from_target = nearest_squared(x + field, y, mask)
        loss = from_source.sum() / mask.sum() + from_target.mean()
        differences = change[0, graph.tail] - change[0, graph.head]
        loss = loss + smoothness * differences.square().sum(-1).mean()
        if fits:
            loss = loss + prior_weight * prior.penalty(field).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return (start + change)[0].detach().double().cpu().numpy()
