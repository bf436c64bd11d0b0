"""What is known about the alignment of one epoch, and what it does to elevation differences."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from changedetect.coregistration.choice import Candidate
from changedetect.coregistration.transform import Transform

if TYPE_CHECKING:
    from changedetect.pointcloud import PointCloud
    from changedetect.typing import FloatArray, JSONObject

__all__ = ["Alignment"]

#: Version of the document that `Alignment.to_dict` gives.
FORMAT_VERSION = 1
_UNITS = {"east": "m", "north": "m", "up": "m", "tilt": "m/m", "rotation": "rad", "scale": "1"}
#: Significant digits in which a sentence states a parameter, by its unit: factor, and unit as people read it.
_READABLE = {"m": (1.0, "m"), "m/m": (1e3, "mm/m"), "rad": (1e3, "mrad"), "1": (1e6, "ppm")}


@dataclass(frozen=True, kw_only=True, eq=False)
class Alignment:
    """
    Transform from an epoch to its reference and how well it is known.

    Attributes
    ----------
    transform : Transform
    covariance : array, shape (k, k)
        Of the transform's parameters, in their units; errors correlated in space are in it.
    degrees_of_freedom : array, shape (k,)
        Of each variance; intervals follow Student's t.
    candidates : tuple of Candidate
        The kinds considered and the tests that led to the one taken.
    n_observations : int
        In the epoch, in the stable areas where these were given.
    n_used : int
        Drawn from these, evenly over the ground, and in agreement with the reference.
    n_effective : float
        Independent observations that would determine the vertical shift as well.
    overlap_share : float, 0 to 1
        Part of the observations on ground that the reference covers.
    stable_share : float, 0 to 1
        Part of these on ground that did not change.
    median_before, nmad_before, median_after, nmad_after : float, m
        Of the residuals on that ground.
    correlation_length : float, m
        Over which errors are correlated by 1 / e; 0 where no correlation was found.
    vertical_step : str or None
        In plain words, where the epoch differs from the reference as by another vertical datum.
    remarks : tuple of str
        What the reader should know.
    """

    transform: Transform
    covariance: FloatArray
    degrees_of_freedom: FloatArray
    candidates: tuple[Candidate, ...]
    n_observations: int
    n_used: int
    n_effective: float
    overlap_share: float
    stable_share: float
    median_before: float
    nmad_before: float
    median_after: float
    nmad_after: float
    correlation_length: float
    vertical_step: str | None
    remarks: tuple[str, ...]

    @property
    def standard_errors(self) -> FloatArray:
        """Of the parameters, shape (k,), in their units."""
        errors: FloatArray = np.sqrt(np.diag(self.covariance))
        return errors

    def intervals(self, confidence: float = 0.95) -> FloatArray:
        """Lower and upper bound of each parameter, shape (k, 2)."""
        half = stats.t.ppf(0.5 + 0.5 * confidence, self.degrees_of_freedom) * self.standard_errors
        centre = np.array(self.transform.parameters)
        return np.stack([centre - half, centre + half], axis=1)

    def apply(self, cloud: PointCloud) -> PointCloud:
        """Move observations of the epoch into the frame of the reference."""
        easting, northing, elevation = self.transform.apply(*cloud.coordinates, cloud.elevation)
        return replace(cloud, easting=easting, northing=northing, elevation=elevation)

    def inverted(self) -> Alignment:
        """
        Return the alignment of the reference to the epoch.

        The covariance stays, since parameters change their sign and little else; residuals change theirs.
        """
        step, remarks = self.vertical_step, self.remarks
        return replace(
            self,
            transform=self.transform.inverted(),
            median_before=-self.median_before,
            median_after=-self.median_after,
            vertical_step=None if step is None else _exchanged(step, "below the reference", "above the reference"),
            remarks=tuple(_exchanged(remark, "smaller than", "larger than") for remark in remarks),
        )

    def offset_design(
        self,
        easting: FloatArray,
        northing: FloatArray,
        slope_east: FloatArray,
        slope_north: FloatArray,
        elevation: FloatArray | None = None,
    ) -> FloatArray:
        """
        How an error of each parameter changes the epoch's elevation at places.

        Parameters
        ----------
        easting, northing : array, shape (n,), m
            In the frame of the reference.
        slope_east, slope_north : array, shape (n,), m/m
            Of the ground there.
        elevation : array, shape (n,), m, optional
            Of the ground; by default that of the transform's centre, which matters for rotation and scale alone.

        Returns
        -------
        design : array, shape (n, k)
            With D this and V `covariance`, D V D' is the covariance of the elevation errors among the places: an error
            of the transform is one and the same everywhere, so it is coherent in space.
        """
        if elevation is None:
            elevation = np.full(np.shape(easting), self.transform.centre[2] + self.transform["up"])
        return self.transform.jacobian(easting, northing, elevation, slope_east, slope_north)

    def covariance_of_offset(
        self,
        easting: FloatArray,
        northing: FloatArray,
        slope_east: FloatArray,
        slope_north: FloatArray,
        elevation: FloatArray | None = None,
    ) -> FloatArray:
        """
        Variance of the elevation error that the uncertainty of the transform causes at places.

        Parameters
        ----------
        easting, northing, slope_east, slope_north, elevation
            As for `offset_design`, which gives the covariance from place to place.

        Returns
        -------
        variance : array, shape (n,), m2
        """
        design = self.offset_design(easting, northing, slope_east, slope_north, elevation)
        variance: FloatArray = np.einsum("ni,ij,nj->n", design, self.covariance, design)
        return variance

    def wording(self) -> str:
        """One sentence about the transform, with intervals of one standard error, and the residuals."""
        transform = self.transform
        parts = []
        for name, value, error in zip(transform.names, transform.parameters, self.standard_errors, strict=True):
            factor, unit = _READABLE[_unit(name)]
            parts.append(f"{name.replace('_', ' ')} {factor * value:+.3f} ± {factor * error:.3f} {unit}")
        return (
            f"Moved by {', '.join(parts)}; residuals on {100.0 * self.stable_share:.0f} % of the shared ground, taken "
            f"as stable: median {self.median_before:+.3f} m and NMAD {self.nmad_before:.3f} m before, "
            f"{self.median_after:+.3f} m and {self.nmad_after:.3f} m after."
        )

    def to_dict(self) -> JSONObject:
        """Return everything as JSON knows it."""
        document: JSONObject = {"format_version": FORMAT_VERSION, "wording": self.wording()}
        document |= {field.name: getattr(self, field.name) for field in fields(self)}
        document["transform"] = self.transform.to_dict() | {
            "standard_errors": dict(zip(self.transform.names, self.standard_errors.tolist(), strict=True)),
            "units": {name: _unit(name) for name in self.transform.names},
        }
        document["covariance"] = self.covariance.tolist()
        document["degrees_of_freedom"] = self.degrees_of_freedom.tolist()
        document["candidates"] = [dict(vars(candidate)) for candidate in self.candidates]
        document["remarks"] = list(self.remarks)
        return document

    @classmethod
    def from_dict(cls, document: JSONObject) -> Alignment:
        """
        Read back what `to_dict` gave.

        Raises
        ------
        ValueError, KeyError
            The document is of another format version, or something is missing.
        """
        if document.get("format_version") != FORMAT_VERSION:
            msg = f"An alignment of format version {document.get('format_version')!r}; {FORMAT_VERSION} is read."
            raise ValueError(msg)
        values = {field.name: document[field.name] for field in fields(cls)}
        return cls(
            **values
            | {
                "transform": Transform.from_dict(document["transform"]),
                "covariance": np.array(document["covariance"], dtype=np.float64),
                "degrees_of_freedom": np.array(document["degrees_of_freedom"], dtype=np.float64),
                "candidates": tuple(Candidate(**candidate) for candidate in document["candidates"]),
                "remarks": tuple(document["remarks"]),
            }
        )


def _exchanged(text: str, one: str, other: str) -> str:
    """Text with one phrase where the other stood."""
    return text.replace(one, other) if one in text else text.replace(other, one)


def _unit(name: str) -> str:
    return _UNITS[name.partition("_")[0]]
