"""Mechanisms from files and plain data: what is well-formed is read, anything else refused at once, with a reason."""

import copy
import functools
import gc
import json
import math
import operator
import os
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mechanics
from mechanics import Mechanism, MechanismError, Model
from mechanics.catalog.snake import n_link_snake
from mechanics.expressions import ExpressionError
from mechanics.spec import MAX_BYTES

TOML = """
name = "sleigh"
coordinates = ["x", "y", "theta"]
inertia = [["m", 0, 0], [0, "m", 0], [0, 0, "J"]]  # a number may stand for an expression
one_forms = [["-sin(theta)", "cos(theta)", 0]]

[parameters]
m = 2
J = 0.5

[forces]
F = ["cos(theta)", "sin(theta)", 0]

[frames]
body = [["cos(theta)", "sin(theta)", 0], [0, 0, 1]]
"""

SLEIGH = {
    "name": "sleigh",
    "coordinates": ["x", "y", "theta"],
    "parameters": {"m": 2.0, "J": 0.5},
    "inertia": [["m", "0", "0"], ["0", "m", "0"], ["0", "0", "J"]],
    "one_forms": [["-sin(theta)", "cos(theta)", "0"]],
    "forces": {"F": ["cos(theta)", "sin(theta)", "0"]},
    "frames": {"body": [["cos(theta)", "sin(theta)", "0"], ["0", "0", "1"]]},
}


def sleigh(**changes):
    return copy.deepcopy(SLEIGH) | changes


def written(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


# -- files -------------------------------------------------------------------------------------


def toml(spec):
    """TOML of a spec: a JSON string, number or array is also one of TOML."""
    tables = {key: value for key, value in spec.items() if isinstance(value, dict)}
    lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in spec.items() if key not in tables]
    for key, table in tables.items():
        lines.append(f"[{key}]")
        lines += [f"{json.dumps(name)} = {inline(value)}" for name, value in table.items()]
    return "\n".join(lines)


def inline(value):
    if isinstance(value, dict):
        return f"{{{', '.join(f'{name} = {inline(entry)}' for name, entry in value.items())}}}"
    return json.dumps(value, ensure_ascii=False)


@pytest.mark.parametrize(("suffix", "dumps"), [(".toml", toml), (".json", json.dumps), (".JSON", json.dumps)])
@pytest.mark.parametrize("name", mechanics.names())
def test_the_catalogue_survives_a_file(tmp_path, name, suffix, dumps):
    mechanism = mechanics.get(name)
    path = written(tmp_path / f"file{suffix}", dumps(mechanism.to_dict()))
    assert Mechanism.from_file(path) == mechanism
    assert Mechanism.from_file(str(path)) == mechanism


@pytest.mark.parametrize("bom", ["", "\ufeff"])
def test_a_file_by_hand(tmp_path, bom):
    assert Mechanism.from_file(written(tmp_path / "s.toml", bom + TOML)) == Mechanism.from_dict(SLEIGH)


