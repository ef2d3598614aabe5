"""A policy as a TorchScript module that gives commands; the only module here that needs torch."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from bo_sysid.policy.export import deterministic, write_torchscript
from bo_sysid.policy.store import LearnedPolicy


class _Commands(torch.nn.Module):
    """Actions in [-1, 1], scaled to the commands' range."""

    middle: torch.Tensor
    reach: torch.Tensor

    def __init__(
        self,
        actions: torch.nn.Module,
        low: Float[np.ndarray, " a"],
        high: Float[np.ndarray, " a"],
    ) -> None:
        super().__init__()
        self.actions = actions
        self.register_buffer("middle", torch.tensor((low + high) / 2, dtype=torch.float32))
        self.register_buffer("reach", torch.tensor((high - low) / 2, dtype=torch.float32))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        commands: torch.Tensor = self.middle + self.reach * self.actions(observations)
        return commands


def write_module(
    policy: LearnedPolicy,
    low: Float[np.ndarray, " a"],
    high: Float[np.ndarray, " a"],
    path: Path,
) -> None:
    """Write the module.

    Args:
        policy: gives actions in [-1, 1].
        low: `a` lowest commands, in the actuators' units.
        high: `a` highest commands.
        path: of the file.
    """
    module = _Commands(deterministic(policy), low, high)
    write_torchscript(module.eval().requires_grad_(False), path)
