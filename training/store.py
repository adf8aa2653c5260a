"""Results on disk: found again by a digest of all that they follow from, and written whole or not at all."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import json
import math
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym

from nhenv import tasks
from nhenv.registration import as_mechanism

__all__ = [
    "digest",
    "machine",
    "piece_path",
    "read_json",
    "settings",
    "source_digest",
    "versions",
    "write_bytes",
    "write_json",
]

_LIBRARIES = ("numpy", "scipy", "numba", "gymnasium", "torch", "stable_baselines3")


def source_digest(*files: str | Path) -> str:
    """Digest of the source of one or several modules. Taken on import, it is that of the code that runs."""
    each = (hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in files)
    return hashlib.sha256("".join(each).encode()).hexdigest()


def settings(env_id: str, code: str, **config: Any) -> dict[str, Any]:
    """All that a result follows from, as plain data.

    Args:
        env_id: environment; its mechanism and task enter as the data that define them. What the engine does
            with these data is in the id's version.
        code: digest of the modules that make the result; a change of them makes old results old.
        **config: settings, as numbers or frozen dataclasses.
    """
    spec = gym.spec(env_id)
    return {
        "env_id": env_id,
        "max_episode_steps": spec.max_episode_steps,
        "mechanism": as_mechanism(spec.kwargs["mechanism"]).to_dict(drawing=False),
        "task": tasks.get(spec.kwargs["task"]).to_dict(drawing=False),
        "code": code,
        **{k: dataclasses.asdict(v) if dataclasses.is_dataclass(v) else v for k, v in config.items()},  # type: ignore[arg-type]
    }


def digest(data: Mapping[str, Any]) -> str:
    """Twelve hexadecimal digits that differ where the data do."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:12]


def piece_path(out: Path, data: Mapping[str, Any], name: str) -> Path:
    """Where the result `name` with these settings is kept; it is finished when this file exists."""
    return out / data["env_id"].rpartition("/")[2] / f"{name}-{digest(data)}.json"


def write_bytes(path: Path, content: bytes) -> None:
    """Put a file in place in one step, so that nobody ever sees half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, data: Any) -> None:
    """Write plain data; what is not a finite number becomes null."""
    write_bytes(path, (json.dumps(_finite(data), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Data of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


def versions() -> dict[str, str]:
    """Versions of Python and of the libraries that take part."""
    return {"python": platform.python_version(), **{name: importlib.metadata.version(name) for name in _LIBRARIES}}


def machine() -> dict[str, Any]:
    """The computer, without its name."""
    return {"system": platform.system(), "processor": _processor(), "logical_cpus": os.cpu_count()}


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _finite(data: Any) -> Any:
    match data:
        case float():
            return data if math.isfinite(data) else None
        case Mapping():
            return {str(key): _finite(value) for key, value in data.items()}
        case list() | tuple():
            return [_finite(value) for value in data]
    return data
