"""Loading generated modules, from a disk cache that is safe to share between processes.

A module is found by a hash of everything that it follows from: the specification, the source
files that derive it, and the versions of the libraries that take part. Files appear whole
(`os.replace`) and are checked before use. Where no safe directory can be written, modules live
in memory, and a warning says what that costs.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import json
import os
import stat
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

__all__ = ["cache_directory", "load"]

_MECHANICS = Path(__file__).parent.parent
_LIBRARIES = ("numpy", "numba", "sympy")

_loaded: dict[str, ModuleType] = {}  # by key: the same key is always the same module


def cache_directory() -> Path:
    """Directory of the generated modules: $NHENV_CACHE_DIR, or the user's cache directory."""
    if given := os.environ.get("NHENV_CACHE_DIR"):
        return Path(given)
    if sys.platform == "win32" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local) / "nhenv" / "cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nhenv"


def load(
    name: str, specification: Mapping[str, Any], build: Callable[[], str], *, deriving: tuple[Path, ...] = ()
) -> ModuleType:
    """Module generated from `specification`; `build` makes its source if it is not cached.

    Args:
        name: readable part of the file name.
        specification: plain data that determines the source.
        build: makes the source; called only on a miss, so heavy imports belong inside it.
        deriving: source files outside `mechanics` that take part in `build`.
    """
    content = json.dumps([specification, _environment(deriving)], sort_keys=True)
    key = f"{name}_{hashlib.sha256(content.encode()).hexdigest()[:24]}"
    if key not in _loaded:
        _loaded[key] = _from_disk(key, build)
    return _loaded[key]


@functools.cache
def _environment(deriving: tuple[Path, ...]) -> dict[str, str]:
    """Hash of every deriving source file, and the versions of what runs them."""
    digest = hashlib.sha256()
    for path in sorted([*_MECHANICS.rglob("*.py"), *deriving]):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    versions = {library: version(library) for library in _LIBRARIES}
    return {"sources": digest.hexdigest(), "python": sys.version, **versions}


def _from_disk(key: str, build: Callable[[], str]) -> ModuleType:
    path = cache_directory() / f"{key}.py"
    source = _read(path)
    if source is None:
        source = build()
        problem = _write(path, source)
        if problem:
            warnings.warn(
                f"cannot cache kernels in {path.parent}: {problem}. They are derived and compiled afresh in each "
                "process, some seconds each; set NHENV_CACHE_DIR to a directory of your own.",
                RuntimeWarning,
                stacklevel=4,
            )
            return _in_memory(key, source)
    try:
        return _execute(key, path, source)
    except Exception:
        # Numba's own files beside it may be damaged. If they are not to blame, it fails again.
        for file in path.parent.glob(f"__pycache__/{key}.*"):
            file.unlink(missing_ok=True)
        return _execute(key, path, source)


def _execute(key: str, path: Path, source: str) -> ModuleType:
    specification = importlib.util.spec_from_file_location(f"nhenv_kernel_{key}", path)
    assert specification is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[module.__name__] = module  # where Numba looks for the owner of a cached function
    module.__dict__["CACHE__"] = os.access(path.parent, os.W_OK)
    # Compiled from the text that was checked, not read again; its lines are those of the file.
    exec(compile(f"\n{source}", str(path), "exec"), module.__dict__)  # noqa: S102
    return module


def _in_memory(key: str, source: str) -> ModuleType:
    module = ModuleType(f"nhenv_kernel_{key}")
    module.__dict__["CACHE__"] = False  # Numba can cache only what has a file
    exec(compile(source, f"<{key}>", "exec"), module.__dict__)  # noqa: S102
    return module


def _read(path: Path) -> str | None:
    """Source in `path`, or None if there is none that is whole and ours."""
    if _unsafe(path.parent):
        return None
    try:
        first, _, source = path.read_text(encoding="utf-8").partition("\n")
    except (OSError, UnicodeDecodeError):
        return None
    return source if first == _seal(source) else None


def _write(path: Path, source: str) -> str | None:
    """Put the source in place; return what prevents it, or None."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if problem := _unsafe(path.parent):
            return problem
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(f"{_seal(source)}\n{source}")
            # Numba ties its compiled code to the file's time: equal content must look equal.
            os.utime(temporary, (0, 0))
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as error:
        return str(error)
    return None


def _seal(source: str) -> str:
    return f"# sha256 {hashlib.sha256(source.encode()).hexdigest()}"


def _unsafe(directory: Path) -> str | None:
    """Reason not to run code from this directory, or None: others must not be able to write there."""
    if not hasattr(os, "geteuid") or not directory.exists():
        return None
    status = directory.stat()
    if status.st_uid != os.geteuid():
        return "it belongs to another user"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return "others may write to it"
    return None
