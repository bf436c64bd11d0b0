"""Ground and what stands on it: fractal and analytic relief, trees, scarps, channels, dunes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from changedetect.synthetic.surfaces import PlaneWaves, Surface

if TYPE_CHECKING:
    from changedetect.typing import BoolArray, FloatArray, Region

__all__ = [
    "Channel",
    "DuneCrests",
    "Scarp",
    "Trees",
    "across_and_along",
    "analytic_ground",
    "correlated_field",
    "fractal_ground",
    "random_trees",
    "smoothstep",
]


def smoothstep(position: FloatArray) -> FloatArray:
    """
    Smooth rise from 0 at `position` <= 0 to 1 at `position` >= 1, with zero slope at both ends: 3 t^2 - 2 t^3.

    Examples
    --------
    >>> smoothstep(np.array([-1.0, 0.5, 2.0]))
    array([0. , 0.5, 1. ])
    """
    t = np.clip(position, 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def across_and_along(
    easting: FloatArray, northing: FloatArray, point: tuple[float, float], azimuth_deg: float
) -> tuple[FloatArray, FloatArray]:
    """
    Distances of points from a line and along it.

    Parameters
    ----------
    easting, northing : array, shape (n,), m
    point : (easting, northing), m
        Where the line starts.
    azimuth_deg : float, degrees
        Direction of the line, clockwise from north.

    Returns
    -------
    across : array, shape (n,), m
        Positive to the right of the line, seen along it.
    along : array, shape (n,), m
    """
    azimuth = np.radians(azimuth_deg)
    east, north = easting - point[0], northing - point[1]
    return east * np.cos(azimuth) - north * np.sin(azimuth), east * np.sin(azimuth) + north * np.cos(azimuth)


def fractal_ground(
    region: Region,
    rng: np.random.Generator,
    *,
    relief_std: float = 2.5,
    roughness: float = 1.0,
    shortest: float = 2.0,
    longest: float | None = None,
    n_waves: int = 240,
) -> PlaneWaves:
    """
    Self-affine ground: waves of all directions whose height grows as wavelength ** `roughness`.

    Parameters
    ----------
    region : (west, east, south, north), m
        Sets the origin and, by default, the longest wave; the ground itself is defined everywhere.
    rng : numpy.random.Generator
    relief_std : float, m
        Standard deviation of the ground over many realisations.
    roughness : float
        Hurst exponent H, 0 (jagged) to 1 (smooth). The spectrum in two dimensions falls as wavenumber ** -(2 H + 2).
    shortest, longest : float, m
        Wavelengths; `longest` is 1.5 times the longer side of the region by default.
    n_waves : int

    Returns
    -------
    ground : PlaneWaves

    Notes
    -----
    Wavelengths are stratified in their logarithm, so each octave has as many waves; the variance of an octave of a
    self-affine surface is proportional to wavelength ** (2 H) [1]_.

    References
    ----------
    .. [1] Turcotte, D. L. (1997), Fractals and Chaos in Geology and Geophysics, chapter 7,
       doi:10.1017/CBO9781139174695.
    """
    west, east, south, north = region
    if longest is None:
        longest = 1.5 * max(east - west, north - south)
    if not 0 < shortest < longest:
        msg = f"Wavelengths must satisfy 0 < shortest < longest; got {shortest!r} and {longest!r} m."
        raise ValueError(msg)
    stratum = (np.arange(n_waves) + rng.uniform(0.0, 1.0, n_waves)) / n_waves
    wavelength = shortest * (longest / shortest) ** stratum
    direction = rng.uniform(0.0, 2.0 * np.pi, n_waves)
    amplitude = wavelength**roughness
    amplitude *= relief_std / np.sqrt(0.5 * np.sum(amplitude**2))
    return PlaneWaves(
        origin=(0.5 * (west + east), 0.5 * (south + north)),
        amplitude=amplitude,
        wavenumber_east=2.0 * np.pi / wavelength * np.cos(direction),
        wavenumber_north=2.0 * np.pi / wavelength * np.sin(direction),
        phase=rng.uniform(0.0, 2.0 * np.pi, n_waves),
    )


def correlated_field(
    region: Region, rng: np.random.Generator, *, std: float, correlation_length: float, n_waves: int = 300
) -> PlaneWaves:
    """
    Stationary Gaussian random field with covariance std^2 exp(-h^2 / (2 correlation_length^2)).

    Parameters
    ----------
    region : (west, east, south, north), m
        Sets the origin only.
    rng : numpy.random.Generator
    std : float, m
        Standard deviation over many realisations.
    correlation_length : float, m
    n_waves : int

    Notes
    -----
    Random spectral representation [1]_: wavenumbers drawn from the spectrum, which for this covariance is normal
    with standard deviation 1 / correlation_length in each direction, and uniform phases.

    References
    ----------
    .. [1] Shinozuka, M. & Deodatis, G. (1991), Simulation of stochastic processes by spectral representation,
       doi:10.1115/1.3119501.
    """
    if std < 0 or correlation_length <= 0:
        msg = f"A field needs std >= 0 and correlation_length > 0; got {std!r} and {correlation_length!r} m."
        raise ValueError(msg)
    west, east, south, north = region
    return PlaneWaves(
        origin=(0.5 * (west + east), 0.5 * (south + north)),
        amplitude=np.full(n_waves, std * np.sqrt(2.0 / n_waves)),
        wavenumber_east=rng.normal(0.0, 1.0 / correlation_length, n_waves),
        wavenumber_north=rng.normal(0.0, 1.0 / correlation_length, n_waves),
        phase=rng.uniform(0.0, 2.0 * np.pi, n_waves),
    )


def analytic_ground(region: Region, rng: np.random.Generator, *, relief: float = 8.0) -> PlaneWaves:
    """
    Rolling ground of three scales: hills as long as the region, swells of a quarter of it, hummocks of 5-7 m.

    Parameters
    ----------
    region : (west, east, south, north), m
    rng : numpy.random.Generator
        Draws wavelengths within 20 %, directions and phases.
    relief : float, m
        Amplitude of the hills; swells have 0.2 and hummocks 0.03 of it.
    """
    west, east, south, north = region
    side = max(east - west, north - south)
    wavelength = np.array([0.9 * side, 0.7 * side, 0.23 * side, 6.0, 5.3]) * rng.uniform(0.8, 1.2, 5)
    direction = rng.uniform(0.0, 2.0 * np.pi, 5)
    return PlaneWaves(
        origin=(0.5 * (west + east), 0.5 * (south + north)),
        amplitude=relief * np.array([0.6, 0.6, 0.2, 0.02, 0.02]),
        wavenumber_east=2.0 * np.pi / wavelength * np.cos(direction),
        wavenumber_north=2.0 * np.pi / wavelength * np.sin(direction),
        phase=rng.uniform(0.0, 2.0 * np.pi, 5),
    )


@dataclass(frozen=True, eq=False)
class Trees(Surface):
    """
    Crowns as spherical caps on steep rims, to be added to a ground; where crowns overlap the highest counts.

    Attributes
    ----------
    easting, northing : array, shape (n_trees,), m
    height : array, shape (n_trees,), m
        Of the top above the ground.
    radius : array, shape (n_trees,), m
        Of the crown.
    rim_share : float, 0 to 1
        Height of the crown's vertical edge as a part of `height`; the cap covers the rest.
    """

    easting: FloatArray
    northing: FloatArray
    height: FloatArray
    radius: FloatArray
    rim_share: float

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at points."""
        canopy = np.zeros(easting.shape)
        for east, north, height, radius in zip(self.easting, self.northing, self.height, self.radius, strict=True):
            near = np.flatnonzero((np.abs(easting - east) < radius) & (np.abs(northing - north) < radius))
            distance2 = (easting[near] - east) ** 2 + (northing[near] - north) ** 2
            crown = near[distance2 < radius**2]
            share = _cap(distance2[distance2 < radius**2] / radius**2, height * (1.0 - self.rim_share) / radius)
            cap = height * (self.rim_share + (1.0 - self.rim_share) * share)
            canopy[crown] = np.maximum(canopy[crown], cap)
        return canopy

    def covers(self, easting: FloatArray, northing: FloatArray) -> BoolArray:
        """Whether points lie under a crown, shape (n,)."""
        return np.asarray(self(easting, northing) > 0.0)


