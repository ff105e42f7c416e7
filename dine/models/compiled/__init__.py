"""Compiled CPU kernels of the hot paths; their eager forms, beside the callers, work anywhere.

Each kernel runs over a range of blocks and releases the interpreter lock, so a pool of threads
shares the blocks out. What a block adds up is added up again in a fixed order, so results do not
depend on the number of threads.
"""

from __future__ import annotations

import torch
from torch import Tensor


def supported(*tensors: Tensor) -> bool:
    """Whether the compiled kernels take these tensors: float32 or float64 on the CPU.

    Their modules are imported by the functions that call them, as numba takes a while to import.
    """
    return all(
        t.device.type == "cpu" and t.dtype in (torch.float32, torch.float64) for t in tensors
    )
