"""From a kernel to what an environment's step returns, in compiled code.

One environment's step is mostly plumbing: beside 0.15 to 0.3 µs of physics, the ways in (arrays adopted by Numba's
runtime, floats) and out (a tuple of floats, a new array, a dictionary) took 0.7. They take 0.2 where the kernel is
compiled for three types of this file, which say through `numba.extending` how they come from Python and go there:

    (Memory, Action) -> Response

Memory is read and written where it lies, an action is read out of the array it comes in, and the response is built by
the calls of CPython and NumPy that the interpreter would make. What it does is what `nhenv.response.plain` does, and
that stands in where arrays are not laid out as this file knows them.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import config, njit, types
from numba._helperlib import c_helpers  # type: ignore[attr-defined]
from numba.core import cgutils
from numba.extending import NativeValue, box, models, register_model, unbox
from numba.np.arrayobj import populate_array

from nhenv.response import Kernel, Respond, plain

__all__ = ["compiled", "possible"]


def compiled(
    *, memory: int, actions: int, observations: int, info: tuple[str, ...], **options: Any
) -> Callable[[Kernel], Respond]:
    """Decorator that compiles a kernel, and makes `respond` of it.

    Args:
        memory: number of elements of the memory.
        actions: number of elements of an action.
        observations: number of elements of an observation.
        info: names of the entries of `info`, in the order of the kernel.
        **options: those of `numba.njit`.

    `respond` raises TypeError for an action that is not an array of shape (actions,), float32 or float64.
    """

    def decorate(kernel: Kernel) -> Respond:
        count = 2 + len(info) + observations
        if not possible():
            numbers = types.UniTuple(types.float64, count), types.UniTuple(types.float64, actions)
            signature = numbers[0](types.float64[::1], numbers[1])
            return plain(actions=actions, info=info)(njit(signature, **options)(kernel))
        signature = Response(count, info)(Memory(memory), Action(types.float64, actions))
        # The compiled function itself: the dispatcher around it would look up the type of each argument.
        dispatcher: Any = njit(signature, **options)(kernel)
        return dispatcher.get_overload(signature)

    return decorate


# -- arrays as they lie in memory ---------------------------------------------------------------


class _Array(ctypes.Structure):
    """NumPy's PyArrayObject behind the head that every object has; part of its binary interface."""

    _fields_ = (
        ("data", ctypes.c_void_p),
        ("ndim", ctypes.c_int),
        ("shape", ctypes.c_void_p),
        ("strides", ctypes.c_void_p),
        ("base", ctypes.c_void_p),
        ("dtype", ctypes.c_void_p),
    )


class _DType(ctypes.Structure):
    """The beginning of NumPy's PyArray_Descr behind that head: the same in NumPy 1 and 2."""

    _fields_ = (
        ("type", ctypes.c_void_p),
        ("kind", ctypes.c_char),
        ("letter", ctypes.c_char),
        ("byteorder", ctypes.c_char),
        ("flags", ctypes.c_char),
        ("number", ctypes.c_int),
    )


WORD = ctypes.sizeof(ctypes.c_void_p)
HEAD = object.__basicsize__  # reference count, then type
FOREIGN = b">" if sys.byteorder == "little" else b"<"  # byte order of numbers that must be converted
FLOAT32, FLOAT64 = np.dtype(np.float32), np.dtype(np.float64)

# Compiled code, from the cache too, finds these by name: they lie elsewhere in each process.
NDARRAY = "nhenv_ndarray"
llvm.add_symbol(NDARRAY, id(np.ndarray))
NEW_ARRAY = "numba_ndarray_new"  # Numba's name for NumPy's PyArray_New, one of its `c_helpers`


def possible() -> bool:
    """Whether arrays are laid out as this file says, and compiled code can make new ones."""
    if config.DISABLE_JIT or HEAD != 2 * WORD or "ndarray_new" not in c_helpers:  # type: ignore[attr-defined]
        return False
    sample = np.zeros((2, 3), FLOAT32)
    array, dtype = _Array.from_address(id(sample) + HEAD), _DType.from_address(id(FLOAT32) + HEAD)
    return (
        ctypes.c_void_p.from_address(id(sample) + HEAD - WORD).value == id(np.ndarray)
        and (array.data, array.ndim, array.dtype) == (sample.ctypes.data, 2, id(FLOAT32))
        and (dtype.kind, dtype.byteorder, dtype.number) == (b"f", FLOAT32.byteorder.encode(), FLOAT32.num)
    )


