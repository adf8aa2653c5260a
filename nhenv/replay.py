"""What a scene left out, worked out when somebody asks for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nhenv.compiled import CompiledScene

__all__ = ["Replay"]


class Replay:
    """The whole state of an environment whose scene prunes some of it.

    The kernel remembers the actions of the episode; they are repeated, in a memory of its own, on the
    scene with nothing left out. An environment that nobody asks pays a few stores a step.

    Args:
        scene: the environment's scene.
        memory: memory of `scene.whole` in the state in which the episode began.
    """

    def __init__(self, scene: CompiledScene, memory: NDArray[np.float64]) -> None:
        self._scene, self._memory = scene, memory
        self._done = 0

    def values(self, memory: NDArray[np.float64]) -> dict[str, float]:
        """Every state by name, after all the actions that the environment's `memory` remembers."""
        places, whole = self._scene.kernel.MEMORY, self._scene.whole
        count = int(memory[places["count"][0]])
        actions = memory[slice(*places["history"])].reshape(-1, len(whole.mechanism.controls))
        for action in actions[self._done : count]:
            whole.kernel.respond(self._memory, action)
        self._done = count
        return whole.values(self._memory)

    def make_room(self, memory: NDArray[np.float64]) -> None:
        """Catch up, then let the kernel forget the actions it remembers."""
        self.values(memory)
        memory[self._scene.kernel.MEMORY["count"][0]] = 0
        self._done = 0
