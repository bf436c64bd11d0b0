"""
Ground that can be photographed: heights and brightness on grids, with changes from epoch to epoch.

Everything is drawn from a seed: fractal relief, boulders, houses and trees, ground with detail from centimetres to
metres, and in each later epoch a mound of fresh ground, a pit and a low plateau that keep their look, as ground that
sinks or heaves does, and a decoy that is painted only. The sun moves, and part of the ground looks different.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfftfreq
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates, maximum_filter

from changedetect.typing import BoolArray, FloatArray, IntArray

__all__ = ["CELL", "FlightChange", "FlightScene", "draw_scene", "scene_nodes"]

#: Node distance of heights, m.
CELL = 0.25
#: Brightness of level ground in the mean, and its standard deviation, of 255.
_BRIGHTNESS, _CONTRAST = 115.0, 38.0
#: Share of light that comes from the whole sky.
_SKY = 0.45
_SUN_ELEVATION = np.radians(48.0)
#: Photos of each flight that see a change at least.
_VIEWS = 4
#: Changes that look new; the others carry the ground they had up or down.
_FRESH = ("mound", "paint")
#: Radii of the largest change that are tried, m.
_RADII = (6.0, 5.0, 4.0, 3.0)


@dataclass(frozen=True)
class FlightChange:
    """
    Something that is new from the second epoch on.

    Attributes
    ----------
    kind : {"mound", "pit", "plateau", "paint"}
    east, north : float, m
        Middle, in the local frame.
    radius : float, m
    height : float, m
        At most, negative for a pit, zero for paint; in the second epoch.
    """

    kind: str
    east: float
    north: float
    radius: float
    height: float

    def rise(self, east: FloatArray, north: FloatArray) -> FloatArray:
        """Change of height, m: a cosine bell, or level to 0.8 of the radius for a plateau."""
        distance = np.hypot(east - self.east, north - self.north) / self.radius
        if self.kind == "plateau":
            distance = (distance - 0.8) / 0.2
        return self.height * (0.5 + 0.5 * np.cos(np.pi * np.clip(distance, 0.0, 1.0)))

    def is_inside(self, east: FloatArray, north: FloatArray) -> BoolArray:
        """Whether places lie within its radius."""
        return np.asarray(np.hypot(east - self.east, north - self.north) < self.radius)


@dataclass(frozen=True)
class FlightScene:
    """
    A site, square grids about the origin of its local frame, row 0 in the south.

    Attributes
    ----------
    half_east, half_north : float, m
        The grids reach from minus to plus this.
    texture_cell : float, m
    ground : array, shape (n_north, n_east), m
        Heights without objects, nodes every `CELL`.
    objects : array of the same shape, m
        Height of boulders, houses and trees above it.
    texture : array, shape (m_north, m_east)
        Reflectance, mean 1.
    views : array, shape of `ground`, int64
        Photos that see each node in the flight that sees it least.
    seed : int
        Of what later epochs draw.
    changes : tuple of FlightChange
    """

    half_east: float
    half_north: float
    texture_cell: float
    ground: FloatArray
    objects: FloatArray
    texture: FloatArray
    views: IntArray
    seed: int
    changes: tuple[FlightChange, ...]

    def nodes(self, cell: float) -> tuple[FloatArray, FloatArray]:
        """Coordinates of all nodes of a grid, each of its shape, m."""
        return scene_nodes(self.half_east, self.half_north, cell)

    @cached_property
    def near_object(self) -> BoolArray:
        """Where something stands within 0.75 m, nodes of `ground`."""
        return np.asarray(maximum_filter(np.abs(self.objects) > 0.05, size=int(2 * 0.75 / CELL) + 1), dtype=np.bool_)

    def growth(self, epoch: int) -> float:
        """Share of the changes that is there in an epoch, numbered from 0: none, all, and half more each time."""
        return 0.0 if epoch == 0 else 0.5 + 0.5 * epoch

    def change(self, epoch: int) -> FloatArray:
        """Height gained since the first epoch, nodes of `ground`, m."""
        east, north = self.nodes(CELL)
        total = np.zeros_like(self.ground)
        for change in self.changes:
            total += change.rise(east, north)
        return self.growth(epoch) * total

    def surface(self, epoch: int) -> FloatArray:
        """Heights with objects and changes, nodes of `ground`, m."""
        return self.ground + self.objects + self.change(epoch)

    def brightness(self, epoch: int, *, texture_change: float = 0.15) -> FloatArray:
        """
        What the ground looks like from above under the sun of an epoch, nodes every `texture_cell`, 0 to 255.

        Parameters
        ----------
        epoch : int
        texture_change : float
            Share of the detail that is new in each epoch after the first.
        """
        rng = np.random.default_rng([self.seed, 7, epoch])
        reflectance = self.texture
        if epoch:
            east, north = self.nodes(self.texture_cell)
            fresh = _detail(self.texture.shape, self.texture_cell, rng)
            keep = np.sqrt(1.0 - texture_change**2)
            reflectance = 1.0 + keep * (reflectance - 1.0) + texture_change * (fresh - 1.0)
            for change in self.changes:
                if change.kind not in _FRESH:
                    continue
                distance = np.hypot(east - change.east, north - change.north) / change.radius
                share = np.clip((1.0 - distance) / 0.15, 0.0, 1.0)
                reflectance = (1 - share) * reflectance + share * (0.15 + fresh)
        azimuth = np.radians(60.0) + rng.uniform(-0.6, 0.6)
        light = self._light(epoch, azimuth)
        scale = self.texture_cell / CELL
        rows, columns = (np.arange(n) * scale for n in reflectance.shape)
        at = np.meshgrid(rows, columns, indexing="ij")
        shaded = map_coordinates(light, at, order=1, mode="nearest")
        return np.asarray(np.clip(_BRIGHTNESS * shaded * np.maximum(reflectance, 0.05), 0.0, 255.0))

    def _light(self, epoch: int, azimuth: float) -> FloatArray:
        """Lambert's law on the surface, 1 on level ground."""
        slope_north, slope_east = np.gradient(self.surface(epoch), CELL)
        sun = np.array(
            [np.sin(azimuth) * np.cos(_SUN_ELEVATION), np.cos(azimuth) * np.cos(_SUN_ELEVATION), np.sin(_SUN_ELEVATION)]
        )
        cosine = (sun[2] - slope_east * sun[0] - slope_north * sun[1]) / np.sqrt(1 + slope_east**2 + slope_north**2)
        return np.asarray(_SKY + (1 - _SKY) * np.maximum(cosine, 0.0) / sun[2])