I8, I32, INTP = ir.IntType(8), ir.IntType(32), ir.IntType(8 * WORD)
F32, F64 = ir.FloatType(), ir.DoubleType()
ADDRESS = I8.as_pointer()


def _load(builder: ir.IRBuilder, base: ir.Value, offset: int | ir.Value, kind: ir.Type) -> ir.Value:
    """What lies `offset` bytes from an address, aligned or not."""
    place = builder.gep(base, [INTP(offset) if isinstance(offset, int) else offset])
    return builder.load(builder.bitcast(place, kind.as_pointer()), align=1)


def _unbox(kind: Any, obj: ir.Value, c: Any, read: Callable[..., ir.Value]) -> NativeValue:
    """`read(data, stride, number, require)` of an array; TypeError unless it is an ndarray of shape (kind.count,).

    Nothing is read before it is known to be there.
    """
    builder, obj = c.builder, c.builder.bitcast(obj, ADDRESS)
    refused, done = builder.append_basic_block("refused"), builder.append_basic_block("done")

    def require(condition: ir.Value) -> None:
        fulfilled = builder.append_basic_block("fulfilled")
        builder.cbranch(condition, fulfilled, refused)
        builder.position_at_end(fulfilled)

    ndarray = builder.module.globals.get(NDARRAY) or ir.GlobalVariable(builder.module, I8, NDARRAY)
    require(builder.icmp_unsigned("==", _load(builder, obj, HEAD - WORD, ADDRESS), ndarray))
    require(builder.icmp_signed("==", _load(builder, obj, HEAD + _Array.ndim.offset, I32), I32(1)))
    shape = _load(builder, obj, HEAD + _Array.shape.offset, ADDRESS)
    require(builder.icmp_signed("==", _load(builder, shape, 0, INTP), INTP(kind.count)))
    dtype = _load(builder, obj, HEAD + _Array.dtype.offset, ADDRESS)
    byteorder = _load(builder, dtype, HEAD + _DType.byteorder.offset, I8)
    require(builder.icmp_signed("!=", byteorder, I8(ord(FOREIGN))))
    value = read(
        _load(builder, obj, HEAD + _Array.data.offset, ADDRESS),
        _load(builder, _load(builder, obj, HEAD + _Array.strides.offset, ADDRESS), 0, INTP),
        _load(builder, dtype, HEAD + _DType.number.offset, I32),
        require,
    )
    accepted = builder.block
    builder.branch(done)
    builder.position_at_end(refused)
    c.pyapi.err_set_string("PyExc_TypeError", f"not an array of {kind.count} floating-point numbers")
    builder.branch(done)
    builder.position_at_end(done)
    result, failed = builder.phi(value.type), builder.phi(cgutils.bool_t)
    result.add_incoming(value, accepted)
    failed.add_incoming(cgutils.false_bit, accepted)
    result.add_incoming(ir.Constant(value.type, ir.Undefined), refused)
    failed.add_incoming(cgutils.true_bit, refused)
    return NativeValue(result, is_error=failed)


# -- from Python --------------------------------------------------------------------------------


class Memory(types.Array):
    """A contiguous float64 array (count,) that outlives the call, and is not given away by it."""

    def __init__(self, count: int) -> None:
        super().__init__(types.float64, 1, "C", name=f"Memory({count})")
        self.count = count

    @property
    def key(self) -> Any:
        """What distinguishes two of these types."""
        return self.count


class Action(types.UniTuple):
    """The elements of an array (count,), float32 or float64, however strided."""


register_model(Memory)(models.ArrayModel)
register_model(Action)(models.UniTupleModel)


@unbox(Memory)
def _unbox_memory(kind: Memory, obj: ir.Value, c: Any) -> NativeValue:
    builder = c.builder

    def read(data: ir.Value, stride: ir.Value, number: ir.Value, require: Callable[..., None]) -> ir.Value:
        require(builder.icmp_signed("==", number, I32(FLOAT64.num)))
        require(builder.icmp_signed("==", stride, INTP(FLOAT64.itemsize)))
        array, size = c.context.make_array(kind)(c.context, builder), INTP(FLOAT64.itemsize)
        data = builder.bitcast(data, F64.as_pointer())
        populate_array(array, data=data, shape=[INTP(kind.count)], strides=[size], itemsize=size, meminfo=None)
        return array._getvalue()

    return _unbox(kind, obj, c, read)


