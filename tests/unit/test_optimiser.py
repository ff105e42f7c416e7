"""AdamW without the compiler: the same steps, and nothing loaded for them."""

import subprocess
import sys

import pytest
import torch

from dine.optimiser import AdamW

STEPS = 7


def _trained(kind, **options):
    """Weights and the optimiser's state after some steps, stopped and taken up again halfway."""
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(3, 5), torch.nn.Tanh(), torch.nn.Linear(5, 1))
    inputs = torch.randn(STEPS, 4, 3)
    optimiser = kind(network.parameters(), lr=0.1, weight_decay=0.3, **options)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for step, batch in enumerate(inputs):
        if step == STEPS // 2:
            state = optimiser.state_dict()
            optimiser = kind(network.parameters(), lr=0.1, weight_decay=0.3, **options)
            optimiser.load_state_dict(state)
            schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
        optimiser.zero_grad(set_to_none=True)
        network(batch).square().mean().backward()
        optimiser.step()
        schedule.step()
    return [x.detach().clone() for x in network.parameters()], optimiser.state_dict()


@pytest.mark.parametrize("options", [{}, {"fused": True}, {"foreach": False}], ids=str)
def test_steps_are_those_of_pytorch(options):
    ours, our_state = _trained(AdamW, **options)
    theirs, their_state = _trained(torch.optim.AdamW, **options)
    assert all(torch.equal(x, y) for x, y in zip(ours, theirs, strict=True))
    assert our_state["param_groups"] == their_state["param_groups"]
    for mine, other in zip(our_state["state"].values(), their_state["state"].values(), strict=True):
        assert all(torch.equal(mine[key], other[key]) for key in other)


def test_steps_leave_no_trace_in_a_graph():
    weight = torch.nn.Parameter(torch.ones(2))
    optimiser = AdamW([weight], lr=0.1)
    weight.sum().backward()
    optimiser.step()
    assert weight.is_leaf
    assert weight.grad_fn is None


def test_no_compiler_is_loaded():
    code = (
        "import sys, torch; from dine.optimiser import AdamW\n"
        "weight = torch.nn.Parameter(torch.ones(2)); optimiser = AdamW([weight], lr=0.1)\n"
        "weight.sum().backward(); optimiser.step(); optimiser.zero_grad()\n"
        "optimiser.load_state_dict(optimiser.state_dict())\n"
        "print(weight.tolist(), 'torch._dynamo' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "False"
    assert not done.stdout.startswith("[1.0")  # a step was taken