def scene_nodes(half_east: float, half_north: float, cell: float) -> tuple[FloatArray, FloatArray]:
    """East and north of all nodes of a grid about the origin, each of its shape, m."""
    north, east = np.meshgrid(
        np.arange(_count(half_north, cell)) * cell - half_north,
        np.arange(_count(half_east, cell)) * cell - half_east,
        indexing="ij",
    )
    return east, north


def draw_scene(
    half_east: float,
    half_north: float,
    views: IntArray,
    texture_cell: float,
    *,
    seed: int = 0,
    n_houses: int = 1,
    n_trees: int = 3,
    relief_std: float = 1.8,
) -> FlightScene:
    """
    Draw a site.

    Parameters
    ----------
    half_east, half_north : float, m
        Ground on all sides of the origin.
    views : array, shape (n_north, n_east), int64
        Photos that see each of `scene_nodes` in the flight that sees it least: changes lie where there are four.
    texture_cell : float, m
    seed : int
    n_houses, n_trees : int
    relief_std : float, m

    Returns
    -------
    scene : FlightScene

    Raises
    ------
    ValueError
        There is no room for the changes.
    """
    rng = np.random.default_rng(seed)
    shape = _count(half_north, CELL), _count(half_east, CELL)
    ground = relief_std * _spectral(shape, CELL, rng, exponent=2.0, shortest=3.0, longest=120.0)
    changes = _draw_changes(views >= _VIEWS, scene_nodes(half_east, half_north, CELL), rng)
    objects = _draw_objects(shape, (half_east, half_north), changes, (n_houses, n_trees), rng)
    texture = _detail((_count(half_north, texture_cell), _count(half_east, texture_cell)), texture_cell, rng)
    return FlightScene(half_east, half_north, texture_cell, ground, objects, texture, views, seed, changes)


def _count(half: float, cell: float) -> int:
    return round(2 * half / cell) + 1


def _spectral(
    shape: tuple[int, int], cell: float, rng: np.random.Generator, *, exponent: float, shortest: float, longest: float
) -> FloatArray:
    """Gaussian field of mean 0 and standard deviation 1 whose amplitudes fall with wavenumber to `exponent`."""
    n = [next_fast_len(int(1.1 * size)) for size in shape]  # a border, else opposite rims would be alike
    ky, kx = np.fft.fftfreq(n[0], cell)[:, None], rfftfreq(n[1], cell)[None, :]
    wavenumber = np.hypot(ky, kx)
    inside = (wavenumber > 1 / longest) & (wavenumber < 1 / shortest)
    amplitude = np.where(inside, np.maximum(wavenumber, 1e-9) ** -exponent, 0.0)
    noise = np.exp(2j * np.pi * rng.random(amplitude.shape))
    field = irfft2(amplitude * noise, s=n)[: shape[0], : shape[1]]
    return np.asarray((field - field.mean()) / field.std())


