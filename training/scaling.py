"""Observations in units in which they differ by about as much as weights do."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor

__all__ = ["Scaled"]


class Scaled(FlattenExtractor):
    """Multiplies each observation by a factor.

    A running standard deviation, as `VecNormalize` has, would be that of the whole episode; a joint that swings by a
    twentieth of a radian after it stood at its stop for seconds needs another.

    Args:
        observation_space: a box of d observations.
        factors: d factors.
    """

    def __init__(self, observation_space: spaces.Box, factors: Sequence[float]) -> None:
        super().__init__(observation_space)
        self.factors: torch.Tensor
        self.register_buffer("factors", torch.tensor(factors))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Features (N, d) of observations (N, d)."""
        return super().forward(observations) * self.factors
