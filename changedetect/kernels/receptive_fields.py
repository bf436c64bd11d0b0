"""
Receptive fields computed from micro-cell moments, and their blending into one surface.

A receptive field (RF) is a weighted local plane about its centre. Its activation is LWPR's bisquare kernel [1]_,
w = (1 - q / 4)**2 for q = |x - c|**2 / h**2 < 4: the same curvature at the centre as exp(-q / 2), but of compact
support, so that an RF touches only the cells within 2 h. RFs of one level stand on a square lattice of spacing
0.8 h anchored at the origin of the CRS; RF (i, j) has its centre at ((j + 1/2), (i + 1/2)) spacings.

References
----------
.. [1] S. Vijayakumar, A. D'Souza, S. Schaal (2005), Incremental online learning in high dimensions,
   Neural Computation 17, 2602-2634.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit, prange

from changedetect.kernels.compilation import FUSED

if TYPE_CHECKING:
    from changedetect.typing import FloatArray

__all__ = [
    "N_FIT",
    "N_PLANE",
    "RIDGE",
    "add_surface",
    "blend_planes",
    "fit_planes",
    "invert_plane",
    "pool_noise",
    "shrink_planes",
    "survey_support",
]

#: Columns of `fit_planes`: 0 value, 1 slope east * h, 2 slope north * h, 3-8 covariance of these (00 01 02 11 12 22),
#: 9 sum of weights, 10 effective number of observations, 11 weighted residual sum, 12 its expectation under the noise
#: variances stated, 13 centroid offset / h, 14 mean time, 15 mean weight of an observation.
N_FIT = 16
#: Rows of a level's planes: 0 value, 1 slope east, 2 slope north, 3 variance of the surface, 4 blending weight,
#: 5 noise variance of one observation, 6 support (1 or 0), 7 mean time, 8 shrinkage factor.
N_PLANE = 9
#: Ridge on slopes, in observations: keeps the plane of collinear cells defined.
RIDGE = 1e-2


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def invert_plane(
    s0: float, s1: float, s2: float, s3: float, s4: float, s5: float
) -> tuple[float, float, float, float, float, float]:
    """Inverse of the normal matrix [[s0, s1, s2], [s1, s3, s4], [s2, s4, s5]] of a plane, as 00 01 02 11 12 22."""
    c00 = s3 * s5 - s4 * s4
    c01 = s2 * s4 - s1 * s5
    c02 = s1 * s4 - s2 * s3
    det = s0 * c00 + s1 * c01 + s2 * c02
    return (
        c00 / det,
        c01 / det,
        c02 / det,
        (s0 * s5 - s2 * s2) / det,
        (s1 * s2 - s0 * s4) / det,
        (s0 * s3 - s1 * s1) / det,
    )


@njit(cache=True, parallel=True, error_model="numpy", fastmath=FUSED)
def fit_planes(
    window: FloatArray,
    cell_size: float,
    row0: int,
    column0: int,
    kernel: float,
    spacing: float,
    first_row: int,
    first_column: int,
    fits: FloatArray,
) -> None:
    """
    Weighted local plane of every receptive field of a lattice block.

    Parameters
    ----------
    window : array, shape (n_rows, n_columns, N_MOMENTS)
        Moments of the cells, covering two kernel sizes around the block; weights are about 1 / noise variance.
    cell_size : float, m
    row0, column0 : int
        First row and column of the window.
    kernel : float, m
        Kernel size h.
    spacing : float, m
        Lattice spacing of the receptive fields.
    first_row, first_column : int
        Lattice indices of fits[0, 0].
    fits : array, shape (n_i, n_j, N_FIT)
        Filled in place; column 9 is 0 where a field has no cell at all.

    Notes
    -----
    With v the weight of an observation, w its activation, A = sum w v xx' and
    y = sum w v x z, beta = A^-1 y and cov(beta) = A^-1 (sum w2 v2 s2 xx') A^-1 with s2 the
    noise variance of each observation (sandwich); the residual sum's expectation is sum w v s2 less the trace of
    A^-1 (sum w2 v2 s2 xx'). The plane inside a cell is exact; the activation is taken at
    the mean position of the cell's observations.
    """
    radius = 2.0 * kernel
    per_h = 1.0 / kernel
    per_h2 = per_h * per_h
    for i in prange(fits.shape[0]):
        y0 = (first_row + i + 0.5) * spacing
        a_low = max(0, int(math.floor((y0 - radius) / cell_size)) - row0)
        a_high = min(window.shape[0] - 1, int(math.floor((y0 + radius) / cell_size)) - row0)
        for j in range(fits.shape[1]):
            x0 = (first_column + j + 0.5) * spacing
            b_low = max(0, int(math.floor((x0 - radius) / cell_size)) - column0)
            b_high = min(window.shape[1] - 1, int(math.floor((x0 + radius) / cell_size)) - column0)
            s0 = s1 = s2 = s3 = s4 = s5 = 0.0
            t0 = t1 = t2 = t3 = t4 = t5 = 0.0
            z0 = z1 = z2 = zz = 0.0
            count = time = p0 = expected = 0.0
            for a in range(a_low, a_high + 1):
                v = (row0 + a + 0.5) * cell_size - y0
                for b in range(b_low, b_high + 1):
                    m = window[a, b]
                    n = m[1]
                    if n <= 0.0:
                        continue
                    u = (column0 + b + 0.5) * cell_size - x0
                    per_n = 1.0 / n
                    du = u + m[2] * per_n
                    dv = v + m[3] * per_n
                    q = (du * du + dv * dv) * per_h2
                    if q >= 4.0:
                        continue
                    w = 1.0 - 0.25 * q
                    w *= w
                    x1 = m[2] + n * u
                    x2 = m[3] + n * v
                    x3 = m[4] + u * (2.0 * m[2] + n * u)
                    x4 = m[5] + u * m[3] + v * m[2] + n * u * v
                    x5 = m[6] + v * (2.0 * m[3] + n * v)
                    s0 += w * n
                    s1 += w * x1
                    s2 += w * x2
                    s3 += w * x3
                    s4 += w * x4
                    s5 += w * x5
                    p0 += w * w * n * n / m[0]
                    # weight times noise variance of this cell's observations: 1 where the weights are right
                    f = n * m[12] / (m[0] * m[0])
                    expected += w * m[0] * f
                    f *= w * w
                    t0 += f * n
                    t1 += f * x1
                    t2 += f * x2
                    t3 += f * x3
                    t4 += f * x4
                    t5 += f * x5
                    z0 += w * m[7]
                    z1 += w * (m[8] + u * m[7])
                    z2 += w * (m[9] + v * m[7])
                    zz += w * m[10]
                    count += w * m[0]
                    time += w * m[11]
            o = fits[i, j]
            o[9] = s0
            if s0 <= 0.0:
                continue
            n_effective = s0 * s0 / p0
            ridge = RIDGE * s0 / n_effective
            s1, s2, s3, s4, s5 = s1 * per_h, s2 * per_h, s3 * per_h2 + ridge, s4 * per_h2, s5 * per_h2 + ridge
            t1, t2, t3, t4, t5 = t1 * per_h, t2 * per_h, t3 * per_h2, t4 * per_h2, t5 * per_h2
            z1, z2 = z1 * per_h, z2 * per_h
            i00, i01, i02, i11, i12, i22 = invert_plane(s0, s1, s2, s3, s4, s5)
            o[0] = i00 * z0 + i01 * z1 + i02 * z2
            o[1] = i01 * z0 + i11 * z1 + i12 * z2
            o[2] = i02 * z0 + i12 * z1 + i22 * z2
            # rows of A^-1 T, then A^-1 T A^-1
            g00 = i00 * t0 + i01 * t1 + i02 * t2
            g01 = i00 * t1 + i01 * t3 + i02 * t4
            g02 = i00 * t2 + i01 * t4 + i02 * t5
            g10 = i01 * t0 + i11 * t1 + i12 * t2
            g11 = i01 * t1 + i11 * t3 + i12 * t4
            g12 = i01 * t2 + i11 * t4 + i12 * t5
            g20 = i02 * t0 + i12 * t1 + i22 * t2
            g21 = i02 * t1 + i12 * t3 + i22 * t4
            g22 = i02 * t2 + i12 * t4 + i22 * t5
            # rounding may take a variance below zero where noise differs by orders of magnitude inside one field
            o[3] = max(g00 * i00 + g01 * i01 + g02 * i02, 1e-3 * t0 / (s0 * s0))
            o[4] = g00 * i01 + g01 * i11 + g02 * i12
            o[5] = g00 * i02 + g01 * i12 + g02 * i22
            o[6] = max(g10 * i01 + g11 * i11 + g12 * i12, 0.0)
            o[7] = g10 * i02 + g11 * i12 + g12 * i22
            o[8] = max(g20 * i02 + g21 * i12 + g22 * i22, 0.0)
            o[10] = n_effective
            o[11] = max(zz - o[0] * z0 - o[1] * z1 - o[2] * z2, 0.0)
            trace = g00 + g11 + g22
            o[12] = max(expected - trace, 0.0)
            o[13] = math.sqrt(s1 * s1 + s2 * s2) / s0
            o[14] = time / s0
            o[15] = s0 / count


@njit(cache=True, error_model="numpy", fastmath=FUSED)
def _posterior_plane(o: FloatArray, t0: float, t1: float) -> tuple[float, float, float, float]:
    """Weight of the value and posterior mean of the plane under a prior of variances t0 (value) and t1 (slopes)."""
    if t0 <= 0.0 and t1 <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    a, b, c, d, e, f = o[3] + t0, o[4], o[5], o[6] + t1, o[7], o[8] + t1
    c00 = d * f - e * e
    c01 = c * e - b * f
    c02 = b * e - c * d
    det = a * c00 + b * c01 + c * c02
    if not det > 0.0:
        return 0.0, 0.0, 0.0, 0.0
    c11 = a * f - c * c
    c12 = b * c - a * e
    c22 = a * d - b * b
    x, y, z = o[0] / det, o[1] / det, o[2] / det
    b0 = t0 * (c00 * x + c01 * y + c02 * z)
    b1 = t1 * (c01 * x + c11 * y + c12 * z)
    b2 = t1 * (c02 * x + c12 * y + c22 * z)
    return t0 * c00 / det, b0, b1, b2


@njit(cache=True, parallel=True, error_model="numpy", fastmath=FUSED)
def shrink_planes(
    fits: FloatArray,
    base: FloatArray,
    prior: FloatArray,
    detail: FloatArray,
    kernel: float,
    n_minimum: float,
    planes: FloatArray,
) -> None:
    """
    Planes of one level: what the coarser levels left over, shrunk.

    Parameters
    ----------
    fits : array, shape (n_i, n_j, N_FIT)
        Local planes of the residuals.
    base : array, shape (2, n_i, n_j)
        Variance of the coarser levels' sum at the centres, and whether it is defined (1 or 0).
    prior : array, shape (2, n_i, n_j), m2
        Variance, over the neighbourhood, of the true values and of the true slopes times kernel of this level's
        planes. Infinite takes a plane as fitted.
    detail : array, shape (n_i, n_j), m2
        Typical variance of what this level adds around there; enters the variance where the data of a field cannot
        tell.
    kernel : float, m
    n_minimum : float
        Effective number of observations a field needs.
    planes : array, shape (N_PLANE, n_i, n_j)
        Filled in place.

    Notes
    -----
    Empirical Bayes: with prior covariance T = diag(t0, t1, t1) and C the noise covariance of the fitted plane beta, the
    posterior mean is T (T + C)^-1 beta: directions that the data determine badly are shrunk most. The coarse estimate
    and this level's share their data, so with s = [T (T + C)^-1]_00, v the variance of the coarse surface and C_00 that
    of the unshrunk fine one the combination has variance (1 - s) v + s C_00; detail that the field cannot see, of prior
    variance t, adds t A / (t + A) (1 - s) with A = C_00 - v.
    """
    for i in prange(fits.shape[0]):
        for j in range(fits.shape[1]):
            o = fits[i, j]
            is_based = base[1, i, j] > 0.0
            is_fitted = o[9] > 0.0 and o[10] >= n_minimum
            v = base[0, i, j] if is_based else 0.0
            s = 0.0
            b0 = b1 = b2 = 0.0
            added = detail[i, j]
            if is_fitted:
                s, b0, b1, b2 = 1.0, o[0], o[1], o[2]
                t0, t1 = prior[0, i, j], prior[1, i, j]
                if is_based and t0 < math.inf:
                    s, b0, b1, b2 = _posterior_plane(o, t0, t1)
                unseen = max(o[3] - v, 0.0)
                t = detail[i, j]
                added = t * unseen / (t + unseen) * (1.0 - s) if t + unseen > 0.0 else 0.0
            planes[8, i, j] = s
            if not is_based and not is_fitted:
                planes[4, i, j] = 0.0
                continue
            planes[0, i, j] = b0
            planes[1, i, j] = b1 / kernel
            planes[2, i, j] = b2 / kernel
            planes[3, i, j] = (1.0 - s) * v + s * o[3] + added
            gamma = detail[i, j] + 1e-8
            if is_fitted:
                d0, d1, d2 = o[0] - b0, o[1] - b1, o[2] - b2
                left = d0 * d0 + 0.25 * (d1 * d1 + d2 * d2)
                gamma = o[11] / max(o[12] * o[15], 0.3 * o[9]) + left + 1e-8
            elif o[9] > 0.0:
                gamma += 10.0 / o[15]
            planes[4, i, j] = 1.0 / gamma


@njit(cache=True, parallel=True, error_model="numpy", fastmath=FUSED)
def blend_planes(
    easting: FloatArray,
    northing: FloatArray,
    planes: FloatArray,
    spacing: float,
    first_row: int,
    first_column: int,
    reach: float,
    disagreement: float,
    blended: FloatArray,
) -> None:
    """
    Surface, slope and variance at scattered places: eq. 1 of the paper with weights w_k / Gamma_k.

    Parameters
    ----------
    easting, northing : array, shape (n,), m
    planes : array, shape (N_PLANE, n_i, n_j)
    spacing : float, m
    first_row, first_column : int
        Lattice indices of planes[:, 0, 0].
    reach : float
        Radius of the blending kernel, lattice spacings.
    disagreement : float
        Share of the weighted variance between the fields' answers that adds to the variance: their smoothing bias.
    blended : array, shape (n, 8)
        Filled in place: value, slope east, slope north, variance, noise variance, support (0 to 1), mean time,
        defined (1 or 0). Slopes are the blended slopes of the fields; the derivative of the blend itself also holds
        that of the weights, which at the rim of the data is large and means nothing. Standard deviations are
        averaged, that is neighbouring fields count as fully correlated.
    """
    k = int(math.ceil(reach))
    radius = reach * spacing
    per_r2 = 1.0 / (radius * radius)
    n_i, n_j = planes.shape[1], planes.shape[2]
    for p in prange(easting.size):
        x, y = easting[p], northing[p]
        i0 = int(math.floor(y / spacing)) - first_row
        j0 = int(math.floor(x / spacing)) - first_column
        w_sum = f_sum = ff_sum = fx = fy = sd = noise = support = time = flat = 0.0
        for i in range(max(0, i0 - k), min(n_i, i0 + k + 1)):
            dy = y - (first_row + i + 0.5) * spacing
            for j in range(max(0, j0 - k), min(n_j, j0 + k + 1)):
                g = planes[4, i, j]
                if not g > 0.0:
                    continue
                dx = x - (first_column + j + 0.5) * spacing
                q = (dx * dx + dy * dy) * per_r2
                if q >= 1.0:
                    continue
                w = (1.0 - q) * (1.0 - q) * g
                f = planes[0, i, j] + planes[1, i, j] * dx + planes[2, i, j] * dy
                w_sum += w
                f_sum += w * f
                ff_sum += w * f * f
                fx += w * planes[1, i, j]
                fy += w * planes[2, i, j]
                sd += w * math.sqrt(planes[3, i, j])
                noise += w * planes[5, i, j]
                # support and time belong to the place, not to the better fit: no Gamma here
                flat += w / g
                support += w / g * planes[6, i, j]
                time += w * planes[7, i, j]
        o = blended[p]
        if not w_sum > 0.0:
            for c in range(8):
                o[c] = 0.0
            continue
        f = f_sum / w_sum
        o[0] = f
        o[1] = fx / w_sum
        o[2] = fy / w_sum
        o[3] = (sd / w_sum) ** 2 + disagreement * max(ff_sum / w_sum - f * f, 0.0)
        o[4] = noise / w_sum
        o[5] = support / flat
        o[6] = time / w_sum
        o[7] = 1.0


@njit(cache=True, parallel=True, error_model="numpy", fastmath=FUSED)
def add_surface(
    easting: FloatArray,
    northing: FloatArray,
    fields: FloatArray,
    spacing: float,
    first_row: int,
    first_column: int,
    reach: float,
    surface: FloatArray,
) -> None:
    """
    Add the surface and its slope at scattered places: what `blend_planes` gives, and nothing else.

    Parameters
    ----------
    easting, northing : array, shape (n,), m
    fields : array, shape (n_i, n_j, 4)
        Blending weight, value, slope east, slope north: the four that are needed, side by side in memory.
    spacing : float, m
    first_row, first_column : int
        Lattice indices of fields[0, 0].
    reach : float
        Radius of the blending kernel, lattice spacings.
    surface : array, shape (n, 3)
        Value, slope east and slope north are added in place; nothing where no field answers.
    """
    radius = reach * spacing
    r2 = radius * radius
    per_r2 = 1.0 / r2
    n_i, n_j = fields.shape[0], fields.shape[1]
    for p in prange(easting.size):
        # from the centre of field (0, 0)
        x = easting[p] - (first_column + 0.5) * spacing
        y = northing[p] - (first_row + 0.5) * spacing
        i_low = max(0, int(math.ceil((y - radius) / spacing)))
        i_high = min(n_i - 1, int(math.floor((y + radius) / spacing)))
        w_sum = f_sum = fx = fy = 0.0
        for i in range(i_low, i_high + 1):
            dy = y - i * spacing
            half = math.sqrt(max(r2 - dy * dy, 0.0))
            j_low = max(0, int(math.ceil((x - half) / spacing)))
            j_high = min(n_j - 1, int(math.floor((x + half) / spacing)))
            for j in range(j_low, j_high + 1):
                o = fields[i, j]
                dx = x - j * spacing
                w = 1.0 - (dx * dx + dy * dy) * per_r2
                w *= w * o[0]
                w_sum += w
                f_sum += w * (o[1] + o[2] * dx + o[3] * dy)
                fx += w * o[2]
                fy += w * o[3]
        if w_sum > 0.0:
            surface[p, 0] += f_sum / w_sum
            surface[p, 1] += fx / w_sum
            surface[p, 2] += fy / w_sum


@njit(cache=True, parallel=True, error_model="numpy", fastmath=FUSED)
def pool_noise(
    fits: FloatArray, row: int, column: int, reach: int, n_minimum: float, fallback: float, pooled: FloatArray
) -> None:
    """
    Variance factor of the observations, insensitive to what the planes cannot follow.

    Parameters
    ----------
    fits : array, shape (n_i, n_j, N_FIT)
    row, column : int
        Place k of the answer lies midway between fields row + 2 k and row + 2 k + 1; columns likewise.
    reach : int
        So many fields on every side take part.
    n_minimum : float
        Effective number of observations a field needs to take part.
    fallback : float
        Answer where fewer than three fields take part.
    pooled : array, shape (m_i, m_j)
        Filled in place: the median of residual sum / degrees of freedom, weighted by degrees of freedom and divided
        by the median of chi-square with nu degrees over nu, (1 - 2 / (9 nu))**3 (Wilson and Hilferty 1931). Edges and
        other ground that bends inside a kernel raise the mean of these ratios, but not their median while they are
        the minority.
    """
    n_i, n_j = fits.shape[0], fits.shape[1]
    side = 2 * reach
    for i in prange(pooled.shape[0]):
        ratio = np.empty(side * side)
        weight = np.empty(side * side)
        for j in range(pooled.shape[1]):
            n = 0
            freedom = 0.0
            for a in range(max(0, row + 2 * i - reach + 1), min(n_i, row + 2 * i + reach + 1)):
                for b in range(max(0, column + 2 * j - reach + 1), min(n_j, column + 2 * j + reach + 1)):
                    o = fits[a, b]
                    if o[9] > 0.0 and o[10] >= n_minimum and o[12] > 0.25 * o[9] / o[15]:
                        # kept in ascending order: a few dozen values at most
                        value = o[11] / o[12]
                        k = n
                        while k > 0 and ratio[k - 1] > value:
                            ratio[k] = ratio[k - 1]
                            weight[k] = weight[k - 1]
                            k -= 1
                        ratio[k] = value
                        # degrees of freedom of the quadratic form, not of the weights: n_eff less the plane's three
                        weight[k] = max(o[10] - 3.0, 1.0)
                        freedom += weight[k]
                        n += 1
            if n < 3:
                pooled[i, j] = fallback
                continue
            below = 0.0
            k = 0
            while k < n - 1 and below + weight[k] < 0.5 * freedom:
                below += weight[k]
                k += 1
            nu = freedom / n
            pooled[i, j] = ratio[k] / (1.0 - 2.0 / (9.0 * nu)) ** 3


@njit(cache=True, parallel=True, error_model="numpy", fastmath=FUSED)
def survey_support(
    window: FloatArray,
    cell_size: float,
    row0: int,
    column0: int,
    kernel: float,
    spacing: float,
    first_row: int,
    first_column: int,
    support: FloatArray,
) -> None:
    """
    What observations surround each receptive field, every one counting the same.

    Parameters
    ----------
    window, cell_size, row0, column0, kernel, spacing, first_row, first_column
        As for `fit_planes`.
    support : array, shape (n_i, n_j, 4)
        Filled in place: effective number of observations, distance of their centroid / kernel, mean time in days,
        mean noise variance of one observation in m2.
    """
    radius = 2.0 * kernel
    per_h2 = 1.0 / (kernel * kernel)
    for i in prange(support.shape[0]):
        y0 = (first_row + i + 0.5) * spacing
        a_low = max(0, int(math.floor((y0 - radius) / cell_size)) - row0)
        a_high = min(window.shape[0] - 1, int(math.floor((y0 + radius) / cell_size)) - row0)
        for j in range(support.shape[1]):
            x0 = (first_column + j + 0.5) * spacing
            b_low = max(0, int(math.floor((x0 - radius) / cell_size)) - column0)
            b_high = min(window.shape[1] - 1, int(math.floor((x0 + radius) / cell_size)) - column0)
            s0 = s1 = s2 = p0 = time = variance = 0.0
            for a in range(a_low, a_high + 1):
                v = (row0 + a + 0.5) * cell_size - y0
                for b in range(b_low, b_high + 1):
                    m = window[a, b]
                    n = m[0]
                    if n <= 0.0:
                        continue
                    du = (column0 + b + 0.5) * cell_size - x0 + m[2] / m[1]
                    dv = v + m[3] / m[1]
                    q = (du * du + dv * dv) * per_h2
                    if q >= 4.0:
                        continue
                    w = 1.0 - 0.25 * q
                    w *= w * n
                    s0 += w
                    s1 += w * du
                    s2 += w * dv
                    p0 += w * w / n
                    time += w * m[11] / m[1]
                    variance += w * m[12] / n
            o = support[i, j]
            o[0] = o[1] = o[2] = o[3] = 0.0
            if s0 > 0.0:
                o[0] = s0 * s0 / p0
                o[1] = math.sqrt(s1 * s1 + s2 * s2) / (s0 * kernel)
                o[2] = time / s0
                o[3] = variance / s0
