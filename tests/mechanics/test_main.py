"""`python -m mechanics NAME` or FILE prints the equations, and says in one line what is wrong."""

import dataclasses
import functools
import json
import subprocess
import sys
import unicodedata

import pytest

import mechanics
from mechanics import Mechanism
from mechanics.__main__ import catalogue, main, report
from mechanics.geometry.reduction import derive

EASEL = """
name = "easel"
coordinates = ["x", "y"]
inertia = [["m", 0], [0, "m"]]
one_forms = []
potential = "m*g*y"
rayleigh = "c*x_dot**2/2"
[parameters]
m = 2
g = 9.81
[forces]
u_x = [1, 0]
[drag]
c = 0.5
"""


@functools.cache
def derived(name, frame, drag=False):
    return derive(mechanics.get(name), frame, drag=drag)


@pytest.mark.parametrize("name", ["snakeboard", "roller_racer", "knife_edge_incline", "suslov", "snake"])
@pytest.mark.parametrize("shorthands", [True, False])
def test_report_covers_every_frame(name, shorthands):
    for frame in mechanics.get(name).frames:
        sections = dict(report(derived(name, frame), frame, shorthands))
        assert len(sections["Kinematic equations"]) == mechanics.get(name).n
        assert len(sections["Dynamic equations"]) == mechanics.get(name).rank
        assert shorthands or "where" not in sections


def test_shorthands_are_used_and_explained():
    sections = dict(report(derived("roller_racer", "paper"), "paper"))
    gamma = next(lines for title, lines in sections.items() if "Christoffel" in title)
    assert "Γ̃¹₂₂ = c k m (l₁ + l₂ cos(ψ))/f₁²" in gamma
    assert [line.split(" = ")[0] for line in sections["where"]] == ["c", "k", "f₁", "f₂"]


def test_steps_are_all_explained_before_they_are_used():
    """A snake's formulas are cut into steps; a reader meets none whose meaning is not given."""
    sections = dict(report(derived("snake", "last_link"), "last_link"))
    steps = sections.pop("Steps that these formulas share")
    words = {word for lines in sections.values() for line in lines for word in tokens(line) if word.startswith("_d")}
    known = set()
    for line in steps:
        name, _, meaning = line.partition(" = ")
        assert {word for word in tokens(meaning) if word.startswith("_d")} <= known
        known.add(name)
    assert words <= known


def decomposed(text):
    """With the dot of a rate as a character of its own, as it is printed."""
    return unicodedata.normalize("NFD", text)


def tokens(line):
    return "".join(c if c.isalnum() or c == "_" else " " for c in line).split()


def test_a_potential_and_drag_are_printed():
    sections = dict(report(derived("knife_edge_incline", "body", True), "body"))
    assert sections["Potential energy and what it adds to the accelerations"] == [
        "V = -g m x sin(α)",
        "-X₁(V)/‖X₁‖² = g sin(α) cos(θ)",
        "-X₂(V)/‖X₂‖² = 0",
    ]
    drag = next(lines for title, lines in sections.items() if title.startswith("Drag"))
    assert drag[0] == decomposed("R = c_θ θ̇²/2 + c_w (ẋ² + ẏ²)/2")
    assert drag[1:] == ["c_w = 0.1", "c_θ = 0.01", "R¹₁ = c_w/m", "R²₂ = c_θ/J"]
    without = dict(report(derived("roller_racer", "paper"), "paper"))
    assert not any(title.startswith(("Potential", "Drag")) for title in without)


def test_a_frame_that_was_found_says_so():
    racer = dataclasses.replace(mechanics.get("knife_edge_incline"), frames={})
    titles = [title for title, _ in report(derive(racer), None)]
    assert "Frame found of the velocities that the constraints allow" in titles


def test_every_mechanism_of_the_catalogue_has_a_line():
    lines = list(catalogue())
    assert [line.split()[0] for line in lines] == list(mechanics.names())
    assert all(str(mechanics.get(line.split()[0]).n) in line for line in lines)


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "mechanics", *arguments], capture_output=True, text=True, encoding="utf-8"
    )


def test_prints(monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "utf-8")
    result = run("snakeboard", "--frame", "flat")
    assert result.returncode == 0
    assert result.stderr == ""
    assert "v̇₂ = u_ψ sin(φ)/√(D)" in result.stdout
    assert "22 when" in result.stdout


def test_lists_the_catalogue_if_nothing_is_asked(monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "utf-8")
    result = run()
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.splitlines() == list(catalogue())


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_prints_a_file(tmp_path, capsys, suffix):
    path = tmp_path / f"easel{suffix}"
    path.write_text(EASEL)
    if suffix == ".json":
        (tmp_path / "easel.toml").write_text(EASEL)
        path.write_text(json.dumps(Mechanism.from_file(tmp_path / "easel.toml").to_dict()))
    main(str(path), drag=True)
    out = capsys.readouterr().out
    assert "Frame found of the velocities" in out
    assert "v̇₂ = -g" in out
    assert decomposed("R = c ẋ²/2") in out
    main(str(path))
    assert "Drag" not in capsys.readouterr().out


BAD_FILES = {
    "none.toml": (None, "there is no such file"),
    "a.yaml": (EASEL, r"ends in .toml or .json"),
    "bad.toml": ("x = ", "Invalid value"),
    "wrong.toml": (EASEL.replace('"m*g*y"', '"m*G*y"'), "unknown name 'G'"),
    "odd.toml": (EASEL.replace('"m*g*y"', '"y/exp(exp(9))"'), "easel cannot be reduced: "),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_gets_one_line(tmp_path, capsys, name):
    text, reason = BAD_FILES[name]
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(SystemExit) as stop:
        main(str(tmp_path / name))
    out, err = capsys.readouterr()
    assert (stop.value.code, out) == (2, "")
    assert err.startswith("error: ")
    assert len(err.splitlines()) == 1
    assert reason in err


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [(["snakebord"], "Did you mean 'snakeboard'?"), (["snakeboard", "--frame", "papr"], "Did you mean 'paper'?"),
     (["suslov", "--drag"], "has no drag")],
)  # fmt: skip
def test_what_is_not_there_gets_one_line(arguments, hint):
    result = run(*arguments)
    assert result.returncode == 2
    assert result.stdout == ""
    first, *more = result.stderr.splitlines()
    assert hint in first
    # Who does not know the names is told them.
    assert len(more) == (len(mechanics.names()) if arguments == ["snakebord"] else 0)
