"""Vectors of numbers in code that numba compiles: an instruction works on many paths.

Paths are simulated in *blocks*, side by side: an array has rows of `BLOCK` numbers, one for each
path. A vector has those of `LANES` paths, and is a variable that the compiler keeps in registers.
Operators work on each number, and a single number that meets a vector is one of its type.
"""

import operator

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel.models import PrimitiveModel
from numba.core.typing import signature
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import intrinsic, lower_builtin, lower_cast, register_model

LANES = 16  # numbers of a vector: a register with AVX-512, several elsewhere
BLOCK = 64  # paths side by side: enough independent work to hide the latency of a step

OPERATORS = ("add", "sub", "mul", "and_", "or_", "xor", "lshift", "rshift")


class Vector(types.Type):
    """`LANES` numbers of a type."""

    def __init__(self, dtype: types.Number):
        self.dtype = dtype
        super().__init__(name=f"Vector({dtype})")


@register_model(Vector)
class VectorModel(PrimitiveModel):
    """A vector is one of LLVM's."""

    def __init__(self, manager, kind):
        super().__init__(manager, kind, ir.VectorType(manager[kind.dtype].get_value_type(), LANES))


@lower_cast(types.Number, Vector)
def filled(context, builder, number, vector, value):
    """Return code for a vector of one number."""
    value, kind = context.cast(builder, value, number, vector.dtype), context.get_value_type(vector)
    undefined, places = ir.Constant(kind, ir.Undefined), ir.VectorType(ir.IntType(32), LANES)
    first = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(places, 0))


@lower_cast(Vector, Vector)
def converted_numbers(context, builder, given, wanted, value):
    """Return code for the numbers as floats of another type; integers are signed."""
    name = "fpext" if wanted.dtype.bitwidth > given.dtype.bitwidth else "fptrunc"
    name = "sitofp" if isinstance(given.dtype, types.Integer) else name
    return getattr(builder, name)(value, context.get_value_type(wanted))


def _define(name):
    operation = getattr(operator, name)

    @infer_global(operation)
    class _Typed(AbstractTemplate):
        def generic(self, arguments, keywords):
            vectors = [kind for kind in arguments if isinstance(kind, Vector)]
            return signature(vectors[0], *vectors[:1] * 2) if vectors else None

    @lower_builtin(operation, Vector, Vector)
    def _lowered(context, builder, signature, arguments):
        kind = signature.return_type.dtype
        shifts = {"lshift": "shl", "rshift": "ashr" if kind in types.signed_domain else "lshr"}
        prefix = "f" if isinstance(kind, types.Float) else ""
        return getattr(builder, prefix + shifts.get(name, name))(*arguments)


for _name in OPERATORS:
    _define(_name)


def call(builder, name, *arguments):
    """Return code that calls a function of LLVM, of numbers or vectors of one type."""
    kind = arguments[0].type
    of_vectors = isinstance(kind, ir.VectorType)
    suffix = f"v{LANES}{kind.element.intrinsic_name}" if of_vectors else kind.intrinsic_name
    function = ir.FunctionType(kind, [kind] * len(arguments))
    name = f"llvm.{name}.{suffix}"
    return builder.call(cgutils.get_or_insert_function(builder.module, function, name), arguments)


@intrinsic
def fma(typingctx, a, b, c):
    """`a * b + c`, rounded once, in the precision of a vector among them, or else of `a`."""
    kind = next((each for each in (a, b, c) if isinstance(each, Vector)), a)

    def codegen(context, builder, signature, arguments):
        given = zip(arguments, signature.args, strict=True)
        return call(builder, "fma", *(context.cast(builder, x, of, kind) for x, of in given))

    return kind(a, b, c), codegen


@intrinsic
def is_set(typingctx, flag):
    """Whether the first byte of an array is not zero; another thread may change it at any time."""

    def codegen(context, builder, signature, arguments):
        data = context.make_array(flag)(context, builder, arguments[0]).data
        byte = builder.load_atomic(data, "monotonic", align=1)  # a plain load is made only once
        return builder.icmp_unsigned("!=", byte, ir.Constant(byte.type, 0))

    return types.boolean(flag), codegen


