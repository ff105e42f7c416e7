"""Both backbones written plainly from their formulas, for one pair: the oracle of tests and the
yardstick of benchmarks. No trick, no fusion, no batching; PyTorch's own gradients throughout.

``state`` is a state dict with the published keys.
"""

import torch
from torch import Tensor
from torch.nn import functional as F


def normalise(x: Tensor) -> Tensor:
    """Instance norm without affine part over the rows of (L, C)."""
    mean = x.mean(dim=0)
    variance = ((x - mean) ** 2).mean(dim=0)
    return (x - mean) / torch.sqrt(variance + 1e-5)


def linear(state: dict, key: str, x: Tensor) -> Tensor:
    weight = state[f"{key}.weight"].flatten(1)
    bias = state.get(f"{key}.bias")
    return x @ weight.T if bias is None else x @ weight.T + bias


def transform(state: dict, x: Tensor) -> Tensor:
    """T-Net: (N, 3) to (3, 3)."""
    for layer in ("conv1", "conv2", "conv3"):
        x = F.relu(normalise(linear(state, f"input_transform.{layer}", x)))
    x = x.max(dim=0).values
    for layer in ("fc1", "fc2"):
        x = linear(state, f"input_transform.{layer}", x)
        x = F.relu(F.layer_norm(x, x.shape, eps=1e-5))
    return linear(state, "input_transform.fc3", x).view(3, 3) + torch.eye(3, dtype=x.dtype)


def neighbours(x: Tensor, k: int) -> Tensor:
    distance = ((x[:, None] - x[None]) ** 2).sum(dim=2)
    return distance.topk(min(k, len(x)), dim=1, largest=False).indices


def edge_convolution(state: dict, key: str, x: Tensor, near: Tensor) -> Tensor:
    own = x[:, None].expand(-1, near.shape[1], -1)
    edges = torch.cat([x[near] - own, own], dim=2)
    shape = (*near.shape, -1)
    for layer in (0, 3, 6):
        edges = linear(state, f"{key}.conv.{layer}", edges.flatten(0, 1))
        edges = F.leaky_relu(normalise(edges), 0.01).view(shape)
    return edges.max(dim=1).values


def attention(state: dict, key: str, x: Tensor, memory: Tensor, heads: int = 4) -> Tensor:
    query, keys, values = (
        linear(state, f"{key}.linears.{i}", y).unflatten(1, (heads, -1)).transpose(0, 1)
        for i, y in enumerate((x, memory, memory))
    )
    weights = torch.softmax(query @ keys.transpose(1, 2) / query.shape[2] ** 0.5, dim=2)
    return linear(state, f"{key}.linears.3", (weights @ values).transpose(0, 1).flatten(1))


def unbiased_norm(state: dict, key: str, x: Tensor) -> Tensor:
    centred = x - x.mean(dim=1, keepdim=True)
    return state[f"{key}.a_2"] * centred / (x.std(dim=1, keepdim=True) + 1e-6) + state[f"{key}.b_2"]


def feed_forward(state: dict, key: str, x: Tensor) -> Tensor:
    return linear(state, f"{key}.w_2", F.relu(linear(state, f"{key}.w_1", x)))


def encode(state: dict, x: Tensor) -> Tensor:
    key = "transform.model.encoder"
    normed = unbiased_norm(state, f"{key}.layers.0.sublayer.0.norm", x)
    x = x + attention(state, f"{key}.layers.0.self_attn", normed, normed)
    normed = unbiased_norm(state, f"{key}.layers.0.sublayer.1.norm", x)
    x = x + feed_forward(state, f"{key}.layers.0.feed_forward", normed)
    return unbiased_norm(state, f"{key}.norm", x)


def decode(state: dict, x: Tensor, memory: Tensor) -> Tensor:
    key = "transform.model.decoder"
    normed = unbiased_norm(state, f"{key}.layers.0.sublayer.0.norm", x)
    x = x + attention(state, f"{key}.layers.0.self_attn", normed, normed)
    normed = unbiased_norm(state, f"{key}.layers.0.sublayer.1.norm", x)
    x = x + attention(state, f"{key}.layers.0.src_attn", normed, memory)
    normed = unbiased_norm(state, f"{key}.layers.0.sublayer.2.norm", x)
    x = x + feed_forward(state, f"{key}.layers.0.feed_forward", normed)
    return unbiased_norm(state, f"{key}.norm", x)


def features(state: dict, source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 64) and (M, 64)."""
    clouds = []
    for x, k in ((source, 10), (target, 30)):
        x = x @ transform(state, x)
        near = neighbours(x, k)
        for layer in ("conv1", "conv2", "conv3"):
            x = edge_convolution(state, layer, x, near)
        clouds.append(x)
    x, y = clouds
    if "transform.model.encoder.norm.a_2" in state:
        x, y = (
            x + decode(state, x, encode(state, y)),
            y + decode(state, y, encode(state, x)),
        )
    x, y = (linear(state, "conv4.2", normalise(linear(state, "conv4.0", z))) for z in (x, y))
    return x, y


def edges_of(source: Tensor, k: int = 10) -> list[tuple[int, int]]:
    """Directed edges of the symmetrised graph of the k nearest other points."""
    distance = ((source[:, None] - source[None]) ** 2).sum(dim=2)
    distance.fill_diagonal_(torch.inf)
    near = distance.topk(min(k, len(source) - 1), dim=1, largest=False).indices.tolist()
    pairs = {(i, j) for i, row in enumerate(near) for j in row}
    return sorted(pairs | {(j, i) for i, j in pairs})


def propagate(
    cost: Tensor, candidates: Tensor, edges: list[tuple[int, int]], updates: int, s: float = 10.0
) -> Tensor:
    """Beliefs (N, K) from unary costs (N, K) and candidate displacements (N, K, 3)."""
    position = {edge: number for number, edge in enumerate(edges)}
    tail, head = torch.tensor(edges).T
    reverse = torch.tensor([position[j, i] for i, j in edges])
    messages = cost.new_zeros(len(edges), cost.shape[1])
    for _ in range(updates):
        belief = cost.index_add(0, head, messages)
        h = belief[tail] - messages[reverse]
        messages = torch.stack(
            [
                (
                    h[e][:, None]
                    + s * ((candidates[i][:, None] - candidates[j][None]) ** 2).sum(dim=2)
                ).amin(dim=0)
                for e, (i, j) in enumerate(edges)
            ]
        )
    return cost.index_add(0, head, messages)


def register(state: dict, source: Tensor, target: Tensor, count: int = 128) -> Tensor:
    """Displacement (N, 3) of source (N, 3) onto target (M, 3)."""
    x, y = features(state, source, target)
    table = ((x[:, None] - y[None]) ** 2).mean(dim=2)
    index = table.topk(min(count, len(target)), dim=1, largest=False).indices
    candidates = target[index] - source[:, None]
    belief = propagate(table.gather(1, index), candidates, edges_of(source), updates=2)
    return (torch.softmax(-50 * belief, dim=1)[..., None] * candidates).sum(dim=1)


def chamfer_distance(a: Tensor, b: Tensor) -> Tensor:
    table = ((a[:, None] - b[None]) ** 2).sum(dim=2)
    return table.amin(dim=1).mean() + table.amin(dim=0).mean()
