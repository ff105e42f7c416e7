"""The feature network that both backbones share: T-Net, EdgeConv layers, head; and the transformer.

Clouds are channels-last, (B, N, C). A mask (B, N) is True at valid points; without padding it is
None, which is the fast path. Parameter names and shapes are those of the published state dicts.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dine.geometry.chamfer import gather_points, squared_distances
from dine.models import kernels

NORM_EPS = 1e-5


def instance_norm(x: Tensor, mask: Tensor | None = None, slope: float = 1.0) -> Tensor:
    """Instance norm without affine part over the points of (B, L, C), then LeakyReLU.

    The variance is the biased one; a slope of 1 is the norm alone.
    """
    if kernels.supported(x):
        return kernels.NormLeakyReLU.apply(x, slope, mask, NORM_EPS)
    return instance_norm_eager(x, mask, slope)


def instance_norm_eager(x: Tensor, mask: Tensor | None = None, slope: float = 1.0) -> Tensor:
    """:func:`instance_norm` in plain PyTorch, on any device."""
    mean, scale = _statistics(x, mask)
    return F.leaky_relu((x - mean) * scale, slope)


def normalised_maximum(x: Tensor, mask: Tensor | None = None) -> Tensor:
    """Instance norm over all rows of (B, G, k, C), then the maximum over k: (B, G, C).

    The mask is (B, G·k); a group without valid rows gives zeros.
    """
    if kernels.supported(x):
        return kernels.NormMax.apply(x, mask, NORM_EPS)
    return normalised_maximum_eager(x, mask)


def normalised_maximum_eager(x: Tensor, mask: Tensor | None = None) -> Tensor:
    """:func:`normalised_maximum` in plain PyTorch, on any device."""
    mean, scale = _statistics(x.flatten(1, 2), mask)
    if mask is None:
        return (x.amax(dim=2) - mean) * scale
    mask = mask.view(*x.shape[:3], 1)
    empty = ~mask.any(dim=2)
    # Infinities must not meet the scale: its gradient would be NaN.
    highest = x.masked_fill(~mask, -torch.inf).amax(dim=2).masked_fill(empty, 0)
    return ((highest - mean) * scale).masked_fill(empty, 0)


def _statistics(x: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Mean and 1/√(variance + eps) over the valid points of (B, L, C): both (B, 1, C)."""
    if mask is None:
        variance, mean = torch.var_mean(x, dim=1, keepdim=True, correction=0)
    else:
        weight = mask.unsqueeze(-1).to(x.dtype)
        count = weight.sum(dim=1, keepdim=True)
        mean = (x * weight).sum(dim=1, keepdim=True) / count
        variance = ((x - mean).square() * weight).sum(dim=1, keepdim=True) / count
    return mean, torch.rsqrt(variance + NORM_EPS)


def pointwise(x: Tensor, convolution: nn.Module) -> Tensor:
    """Apply a 1×1 convolution's weights to channels-last data."""
    return F.linear(x, convolution.weight.flatten(1), convolution.bias)


class TNet(nn.Module):
    """Predicts a 3×3 transform of a cloud from the cloud itself."""

    def __init__(self):
        super().__init__()
        self.conv1 = nn.Conv1d(3, 64, 1)
        self.conv2 = nn.Conv1d(64, 128, 1)
        self.conv3 = nn.Conv1d(128, 1024, 1)
        self.fc1 = nn.Linear(1024, 512)
        self.fc2 = nn.Linear(512, 256)
        self.fc3 = nn.Linear(256, 9)

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, N, 3) to (B, 3, 3)."""
        x = F.relu(instance_norm(pointwise(x, self.conv1), mask))
        x = F.relu(instance_norm(pointwise(x, self.conv2), mask))
        # ReLU keeps the order of values, so the maximum over points can be taken before it.
        x = normalised_maximum(pointwise(x, self.conv3).unsqueeze(1), mask)
        x = F.relu(x.squeeze(1))
        # InstanceNorm1d on a (batch, channels) tensor normalises each row over its channels.
        x = F.relu(F.layer_norm(self.fc1(x), (512,), eps=NORM_EPS))
        x = F.relu(F.layer_norm(self.fc2(x), (256,), eps=NORM_EPS))
        return self.fc3(x).view(-1, 3, 3) + torch.eye(3, dtype=x.dtype, device=x.device)


class EdgeConv(nn.Module):
    """Three 1×1 convolutions on edge features [f_j − f_i, f_i], then a maximum over neighbours."""

    SLOPE = 0.01

    def __init__(self, channels: int, width: int):
        super().__init__()
        layers: list[nn.Module] = []
        for inputs in (2 * channels, width, width):
            layers += [nn.Conv2d(inputs, width, 1, bias=False), nn.Identity(), nn.Identity()]
        self.conv = nn.Sequential(*layers)

    def forward(self, x: Tensor, neighbours: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, N, C) features and (B, N, k) neighbour indices to (B, N, width)."""
        batch, points, channels = x.shape
        k = neighbours.shape[-1]
        edge_mask = None if mask is None else mask.repeat_interleave(k, dim=1)
        # W·[f_j − f_i, f_i] = W₁f_j + (W₂ − W₁)f_i: two products on points instead of one on edges.
        weight = self.conv[0].weight.flatten(1)
        near, own = weight[:, :channels], weight[:, channels:]
        edges = gather_points(F.linear(x, near), neighbours.flatten(1)).view(batch, points, k, -1)
        edges = (edges + F.linear(x, own - near).unsqueeze(2)).flatten(1, 2)
        edges = instance_norm(edges, edge_mask, self.SLOPE)
        edges = instance_norm(pointwise(edges, self.conv[3]), edge_mask, self.SLOPE)
        edges = pointwise(edges, self.conv[6]).view(batch, points, k, -1)
        # LeakyReLU, too, commutes with the maximum.
        return F.leaky_relu(normalised_maximum(edges, edge_mask), self.SLOPE)


