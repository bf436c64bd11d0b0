"""Transformation of points between CRSs, refused where it would be a guess."""

from __future__ import annotations

import logging
import re
import warnings
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from pyproj.network import set_network_enabled  # type: ignore[attr-defined]  # missing from its __all__
from pyproj.transformer import TransformerGroup

from changedetect.crs.definition import (
    authority_or_wkt,
    brief,
    check_located,
    crs_name,
    height_ratio,
    horizontal_crs,
    is_same_horizontal,
    parse_crs,
    unbound,
    vertical_crs,
)
from changedetect.errors import CRSMismatchError, InputDataError, VerticalDatumError

if TYPE_CHECKING:
    from changedetect.typing import BoolArray, FloatArray

__all__ = ["PointTransform", "check_compatible", "make_transform"]

logger = logging.getLogger(__name__)

#: A height transformation without a grid must be at least this accurate (m): offsets that a standard defines exactly
#: pass; regional averages and datums that are only nominally alike do not.
_MAX_GRIDLESS_HEIGHT_ERROR = 0.05
#: A horizontal transformation less accurate than this (m) displaces a survey too far to tell what changed.
_MAX_HORIZONTAL_ERROR = 5.0
#: Worth a line in the log (m).
_NOTABLE_ERROR = 0.1
_HEIGHT_GRID = re.compile(r"\bproj=(vgridshift|gridshift|tinshift|xyzgridshift)\b")


def check_compatible(source: str, programme: str) -> None:
    """
    Refuse a source CRS from which there is no trustworthy way to the programme's.

    Raises
    ------
    CRSMismatchError, VerticalDatumError
        As `make_transform`.
    """
    make_transform(source, programme)


