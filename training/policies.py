"""Policies as plain data: weights in a safetensors file, all else in a JSON card beside it.

from training.policies import load

policy = load("SnakeboardForward-v0")  # one that is shipped, or the path of a file
action = policy(observation)

Reading one executes nothing, and running one takes NumPy: no PyTorch, no Stable-Baselines3, no environment.
`training.export` writes them.
"""

from __future__ import annotations

import hashlib
import json
import os
import reprlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["FORMAT", "SUFFIX", "Policy", "PolicyError", "load", "pack", "read", "shipped"]

FORMAT = "nhenv policy 1"
SUFFIX = ".safetensors"
SHIPPED = Path(__file__).with_name("shipped")

# A policy takes some 20 kB and its card less. What is larger is none, and is not read.
LARGEST_WEIGHTS = 16 << 20
LARGEST_CARD = 1 << 20

_short = reprlib.repr  # an error message need not be as long as what is wrong

# Between the layers, under the names that `training.config.PPOConfig.activation` has for them.
ACTIVATIONS: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "leaky_relu": lambda values: np.maximum(values, 0.01 * values),
    "tanh": np.tanh,
}

Layers = list[tuple[NDArray[np.float64], NDArray[np.float64]]]


class PolicyError(ValueError):
    """A file is not a policy."""


class Policy:
    """The action of a network: a function, and a controller of `training.rollout`.

    It is the mean action; with "levels" in the card's network, the outputs are preferences for that many values of each
    action, evenly from -1 to 1, and the preferred ones are taken.

    Args:
        card: what `training.export` wrote beside the weights; "network" and "observation" are used here.
        layers: weights (out, in) and biases (out,) of each layer.

    Attributes:
        card: as given.
    """

    def __init__(self, card: Mapping[str, Any], layers: Layers) -> None:
        self.card = card
        self._activation = ACTIVATIONS[card["network"]["activation"]]
        levels = card["network"].get("levels")
        self._values = None if levels is None else np.linspace(-1, 1, levels, dtype=np.float32)
        # In float64, so that what is left of a difference to another library is that library's rounding.
        self._layers = [(np.asarray(weight, float).T.copy(), np.asarray(bias, float)) for weight, bias in layers]

    def reset(self, episodes: int) -> None:
        """Nothing to do: the policy has no memory."""

    def __call__(self, observations: ArrayLike, /) -> NDArray[np.float32]:
        """Actions (..., m) in [-1, 1] for observations (..., d)."""
        values = np.asarray(observations, dtype=float)
        labels = self.card["observation"]
        if values.shape[-1:] != (len(labels),):
            raise ValueError(f"observations must have shape (..., {len(labels)}): {labels}; got {values.shape}")
        *hidden, (weight, bias) = self._layers
        for inner, shift in hidden:
            values = self._activation(values @ inner + shift)
        values = values @ weight + bias
        if self._values is not None:
            return self._values[values.reshape(*values.shape[:-1], -1, len(self._values)).argmax(-1)]
        return np.clip(values, -1, 1).astype(np.float32)

    def require(self, labels: Sequence[str]) -> None:
        """Raise ValueError unless these are the labels of what the policy learned to observe."""
        if list(labels) != self.card["observation"]:
            raise ValueError(
                f"this policy of {self.card['env_id']} observes {self.card['observation']}, the environment shows "
                f"{list(labels)}: give it the environment that it learned in"
            )


def shipped() -> tuple[str, ...]:
    """Names of the policies that come with the package."""
    return tuple(sorted(path.stem for path in SHIPPED.glob(f"*{SUFFIX}")))


def load(policy: str | os.PathLike[str]) -> Policy:
    """Read a policy: one of `shipped()` by name, or a .safetensors file with its .json card beside it.

    Raises:
        FileNotFoundError: there is no such file.
        PolicyError: the files are not a policy; it says why.
    """
    path = Path(policy)
    if path.suffix != SUFFIX:
        if str(policy) not in shipped():
            raise FileNotFoundError(
                f"there is no policy {str(policy)!r}: give the path of a {SUFFIX} file, or one of {list(shipped())}"
            )
        path = SHIPPED / f"{policy}{SUFFIX}"
    beside = path.with_suffix(".json")
    for file, largest in ((path, LARGEST_WEIGHTS), (beside, LARGEST_CARD)):
        if not file.is_file():
            raise FileNotFoundError(f"there is no {file}: a policy is a {SUFFIX} file and a .json file of one name")
        if file.stat().st_size > largest:
            raise PolicyError(f"{file} has {file.stat().st_size:,} bytes, and no policy has more than {largest:,}")
    try:
        card = json.loads(beside.read_bytes())
    except (ValueError, RecursionError) as problem:
        raise PolicyError(f"{beside} is not JSON: {problem}") from None
    try:
        return read(card, path.read_bytes())
    except PolicyError as problem:
        raise PolicyError(f"{path}: {problem}") from None