def nearest_neighbours(x: Tensor, k: int, mask: Tensor | None = None) -> Tensor:
    """Indices (B, N, k) of the k nearest points of each point of (B, N, 3), itself included."""
    with torch.no_grad():
        distances = squared_distances(x, x)
        if mask is not None:
            # A padded point's own row is meaningless but must stay in range.
            distances = distances.masked_fill(~mask.unsqueeze(1), torch.inf)
        return distances.topk(k, dim=2, largest=False, sorted=False).indices


class FeatureNetwork(nn.Module):
    """T-Net, three EdgeConv layers and the head; per-point features of both clouds.

    Args:
        source_neighbours: k of the source's graph; the target's has ``target_neighbours``.
        transformer: mix the two clouds' features by attention before the head (DefTransNet).
    """

    CHANNELS = 64
    DIFFERENCE_SCALE = 0.1

    def __init__(
        self, source_neighbours: int = 10, target_neighbours: int = 30, transformer: bool = False
    ):
        super().__init__()
        self.source_neighbours = source_neighbours
        self.target_neighbours = target_neighbours
        self.input_transform = TNet()
        self.conv1 = EdgeConv(3, 32)
        self.conv2 = EdgeConv(32, 32)
        self.conv3 = EdgeConv(32, 64)
        self.conv4 = nn.Sequential(
            nn.Conv1d(64, 64, 1, bias=False), nn.Identity(), nn.Conv1d(64, 64, 1)
        )
        if transformer:
            self.transform = CrossTransformer(self.CHANNELS, heads=4, hidden=1024)
        else:
            self.register_module("transform", None)

    @torch.no_grad()
    def start_geometric(self) -> None:
        """Make random initial features smooth functions of position.

        Source and target have graphs of different size, so the differences f_j − f_i that EdgeConv
        looks at differ in scale between the clouds; with PyTorch's own initial weights they drown
        the positions, and points of one place get unlike features. Starting with small weights on
        the differences, and with the identity as the T-Net's transform (as in PointNet), the same
        place has nearly the same features in both clouds before any training.
        """
        nn.init.zeros_(self.input_transform.fc3.weight)
        nn.init.zeros_(self.input_transform.fc3.bias)
        for layer in (self.conv1, self.conv2, self.conv3):
            weight = layer.conv[0].weight
            weight[:, : weight.shape[1] // 2] *= self.DIFFERENCE_SCALE

    def forward(
        self,
        source: Tensor,
        target: Tensor,
        source_mask: Tensor | None = None,
        target_mask: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """(B, N, 3) and (B, M, 3) clouds to (B, N, 64) and (B, M, 64) features."""
        source = self._local(source, self.source_neighbours, source_mask)
        target = self._local(target, self.target_neighbours, target_mask)
        if self.transform is not None:
            source, target = self.transform(source, target, source_mask, target_mask)
        return self._head(source, source_mask), self._head(target, target_mask)

    def _local(self, x: Tensor, k: int, mask: Tensor | None) -> Tensor:
        x = x @ self.input_transform(x, mask)
        if mask is None:
            neighbours = nearest_neighbours(x, min(k, x.shape[1]))
            return self._edges(x, neighbours, None)
        # Smaller clouds than k would reach into the padding, so such members run on their own.
        sizes = mask.sum(1)
        if int(sizes.min()) >= k:
            return self._edges(x, nearest_neighbours(x, k, mask), mask)
        rows = []
        for row, size in zip(x, sizes.tolist(), strict=True):
            own = row[None, :size]
            features = self._edges(own, nearest_neighbours(own, min(k, size)), None)
            rows.append(F.pad(features[0], (0, 0, 0, x.shape[1] - size)))
        return torch.stack(rows)

    def _edges(self, x: Tensor, neighbours: Tensor, mask: Tensor | None) -> Tensor:
        x = self.conv1(x, neighbours, mask)
        x = self.conv2(x, neighbours, mask)
        return self.conv3(x, neighbours, mask)

    def _head(self, x: Tensor, mask: Tensor | None) -> Tensor:
        return pointwise(instance_norm(pointwise(x, self.conv4[0]), mask), self.conv4[2])


class UnbiasedNorm(nn.Module):
    """a·(x − mean)/(std + eps) + b with the unbiased std, unlike torch's LayerNorm."""

    EPS = 1e-6

    def __init__(self, channels: int):
        super().__init__()
        self.a_2 = nn.Parameter(torch.ones(channels))
        self.b_2 = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        variance, mean = torch.var_mean(x, dim=-1, keepdim=True, correction=1)
        return self.a_2 * (x - mean) / (variance.sqrt() + self.EPS) + self.b_2


class Attention(nn.Module):
    """Multi-head attention with its four linear maps: query, key, value, output."""

    def __init__(self, channels: int, heads: int):
        super().__init__()
        self.heads = heads
        self.linears = nn.ModuleList(nn.Linear(channels, channels) for _ in range(4))

    def forward(self, query: Tensor, memory: Tensor, memory_mask: Tensor | None) -> Tensor:
        def split(x: Tensor, linear: nn.Linear) -> Tensor:
            return linear(x).unflatten(-1, (self.heads, -1)).transpose(1, 2)

        mask = None if memory_mask is None else memory_mask[:, None, None, :]
        mixed = F.scaled_dot_product_attention(
            split(query, self.linears[0]),
            split(memory, self.linears[1]),
            split(memory, self.linears[2]),
            attn_mask=mask,
        )
        return self.linears[3](mixed.transpose(1, 2).flatten(2))


class FeedForward(nn.Module):
    def __init__(self, channels: int, hidden: int):
        super().__init__()
        self.w_1 = nn.Linear(channels, hidden)
        self.w_2 = nn.Linear(hidden, channels)

    def forward(self, x: Tensor) -> Tensor:
        return self.w_2(F.relu(self.w_1(x)))


class _Sublayer(nn.Module):
    """Holds the norm of one residual branch, under the published name."""

    def __init__(self, channels: int):
        super().__init__()
        self.norm = UnbiasedNorm(channels)


class EncoderLayer(nn.Module):
    def __init__(self, channels: int, heads: int, hidden: int):
        super().__init__()
        self.self_attn = Attention(channels, heads)
        self.feed_forward = FeedForward(channels, hidden)
        self.sublayer = nn.ModuleList(_Sublayer(channels) for _ in range(2))

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        normed = self.sublayer[0].norm(x)
        x = x + self.self_attn(normed, normed, mask)
        return x + self.feed_forward(self.sublayer[1].norm(x))


class DecoderLayer(nn.Module):
    def __init__(self, channels: int, heads: int, hidden: int):
        super().__init__()
        self.self_attn = Attention(channels, heads)
        self.src_attn = Attention(channels, heads)
        self.feed_forward = FeedForward(channels, hidden)
        self.sublayer = nn.ModuleList(_Sublayer(channels) for _ in range(3))

    def forward(
        self, x: Tensor, memory: Tensor, mask: Tensor | None, memory_mask: Tensor | None
    ) -> Tensor:
        normed = self.sublayer[0].norm(x)
        x = x + self.self_attn(normed, normed, mask)
        x = x + self.src_attn(self.sublayer[1].norm(x), memory, memory_mask)
        return x + self.feed_forward(self.sublayer[2].norm(x))


class _Stack(nn.Module):
    """A single layer and the norm after it, under the published names."""

    def __init__(self, layer: nn.Module, channels: int):
        super().__init__()
        self.layers = nn.ModuleList([layer])
        self.norm = UnbiasedNorm(channels)

    def forward(self, *inputs) -> Tensor:
        return self.norm(self.layers[0](*inputs))


class CrossTransformer(nn.Module):
    """x ← x + decode(x | encode(y)) and y ← y + decode(y | encode(x)), both from the old x, y."""

    def __init__(self, channels: int, heads: int, hidden: int):
        super().__init__()
        self.model = nn.Module()
        self.model.encoder = _Stack(EncoderLayer(channels, heads, hidden), channels)
        self.model.decoder = _Stack(DecoderLayer(channels, heads, hidden), channels)
        # As in "The Annotated Transformer", which the published code follows.
        for parameter in self.parameters():
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)

    def forward(
        self, x: Tensor, y: Tensor, x_mask: Tensor | None, y_mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        encode, decode = self.model.encoder, self.model.decoder
        x_code, y_code = encode(x, x_mask), encode(y, y_mask)
        return x + decode(x, y_code, x_mask, y_mask), y + decode(y, x_code, y_mask, x_mask)
