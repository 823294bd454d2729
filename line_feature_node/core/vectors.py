"""Vectors: what the compiler does not find by itself, written as arithmetic on so many numbers at once.

Numba's loops over arrays are vectorised by LLVM where one step does not depend on another. The recursion along a row
does, so many rows are taken at once, one a lane; written as a loop over lanes LLVM keeps the state in memory (0.14
instead of 0.03 ms for 640×480). Rows must be turned into lanes and back, for which a loop moves single floats (0.10
instead of 0.02 ms each way). And along a line pixels are anywhere in memory, and sums are taken one by one; several
steps at once take less than two thirds of the time. bench/vectors.py measures all.

A vector is a few instructions of LLVM, for any processor. Under NUMBA_DISABLE_JIT it is a NumPy array of as many
numbers, and the functions are their plain twins, which stand beside them; tests hold the one against the other.
"""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.core.imputils import lower_builtin
from numba.core.typing import signature as signature_of
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import intrinsic, models, register_model

from line_feature_node.core.compiling import inlined

#: Lanes of a vector of rows: two registers of AVX-512, four of AVX2, eight of NEON or SSE, which hides latencies.
LANES = 32
#: Lanes of a vector of steps along a line.
STEPS = 8
#: Bytes that come from memory together.
CACHE_LINE = 64
#: Width and height of the tiles that are transposed.
TILE = 16

_PLAIN = bool(vars(config)['DISABLE_JIT'])
_INT = ir.IntType(32)
_ELEMENTS = {types.float32: ir.FloatType(), types.int32: _INT, types.boolean: ir.IntType(1)}
_ROW = ir.VectorType(ir.FloatType(), TILE)


class _Vector(types.Type):
    """The Numba type of a vector."""

    def __init__(self, element: Any, lanes: int) -> None:
        self.element, self.lanes = element, lanes
        self.llvm = ir.VectorType(_ELEMENTS[element], lanes)
        super().__init__(name=f'Vector({element}, {lanes})')


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, fe_type.llvm)


_ROWS = _Vector(types.float32, LANES)
_FLOATS, _INTEGERS = _Vector(types.float32, STEPS), _Vector(types.int32, STEPS)


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any, vector: Any) -> Any:
    """LLVM pointer to a vector that begins at an index of a flat array."""
    array = context.make_array(array_type)(context, builder, array)
    if context.enable_boundscheck:
        last = builder.add(index, ir.Constant(index.type, vector.count - 1))
        for place in (index, last):
            cgutils.do_boundscheck(context, builder, place, cgutils.unpack_tuple(builder, array.shape)[0])
    return builder.bitcast(builder.gep(array.data, [index]), vector.as_pointer())


def _filled(builder: Any, vector: Any, value: Any) -> Any:
    """The number in every lane."""
    nothing = ir.Constant(vector.llvm, ir.Undefined)
    first = builder.insert_element(nothing, value, ir.Constant(_INT, 0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(_INT, vector.lanes), [0] * vector.lanes))


def _as_vectors(context: Any, builder: Any, vector: Any, kinds: Any, values: Any) -> list[Any]:
    """Operands, of which some may be numbers, as vectors of a kind."""
    return [value if isinstance(kind, _Vector)
            else _filled(builder, vector, context.cast(builder, value, kind, vector.element))
            for kind, value in zip(kinds, values, strict=True)]


# Operators, of vectors of a kind, and of a vector and a number