def pack(layers: Layers) -> bytes:
    """Content of a .safetensors file, in float32."""
    named = zip(_names(len(layers)), layers, strict=True)
    tensors = {name: array for names, pair in named for name, array in zip(names, pair, strict=True)}
    content: bytes = _safetensors().numpy.save(
        {name: np.ascontiguousarray(a, np.float32) for name, a in tensors.items()}
    )
    return content


def read(card: Any, content: bytes) -> Policy:
    """Policy of a card and the content of a .safetensors file; PolicyError if they are none, or of two."""
    sizes = _checked(card)
    if hashlib.sha256(content).hexdigest() != card["sha256"]:
        raise PolicyError("the weights are not those of the card: one of the two is damaged or was replaced")
    library = _safetensors()
    try:
        tensors = library.numpy.load(content)
    except (library.SafetensorError, LookupError, TypeError, ValueError) as problem:
        raise PolicyError(f"the weights are not in the format safetensors: {problem}") from None
    expected: dict[str, tuple[int, ...]] = {}
    for (weight, bias), inputs, outputs in zip(_names(len(sizes) - 1), sizes, sizes[1:], strict=False):
        expected |= {weight: (outputs, inputs), bias: (outputs,)}
    if tensors.keys() != expected.keys():
        raise PolicyError(f"the card tells of tensors {sorted(expected)}, the weights are {sorted(tensors)}")
    for name, shape in expected.items():
        tensor = tensors[name]
        if tensor.dtype != np.float32 or tensor.shape != shape:
            raise PolicyError(f"{name} must be float32 of shape {shape}, got {tensor.dtype} of shape {tensor.shape}")
        if not np.isfinite(tensor).all():
            raise PolicyError(f"{name} has numbers that are not finite")
    return Policy(card, [(tensors[weight], tensors[bias]) for weight, bias in _names(len(sizes) - 1)])


def _checked(card: Any) -> list[int]:
    """Sizes of the layers' inputs and outputs, of a card that has all that is used of it."""
    if not isinstance(card, dict):
        raise PolicyError(f"a card is a JSON object, got {type(card).__name__}")
    kinds = {"format": str, "env_id": str, "env_kwargs": dict, "observation": list, "network": dict, "sha256": str}
    for key, kind in kinds.items():
        if not isinstance(card.get(key), kind):
            raise PolicyError(f"the card's {key!r} must be a {kind.__name__}, got {_short(card.get(key))}")
    if card["format"] != FORMAT:
        raise PolicyError(
            f"the card has the format {_short(card['format'])}, and this version of nhenv reads {FORMAT!r}"
        )
    network = card["network"]
    if (activation := network.get("activation")) not in tuple(ACTIVATIONS):  # which need not be hashable
        raise PolicyError(f"the card's activation must be one of {list(ACTIVATIONS)}, got {_short(activation)}")
    sizes = network.get("layers")
    whole = isinstance(sizes, list) and all(isinstance(size, int) and size > 0 for size in sizes)
    if not whole or len(sizes) < 2 or sizes[0] != len(card["observation"]):
        raise PolicyError(
            f"the card's layers must be the sizes of {len(card['observation'])} observations, of hidden layers and of "
            f"the action, got {_short(sizes)}"
        )
    if (levels := network.get("levels")) is not None:
        if not isinstance(levels, int) or levels < 2 or sizes[-1] % levels:
            raise PolicyError(
                f"the card's levels must be a number above 1 that divides {sizes[-1]} outputs, got {_short(levels)}"
            )
    return list(sizes)


def _names(count: int) -> list[tuple[str, str]]:
    """Names of weight and bias of each layer."""
    return [(f"layer{i}.weight", f"layer{i}.bias") for i in range(count)]


def _safetensors() -> Any:
    try:
        import safetensors.numpy
    except ImportError as problem:
        raise ImportError(f'policies need safetensors ({problem}): run pip install "nhenv[policies]"') from problem
    return safetensors
