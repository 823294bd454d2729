"""Two things that the compiler does not find by itself: a recursion in vector registers, and a transposition in them.

Numba's loops over arrays are vectorised by LLVM where one step does not depend on another. The recursion along a row
does, so many rows are taken at once, one a lane; written as a loop over lanes LLVM keeps the state in memory (0.14
instead of 0.03 ms for 640×480). And rows must be turned into lanes and back, for which a loop moves single floats (0.10
instead of 0.02 ms each way). bench/vectors.py measures both.

Each block is a few LLVM instructions that every processor has. Its plain twin stands beside it; tests hold the one
against the other, and the twin runs under NUMBA_DISABLE_JIT.
"""

from typing import Any

from llvmlite import ir
from numba import config, types
from numba.extending import intrinsic, models, register_model

#: Lanes of a vector: two registers of AVX-512, four of AVX2, eight of NEON or SSE, so that latencies are hidden.
LANES = 32
#: Width and height of the tiles that are transposed.
TILE = 16

_PLAIN = bool(vars(config)['DISABLE_JIT'])
_LANES = ir.VectorType(ir.FloatType(), LANES)
_ROW = ir.VectorType(ir.FloatType(), TILE)


class _Vector(types.Type):
    """The Numba type of a vector of LANES floats."""

    def __init__(self) -> None:
        super().__init__(name=f'Vector{LANES}')


_vector = _Vector()


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, _LANES)


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any, vector: Any) -> Any:
    """LLVM pointer to a vector that begins at an index of a flat float32 array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def load_plain(array: Any, index: int) -> Any:
    """LANES values of a flat float32 array from an index on, as a vector."""
    return array[index:index + LANES].copy()


@intrinsic
def _load(typing: Any, array: Any, index: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.load(_pointer(context, builder, signature.args[0], arguments[0], arguments[1], _LANES), align=4)

    return _vector(array, types.intp), generate


def store_plain(array: Any, index: int, vector: Any) -> None:
    """Put a vector into a flat float32 array from an index on."""
    array[index:index + LANES] = vector


@intrinsic
def _store(typing: Any, array: Any, index: Any, vector: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        target = _pointer(context, builder, signature.args[0], arguments[0], arguments[1], _LANES)
        builder.store(arguments[2], target, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


def multiply_add_plain(factor: Any, vector: Any, summand: Any) -> Any:
    """A number times a vector plus a vector; the processor may round once or twice."""
    return factor * vector + summand


@intrinsic
def _multiply_add(typing: Any, factor: Any, vector: Any, summand: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fadd(_scaled(builder, *arguments[:2]), arguments[2], flags=('contract',))

    return _vector(types.float32, vector, summand), generate


def multiply_plain(factor: Any, vector: Any) -> Any:
    """A number times a vector."""
    return factor * vector


@intrinsic
def _multiply(typing: Any, factor: Any, vector: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _scaled(builder, *arguments)

    return _vector(types.float32, vector), generate


def _scaled(builder: Any, factor: Any, vector: Any) -> Any:
    first = builder.insert_element(ir.Constant(_LANES, ir.Undefined), factor, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    repeated = builder.shuffle_vector(first, ir.Constant(_LANES, ir.Undefined), zeros)
    return builder.fmul(repeated, vector, flags=('contract',))


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
multiply: Any = multiply_plain if _PLAIN else _multiply
multiply_add: Any = multiply_add_plain if _PLAIN else _multiply_add
transpose: Any = transpose_plain if _PLAIN else _transpose