def _define(function: Any, generate: Callable[..., Any], *, compares: bool = False) -> None:
    """Teach Numba an operator.

    Args:
        function: What the operator stands for.
        generate: From a builder and the operands, vectors, the result.
        compares: Whether the result is a mask; it is what the operands are otherwise.
    """
    def generic(self: Any, arguments: Any, keywords: Any) -> Any:
        vectors = [kind for kind in arguments if isinstance(kind, _Vector)]
        if vectors and all(kind == vectors[0] or isinstance(kind, types.Number) for kind in arguments):
            return signature_of(_Vector(types.boolean, vectors[0].lanes) if compares else vectors[0], *arguments)
        return None

    infer_global(function)(type('Template', (AbstractTemplate,), {'key': function, 'generic': generic}))

    def lower(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        vector = next(kind for kind in signature.args if isinstance(kind, _Vector))
        return generate(builder, *_as_vectors(context, builder, vector, signature.args, arguments))

    for kinds in ((_Vector,), (_Vector, _Vector), (types.Number, _Vector), (_Vector, types.Number)):
        lower_builtin(function, *kinds)(lower)


def _is_float(operand: Any) -> bool:
    return bool(operand.type.element == ir.FloatType())


def _arithmetic(of_floats: str, of_integers: str) -> Callable[[Any, Any, Any], Any]:
    def generate(builder: Any, first: Any, second: Any) -> Any:
        if _is_float(first):
            return getattr(builder, of_floats)(first, second, flags=('contract',))
        return getattr(builder, of_integers)(first, second)

    return generate


def _comparison(sign: str) -> Callable[[Any, Any, Any], Any]:
    def generate(builder: Any, first: Any, second: Any) -> Any:
        return (builder.fcmp_ordered if _is_float(first) else builder.icmp_signed)(sign, first, second)

    return generate


def _of_llvm(name: str) -> Callable[[Any, Any], Any]:
    """A function of LLVM's on vectors of floats."""
    def generate(builder: Any, operand: Any) -> Any:
        full = f'{name}.v{operand.type.count}f32'
        return builder.call(cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(operand.type, [operand.type]), full), [operand])

    return generate


_define(operator.add, _arithmetic('fadd', 'add'))
_define(operator.sub, _arithmetic('fsub', 'sub'))
_define(operator.mul, _arithmetic('fmul', 'mul'))
_define(operator.truediv, lambda builder, first, second: builder.fdiv(first, second, flags=('contract',)))
_define(operator.lt, _comparison('<'), compares=True)
_define(operator.le, _comparison('<='), compares=True)
_define(operator.ge, _comparison('>='), compares=True)
_define(operator.and_, lambda builder, first, second: builder.and_(first, second))
_define(abs, _of_llvm('llvm.fabs'))


# Memory

def load_plain(array: Any, index: int) -> Any:
    """LANES values of a flat float32 array from an index on, as a vector."""
    if not 0 <= index <= array.size - LANES:
        raise IndexError(f'{LANES} values from {index} on are not in an array of {array.size}')
    return array[index:index + LANES].copy()


@intrinsic
def _load(typing: Any, array: Any, index: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_pointer(context, builder, array, arguments[0], arguments[1], _ROWS.llvm), align=4)

    return _ROWS(array, types.intp), generate


def store_plain(array: Any, index: int, vector: Any) -> None:
    """Put a vector into a flat float32 array from an index on."""
    array[index:index + vector.size] = vector