def _detail(shape: tuple[int, int], cell: float, rng: np.random.Generator) -> FloatArray:
    """Reflectance of natural ground, mean 1: spectrum of images of nature (1 / f), and sharp-edged spots."""
    smooth = _spectral(shape, cell, rng, exponent=1.0, shortest=2 * cell, longest=15.0)
    spots = _spectral(shape, cell, rng, exponent=1.0, shortest=8 * cell, longest=6.0)
    patches = gaussian_filter(np.where(np.abs(spots) > 1.2, np.sign(spots), 0.0), 0.7)
    mixed = 0.75 * smooth + 0.6 * patches
    return np.asarray(1.0 + _CONTRAST / _BRIGHTNESS * mixed / mixed.std())


def _draw_changes(
    is_seen: BoolArray, nodes: tuple[FloatArray, FloatArray], rng: np.random.Generator
) -> tuple[FlightChange, ...]:
    """Place the four changes where all of their ground is seen, apart from each other, as large as there is room."""
    kinds = [("mound", 1.0, 1.0), ("plateau", 1.0, 0.3), ("pit", 0.85, -0.6), ("paint", 0.85, 0.0)]
    inside = CELL * distance_transform_edt(is_seen)
    for radius in _RADII:
        places: list[FlightChange] = []
        for kind, share, height in kinds:
            room = inside > share * radius + 1.0
            for other in places:
                apart = share * radius + other.radius + 2.5
                room &= np.hypot(nodes[0] - other.east, nodes[1] - other.north) > apart
            free = np.flatnonzero(room)
            if free.size == 0:
                break
            k = int(rng.choice(free))
            places.append(FlightChange(kind, float(nodes[0].flat[k]), float(nodes[1].flat[k]), share * radius, height))
        if len(places) == len(kinds):
            return tuple(places)
    msg = (
        f"The ground seen by {_VIEWS} photos of each flight, {int(is_seen.sum() * CELL**2)} m2, is too little for four "
        f"changes of {_RADII[-1]} m radius. Fly more or longer strips, or higher."
    )
    raise ValueError(msg)


def _draw_objects(
    shape: tuple[int, int],
    half: tuple[float, float],
    changes: tuple[FlightChange, ...],
    counts: tuple[int, int],
    rng: np.random.Generator,
) -> FloatArray:
    """Houses with a flat roof, trees, and boulders, none of them near a change; heights above the ground, m."""
    rows, columns = np.indices(shape)
    east, north = columns * CELL - half[0], rows * CELL - half[1]
    out = np.zeros(shape)
    n_boulders = int(half[0] * half[1] / 120)
    kinds = ["house"] * counts[0] + ["tree"] * counts[1] + ["boulder"] * n_boulders
    for kind in kinds:
        size = {"house": rng.uniform(3.0, 5.0), "tree": rng.uniform(1.0, 2.2), "boulder": rng.uniform(0.4, 1.1)}[kind]
        place = _free_place(half, changes, 1.5 * size + 1.0, rng)
        if place is None:
            continue
        de, dn = east - place[0], north - place[1]
        if kind == "house":
            turn = rng.uniform(0, np.pi)
            along, across = de * np.cos(turn) + dn * np.sin(turn), dn * np.cos(turn) - de * np.sin(turn)
            rise = np.where((np.abs(along) < size) & (np.abs(across) < 0.65 * size), rng.uniform(2.5, 4.0), 0.0)
        else:
            height = size * (2.2 if kind == "tree" else 0.7)
            rise = height * np.sqrt(np.maximum(1 - (de**2 + dn**2) / size**2, 0.0))
        out = np.maximum(out, rise)
    return out


def _free_place(
    half: tuple[float, float], changes: tuple[FlightChange, ...], clearance: float, rng: np.random.Generator
) -> FloatArray | None:
    """Place away from all changes; None where there is no room."""
    for _ in range(50):
        place: FloatArray = rng.uniform(-1.0, 1.0, 2) * np.array(half)
        if all(np.hypot(place[0] - c.east, place[1] - c.north) > c.radius + clearance for c in changes):
            return place
    return None
