"""How kernels are compiled."""

from __future__ import annotations

__all__ = ["FUSED"]

#: For njit(fastmath=...): a product and a sum in one rounding where the processor can, a tenth to a quarter faster in
#: sums over cells. Unlike fastmath=True it promises nothing about NaN, which these kernels test for.
FUSED = {"contract"}
