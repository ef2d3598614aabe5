"""Learned policies for other programs."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from bo_sysid.policy.store import LearnedPolicy


class _Deterministic(torch.nn.Module):
    """The mean action at observations that are not normalised."""

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self, learned: "LearnedPolicy") -> None:
        super().__init__()
        normaliser = learned.normaliser
        self.register_buffer("mean", torch.tensor(normaliser.mean, dtype=torch.float32))
        self.register_buffer("std", torch.tensor(normaliser.std, dtype=torch.float32))
        self.clip = float(normaliser.clip)
        modules: list[torch.nn.Module] = []
        for weight, bias in learned.policy.network.layers(torch.from_numpy(learned.theta)):
            linear = torch.nn.Linear(weight.shape[1], weight.shape[0])
            linear.weight.data[:], linear.bias.data[:] = weight, bias
            modules += [linear, torch.nn.Tanh()]
        self.layers = torch.nn.Sequential(*modules[:-1])

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        z = ((observations - self.mean) / self.std).clamp(-self.clip, self.clip)
        z = z.nan_to_num()  # a reading that is missing counts as its mean
        actions: torch.Tensor = self.layers(z)
        return actions.clamp(-1.0, 1.0)


def deterministic(learned: "LearnedPolicy") -> torch.nn.Module:
    """Return the mean action as a module from `n x o` observations to `n x a` in [-1, 1]."""
    return _Deterministic(learned).eval().requires_grad_(False)


def write_torchscript(module: torch.nn.Module, path: Path) -> None:
    """Write a module for libtorch."""
    with warnings.catch_warnings():
        # torch.export, which is to replace it, gives no file for libtorch alone
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.save(torch.jit.script(module), str(path))
