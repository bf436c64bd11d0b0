"""Records in memory: aligned to cache lines, and asked for before they are needed. Neither changes a result."""

from __future__ import annotations

from typing import Any

import numba.core
import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

__all__ = ["aligned_records", "prefetch"]

_LINE = 64
# numba's code generation and its configuration carry no types
_cgutils: Any = numba.core.cgutils
_config: Any = numba.core.config


def aligned_records(capacity: int, dtype: np.dtype[np.void]) -> NDArray[np.void]:
    """
    Zeroed records that start on a cache line, so that one costs as few memory accesses as it can.

    Parameters
    ----------
    capacity : int
    dtype : structured dtype

    Returns
    -------
    records : array, shape (capacity,)
    """
    buffer = np.zeros(capacity * dtype.itemsize + _LINE, dtype=np.uint8)
    offset = -buffer.ctypes.data % _LINE
    return buffer[offset : offset + capacity * dtype.itemsize].view(dtype)


def _prefetch_line(_typing_context: Any, records: Any, i: Any, line: Any) -> Any:  # noqa: ARG001
    """
    Ask for one cache line of records[i] without waiting for it.

    Random access to a large array is spent waiting for memory; asking one sample ahead hides that.
    """
    signature = types.void(records, types.intp, types.intp)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array_type = signature.args[0]
        array = context.make_array(array_type)(context, builder, arguments[0])
        element = _cgutils.get_item_pointer(context, builder, array_type, array, [arguments[1]])
        record = builder.bitcast(element, _cgutils.voidptr_t)
        address = builder.gep(record, [builder.mul(arguments[2], _cgutils.intp_t(_LINE))])
        kind = _cgutils.ir.FunctionType(_cgutils.ir.VoidType(), [_cgutils.voidptr_t] + 3 * [_cgutils.int32_t])
        hint = _cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        options = [_cgutils.int32_t(0), _cgutils.int32_t(3), _cgutils.int32_t(1)]  # for reading, all caches, data
        builder.call(hint, [address, *options])
        return context.get_dummy_value()

    return signature, generate


def _no_prefetch(records: NDArray[Any], i: int, line: int) -> None:
    """Do nothing: interpreted code has nothing to hint at."""


prefetch: Any = _no_prefetch if _config.DISABLE_JIT else intrinsic(_prefetch_line)
