"""The cache of generated modules: when it is used, when it is not trusted, and how processes share it."""

import os
import stat
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from mechanics.compiler import kernels

ROOT = Path(__file__).parents[3]

SOURCE = '''"""A module such as the generator makes."""

from numba import njit

VALUE = 41


@njit("float64(float64)", cache=CACHE__)
def step(x):
    return x + VALUE + 1
'''

posix = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="owners and modes of directories are POSIX")


class Builder:
    """Counts how often it is asked for the source."""

    def __init__(self, source="VALUE = 1\n"):
        self.source, self.calls = source, 0

    def __call__(self):
        self.calls += 1
        return self.source


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache directory, and a process that has loaded nothing."""
    directory = tmp_path / "cache"
    monkeypatch.setenv("NHENV_CACHE_DIR", str(directory))
    monkeypatch.setattr(kernels, "_loaded", {})
    return directory


@pytest.fixture
def forget(monkeypatch):
    """Forget what this process has loaded, as a new process would."""
    return lambda: monkeypatch.setattr(kernels, "_loaded", {})


def _only_file(directory):
    (path,) = directory.glob("*.py")
    return path


# -- hits and misses ----------------------------------------------------------------------------


def test_a_module_is_built_once(cache, forget):
    build = Builder()
    first = kernels.load("thing", {"n": 1}, build)
    assert kernels.load("thing", {"n": 1}, build) is first
    forget()
    again = kernels.load("thing", {"n": 1}, build)
    assert again is not first
    assert again.VALUE == 1
    assert build.calls == 1
    assert _only_file(cache).name.startswith("thing_")


def test_the_directory_is_private(cache):
    kernels.load("thing", {}, Builder())
    if hasattr(os, "geteuid"):
        assert stat.S_IMODE(cache.stat().st_mode) == 0o700
        assert stat.S_IMODE(_only_file(cache).stat().st_mode) == 0o600
    assert kernels.cache_directory() == cache


def test_no_temporary_file_stays(cache):
    kernels.load("thing", {}, Builder())
    assert [path.suffix for path in cache.iterdir()] == [".py"]


@pytest.mark.parametrize(
    "other", [{"n": 2}, {"n": 1, "m": 0}, {"n": 1.5}, {"m": 1}, {}, {"n": [1]}, {"n": "1"}], ids=str
)
def test_another_specification_is_another_module(cache, other):
    first, second = Builder(), Builder("VALUE = 2\n")
    kernels.load("thing", {"n": 1}, first)
    assert kernels.load("thing", other, second).VALUE == 2
    assert second.calls == 1


def test_the_order_of_a_specification_does_not_matter(cache):
    build = Builder()
    kernels.load("thing", {"a": 1, "b": 2}, build)
    kernels.load("thing", {"b": 2, "a": 1}, build)
    assert build.calls == 1


def test_another_deriving_source_is_another_module(cache, tmp_path):
    """The key hashes the code that derives, not only what it derives from."""
    build = Builder()
    for name, text in (("one", "x = 1"), ("same", "x = 1"), ("two", "x = 2")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "derive.py").write_text(text)
    files = {name: (tmp_path / name / "derive.py",) for name in ("one", "same", "two")}
    first = kernels.load("thing", {}, build, deriving=files["one"])
    assert kernels.load("thing", {}, build, deriving=files["same"]) is first
    assert kernels.load("thing", {}, build, deriving=files["two"]) is not first
    assert kernels.load("thing", {}, build) is not first
    assert build.calls == 3


def test_another_version_of_a_library_is_another_module(cache, monkeypatch):
    build = Builder()
    kernels.load("thing", {}, build)
    for library in ("numpy", "numba", "sympy"):
        real = kernels.version
        monkeypatch.setattr(
            kernels, "version", lambda name, real=real, newer=library: real(name) + "x" * (name == newer)
        )
        kernels._environment.cache_clear()
        kernels.load("thing", {}, build)
    monkeypatch.undo()
    kernels._environment.cache_clear()
    assert build.calls == 4


@pytest.mark.parametrize("variable", ["XDG_CACHE_HOME", None])
def test_the_default_directory(variable, tmp_path, monkeypatch):
    monkeypatch.delenv("NHENV_CACHE_DIR")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    if variable:
        monkeypatch.setenv(variable, str(tmp_path / "xdg"))
    assert kernels.cache_directory() == tmp_path / ("xdg" if variable else ".cache") / "nhenv"


# -- files that are not whole -------------------------------------------------------------------

DAMAGE = {
    "empty": lambda text: "",
    "truncated": lambda text: text[: len(text) // 2],
    "without its last line": lambda text: text.rpartition("\n")[0],
    "tampered": lambda text: text.replace("VALUE = 1", "VALUE = 6"),
    "code added": lambda text: text + "VALUE = 6\n",
    "without a seal": lambda text: text.partition("\n")[2],
    "another seal": lambda text: "# sha256 " + 64 * "0" + "\n" + text.partition("\n")[2],
    "code before the seal": lambda text: "VALUE = 6\n" + text,
    "no text": lambda text: "\x00\x01\ufffd",
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_file_is_rebuilt(cache, forget, damage):
    build = Builder()
    kernels.load("thing", {}, build)
    path = _only_file(cache)
    whole = path.read_text()
    path.write_text(damage(whole))
    forget()
    assert kernels.load("thing", {}, build).VALUE == 1
    assert build.calls == 2
    assert path.read_text() == whole


def test_a_file_that_is_not_utf8_is_rebuilt(cache, forget):
    build = Builder()
    kernels.load("thing", {}, build)
    _only_file(cache).write_bytes(b"\xff\xfe\x00broken")
    forget()
    assert kernels.load("thing", {}, build).VALUE == 1
    assert build.calls == 2


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("content", [b"", b"\x80\x04broken"], ids=["empty", "broken"])
def test_damaged_machine_code_is_compiled_again(cache, suffix, content):
    """Numba keeps an index and machine code beside the source; a full disk may cut them short."""
    _fresh_process(cache, SOURCE)
    files = list(cache.rglob(f"*.{suffix}"))
    assert files
    for path in files:
        path.write_bytes(content)
    assert _fresh_process(cache, SOURCE) == "50.0"


# -- directories that cannot be used ------------------------------------------------------------


def _works_in_memory(build, why):
    with pytest.warns(RuntimeWarning, match="cannot cache kernels in") as caught:
        module = kernels.load("thing", {}, build)
    (warning,) = caught
    assert why in str(warning.message)
    assert "NHENV_CACHE_DIR" in str(warning.message)
    assert module.step(8.0) == 50.0
    assert module.step.stats.cache_path is None if hasattr(module.step, "stats") else True
    assert kernels.load("thing", {}, build) is module  # once a process, and warned of once
    assert build.calls == 1


def test_a_file_in_the_place_of_the_directory(cache):
    cache.write_text("in the way")
    _works_in_memory(Builder(SOURCE), "exists")
    assert cache.read_text() == "in the way"


def test_a_directory_that_cannot_be_made(cache, monkeypatch):
    cache.write_text("in the way")
    monkeypatch.setenv("NHENV_CACHE_DIR", str(cache / "below"))
    _works_in_memory(Builder(SOURCE), "Not a directory")


def test_a_disk_that_is_full(cache, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    _works_in_memory(Builder(SOURCE), "No space left")
    assert list(cache.iterdir()) == []


@posix
@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o770, 0o720, 0o702])
def test_nothing_is_run_from_a_directory_that_others_may_write_to(cache, forget, mode):
    """Not even a file that is whole: others can write a seal as well as we can."""
    kernels.load("thing", {}, Builder())
    path = _only_file(cache)
    body = "VALUE = 666\n"
    path.write_text(f"{kernels._seal(body)}\n{body}")
    planted = path.read_text()
    cache.chmod(mode)
    forget()
    build = Builder(SOURCE)
    _works_in_memory(build, "others may write to it")
    assert path.read_text() == planted
    assert len(list(cache.iterdir())) == 1


@posix
@pytest.mark.skipif(getattr(os, "geteuid", lambda: 1)() != 0, reason="only root can give a directory away")
def test_nothing_is_run_from_another_users_directory(cache):
    cache.mkdir(mode=0o755)
    os.chown(cache, 12345, 12345)
    _works_in_memory(Builder(SOURCE), "another user")
    assert list(cache.iterdir()) == []


def test_a_readable_directory_is_used(cache, forget):
    """Others may read: that harms nobody."""
    build = Builder()
    kernels.load("thing", {}, build)
    cache.chmod(0o755)
    forget()
    kernels.load("thing", {}, build)
    assert build.calls == 1


# -- processes ----------------------------------------------------------------------------------

SCRIPT = """
import sys
from pathlib import Path
from mechanics.compiler import kernels