@intrinsic
def _store(typing: Any, array: Any, index: Any, vector: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        target = _pointer(context, builder, array, arguments[0], arguments[1], vector.llvm)
        builder.store(arguments[2], target, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


def pairs_plain(array: Any, index: Any) -> tuple[Any, Any]:
    """Both numbers of pairs that stand anywhere in a flat array, int16 or float32: one vector of each.

    Args:
        array: Of which the pairs begin at even places.
        index: Vector of whole numbers, how many pairs are before each.
    """
    places = 2 * index.astype(np.int64)
    if places.min() < 0:
        raise IndexError(f'pair {index.min()} is before the array')
    return array[places].astype(np.float32), array[places + 1].astype(np.float32)


@intrinsic
def _pairs(typing: Any, array: Any, index: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = array.dtype.bitwidth
        both = ir.Constant(ir.VectorType(ir.IntType(2 * bits), STEPS), ir.Undefined)
        pair = ir.VectorType(both.type.element, 1)
        for lane in range(STEPS):
            # One load each: where processors have an instruction for all at once it is no faster.
            number = ir.Constant(_INT, lane)
            place = builder.sext(builder.extract_element(arguments[1], number), ir.IntType(64))
            first = builder.shl(place, ir.Constant(place.type, 1))
            found = builder.load(_pointer(context, builder, array, arguments[0], first, pair), align=bits // 8)
            both = builder.insert_element(both, builder.extract_element(found, ir.Constant(_INT, 0)), number)
        return context.make_tuple(builder, signature.return_type, _halves(builder, both))

    return types.UniTuple(_FLOATS, 2)(array, index), generate


def _halves(builder: Any, both: Any) -> list[Any]:
    """The lower and the upper halves of whole numbers, as floats: those of pairs in memory, the first one is lower."""
    bits = both.type.element.width // 2
    halves = [builder.trunc(part, ir.VectorType(ir.IntType(bits), STEPS))
              for part in (both, builder.lshr(both, ir.Constant(both.type, [bits] * STEPS)))]
    return [builder.bitcast(half, _FLOATS.llvm) if bits == _INT.width else builder.sitofp(half, _FLOATS.llvm)
            for half in halves]


def fetch_plain(array: Any, index: int) -> None:
    """Ask for an item of an array that will be looked at soon, as it may take a while to come: any index will do."""


@intrinsic
def _fetch(typing: Any, array: Any, index: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        byte = ir.IntType(8).as_pointer()
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [byte, _INT, _INT, _INT]), 'llvm.prefetch.p0')
        data = context.make_array(array)(context, builder, arguments[0]).data
        item = builder.bitcast(builder.gep(data, [arguments[1]]), byte)
        size = context.get_abi_sizeof(context.get_data_type(array.dtype))
        # A large item may begin anywhere in a line, and end in one more.
        for place in [*range(0, size, CACHE_LINE), *([size - 1] if size > CACHE_LINE else [])]:
            # To read, into the first cache, as data.
            builder.call(function, [builder.gep(item, [ir.Constant(_INT, place)]),
                                    *(ir.Constant(_INT, option) for option in (0, 3, 1))])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


# Steps along a line

def every_plain(value: float) -> Any:
    """A number in every lane of a vector of floats."""
    return np.full(STEPS, value, np.float32)


@intrinsic
def _every(typing: Any, value: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _as_vectors(context, builder, _FLOATS, signature.args, arguments)[0]

    return _FLOATS(value), generate


def ramp_plain(first: int) -> Any:
    """Whole numbers that follow each other."""
    return np.arange(first, first + STEPS, dtype=np.int32)


@intrinsic
def _ramp(typing: Any, first: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        filled = _as_vectors(context, builder, _INTEGERS, signature.args, arguments)[0]
        return builder.add(filled, ir.Constant(_INTEGERS.llvm, list(range(STEPS))))

    return _INTEGERS(first), generate


def floats_plain(vector: Any) -> Any:
    """Whole numbers as floats."""
    return vector.astype(np.float32)


@intrinsic
def _floats(typing: Any, vector: Any) -> Any:
    return _FLOATS(vector), lambda _, builder, __, arguments: builder.sitofp(arguments[0], _FLOATS.llvm)


def integers_plain(vector: Any) -> Any:
    """Floats as whole numbers, without what follows the point."""
    return vector.astype(np.int32)


@intrinsic
def _integers(typing: Any, vector: Any) -> Any:
    return _INTEGERS(vector), lambda _, builder, __, arguments: builder.fptosi(arguments[0], _INTEGERS.llvm)


@intrinsic
def _floor(typing: Any, vector: Any) -> Any:
    return vector(vector), lambda _, builder, __, arguments: _of_llvm('llvm.floor')(builder, arguments[0])


def where_plain(mask: Any, vector: Any, other: Any) -> Any:
    """The one or the other, lane by lane; the other may be a number."""
    return np.where(mask, vector, np.asarray(other, vector.dtype))


@intrinsic
def _where(typing: Any, mask: Any, vector: Any, other: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(arguments[0], *_as_vectors(
            context, builder, vector, signature.args[1:], arguments[1:]))

    return vector(mask, vector, other), generate


def total_plain(vector: Any) -> Any:
    """The sum of all lanes, in the same order on every processor: the halves are added, then those of the sum, ..."""
    while vector.size > 1:
        vector = vector[:vector.size // 2] + vector[vector.size // 2:]
    return vector[0]


@intrinsic
def _total(typing: Any, vector: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        rest = arguments[0]
        while rest.type.count > 1:
            half = rest.type.count // 2
            rest = builder.fadd(*(builder.shuffle_vector(rest, rest, ir.Constant(
                ir.VectorType(_INT, half), list(range(first, first + half)))) for first in (0, half)))
        return builder.extract_element(rest, ir.Constant(_INT, 0))

    return types.float32(vector), generate


# Tiles

def transpose_plain(source: Any, start: int, step: int, target: Any, target_start: int, target_step: int) -> None:
    """Transpose a tile of TILE×TILE values from one flat float32 array into another.

    Args:
        source, start, step: Array, index of the tile's first value, and from row to row.
        target, target_start, target_step: The same for the result.
    """
    for row in range(TILE):
        for column in range(TILE):
            target[target_start + column * target_step + row] = source[start + row * step + column]


@intrinsic
def _transpose(
    typing: Any, source: Any, start: Any, step: Any, target: Any, target_start: Any, target_step: Any,
) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def row_pointer(argument: int, row: int) -> Any:
            array, first, stride = arguments[argument:argument + 3]
            index = builder.add(first, builder.mul(stride, ir.Constant(stride.type, row)))
            return _pointer(context, builder, signature.args[argument], array, index, _ROW)

        rows = [builder.load(row_pointer(0, row), align=4) for row in range(TILE)]
        for row, values in enumerate(_transposed(builder, rows)):
            builder.store(values, row_pointer(3, row), align=4)
        return context.get_dummy_value()

    size = types.intp
    return types.void(source, size, size, target, size, size), generate


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """Transpose TILE vectors: for distances 8, 4, 2, 1 exchange the off-diagonal blocks of that size."""
    distance = TILE // 2
    while distance:
        upper = [k if not k & distance else TILE + k - distance for k in range(TILE)]
        lower = [k + distance if not k & distance else TILE + k for k in range(TILE)]
        for i in range(TILE):
            if not i & distance:
                pair = rows[i], rows[i + distance]
                rows[i], rows[i + distance] = (
                    builder.shuffle_vector(*pair, ir.Constant(ir.VectorType(ir.IntType(32), TILE), mask))
                    for mask in (upper, lower))
        distance //= 2
    return rows


load: Any = load_plain if _PLAIN else _load
store: Any = store_plain if _PLAIN else _store
pairs: Any = pairs_plain if _PLAIN else _pairs
fetch: Any = fetch_plain if _PLAIN else _fetch
every: Any = every_plain if _PLAIN else _every
ramp: Any = ramp_plain if _PLAIN else _ramp
floats: Any = floats_plain if _PLAIN else _floats
integers: Any = integers_plain if _PLAIN else _integers
floor: Any = np.floor if _PLAIN else _floor
where: Any = where_plain if _PLAIN else _where
total: Any = total_plain if _PLAIN else _total
transpose: Any = transpose_plain if _PLAIN else _transpose


@inlined
def smaller(vector: Any, other: Any) -> Any:
    """The smaller one, lane by lane; the other may be a number, and stands in for what is none."""
    return where(vector < other, vector, other)


@inlined
def larger(vector: Any, other: Any) -> Any:
    """The larger one, lane by lane; the other may be a number, and stands in for what is none."""
    return where(vector >= other, vector, other)
