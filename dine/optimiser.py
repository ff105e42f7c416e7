"""PyTorch's AdamW, without the compiler that PyTorch would load for it."""

from __future__ import annotations

import inspect

import torch


class AdamW(torch.optim.AdamW):
    """``torch.optim.AdamW`` for processes that compile nothing.

    PyTorch wraps these methods to keep its compiler out of them, and loads the compiler to do so:
    three seconds, more than all else that a training does before its first step. Here they are
    called without the wrapping; ``differentiable`` has no effect.
    """

    add_param_group = inspect.unwrap(torch.optim.AdamW.add_param_group)
    zero_grad = inspect.unwrap(torch.optim.AdamW.zero_grad)
    state_dict = inspect.unwrap(torch.optim.AdamW.state_dict)
    load_state_dict = inspect.unwrap(torch.optim.AdamW.load_state_dict)
    step = torch.no_grad()(inspect.unwrap(torch.optim.AdamW.step))