def _cap(relative_distance2: FloatArray, aspect: float) -> FloatArray:
    """
    Height of a spherical cap as a part of its greatest height, at squared distances in units of its radius.

    `aspect` is greatest height / radius; a cap higher than a half sphere does not exist over its own outline, so
    beyond 1 it is a half sphere stretched upwards.
    """
    a = min(max(aspect, 1e-6), 1.0)
    sphere = (1.0 + a * a) / (2.0 * a)
    return np.asarray((np.sqrt(np.maximum(sphere**2 - relative_distance2, 0.0)) - (sphere - a)) / a)


def random_trees(
    region: Region,
    rng: np.random.Generator,
    *,
    n_trees: int = 14,
    height: tuple[float, float] = (4.0, 12.0),
    radius: tuple[float, float] = (1.5, 4.0),
    rim_share: float = 0.1,
) -> Trees:
    """
    Trees placed at random, crowns wholly inside `region`.

    Parameters
    ----------
    region : (west, east, south, north), m
    rng : numpy.random.Generator
    n_trees : int
    height, radius : (lowest, highest), m
        Uniform ranges.
    rim_share : float
        See `Trees`.
    """
    west, east, south, north = region
    heights, radii = rng.uniform(*height, n_trees), rng.uniform(*radius, n_trees)
    return Trees(
        easting=west + radii + rng.uniform(0.0, 1.0, n_trees) * (east - west - 2.0 * radii),
        northing=south + radii + rng.uniform(0.0, 1.0, n_trees) * (north - south - 2.0 * radii),
        height=heights,
        radius=radii,
        rim_share=rim_share,
    )