BAD_FILES = {
    "no such file": ("none.toml", None, "there is no such file"),
    "another ending": ("spec.yaml", TOML, r"ends in \.toml or \.json"),
    "no ending": ("spec", TOML, r"ends in \.toml or \.json"),
    "too long": ("spec.toml", "#" * (MAX_BYTES + 1), "longer than 250000 bytes"),
    "not UTF-8": ("spec.toml", b'name = "\xff"', "not UTF-8.*byte 8"),
    "not TOML": ("spec.toml", "name = ", "Invalid value"),
    "not JSON": ("spec.json", "{'name': 1}", "Expecting property name.*line 1"),
    "empty": ("spec.toml", "", "lacks 'name'"),
    "a key twice in TOML": ("spec.toml", "name = 'a'\nname = 'b'", "Cannot overwrite"),
    "a key twice in JSON": ("spec.json", '{"parameters": {"m": 1, "m": 2}}', "the key 'm' is there twice"),
    "a table twice in TOML": ("spec.toml", "[drag]\n[drag]", "declare"),
    "NaN": ("spec.json", '{"parameters": {"m": NaN}}', "NaN is not a finite number"),
    "Infinity": ("spec.json", '{"parameters": {"m": -Infinity}}', "-Infinity is not a finite number"),
    "infinite by its exponent": ("spec.json", '{"parameters": {"m": 1e999}}', "1e999 is not a finite number"),
    "nan": ("spec.toml", "[parameters]\nm = nan", "nan is not a finite number"),
    "a date": ("spec.toml", TOML.replace("m = 2", "m = 2020-01-01"), "parameters: m must be a number"),
    "an integer of 100,000 digits": ("spec.toml", "m = " + "1" * 100_000, "integer string"),
    "an integer of 4,000 digits": ("spec.toml", TOML.replace("m = 2", "m = " + "1" * 4000), "m is not finite"),
    "a list": ("spec.json", "[1]", "must be a mapping, not list"),
    "deep lists": ("spec.json", "[" * 100_000, "nests too deep"),
    "deep tables": ("spec.toml", "a = " + "{a = " * 40_000, "nests too deep"),
    "a long dotted key": ("spec.toml", "a" + ".a" * 100_000 + " = 1", "a key of more than 32 parts"),
    "a long quoted key": ("spec.toml", '"a\\"" . ' * 30_000 + "a = 1", "a key of more than 32 parts"),
    "what is wrong inside": ("spec.toml", TOML.replace('"J"', '"I"'), "in inertia: unknown name 'I'"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_refuses_a_file(tmp_path, case):
    name, text, reason = BAD_FILES[case]
    path = tmp_path / name
    if text is not None:
        written(path, text)
    with quickly(), pytest.raises(MechanismError, match=reason) as caught:
        Mechanism.from_file(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).count(str(path)) == 1


def test_refuses_what_is_not_a_file(tmp_path):
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(MechanismError, match="no such file"):
        Mechanism.from_file(tmp_path / "folder.toml")
    with pytest.raises(MechanismError, match="no such file"):
        Mechanism.from_file("nul\0.toml")
    os.mkfifo(tmp_path / "pipe.toml")  # opening it would wait for a writer
    with pytest.raises(MechanismError, match="no such file"):
        Mechanism.from_file(tmp_path / "pipe.toml")


# -- what a spec may be ------------------------------------------------------------------------


def test_definitions_may_come_in_any_order():
    definitions = {"b": "a*x", "a": "m + c", "c": "J"}
    mechanism = Mechanism.from_dict(sleigh(definitions=definitions, potential="b"))
    assert mechanism.definitions == definitions
    assert list(mechanism.definitions) == ["c", "a", "b"]
    # Those that can stay where they are stay, so that a file and its mechanism read alike.
    ordered = {"p": "m", "a": "p", "q": "J", "b": "a + q"}
    assert list(Mechanism.from_dict(sleigh(definitions=ordered)).definitions) == list(ordered)


def test_no_constraints_no_forces_no_frames():
    mechanism = Mechanism.from_dict(sleigh(one_forms=[], forces={}, frames={}))
    assert (mechanism.rank, mechanism.controls, mechanism.frame_rows()) == (3, (), None)


def test_numbers_stand_for_expressions():
    mechanism = Mechanism.from_dict(sleigh(inertia=[[1, 0, 0], [0, 1e-3, 0], [0, 0, np.float64(2.5)]], potential=0))
    assert mechanism.inertia == (("1", "0", "0"), ("0", "0.001", "0"), ("0", "0", "2.5"))
    assert mechanism == Mechanism.from_dict(sleigh(inertia=mechanism.inertia))


# -- what it may not be ------------------------------------------------------------------------


class quickly:  # noqa: N801 (reads as a statement)
    """Fail if the block takes a second of this process's own time; most take a hundredth of that.

    The garbage of other tests is not its fault.
    """

    def __enter__(self):
        gc.disable()
        self.start = time.process_time()

    def __exit__(self, *_):
        taken = time.process_time() - self.start
        gc.enable()
        assert taken < 1


def chain(step, length=60, start="x + y"):
    """Definitions d0, d1, ... of which each is made of the one before."""
    return {"d0": start, **{f"d{i + 1}": step.format(f"d{i}") for i in range(length)}}


def nested(depth):
    return functools.reduce(lambda inner, _: [inner], range(depth), "x")


def wide(n, **changes):
    """A mechanism of n coordinates that nothing constrains."""
    diagonal = [["1" if i == j else "0" for j in range(n)] for i in range(n)]
    data = {"name": "wide", "coordinates": [f"q{i}" for i in range(n)], "inertia": diagonal}
    return data | {"parameters": {}, "one_forms": [], "forces": {}} | changes


NOT = "must be"  # the beginning of what a wrong type is told
HOSTILE = {
    # sizes
    "doubling": (sleigh(definitions=chain("{0}*{0}")), "definition 'd10': .* degree 1024"),
    "doubling and used": (sleigh(definitions=chain("{0}*{0}"), potential="d60"), "degree 1024"),
    "doubling fractions": (sleigh(definitions=chain("{0} + 1/{0}")), "degree 1024"),
    "doubling without degree": (sleigh(definitions=chain("sin({0}) + cos({0})")), "size"),
    "powers": (sleigh(definitions=chain("{0}**16")), "degree 4096"),
    "powers of numbers": (sleigh(definitions=chain("{0}**16", start="9")), "degree 4096"),
    "powers in functions": (sleigh(definitions=chain("sin({0}**16)**16")), "nesting 101"),
    "powers in one expression": (sleigh(potential="(" * 60 + "9" + ")**16" * 60), "degree 4096"),
    "wide and deep": (sleigh(definitions=chain("+".join(["{0}"] * 390))), "size"),
    "many entries that are large": (
        sleigh(definitions=chain("{0} + {0}", 14), one_forms=[["d14", "d14", "d14"]]),
        "with all definitions written out there are 327681 operations",
    ),
    "a long chain": (sleigh(definitions=chain("sin({0})", 200)), "nesting 101"),
    "exponents of exponents": (sleigh(potential="9**9**9**9"), "an exponent must be"),
    "a long number": (sleigh(potential="1" * 10_000), "cannot read.*4300 digits"),
    "a long name": (sleigh(potential="x" * 19_999), r"unknown name 'xxx.*\.\.\."),
    "a long sum": (sleigh(potential="+".join(["x"] * 5_000)), "cannot read|nests"),
    "a longer sum": (sleigh(potential="+".join(["x"] * 50_000)), "100075 characters; at most"),
    "10,000 coordinates": (sleigh(coordinates=[f"q{i}" for i in range(10_000)]), "10000 coordinates; at most 64"),
    "10,000 parameters": (sleigh(parameters={f"p{i}": 1.0 for i in range(10_000)}), "10000 parameters; at most 256"),
    "10,000 definitions": (sleigh(definitions={f"d{i}": "x" for i in range(10_000)}), "10000 definitions; at most"),
    "10,000 in a chain": (sleigh(definitions=chain("{0}", 10_000)), "10001 definitions; at most"),
    "10,000 forces": (sleigh(forces={f"u{i}": ["0"] * 3 for i in range(10_000)}), "10000 controls; at most 64"),
    "10,000 frames": (sleigh(frames={f"f{i}": [] for i in range(10_000)}), "10000 frames; at most 16"),
    "10,000 coefficients": (sleigh(drag={f"c{i}": 1.0 for i in range(10_000)}), "10000 drag coefficients; at most"),
    "10,000 rows": (sleigh(one_forms=[["0"] * 3] * 10_000), "one_forms must be c rows of 3"),
    "10,000 columns": (sleigh(one_forms=[["0"] * 10_000]), "one_forms must be c rows of 3"),
    "a million entries": (sleigh(inertia=[["0"] * 1000] * 1000), "characters; at most 100000"),
    "a million characters": (sleigh(observation={f"o{i}": "x" * 19_000 for i in range(50)}), "characters; at most"),
    # types
    "deep lists": (sleigh(inertia=nested(100_000)), NOT),
    "deep lists for a name": (sleigh(name=nested(100_000)), NOT),
    "deep lists for a number": (sleigh(parameters={"m": nested(100_000)}), NOT),
    "deep lists for everything": (nested(100_000), "must be a mapping"),
    "a number for a name": (sleigh(name=3), NOT),
    "bytes for a name": (sleigh(name=b"sleigh"), NOT),
    "numbers for names": (sleigh(coordinates=[1, 2, 3]), NOT),
    "a text for names": (sleigh(coordinates="xyz"), "must be a list of strings"),
    "bytes for a row": (sleigh(forces={"F": b"123"}), "must be a list of strings"),
    "a mapping for a row": (sleigh(forces={"F": {}}), "must be a list of strings"),
    "a mapping for a matrix": (sleigh(inertia={}), "must be a list of rows"),
    "a list for a mapping": (sleigh(parameters=[]), "parameters must map names to values"),
    "a list for frames": (sleigh(frames=[]), "frames must map names to values"),
    "a truth value for an expression": (sleigh(potential=True), NOT),
    "nothing for an expression": (sleigh(potential=None), NOT),
    "a truth value for a number": (sleigh(parameters={"m": True, "J": 0.5}), "parameters: m must be a number"),
    "a text for a number": (sleigh(parameters={"m": "2", "J": 0.5}), "parameters: m must be a number"),
    "a complex number": (sleigh(parameters={"m": 1j, "J": 0.5}), "parameters: m must be a number"),
    "an infinite number": (sleigh(parameters={"m": math.inf, "J": 0.5}), "parameters: m is not finite"),
    "no number": (sleigh(drag={"c": math.nan}), "drag: c is not finite"),
    "a huge integer": (sleigh(parameters={"m": 10**5000, "J": 0.5}), "parameters: m is not finite"),
    "a huge integer for an expression": (sleigh(potential=10**5000), "potential is not finite"),
    "a huge integer for a name": (sleigh(name=10**5000), NOT),
    "an infinite expression": (sleigh(potential=math.inf), "potential is not finite"),
    "a key that is no text": (sleigh() | {3: 1}, "unknown key '3'"),
    "a name that is no text": (sleigh(parameters={3: 1.0}), NOT),
    "a long key": (sleigh() | {"k" * 10**6: 1}, "unknown key 'kkk"),
    "a long name for itself": (sleigh(name="x" * 10**6), "longer than 40 characters"),
    "the default frame twice": (sleigh(frame=[], frames={"default": []}), "give it once"),
    # names and texts
    "a foreign letter": (sleigh(potential="m*\u0445"), "'\u0445' is not allowed"),
    "a letter in disguise": (sleigh(potential="\uff4d*x"), "'\uff4d' is not allowed"),  # Python reads m
    "a foreign letter in a name": (sleigh(coordinates=["\u0445", "y", "theta"]), "not a plain ASCII identifier"),
    "a generated name": (sleigh(parameters={"m": 2.0, "J": 0.5, "_k0": 1.0}), "kept for generated names"),
    "a staged name": (sleigh(parameters={"m": 2.0, "J": 0.5, "x__2": 1.0}), "kept for generated names"),
    "a rate": (sleigh(parameters={"m": 2.0, "J": 0.5, "x_dot": 1.0}), "ending _dot is kept"),
    "a function's name": (sleigh(parameters={"m": 2.0, "J": 0.5, "tanh": 1.0}), "reserved word"),
    "a name that generated code calls": (sleigh(parameters={"m": 2.0, "J": 0.5, "fabs": 1.0}), "reserved word"),
    "NumPy's name of a function": (sleigh(parameters={"m": 2.0, "J": 0.5, "arctan2": 1.0}), "reserved word"),
    "a function without arguments": (sleigh(potential="sin + 1"), "'sin' is not allowed"),
    "control characters": (sleigh(citation="\x1b[2J"), "cannot be printed"),
    "half a character": (sleigh(citation="\ud800"), "cannot be printed"),
    "an observation": (sleigh(observation={"a": "x.real"}), "in observation 'a'"),
    "a cycle": (sleigh(definitions={"a": "b", "b": "c*x", "c": "sin(a)"}), "cyclic definitions: .*a uses b"),
    "a cycle of one": (sleigh(definitions={"a": "1 + a"}), "cyclic definitions: a uses a"),
    "a definition that is no expression": (sleigh(definitions={"a": "x if y else 1"}), "in definition 'a'"),
    # numbers
    "inertia not finite": (
        sleigh(inertia=[["sqrt(-m)", 0, 0], [0, "m", 0], [0, 0, "J"]]),
        r"the inertia tensor is not finite: entry \(1, 1\), 'sqrt\(-m\)', is nan at",
    ),
    "inertia singular everywhere": (
        sleigh(inertia=[["m", "m", 0], ["m", "m", 0], [0, 0, "J"]]),
        "not positive definite",
    ),
    "inertia zero": (sleigh(inertia=[[0] * 3] * 3), "not positive definite"),
    "inertia too large": (sleigh(inertia=[["m*1e99**4", 0, 0], [0, "m", 0], [0, 0, "J"]]), "not finite"),
    "inertia barely asymmetric": (
        sleigh(inertia=[["m", "1e-8*m", 0], [0, "m", 0], [0, 0, "J"]]),
        r"not symmetric: entry \(1, 2\) is 2.*e-08",
    ),
    "a negative parameter": (sleigh(parameters={"m": -2.0, "J": 0.5}), "not positive definite with m=-2, J=0.5"),
    "one-forms not finite": (sleigh(one_forms=[["0/0", 1, 0]]), r"one_forms is not finite.*'0/0', is nan"),
    "one-forms infinite": (sleigh(one_forms=[["1/0", 1, 0]]), r"one_forms is not finite.*'1/0', is inf"),
    "one-forms zero": (sleigh(one_forms=[[0, 0, 0]]), "not independent"),
    "one-forms twice": (sleigh(one_forms=SLEIGH["one_forms"] * 2, frames={}), "not independent"),
    "one-forms that contradict": (
        sleigh(one_forms=[["-sin(theta)", "cos(theta)", 0], ["1e-9*sin(theta)", "-1e-9*cos(theta)", 0]], frames={}),
        "not independent",
    ),
    "a force nowhere finite": (sleigh(forces={"F": ["1/0", 0, 0]}), "force 'F' is not finite at any"),
    "a potential nowhere real": (sleigh(potential="(-1 - x**2)**(1/2)"), "potential is not finite at any"),
    "a frame not finite": (sleigh(frame=[["1/(m - m)", 0, 0], [0, 0, 1]]), "frame 'default' is not finite"),
    "a limit of infinity": (sleigh(joint_limits={"theta": math.inf}), "not finite"),
    "a limit below zero": (sleigh(torque_limits={"F": -1.0}), "must be positive"),
    "a pose of one coordinate": (sleigh(fibre=["x", "x", "x"]), "fibre names"),
    "drag that is linear": (sleigh(rayleigh="x_dot"), "must be quadratic"),
    "drag that is cubic": (sleigh(rayleigh="abs(x_dot)*x_dot**2"), "must be quadratic"),
    "drag that is no number": (sleigh(rayleigh="x_dot**2/(m - m)"), "must be quadratic"),
    "drag hidden by zero": (sleigh(rayleigh="c*x_dot**4", drag={"c": 0.0}), "must be quadratic"),
    "drag that drives": (sleigh(rayleigh="x_dot*y_dot"), "would drive"),
    "drag below zero": (sleigh(rayleigh="c*x_dot**2", drag={"c": -1.0}), "must be at least 0"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_refuses(case):
    """The reason is short enough to be read, whatever was given."""
    spec, reason = HOSTILE[case]
    with quickly(), pytest.raises(MechanismError, match=reason) as caught:
        Mechanism.from_dict(spec)
    assert len(str(caught.value)) < 1000


LARGE = {
    "64 coordinates": wide(64),
    "16 frames": wide(64, frames={f"f{i}": wide(64)["inertia"] for i in range(16)}),
    "63 constraints": wide(64, one_forms=wide(64)["inertia"][:63]),
    "4,096 different entries": wide(
        64, inertia=[[f"sin(q{i} + q{j})" if i != j else "100" for j in range(64)] for i in range(64)]
    ),
    "9,000 sines": wide(
        64, definitions={f"d{i}": "+".join(f"sin(q{i * j % 64})" for j in range(100)) for i in range(90)}
    ),
    "drag of 64 rates": wide(64, rayleigh="+".join(f"(q{i}_dot*cos(q{i % 7}))**2" for i in range(64))),
}


@pytest.mark.parametrize("case", LARGE)
def test_the_largest_that_is_accepted_is_checked_quickly(case):
    with quickly():
        Mechanism.from_dict(LARGE[case])


def test_a_long_snake_is_accepted():
    """A mechanism of many links is far from every limit; a bomb of as many definitions is not."""
    snake = n_link_snake(20)
    assert Mechanism.from_dict(json.loads(json.dumps(snake.to_dict()))) == snake


# -- nothing is executed -----------------------------------------------------------------------

SLOTS = {
    "inertia": lambda text: sleigh(inertia=[[text, "0", "0"], ["0", "m", "0"], ["0", "0", "J"]]),
    "one_forms": lambda text: sleigh(one_forms=[[text, "cos(theta)", "0"]], frames={}),
    "force": lambda text: sleigh(forces={"F": [text, "0", "0"]}),
    "frame": lambda text: sleigh(frame=[["cos(theta)", "sin(theta)", text], ["0", "0", "1"]]),
    "potential": lambda text: sleigh(potential=text),
    "definition": lambda text: sleigh(definitions={"d": text}),
    "rayleigh": lambda text: sleigh(rayleigh=text),
    "forward": lambda text: sleigh(forward=text),
    "observation": lambda text: sleigh(observation={"o": text}),
    "name": lambda text: sleigh(name=text),
    "coordinate": lambda text: sleigh(coordinates=[text, "y", "theta"]),
    "parameter": lambda text: sleigh(parameters={"m": 2.0, "J": 0.5, text: 1.0}),
    "parameter's value": lambda text: sleigh(parameters={"m": 2.0, "J": text}),
    "control": lambda text: sleigh(forces={text: ["0", "0", "1"]}),
}
PAYLOADS = [
    "__import__('pathlib').Path({!r}).touch()",
    "open({!r}, 'w')",
    "[open({!r}, 'w') for _ in '1']",
    "(lambda: open({!r}, 'w'))()",
    "(w := open({!r}, 'w'))",
    "f\"{{open({!r}, 'w')}}\"",
    "sin.__globals__['__builtins__']['open']({!r}, 'w')",
    "{{open({!r}, 'w')}}",
    "open({!r}, 'w') if 1 else 1",
    "1\nopen({!r}, 'w')",
    # For the source of a generated module: the end of a string, a line or a comment, and a command after it.
    '1 # """; open({!r}, "w") #',
    '1 #\n"""; open({!r}, "w") #"""',
    "1 # '; open({!r}, 'w') #",
]


@pytest.mark.parametrize("payload", PAYLOADS)
@pytest.mark.parametrize("slot", SLOTS)
def test_nothing_is_executed(tmp_path, slot, payload):
    touched = tmp_path / "touched"
    with pytest.raises(MechanismError):
        Model(Mechanism.from_dict(SLOTS[slot](payload.format(str(touched)))))
    assert not touched.exists()


@pytest.mark.parametrize("payload", PAYLOADS)
def test_nothing_of_a_frame_given_by_hand_is_executed(tmp_path, payload):
    touched = tmp_path / "touched"
    with pytest.raises((MechanismError, ExpressionError)):
        Model(Mechanism.from_dict(SLEIGH), frame=[[payload.format(str(touched)), "0", "0"], ["0", "0", "1"]])
    assert not touched.exists()


# -- anything at all ---------------------------------------------------------------------------

GARBAGE = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([10**400, -1, 0, 1e308, 5e-324, math.nan, math.inf, 1j, b"x", "", "0", "1/0", "-1", "x", "m"])
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=3),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


def arithmetic(names):
    """Expressions of the language, most of them without a sensible value somewhere."""
    leaves = st.sampled_from([*names, "0", "1", "2", "0.5", "1e200", "pi"])
    unary = ["-({})", "sin({})", "log({})", "sqrt({})", "exp({})", "tan({})", "acos({})", "1/({})", "({})**16"]
    unary += ["({})**(-1/2)", "abs({})", "sign({})", "({})**(3/2)"]
    return st.recursive(
        leaves,
        lambda inner: (
            st.builds(str.format, st.sampled_from(unary), inner)
            | st.builds("({}) {} ({})".format, inner, st.sampled_from("+-*/"), inner)
        ),
        max_leaves=5,
    )


def places(data, path=()):
    """Every place in nested lists and mappings, as a path of keys."""
    yield path
    for key, value in data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ():
        yield from places(value, (*path, key))


SPECS = {name: json.loads(json.dumps(mechanics.get(name).to_dict())) for name in mechanics.names()}


@st.composite
def mutants(draw):
    """Specs of the catalogue with a few places changed, deleted, exchanged or said twice."""
    spec = copy.deepcopy(SPECS[draw(st.sampled_from(sorted(SPECS)))])
    words = [*spec["coordinates"], *spec["parameters"], *spec["definitions"]]
    for _ in range(draw(st.integers(1, 3))):
        paths = [path for path in places(spec) if path]
        *above, last = draw(st.sampled_from(paths))
        inner = functools.reduce(operator.getitem, above, spec)
        match draw(st.sampled_from(["garbage", "expression", "another", "delete", "twice", "rename"])):
            case "garbage":
                inner[last] = draw(GARBAGE)
            case "expression":
                inner[last] = draw(arithmetic(words))
            case "another":
                inner[last] = copy.deepcopy(functools.reduce(operator.getitem, draw(st.sampled_from(paths)), spec))
            case "delete":
                del inner[last]
            case "twice" if isinstance(inner, list):
                inner.append(copy.deepcopy(inner[last]))
            case "rename" if isinstance(inner, dict):
                inner[draw(st.text(max_size=5) | st.sampled_from([*words, *SLEIGH]))] = inner.pop(last)
        if not isinstance(spec, dict) or not spec:
            break
    return spec


def answer(spec):
    """Read a spec; whatever it is, the answer is quick, and a mechanism that can be used or a `MechanismError`."""
    with quickly():
        try:
            mechanism = Mechanism.from_dict(spec)
        except MechanismError as error:
            assert str(error)  # noqa: PT017 (either outcome is right)
            return None
    assert Mechanism.from_dict(json.loads(json.dumps(mechanism.to_dict()))) == mechanism
    mechanism.resolve(None)
    return mechanism


@given(mutants())
@settings(max_examples=200, deadline=None)
def test_any_change_of_a_good_spec_is_read_or_refused(spec):
    answer(spec)


@given(st.dictionaries(st.sampled_from([*SLEIGH, "frame", "definitions", "rayleigh", "drag", "fibre"]), GARBAGE))
@settings(max_examples=200, deadline=None)
def test_any_data_are_read_or_refused(changes):
    answer(sleigh(**changes))


@given(arithmetic(["x", "theta", "m"]), st.sampled_from(sorted(SLOTS)[:9]))
@settings(max_examples=200, deadline=None)
def test_any_formula_is_read_or_refused(text, slot):
    """NumPy's warnings (an overflow, a root of a negative number) would be errors here."""
    answer(SLOTS[slot](text))
