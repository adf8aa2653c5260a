"""`python -m mechanics NAME` prints the equations, and says in one line what is wrong."""

import subprocess
import sys

import pytest

import mechanics
from mechanics.__main__ import report
from mechanics.geometry import reduce


@pytest.mark.parametrize("name", mechanics.names())
@pytest.mark.parametrize("shorthands", [True, False])
def test_report_covers_every_frame(name, shorthands):
    for frame in mechanics.get(name).frames:
        sections = dict(report(reduce(mechanics.get(name), frame), frame, shorthands))
        assert len(sections["Kinematic equations"]) == mechanics.get(name).n
        assert len(sections["Dynamic equations"]) == mechanics.get(name).rank
        assert shorthands or "where" not in sections


def test_shorthands_are_used_and_explained():
    sections = dict(report(reduce(mechanics.get("roller_racer"), "paper"), "paper"))
    gamma = next(lines for title, lines in sections.items() if "Christoffel" in title)
    assert "Γ̃¹₂₂ = c k m (l₁ + l₂ cos(ψ))/f₁²" in gamma
    assert [line.split(" = ")[0] for line in sections["where"]] == ["c", "k", "f₁", "f₂"]


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


@pytest.mark.parametrize(
    ("arguments", "hint"), [(["snakebord"], "'snakeboard'"), (["snakeboard", "--frame", "papr"], "'paper'")]
)
def test_an_unknown_name_gets_one_line(arguments, hint):
    result = run(*arguments)
    assert result.returncode == 2
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1
    assert f"Did you mean {hint}?" in result.stderr
