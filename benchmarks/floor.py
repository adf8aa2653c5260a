"""How far a compiled kernel is from the floor that the machine's fused multiply-adds set.

`loops` counts the instructions of a loop in x86 assembly, `fma_rate` measures what the machine can do, and
`kernel_parts` finds the loops that each row of a vector environment goes through in a step. Divisions, roots and memory
are counted and have no part in the floor: they are what keeps a kernel from it.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import gymnasium as gym

__all__ = ["Loop", "Part", "fma_rate", "kernel_parts", "loops"]

# Mnemonics of packed instructions on float64 or float32, whatever their register.
KINDS = {
    "fused": r"vfn?m(?:add|sub)\d*p[ds]",
    "multiply": r"vmulp[ds]",
    "add": r"v(?:add|sub|min|max)p[ds]",
    "divide": r"vdivp[ds]",
    "root": r"vsqrtp[ds]",
    "round": r"v(?:rndscale|round)p[ds]|vcvt\w+",
    "gather": r"v(?:gather|scatter)\w+",
    "move": r"vmov(?:[au]p[ds]|dq[au]\d*|dq[au])",
    "other": r"v\w+",  # comparisons, masks, blends, whole numbers
}
_KIND = re.compile("|".join(f"(?P<{kind}>{pattern})$" for kind, pattern in KINDS.items()))
_INSTRUCTION = re.compile(r"\s+(?P<name>[a-z]\w*)\s+(?P<operands>.*)")
_LABEL = re.compile(r"(?P<label>[.\w$]+):")
_REGISTER = re.compile(r"%([xyz])mm\d+")
_MEMORY = re.compile(r"(?P<address>-?\w*\((?P<base>%\w+)?[^)]*\))(?P<one>\{1to\d+\})?")
BITS = {"x": 128, "y": 256, "z": 512}


@dataclass(frozen=True)
class Loop:
    """One pass through an innermost loop.

    Attributes:
        counts: instructions by kind, those of `KINDS`; packed ones only.
        bits: of the widest register.
        double: whether it computes in float64.
        moved: bytes that are read from arrays or written to them.
        spilled: bytes that are read from the stack or written to it.
    """

    counts: Mapping[str, int]
    bits: int
    double: bool
    moved: int
    spilled: int

    @property
    def lanes(self) -> int:
        """Numbers in a register."""
        return self.bits // (64 if self.double else 32)

    @property
    def arithmetic(self) -> int:
        """Instructions that a fused multiply-add could take the place of."""
        return sum(self.counts.get(kind, 0) for kind in ("fused", "multiply", "add"))


@dataclass(frozen=True)
class Part:
    """A loop over the rows of a vector environment.

    Attributes:
        name: of its function in `nhenv.rows`.
        passes: how often it is run in a step.
        streams: registers of rows that a pass goes through.
        loop: one pass.
    """

    name: str
    passes: int
    streams: int
    loop: Loop

    def floor(self, rate: float) -> float:
        """Least seconds a row, at `fma_rate` of the same width."""
        return self.passes * self.loop.arithmetic / (self.streams * rate)


def loops(*assemblies: str) -> list[Loop]:
    """Innermost loops with packed arithmetic in texts of AT&T syntax, equal ones once, the largest first."""
    found: list[Loop] = []
    for assembly in assemblies:
        found += [loop for loop in map(_count, _innermost(assembly.splitlines())) if loop not in found]
    return sorted((loop for loop in found if loop.arithmetic), key=lambda loop: loop.arithmetic, reverse=True)


def _innermost(lines: list[str]) -> list[list[str]]:
    """Lines between the targets of backward jumps and the jumps, where no other such pair lies in between."""
    labels = {found["label"]: i for i, line in enumerate(lines) if (found := _LABEL.match(line))}
    ends: dict[int, int] = {}
    for i, line in enumerate(lines):
        found = _INSTRUCTION.match(line)
        if found and found["name"].startswith("j"):
            start = labels.get(found["operands"].split("#")[0].strip(), len(lines))
            if start <= i:
                ends[start] = i
    return [
        lines[start + 1 : end + 1]
        for start, end in ends.items()
        if not any(start < other and last <= end for other, last in ends.items())
    ]


def _count(body: list[str]) -> Loop:
    counts: Counter[str] = Counter()
    single, bits, moved, spilled = 0, 0, 0, 0
    for line in body:
        found = _INSTRUCTION.match(line)
        if not found:
            continue
        name, operands = found["name"], found["operands"].split("#")[0]
        widths = [BITS[letter] for letter in _REGISTER.findall(operands)]
        kind = _KIND.match(name)
        if not widths or not kind or re.search(r"(?<!p)s[ds]$", name):  # the last are scalars
            continue
        assert kind.lastgroup
        counts[kind.lastgroup] += 1
        if kind.lastgroup in ("fused", "multiply", "add"):
            bits = max(bits, *widths)
            single += name.endswith("ps")
        memory = _MEMORY.search(operands)
        if memory and not memory["one"] and memory["base"] != "%rip" and "broadcast" not in name:
            if memory["base"] in ("%rsp", "%rbp"):
                spilled += max(widths) // 8
            else:
                moved += max(widths) // 8
    double = 2 * single < sum(counts[kind] for kind in ("fused", "multiply", "add")) or not single
    return Loop(counts, bits, double, moved, spilled)


# -- the machine -----------------------------------------------------------------------------------

CHAINS = 16  # of dependent operations: twice what four cycles of two units ask for, and few enough for the registers
UNROLLED = 8
B, C = 0.5, 0.75  # below one, so that no chain overflows; read from memory, so that nothing is folded


def fma_rate(*, double: bool = True, seconds: float = 0.2) -> float:
    """Fused multiply-adds of single numbers a second, on one core: the best of some turns."""
    lanes = 8 if double else 16
    function, engine = _chains(lanes, "double" if double else "float")
    passes, best, end = 1 << 16, 0.0, time.perf_counter() + seconds
    while time.perf_counter() < end:
        start = time.perf_counter()
        total = function(passes)
        best = max(best, passes * CHAINS * UNROLLED * lanes / (time.perf_counter() - start))
        assert abs(total - (CHAINS * C / (1 - B) + C)) < 1e-4  # it did compute, to the fixed point of B z + C
    del engine  # the function lives in it
    return best


def _chains(lanes: int, scalar: str) -> tuple[Any, Any]:
    """Compiled function of a number of passes of `CHAINS * UNROLLED` vector operations, and what keeps it alive.

    It returns the sum of the chains, each of which starts at C and goes on by z -> B z + C, and of C.
    """
    import llvmlite.binding as llvm

    vector, name = f"<{lanes} x {scalar}>", f"llvm.fma.v{lanes}f{64 if scalar == 'double' else 32}"
    start = [f"%a{i}.0 = phi {vector} [ %c, %entry ], [ %a{i}.{UNROLLED}, %loop ]" for i in range(CHAINS)]
    work = [
        f"%a{i}.{j + 1} = call {vector} @{name}({vector} %a{i}.{j}, {vector} %b, {vector} %c)"
        for j in range(UNROLLED)
        for i in range(CHAINS)
    ]
    total = [f"%t{i} = fadd {vector} {f'%t{i - 1}' if i else '%c'}, %a{i}.{UNROLLED}" for i in range(CHAINS)]
    lines = "\n".join
    source = f"""
        declare {vector} @{name}({vector}, {vector}, {vector})
        define void @chains(i64 %passes, {vector}* %numbers) {{
        entry:
          %b = load {vector}, {vector}* %numbers, align 4
          %where = getelementptr {vector}, {vector}* %numbers, i64 1
          %c = load {vector}, {vector}* %where, align 4
          br label %loop
        loop:
          %n = phi i64 [ 0, %entry ], [ %next, %loop ]
          {lines(start)}
          {lines(work)}
          %next = add i64 %n, 1
          %more = icmp ult i64 %next, %passes
          br i1 %more, label %loop, label %end
        end:
          {lines(total)}
          store {vector} %t{CHAINS - 1}, {vector}* %numbers, align 4
          ret void
        }}
    """
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    features = llvm.get_host_cpu_features().flatten()
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features, opt=3
    )
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(source), machine)
    engine.finalize_object()
    compiled = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_void_p)(engine.get_function_address("chains"))
    kind = ctypes.c_double if scalar == "double" else ctypes.c_float

    def function(passes: int) -> float:
        numbers = (kind * (2 * lanes))(*[B] * lanes, *[C] * lanes)
        compiled(passes, numbers)
        return numbers[0]

    return function, engine


# -- a kernel --------------------------------------------------------------------------------------

# What every row goes through in every step. Impacts on stops, ends of episodes and info come on top.
PARTS = ("load_rows", "prepare_rows", "advance_rows", "screen_rows", "finish_rows", "emit_rows")


def kernel_parts(env_id: str, options: Mapping[str, Any], size: int = 256) -> list[Part]:
    """Those of `PARTS` that are vector code; none where the assembly is not x86's.

    In a process and a cache of its own: Numba shows nothing of what it has loaded.
    """
    with tempfile.TemporaryDirectory() as cache, ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_compiled_parts, env_id, dict(options), size, cache).result()


def _compiled_parts(env_id: str, options: dict[str, Any], size: int, cache: str) -> list[Part]:
    os.environ["NHENV_CACHE_DIR"] = cache
    import nhenv  # noqa: F401 (registers the environments)

    envs = gym.make_vec(env_id, num_envs=size, **options)
    envs.reset(seed=0)
    envs.step(envs.action_space.sample())
    modules = [vars(module) for name, module in sys.modules.items() if name.startswith("nhenv_kernel_")]
    (kernel,) = (names for names in modules if "step_rows" in names)
    parts = []
    for name in PARTS:
        function = kernel.get(name)  # `screen_rows` is there only if there are stops
        found = loops(*function.inspect_asm().values()) if function else []
        passes, streams = (kernel["SUBSTEPS"], kernel["STREAMS"]) if name == "advance_rows" else (1, 1)
        parts += [Part(name, passes, streams, loop) for loop in found[:1]]
    return parts