@intrinsic
def root(typingctx, x):
    """The square root of a vector."""
    return x(x), lambda context, builder, signature, arguments: call(builder, "sqrt", *arguments)


@intrinsic
def polynomial(typingctx, x, coefficients):
    """A polynomial of a vector, with the coefficients of ascending powers."""

    def codegen(context, builder, signature, arguments):
        given = zip(cgutils.unpack_tuple(builder, arguments[1]), coefficients, strict=True)
        *rest, total = (context.cast(builder, value, kind, x) for value, kind in given)
        for coefficient in reversed(rest):
            total = call(builder, "fma", total, arguments[0], coefficient)
        return total

    return x(x, coefficients), codegen


@intrinsic
def view(typingctx, x, dtype):
    """The bits of a vector as another type, of the same size."""
    kind = Vector(dtype.instance_type)

    def codegen(context, builder, signature, arguments):
        return builder.bitcast(arguments[0], context.get_value_type(kind))

    return kind(x, dtype), codegen


@intrinsic
def converted(typingctx, x, dtype):
    """The numbers of a vector as floats of another type; integers are signed."""
    kind = Vector(dtype.instance_type)

    def codegen(context, builder, signature, arguments):
        return context.cast(builder, arguments[0], x, kind)

    return kind(x, dtype), codegen


def _places(context, builder, kinds, arguments, rows):
    """Return pointers to vectors of rows."""
    array, start = arguments[:2]
    start = context.cast(builder, start, kinds[1], types.intp)
    kind = context.get_value_type(Vector(kinds[0].dtype)).as_pointer()
    data = context.make_array(kinds[0])(context, builder, array).data
    indices = (builder.add(start, ir.Constant(start.type, row * BLOCK)) for row in range(rows))
    return [builder.bitcast(builder.gep(data, [index]), kind) for index in indices]


@intrinsic
def load(typingctx, array, start, rows):
    """A tuple of the vectors that begin at `start` and in the rows below, like that of `rows`."""
    stored, kind = Vector(array.dtype), types.UniTuple(Vector(rows.dtype), len(rows))

    def codegen(context, builder, signature, arguments):
        places = _places(context, builder, signature.args, arguments, len(rows))
        align = array.dtype.bitwidth // 8
        vectors = (builder.load(place, align=align) for place in places)
        vectors = [context.cast(builder, each, stored, kind.dtype) for each in vectors]
        return context.make_tuple(builder, kind, vectors)

    return kind(array, start, rows), codegen


@intrinsic
def store(typingctx, array, start, vectors):
    """Write vectors to where `load` reads them."""
    stored = Vector(array.dtype)

    def codegen(context, builder, signature, arguments):
        places = _places(context, builder, signature.args, arguments, len(vectors))
        given = cgutils.unpack_tuple(builder, arguments[2])
        for place, vector, kind in zip(places, given, vectors, strict=True):
            vector = context.cast(builder, vector, kind, stored)
            builder.store(vector, place, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, start, vectors), codegen


@intrinsic
def add_product(typingctx, matrices, start, inputs, vectors):
    """Add to each of the vectors a row of a matrix, which begins at `start`, times the inputs.

    This is done in the precision of the matrix.
    """
    kind = Vector(matrices.dtype)

    def codegen(context, builder, signature, arguments):
        start = context.cast(builder, arguments[1], signature.args[1], types.intp)
        data = context.make_array(matrices)(context, builder, arguments[0]).data
        factors, totals = (
            [
                context.cast(builder, value, of, kind)
                for value, of in zip(cgutils.unpack_tuple(builder, values), kinds, strict=True)
            ]
            for values, kinds in zip(arguments[2:], (inputs, vectors), strict=True)
        )
        for i, j in np.ndindex(len(totals), len(factors)):
            index = builder.add(start, ir.Constant(start.type, i * len(factors) + j))
            number = builder.load(builder.gep(data, [index]))
            number = filled(context, builder, matrices.dtype, kind, number)
            totals[i] = call(builder, "fma", number, factors[j], totals[i])
        return context.make_tuple(builder, types.UniTuple(kind, len(totals)), totals)

    return types.UniTuple(kind, len(vectors))(matrices, start, inputs, vectors), codegen
