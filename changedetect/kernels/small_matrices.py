"""
Rotations in space and the few operations on small matrices that navigation needs, written out.

For matrices of three to fifteen rows the loops below are faster than calls into a linear-algebra library, and they
compile in a fraction of the time.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = [
    "cholesky_solve",
    "congruence",
    "cross",
    "product",
    "rotation_matrix",
    "rotation_series",
    "rotation_vector",
    "times_vector",
]


@njit(cache=True, error_model="numpy")
def rotation_matrix(v: FloatArray) -> FloatArray:
    """
    Rotation matrix exp([v]x) by Rodrigues' formula.

    Parameters
    ----------
    v : array, shape (3,), rad
        Rotation vector.

    Returns
    -------
    R : array, shape (3, 3)
    """
    return rotation_series(v, 0)


@njit(cache=True, error_model="numpy")
def rotation_series(v: FloatArray, order: int) -> FloatArray:
    """
    Rotation matrix exp([v]x), or its mean along the way.

    Parameters
    ----------
    v : array, shape (3,), rad
    order : int
        0: exp([v]x). 1: the integral of exp(s [v]x) over s from 0 to 1.

    Returns
    -------
    M : array, shape (3, 3)
    """
    angle2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    angle = math.sqrt(angle2)
    if order == 0:
        if angle2 < 1e-6:  # series: the closed form loses digits
            a, b = 1.0 - angle2 / 6.0 + angle2 * angle2 / 120.0, 0.5 - angle2 / 24.0 + angle2 * angle2 / 720.0
        else:
            a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2
    elif angle2 < 1e-4:
        a, b = 0.5 - angle2 / 24.0 + angle2 * angle2 / 720.0, 1.0 / 6.0 - angle2 / 120.0 + angle2 * angle2 / 5040.0
    else:
        a, b = (1.0 - math.cos(angle)) / angle2, (angle - math.sin(angle)) / (angle2 * angle)
    R = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R[i, j] = b * v[i] * v[j]
        R[i, i] += 1.0 - b * angle2
    R[0, 1] -= a * v[2]
    R[1, 0] += a * v[2]
    R[0, 2] += a * v[1]
    R[2, 0] -= a * v[1]
    R[1, 2] -= a * v[0]
    R[2, 1] += a * v[0]
    return R


@njit(cache=True, error_model="numpy")
def rotation_vector(R: FloatArray) -> FloatArray:
    """
    Rotation vector of a rotation matrix, the inverse of `rotation_matrix` for angles up to pi.

    Parameters
    ----------
    R : array, shape (3, 3)

    Returns
    -------
    v : array, shape (3,), rad
    """
    v = np.empty(3)
    v[0], v[1], v[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    sine = 0.5 * math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    cosine = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    if cosine > -0.99:
        factor = 0.5 if sine < 1e-7 else 0.5 * math.atan2(sine, cosine) / sine
        for i in range(3):
            v[i] *= factor
        return v
    # Near half a turn the axis is the largest column of R + R^T - 2 cosine I = 2 (1 - cosine) a a^T.
    k = 0
    for i in range(1, 3):
        if R[i, i] > R[k, k]:
            k = i
    column = np.empty(3)
    for i in range(3):
        column[i] = R[i, k] + R[k, i]
    column[k] -= 2.0 * cosine
    norm = math.sqrt(column[0] ** 2 + column[1] ** 2 + column[2] ** 2)
    sign = 1.0 if column[0] * v[0] + column[1] * v[1] + column[2] * v[2] >= 0.0 else -1.0
    angle = math.atan2(sine, cosine)
    for i in range(3):
        v[i] = sign * angle * column[i] / norm
    return v


@njit(cache=True, error_model="numpy")
def product(A: FloatArray, B: FloatArray) -> FloatArray:
    """Matrix product A B, shape (n, p), of A, shape (n, m), and B, shape (m, p)."""
    n, m, p = A.shape[0], A.shape[1], B.shape[1]
    C = np.zeros((n, p))
    for i in range(n):
        for k in range(m):
            a = A[i, k]
            if a != 0.0:
                for j in range(p):
                    C[i, j] += a * B[k, j]
    return C


@njit(cache=True, error_model="numpy")
def times_vector(A: FloatArray, v: FloatArray) -> FloatArray:
    """Product A v, shape (n,), of A, shape (n, m), and v, shape (m,)."""
    out = np.zeros(A.shape[0])
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            out[i] += A[i, j] * v[j]
    return out


@njit(cache=True, error_model="numpy")
def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Vector product a x b, shape (3,)."""
    out = np.empty(3)
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


@njit(cache=True, error_model="numpy")
def congruence(A: FloatArray, P: FloatArray) -> FloatArray:
    """A P A^T, exactly symmetric, for a symmetric P."""
    C = product(product(A, P), A.T)
    for i in range(C.shape[0]):
        for j in range(i):
            C[i, j] = C[j, i] = 0.5 * (C[i, j] + C[j, i])
    return C


@njit(cache=True, error_model="numpy")
def cholesky_solve(A: FloatArray, B: FloatArray) -> FloatArray:
    """
    Solve A X = B for a symmetric positive definite A, scaled to unit diagonal first.

    Variances of a navigation state span twelve orders of magnitude; their correlations do not.

    Parameters
    ----------
    A : array, shape (n, n)
    B : array, shape (n, p)

    Returns
    -------
    X : array, shape (n, p)
        NaN where A is not positive definite.
    """
    n, p = B.shape
    L, X, scale = np.zeros((n, n)), np.empty((n, p)), np.empty(n)
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(A[i, i])
    for j in range(n):
        for i in range(j, n):
            total = A[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(total) if i == j else total / L[j, j]
    for c in range(p):
        for i in range(n):
            total = B[i, c] * scale[i]
            for k in range(i):
                total -= L[i, k] * X[k, c]
            X[i, c] = total / L[i, i]
        for i in range(n - 1, -1, -1):
            total = X[i, c]
            for k in range(i + 1, n):
                total -= L[k, i] * X[k, c]
            X[i, c] = total / L[i, i]
    for i in range(n):
        for c in range(p):
            X[i, c] *= scale[i]
    return X