source = Path(sys.argv[1]).read_text()
module = kernels.load("thing", {}, lambda: source)
print(module.step(8.0))
"""


def _start(cache, source):
    cache.mkdir(mode=0o700, exist_ok=True)
    given = cache.parent / "source.txt"
    given.write_text(source)
    command = [sys.executable, "-W", "error", "-c", textwrap.dedent(SCRIPT), str(given)]
    env = {**os.environ, "NHENV_CACHE_DIR": str(cache)}
    return subprocess.Popen(command, cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _finish(process):
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    return out.strip()


def _fresh_process(cache, source):
    return _finish(_start(cache, source))


def test_two_processes_compile_at_once(cache):
    """Both work, and what they leave is one whole file that a third one uses."""
    processes = [_start(cache, SOURCE) for _ in range(3)]
    assert [_finish(process) for process in processes] == ["50.0"] * 3
    before = _only_file(cache).read_text()
    stamps = {path: path.stat().st_mtime_ns for path in cache.rglob("*") if path.is_file()}
    assert _fresh_process(cache, "raise RuntimeError('must not be built again')") == "50.0"
    assert _only_file(cache).read_text() == before
    assert {path: path.stat().st_mtime_ns for path in cache.rglob("*") if path.is_file()} == stamps


def test_machine_code_is_cached_too(cache):
    _fresh_process(cache, SOURCE)
    assert list(cache.rglob("*.nbc"))
