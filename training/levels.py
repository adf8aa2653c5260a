"""A policy that chooses each torque from a few levels.

The laws that go farthest are bang-bang: a normal distribution has to learn means far beyond the limits to say so, and
explores little there. (Seyde et al., *Is bang-bang control all you need?*, 2021.)
"""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3.common.distributions import CategoricalDistribution
from stable_baselines3.common.type_aliases import Schedule

from training.time_aware import TimeAwareCritic

__all__ = ["LevelPolicy"]


class _Levels(CategoricalDistribution):
    """Independent choices of every action from `levels` values, evenly from -1 to 1.

    Its actions are those values, so that environments and buffers see no indices. Written out because
    `torch.distributions.Categorical` takes twice as long.
    """

    def __init__(self, actions: int, levels: int) -> None:
        super().__init__(actions * levels)
        self._shape = -1, actions, levels
        self._values = torch.linspace(-1, 1, levels)

    def proba_distribution(self, action_logits: torch.Tensor) -> _Levels:
        """Set the logits (N, actions * levels)."""
        self._log = action_logits.view(self._shape).log_softmax(-1)
        return self

    def log_prob(self, actions: torch.Tensor) -> torch.Tensor:
        """Logarithms (N,) of the probabilities of actions (N, actions)."""
        index = ((actions + 1) * (0.5 * (len(self._values) - 1))).round().long()
        return self._log.gather(-1, index[..., None]).squeeze(-1).sum(1)

    def entropy(self) -> torch.Tensor:
        """Entropies (N,)."""
        return -(self._log.exp() * self._log).sum((1, 2))

    def sample(self) -> torch.Tensor:
        """Random actions (N, actions)."""
        # The first of exponential clocks that run at these rates rings with these probabilities.
        return self._values[(self._log - torch.empty_like(self._log).exponential_().log()).argmax(-1)]

    def mode(self) -> torch.Tensor:
        """Most probable actions (N, actions)."""
        return self._values[self._log.argmax(-1)]


class LevelPolicy(TimeAwareCritic):
    """Policy whose actions are each one of `levels` values, evenly from -1 to 1."""

    def __init__(self, *arguments: Any, levels: int, **options: Any) -> None:
        self.levels = levels
        super().__init__(*arguments, **options)

    def _build(self, lr_schedule: Schedule) -> None:
        (actions,) = self.action_space.shape or ()
        self.action_dist = _Levels(actions, self.levels)
        super()._build(lr_schedule)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return super()._get_constructor_parameters() | {"levels": self.levels}
