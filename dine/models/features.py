"""The feature network that both backbones share: T-Net, EdgeConv layers, head; and the transformer.

Clouds are channels-last, (B, N, C). A mask (B, N) is True at valid points; without padding it is
None, which is the fast path. Parameter names and shapes are those of the published state dicts.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dine.geometry.neighbours import Neighbours, gather_points, nearest_neighbours
from dine.models import compiled

if TYPE_CHECKING:
    from dine.models.compiled.convolution import Edges

NORM_EPS = 1e-5

GROUP = 64
"""Points of which the T-Net takes a maximum at once, before that over all."""


def instance_norm(x: Tensor, mask: Tensor | None = None, slope: float = 1.0) -> Tensor:
    """Instance norm without affine part over the points of (B, L, C), then LeakyReLU.

    The variance is the biased one; a slope of 1 is the norm alone.
    """
    if compiled.supported(x):
        from dine.models.compiled.rows import NormLeakyReLU

        return NormLeakyReLU.apply(x, slope, mask, NORM_EPS)
    return instance_norm_eager(x, mask, slope)


def instance_norm_eager(x: Tensor, mask: Tensor | None = None, slope: float = 1.0) -> Tensor:
    """:func:`instance_norm` in plain PyTorch, on any device."""
    mean, scale = _statistics(x, mask)
    return F.leaky_relu((x - mean) * scale, slope).to(x.dtype)


def linear_maximum(x: Tensor, weight: Tensor, group: int, mask: Tensor | None = None) -> Tensor:
    """Instance norm of the rows x Wᵀ of (B, L, C), then the maximum over each ``group`` of rows.

    Returns (B, ⌈L / group⌉, C'); a group without valid rows gives zeros.
    """
    if compiled.supported(x, weight):
        from dine.models.compiled.convolution import LinearMaximum

        return LinearMaximum.apply(x, weight, group, mask, NORM_EPS)
    x = F.linear(x, weight)
    surplus = -x.shape[1] % group
    if surplus:
        if mask is None:
            mask = x.new_ones(x.shape[:2], dtype=torch.bool)
        x, mask = F.pad(x, (0, 0, 0, surplus)), F.pad(mask, (0, surplus))
    return normalised_maximum(x.unflatten(1, (-1, group)), mask)


def normalised_maximum(x: Tensor, mask: Tensor | None = None) -> Tensor:
    """Instance norm over all rows of (B, G, k, C), then the maximum over k: (B, G, C).

    The mask is (B, G·k); a group without valid rows gives zeros.
    """
    mean, scale = _statistics(x.flatten(1, 2), mask)
    if mask is None:
        return (x.amax(dim=2) - mean) * scale
    mask = mask.view(*x.shape[:3], 1)
    empty = ~mask.any(dim=2)
    # Infinities must not meet the scale: its gradient would be NaN.
    highest = x.masked_fill(~mask, -torch.inf).amax(dim=2).masked_fill(empty, 0)
    return ((highest - mean) * scale).masked_fill(empty, 0)


def _statistics(x: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Mean and 1/√(variance + eps) over the valid points of (B, L, C): both (B, 1, C).

    At least in float32, whatever the precision of x.
    """
    x = x.float() if x.dtype == torch.bfloat16 else x
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
        # The norm takes the bias away again, and ReLU keeps the order of values.
        weight = self.conv3.weight.flatten(1)
        x = F.relu(linear_maximum(x, weight, GROUP, mask).max(dim=1).values)
        x = x + 0 * self.conv3.bias  # an exact zero gradient
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

    def forward(self, x: Tensor, neighbours: Neighbours, edges: Edges | None = None) -> Tensor:
        """(B, N, C) features and N neighbourhoods to (B, N, width).

        ``edges`` holds the same neighbours in the form of the compiled kernels, where they run.
        """
        channels = x.shape[2]
        # W·[f_j − f_i, f_i] = W₁f_j + (W₂ − W₁)f_i: two products on points instead of one on edges.
        weight = self.conv[0].weight.flatten(1)
        near, own = weight[:, :channels], weight[:, channels:]
        with torch.autocast(x.device.type, enabled=False):
            # Neighbours' differences would not survive rounding; and these products are small.
            near, own = F.linear(x, near), F.linear(x, own - near)
        middle, last = (self.conv[i].weight.flatten(1) for i in (3, 6))
        if edges is not None:
            from dine.models.compiled.convolution import EdgeConvolution

            x = EdgeConvolution.apply(near, own, middle, last, edges, self.SLOPE, NORM_EPS)
        else:
            x = edge_convolution(near, own, middle, last, neighbours, self.SLOPE)
        # LeakyReLU, too, commutes with the maximum.
        return F.leaky_relu(x, self.SLOPE).to(near.dtype)


def edge_convolution(
    near: Tensor, own: Tensor, middle: Tensor, last: Tensor, neighbours: Neighbours, slope: float
) -> Tensor:
    """:class:`EdgeConvolution` in plain PyTorch, on any device."""
    index, mask = neighbours.index, neighbours.mask
    mask = None if mask is None else mask.flatten(1)
    edges = gather_points(near, index.flatten(1)).unflatten(1, index.shape[1:])
    edges = instance_norm_eager((edges + own.unsqueeze(2)).flatten(1, 2), mask, slope)
    edges = instance_norm_eager(F.linear(edges, middle), mask, slope)
    return normalised_maximum(F.linear(edges, last).unflatten(1, index.shape[1:]), mask)


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
        reduced: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """(B, N, 3) and (B, M, 3) clouds to (B, N, 64) and (B, M, 64) features.

        ``reduced`` does the large products, on edges and in the transformer, in bfloat16;
        positions, norms and the head stay in the clouds' own type.
        """
        kind = source.dtype
        with torch.autocast(source.device.type, torch.bfloat16, enabled=reduced):
            source = self._local(source, self.source_neighbours, source_mask)
            target = self._local(target, self.target_neighbours, target_mask)
            if self.transform is not None:
                source, target = self.transform(source, target, source_mask, target_mask)
        source, target = source.to(kind), target.to(kind)
        return self._head(source, source_mask), self._head(target, target_mask)

    def _local(self, x: Tensor, k: int, mask: Tensor | None) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            x = x @ self.input_transform(x, mask)
        neighbours = nearest_neighbours(x, x, k, mask, mask)
        reduced = torch.is_autocast_enabled(x.device.type)
        edges = None
        if compiled.supported(x) and not reduced:
            from dine.models.compiled.convolution import Edges

            edges = Edges(neighbours)
        for layer in (self.conv1, self.conv2, self.conv3):
            x = layer(x, neighbours, edges)
        return x

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
        # Much faster than torch.var_mean over so few channels.
        x = x - x.mean(dim=-1, keepdim=True)
        std = (x.square().sum(dim=-1, keepdim=True) / (x.shape[-1] - 1)).sqrt()
        return x * (self.a_2 / (std + self.EPS)) + self.b_2


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