@dataclass(frozen=True)
class PointTransform:
    """
    Transformation of points from one CRS to another; call it with (easting, northing, elevation).

    Attributes
    ----------
    source, target : str
        CRSs as given.
    height_factor : float or None
        Elevations are multiplied by it (change of unit or of sign within one vertical datum); None where PROJ
        transforms heights together with the position.
    coordinate_epoch : float or None, decimal year
        Epoch of the coordinates, for transformations from dynamic frames (ITRF).
    has_heights : bool
        False for outlines on the map.

    Notes
    -----
    Where the vertical datum stays the same, the horizontal transformation leaves heights alone: a levelled height
    does not depend on the horizontal frame, and no geoid grid is needed to keep it.
    """

    source: str
    target: str
    height_factor: float | None = 1.0
    coordinate_epoch: float | None = None
    has_heights: bool = True
    _transformer: Transformer | None = field(default=None, repr=False, compare=False)

    @property
    def is_identity(self) -> bool:
        """Whether coordinates pass through unchanged, bit for bit."""
        return self._transformer is None and self.height_factor == 1.0

    @property
    def operation(self) -> str:
        """What is done, in words, for the record; of several candidates the one used last."""
        steps = [] if self._transformer is None else [str(_used(self._transformer).description)]
        if self.height_factor not in (None, 1.0):
            steps.append(f"heights times {self.height_factor!r}")
        return " + ".join(steps) or "identity"

    def __call__(
        self, easting: FloatArray, northing: FloatArray, elevation: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """
        Transform points.

        Parameters
        ----------
        easting, northing : array, shape (n,)
            In the source's units; longitude and latitude in degrees for a geographic source.
        elevation : array, shape (n,)

        Returns
        -------
        easting, northing, elevation : array, shape (n,), float64
            The very arrays given where nothing changes; inputs are never modified.

        Raises
        ------
        InputDataError
            A point lies outside the domain of the transformation.
        CRSMismatchError, VerticalDatumError
            The only operation that PROJ has for these places is too inaccurate, or depends on an epoch not given.
        """
        if self._transformer is not None and np.size(easting):
            easting, northing, elevation = self._project(self._transformer, easting, northing, elevation)
        if self.height_factor not in (None, 1.0):
            elevation = np.asarray(elevation, dtype=np.float64) * self.height_factor
        return easting, northing, elevation

    def _project(
        self, transformer: Transformer, easting: FloatArray, northing: FloatArray, elevation: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        is_3d = self.height_factor is None
        arrays = [np.asarray(easting, dtype=np.float64), np.asarray(northing, dtype=np.float64)]
        if is_3d or self.coordinate_epoch is not None:
            arrays.append(np.asarray(elevation, dtype=np.float64) if is_3d else np.zeros_like(arrays[0]))
        if self.coordinate_epoch is not None:
            arrays.append(np.full_like(arrays[0], self.coordinate_epoch))
        apply: Any = transformer.transform
        try:
            result = apply(*arrays, errcheck=True)
        except ProjError as error:
            reached = np.isfinite(apply(*arrays)[:2]).all(axis=0)
            raise self._failure(arrays, reached, error) from error
        _check_operation(self, transformer)
        return result[0], result[1], result[2] if is_3d else elevation

    def _failure(self, arrays: list[FloatArray], reached: BoolArray, error: ProjError) -> InputDataError:
        """Name the first point that PROJ cannot transform, and the grid it lacks."""
        first = int(np.argmin(reached))
        place = ", ".join(f"{array[first]!s}" for array in arrays[: 3 if self.height_factor is None else 2])
        grids = _missing_grids(self.source, self.target)
        fix = (
            "Check the CRS of the source (--crs), the order of its columns, and their units."
            if self.has_heights
            else "Check the CRS that the file states; GeoJSON is in longitude and latitude."
        )
        if grids:
            fix += f" If they are right, {_install(grids)}"
        msg = (
            f"{int((~reached).sum())} of {reached.size} points cannot be transformed from {crs_name(self.source)!r} "
            f"to {crs_name(self.target)!r}, first at point {first}: ({place}). {fix} ({error})"
        )
        return InputDataError(msg)


def make_transform(
    source: str, target: str, *, coordinate_epoch: float | None = None, has_heights: bool = True
) -> PointTransform:
    """
    Find the way from one CRS to another.

    Parameters
    ----------
    source, target : str
    coordinate_epoch : float, decimal year, optional
        When the source's coordinates are valid; needed only between a dynamic frame (ITRF) and one fixed to a plate,
        where ignoring it costs centimetres a year.
    has_heights : bool
        False for outlines on the map, whose elevations mean nothing: vertical datums are not asked about.

    Returns
    -------
    transform : PointTransform
        The identity where both CRSs mean the same.

    Raises
    ------
    CRSMismatchError
        No horizontal transformation is known, or the source has no place on Earth.
    VerticalDatumError
        One CRS declares its heights and the other does not; the vertical datums differ and no transformation is
        known, or its grid is not installed; or heights may be feet and nobody says so.

    Notes
    -----
    If neither CRS declares its heights they are taken as they are, with a warning.

    Examples
    --------
    >>> transform = make_transform("EPSG:4979", "EPSG:32632+4979")
    >>> [float(round(v[0], 3)) for v in transform(np.array([9.0]), np.array([48.0]), np.array([300.0]))]
    [500000.0, 5316300.224, 300.0]
    """
    source_crs, target_crs = parse_crs(source), parse_crs(target)
    check_located(source_crs, source)
    check_located(target_crs, target)
    if has_heights:
        _check_heights_declared(source, target)
    factor = height_ratio(vertical_crs(source_crs), vertical_crs(target_crs)) if has_heights else 1.0
    transformer = None
    if factor is None:
        transformer = _find_transformer(source_crs, target_crs, source, target, has_heights=has_heights)
    elif not is_same_horizontal(source, target):
        parts = horizontal_crs(source_crs), horizontal_crs(target_crs)
        transformer = _find_transformer(*parts, source, target, has_heights=has_heights)
    transform = PointTransform(source, target, factor, coordinate_epoch, has_heights, transformer)
    if transformer is not None and transformer.accuracy != -1:  # one candidate: judged before any point is read
        _check_operation(transform, transformer)
    return transform


def _find_transformer(first: CRS, second: CRS, source: str, target: str, *, has_heights: bool) -> Transformer:
    set_network_enabled(active=False)
    try:
        return Transformer.from_crs(first, second, always_xy=True, allow_ballpark=False)
    except ProjError as error:
        raise _no_way(source, target, has_heights=has_heights) from error


def _no_way(source: str, target: str, *, has_heights: bool) -> InputDataError:
    source_crs, target_crs = parse_crs(source), parse_crs(target)
    vertical = height_ratio(vertical_crs(source_crs), vertical_crs(target_crs)) is None
    grids = _missing_grids(source, target)
    way = f"a grid is missing: {_install(grids)}" if grids else "PROJ knows no transformation."
    heights_hint = f"state it: --crs {_stated(horizontal_crs(source_crs), vertical_crs(target_crs))}."
    if vertical:
        msg = (
            f"Vertical datums differ: source {_heights_in_words(source)}, programme {_heights_in_words(target)}; {way} "
            f"Or transform the source beforehand. If its heights already refer to the programme's datum, {heights_hint}"
        )
        return VerticalDatumError(msg)
    msg = f"Coordinates cannot be transformed from {crs_name(source)!r} to {crs_name(target)!r}; {way}"
    if has_heights:
        msg += f" If the source's coordinates already refer to the programme's CRS, state it: --crs {brief(target)}."
    return CRSMismatchError(msg)


def _missing_grids(source: str, target: str) -> list[str]:
    """Names of the grids of the operation that needs the fewest of them."""
    source_crs, target_crs = parse_crs(source), parse_crs(target)
    if height_ratio(vertical_crs(source_crs), vertical_crs(target_crs)) is not None:
        source_crs, target_crs = horizontal_crs(source_crs), horizontal_crs(target_crs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "best transformation is not available": that is the question
        group = TransformerGroup(source_crs, target_crs, always_xy=True, allow_ballpark=False)
    needs = [[g.short_name for g in op.grids if not g.available] for op in group.unavailable_operations]
    return min((grids for grids in needs if grids), key=len, default=[])


def _check_operation(transform: PointTransform, transformer: Transformer) -> None:
    """Refuse an operation that PROJ has but that cannot carry change detection."""
    used = _used(transformer)
    accuracy = float(used.accuracy)
    definition = str(used.definition)
    pair = f"from {crs_name(transform.source)!r} to {crs_name(transform.target)!r}"
    if "t_epoch=" in definition and transform.coordinate_epoch is None:
        msg = (
            f"The transformation {pair} depends on the epoch of the coordinates (moving plates, centimetres a year), "
            "which is not known. Transform the source to the programme's frame beforehand, or state its CRS in a "
            "frame that is fixed to the plate."
        )
        raise CRSMismatchError(msg)
    if transform.height_factor is None:
        if _HEIGHT_GRID.search(definition) is None and not 0 <= accuracy <= _MAX_GRIDLESS_HEIGHT_ERROR:
            raise VerticalDatumError(_inaccurate_heights_message(transform, str(used.description), accuracy))
    elif accuracy > _MAX_HORIZONTAL_ERROR:
        grids = _missing_grids(transform.source, transform.target)
        fix = f"To have a better one, {_install(grids)}" if grids else "Transform the source beforehand."
        msg = (
            f"The transformation {pair} that PROJ has is only {accuracy:g} m accurate ({used.description}); at most "
            f"{_MAX_HORIZONTAL_ERROR:g} m is accepted. {fix}"
        )
        raise CRSMismatchError(msg)
    if accuracy > _NOTABLE_ERROR:
        _warn_inaccurate(pair, accuracy, str(used.description))


def _inaccurate_heights_message(transform: PointTransform, description: str, accuracy: float) -> str:
    grids = _missing_grids(transform.source, transform.target)
    stated = f"{accuracy:g} m accurate" if accuracy >= 0 else "of unknown accuracy"
    better = f"To have a better one, {_install(grids)} " if grids else ""
    hint = _stated(horizontal_crs(parse_crs(transform.source)), vertical_crs(parse_crs(transform.target)))
    return (
        f"Vertical datums differ: source {_heights_in_words(transform.source)}, programme "
        f"{_heights_in_words(transform.target)}, and the transformation between them is {stated} ({description}); "
        f"{_MAX_GRIDLESS_HEIGHT_ERROR:g} m is needed. {better}Transform the source beforehand; if its heights "
        f"already refer to the programme's datum, state it: --crs {hint}."
    )


def _used(transformer: Transformer) -> Transformer:
    """Operation applied to the last point; the transformer itself where it has one only or does nothing."""
    try:
        return transformer.get_last_used_operation()
    except ProjError:
        return transformer


def _check_heights_declared(source: str, target: str) -> None:
    """Heights are declared on both sides or on neither."""
    source_crs, target_crs = parse_crs(source), parse_crs(target)
    horizontal, vertical, wanted = horizontal_crs(source_crs), vertical_crs(source_crs), vertical_crs(target_crs)
    if vertical is None and any(
        a.unit_conversion_factor != 1.0 for a in horizontal.axis_info if _is_length(a.unit_name)
    ):
        msg = (
            f"The source's CRS {brief(source)!r} is in {horizontal.axis_info[0].unit_name} and does not say in which "
            f"unit heights are. State a vertical CRS too, for example --crs {_stated(horizontal, None, '6360')} "
            "(NAVD88, US survey feet) or +5703 (NAVD88, metres)."
        )
        raise VerticalDatumError(msg)
    if vertical is None and wanted is not None:
        msg = (
            f"The source's CRS {brief(source)!r} does not declare the vertical datum of its heights; the programme's "
            f"are {_heights_in_words(target)}. State it: --crs {_stated(horizontal, wanted)} if the source's heights "
            "refer to the same datum, else with the code of theirs."
        )
        raise VerticalDatumError(msg)
    if vertical is not None and wanted is None:
        msg = (
            f"The source's heights are {_heights_in_words(source)}; the programme's CRS {brief(target)!r} declares no "
            f"vertical datum. Create the programme with one, for example --crs "
            f"{_stated(horizontal_crs(target_crs), vertical)}, or take the heights as they are by stating the source's "
            f"CRS without it: --crs {brief(authority_or_wkt(horizontal))}."
        )
        raise VerticalDatumError(msg)
    if vertical is None:
        _warn_heights_undeclared(brief(source), brief(target))


@lru_cache(maxsize=1024)
def _warn_heights_undeclared(source: str, target: str) -> None:
    logger.warning(
        "Neither %s nor the programme's %s declares a vertical datum: heights are taken as they are and assumed to "
        "share one. Differing datums would show as change everywhere.",
        source,
        target,
    )


@lru_cache(maxsize=1024)
def _warn_inaccurate(pair: str, accuracy: float, description: str) -> None:
    logger.warning("The transformation %s has a stated accuracy of %g m (%s)", pair, accuracy, description)


def _is_length(unit: str) -> bool:
    return not re.search("degree|grad|gon|radian|second", unit)


def _stated(horizontal: CRS, vertical: CRS | None, code: str = "") -> str:
    """Write a CRS as an example to follow --crs, with gaps where only the user knows."""
    number = code or str((vertical.to_epsg() if vertical is not None else None) or "<vertical code>")
    if vertical is not None and vertical.is_geographic:
        if horizontal.is_geographic:
            return f"EPSG:{number}"
        base = horizontal.geodetic_crs
        if base is None or not base.to_3d().equals(vertical, ignore_axis_order=True):
            return f"EPSG:<code of the same projection in the frame {vertical.name}>+{number}"
    return f"EPSG:{unbound(horizontal).to_epsg() or '<horizontal code>'}+{number}"


def _heights_in_words(text: str) -> str:
    vertical = vertical_crs(parse_crs(text))
    if vertical is None:
        return "undeclared"
    kind = "ellipsoidal heights of" if vertical.is_geographic else "in"
    code = vertical.to_epsg()
    return f"{kind} '{unbound(vertical).name}'{f' (EPSG:{code})' if code else ''}"


def _install(grids: list[str]) -> str:
    name = grids[0] if len(grids) == 1 else "NAME"
    what = f"install {' and '.join(grids)} with"
    return f"{what} `pyproj sync --file {name}` (or `projsync --file {name}`), then run again."