@dataclass(frozen=True)
class Scarp(Surface):
    """
    A straight step: 0 left of a line, `height` beyond `width` metres right of it; width 0 is a cliff.

    Attributes
    ----------
    point : (easting, northing), m
        On the foot of the step.
    azimuth_deg : float, degrees
        Direction of the line, clockwise from north.
    height : float, m
    width : float, m
        Horizontal length of the face.
    """

    point: tuple[float, float]
    azimuth_deg: float
    height: float
    width: float = 0.0

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at points."""
        across, _ = across_and_along(easting, northing, self.point, self.azimuth_deg)
        if self.width == 0.0:
            return np.where(across > 0.0, self.height, 0.0)
        return self.height * smoothstep(across / self.width)

    def retreated(self, distance: float) -> Scarp:
        """Return the same scarp after erosion moved its face back by `distance` m."""
        azimuth = np.radians(self.azimuth_deg)
        east = self.point[0] + distance * float(np.cos(azimuth))
        north = self.point[1] - distance * float(np.sin(azimuth))
        return Scarp((east, north), self.azimuth_deg, self.height, self.width)


@dataclass(frozen=True)
class Channel(Surface):
    """
    A meandering channel cut into the ground.

    Attributes
    ----------
    point : (easting, northing), m
        On the centre line.
    azimuth_deg : float, degrees
        Mean direction, clockwise from north.
    depth : float, m
    half_width : float, m
        Of the flat bed.
    bank_width : float, m
        Of each bank, from bed to bank top.
    meander_amplitude, meander_wavelength : float, m
        The centre line swings by the amplitude to both sides.
    """

    point: tuple[float, float]
    azimuth_deg: float
    depth: float
    half_width: float
    bank_width: float
    meander_amplitude: float = 0.0
    meander_wavelength: float = 40.0

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at points; negative in the channel."""
        across, along = across_and_along(easting, northing, self.point, self.azimuth_deg)
        centre = self.meander_amplitude * np.sin(2.0 * np.pi * along / self.meander_wavelength)
        from_bed = np.abs(across - centre) - self.half_width
        return np.asarray(self.depth * (smoothstep(from_bed / self.bank_width) - 1.0))


@dataclass(frozen=True)
class DuneCrests(Surface):
    """
    Parallel dunes with sharp, wandering crests: long slopes to windward, short ones in the lee.

    Attributes
    ----------
    point : (easting, northing), m
        In a trough.
    azimuth_deg : float, degrees
        Direction of the crests, clockwise from north; the wind blows across them, to the right.
    wavelength : float, m
        From crest to crest.
    height : float, m
        From trough to crest.
    lee_share : float, between 0 and 1
        Part of the wavelength that the lee side takes.
    wander, wander_wavelength : float, m
        The crests swing by `wander` to both sides.
    """

    point: tuple[float, float]
    azimuth_deg: float
    wavelength: float
    height: float
    lee_share: float = 0.25
    wander: float = 0.0
    wander_wavelength: float = 60.0

    def __call__(self, easting: FloatArray, northing: FloatArray) -> FloatArray:
        """Evaluate at points; 0 in the troughs."""
        across, along = across_and_along(easting, northing, self.point, self.azimuth_deg)
        across = across - self.wander * np.sin(2.0 * np.pi * along / self.wander_wavelength)
        phase = np.mod(across / self.wavelength, 1.0)
        crest = 1.0 - self.lee_share
        rise = np.where(phase < crest, phase / crest, (1.0 - phase) / self.lee_share)
        return np.asarray(self.height * rise**1.5)
