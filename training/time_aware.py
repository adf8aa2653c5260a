"""A value function that sees the time, beside a policy that does not."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor

__all__ = ["TimeAwareCritic"]


class _Networks(MlpExtractor):
    """Those of Stable-Baselines3, but that the policy's has no input for the time."""

    def __init__(self, feature_dim: int, **options: Any) -> None:
        super().__init__(feature_dim, **options)
        self.policy_net = MlpExtractor(feature_dim - 1, **options).policy_net

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        """Last layer of the policy's network."""
        return super().forward_actor(features[..., :-1])


class TimeAwareCritic(ActorCriticPolicy):
    """Policy for environments within `training.wrappers.Clock`, whose last observation is the time.

    Only its value function sees the time, so it drives environments without a clock as well. (An asymmetric
    actor-critic: Pinto et al., 2017.)
    """

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = _Networks(
            self.features_dim, net_arch=self.net_arch, activation_fn=self.activation_fn, device=self.device
        )

    def predict(self, observation: Any, *arguments: Any, **options: Any) -> tuple[np.ndarray, Any]:
        """Actions for observations (..., d), or (..., d + 1) with the time."""
        shown = np.asarray(observation)
        if shown.shape[-1] == self.features_dim - 1:
            shown = np.concatenate([shown, np.zeros_like(shown[..., :1])], axis=-1)
        return super().predict(shown, *arguments, **options)