@unbox(Action)
def _unbox_action(kind: Action, obj: ir.Value, c: Any) -> NativeValue:
    builder = c.builder

    def read(data: ir.Value, stride: ir.Value, number: ir.Value, require: Callable[..., None]) -> ir.Value:
        single = builder.icmp_signed("==", number, I32(FLOAT32.num))
        require(builder.or_(single, builder.icmp_signed("==", number, I32(FLOAT64.num))))
        places = [builder.mul(stride, INTP(i)) for i in range(kind.count)]
        with builder.if_else(single) as (then, otherwise):
            with then:
                narrow = [builder.fpext(_load(builder, data, place, F32), F64) for place in places]
                after_narrow = builder.block
            with otherwise:
                wide = [_load(builder, data, place, F64) for place in places]
                after_wide = builder.block
        numbers = []
        for pair in zip(narrow, wide, strict=True):
            numbers.append(builder.phi(F64))
            for value, block in zip(pair, (after_narrow, after_wide), strict=True):
                numbers[-1].add_incoming(value, block)
        return cgutils.pack_array(builder, numbers, F64)

    return _unbox(kind, obj, c, read)


# -- to Python ----------------------------------------------------------------------------------


class Response(types.UniTuple):
    """Numbers (status, reward, *info, *observation), for Python what `nhenv.response` says."""

    def __init__(self, count: int, info: tuple[str, ...]) -> None:
        super().__init__(types.float64, count)
        self.info = info

    @property
    def key(self) -> Any:
        """What distinguishes two of these types."""
        return self.count, self.info

    def __unliteral__(self) -> Response:
        return self


register_model(Response)(models.UniTupleModel)


@box(Response)
def _box_response(kind: Response, value: ir.Value, c: Any) -> ir.Value:
    builder, api, info = c.builder, c.pyapi, kind.info
    status, reward, *rest = (builder.extract_value(value, i) for i in range(kind.count))
    observation = rest[len(info) :]
    # New references, each NULL if there is no memory for it.
    array, terms = _new_vector(c, observation), [api.float_from_double(term) for term in rest[: len(info)]]
    items = [array, api.float_from_double(reward), _flag(c, status), api.bool_from_bool(cgutils.false_bit)]
    items.append(api.dict_new())
    response = api.tuple_new(len(items))
    complete = cgutils.true_bit
    for obj in (*terms, *items, response):
        complete = builder.and_(complete, cgutils.is_not_null(builder, obj))
    result = cgutils.alloca_once_value(builder, cgutils.get_null_value(response.type))
    with builder.if_then(complete, likely=True):  # else MemoryError, and what there is of them is lost
        for name, term in zip(info, terms, strict=True):
            label = c.env_manager.read_const(c.env_manager.add_const(name))
            failure = api.dict_setitem(items[-1], label, term)
            complete = builder.and_(complete, builder.icmp_signed("==", failure, I32(0)))
            api.decref(term)  # the dictionary has taken one of its own
        for i, item in enumerate(items):
            api.tuple_setitem(response, i, item)  # takes ours
        builder.store(builder.select(complete, response, cgutils.get_null_value(response.type)), result)
    return builder.load(result)


def _flag(c: Any, status: ir.Value) -> ir.Value:
    """False if the status is 0, else the status."""
    builder, flag = c.builder, cgutils.alloca_once(c.builder, c.pyapi.pyobj)
    with builder.if_else(builder.fcmp_ordered("==", status, F64(0.0)), likely=True) as (running, otherwise):
        with running:
            builder.store(c.pyapi.bool_from_bool(cgutils.false_bit), flag)
        with otherwise:
            builder.store(c.pyapi.float_from_double(status), flag)
    return builder.load(flag)


def _new_vector(c: Any, values: list[ir.Value]) -> ir.Value:
    """A new float32 array of these values, or NULL."""
    builder, null = c.builder, cgutils.get_null_value
    # ndim, shape, strides, data, dtype, itemsize; without strides and data it makes its own
    arguments = [I32, INTP.as_pointer(), INTP.as_pointer(), ADDRESS, I32, I32]
    new = cgutils.get_or_insert_function(builder.module, ir.FunctionType(c.pyapi.pyobj, arguments), NEW_ARRAY)
    shape = cgutils.alloca_once_value(builder, INTP(len(values)))
    array = builder.call(new, [I32(1), shape, null(arguments[2]), null(ADDRESS), I32(FLOAT32.num), I32(0)])
    with builder.if_then(cgutils.is_not_null(builder, array), likely=True):
        data = _load(builder, builder.bitcast(array, ADDRESS), HEAD + _Array.data.offset, F32.as_pointer())
        for i, value in enumerate(values):
            builder.store(builder.fptrunc(value, F32), builder.gep(data, [INTP(i)]))
    return array
