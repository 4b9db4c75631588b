"""Asking the processor for memory before it is needed, which numba has no name for."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


def _prefetch(typing_context, array, index):
    """Begin to fetch the cache line of `array[index]`, contiguous and of one dimension, and go on at once.

    A load would hold up the instructions behind it until its line has come.
    """
    signature = types.void(array, types.uint64)

    def generate(context, builder, _, arguments):
        data = context.make_array(array)(context, builder, arguments[0]).data
        place = builder.bitcast(builder.gep(data, [arguments[1]]), cgutils.voidptr_t)
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [place, number(1), number(3), number(1)])  # to write, keep near, data
        return context.get_dummy_value()

    return signature, generate


prefetch: Any = intrinsic(_prefetch)  # (array, index)
