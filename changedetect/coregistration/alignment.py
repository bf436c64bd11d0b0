"""What is known about the alignment of one epoch, and what it does to elevation differences."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from changedetect.coregistration.transform import PARAMETER_UNITS, Transform

if TYPE_CHECKING:
    from changedetect.coregistration.transform import Kind
    from changedetect.pointcloud import PointCloud
    from changedetect.typing import FloatArray, JSONObject

__all__ = ["Alignment", "Candidate"]

#: Version of the document that `Alignment.to_dict` gives.
FORMAT_VERSION = 1


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """
    One kind of transform that was considered.

    Attributes
    ----------
    kind : str
    statistic : float or None
        Wald statistic, over the number of parameters, of what this kind leaves out of the largest determined one.
    p_value : float or None
        Probability of a larger one if that were zero; None for the largest kind and where it was not tested.
    verdict : str
        In words.
    """

    kind: Kind
    statistic: float | None
    p_value: float | None
    verdict: str


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
        In the epoch, on stable ground where that was given.
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
    square_std, square_side : float, m
        Robust standard deviation of the mean residual of squares of this side, after aligning.
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
    square_std: float
    square_side: float
    vertical_step: str | None
    remarks: tuple[str, ...]

    @property
    def kind(self) -> Kind:
        """Kind of transform that was taken."""
        return self.transform.kind

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

    def displacement_design(
        self,
        easting: FloatArray,
        northing: FloatArray,
        gradient: tuple[FloatArray, FloatArray],
        elevation: FloatArray | None = None,
    ) -> FloatArray:
        """
        How an error of each parameter changes the elevation difference at places.

        Parameters
        ----------
        easting, northing : array, shape (n,), m
            In the frame of the reference.
        gradient : (slope_east, slope_north), each shape (n,), m/m
            Of the reference there.
        elevation : array, shape (n,), m, optional
            Of the reference; by default that of the centre, which matters for rotations on steep ground alone.

        Returns
        -------
        design : array, shape (n, k)
            With D this and V `covariance`, D V D' is the covariance of the elevation differences among the places:
            an error of the transform is one and the same everywhere.
        """
        if elevation is None:
            elevation = np.full(np.shape(easting), self.transform.centre[2] + float(self.transform.shift[2]))
        return self.transform.jacobian(easting, northing, elevation, *gradient)

    def displacement_covariance(
        self,
        easting: FloatArray,
        northing: FloatArray,
        gradient: tuple[FloatArray, FloatArray],
        elevation: FloatArray | None = None,
    ) -> FloatArray:
        """
        Variance of the elevation difference that the uncertainty of the transform causes at places.

        Parameters
        ----------
        easting, northing, gradient, elevation
            As for `displacement_design`, which gives the covariance from place to place.

        Returns
        -------
        variance : array, shape (n,), m2
        """
        design = self.displacement_design(easting, northing, gradient, elevation)
        variance: FloatArray = np.einsum("ni,ij,nj->n", design, self.covariance, design)
        return variance

    def to_dict(self) -> JSONObject:
        """Return everything as JSON knows it."""
        errors = self.standard_errors
        parameters = {
            name: {
                "value": value,
                "standard_error": float(errors[k]),
                "degrees_of_freedom": float(self.degrees_of_freedom[k]),
                "unit": PARAMETER_UNITS[name],
            }
            for k, (name, value) in enumerate(zip(self.transform.names, self.transform.parameters, strict=True))
        }
        return {
            "format_version": FORMAT_VERSION,
            "transform": self.transform.to_dict(),
            "parameters": parameters,
            "covariance": self.covariance.tolist(),
            "candidates": [dict(vars(candidate)) for candidate in self.candidates],
            "n_observations": self.n_observations,
            "n_used": self.n_used,
            "n_effective": self.n_effective,
            "overlap_share": self.overlap_share,
            "stable_share": self.stable_share,
            "residual_median_before_m": self.median_before,
            "residual_nmad_before_m": self.nmad_before,
            "residual_median_after_m": self.median_after,
            "residual_nmad_after_m": self.nmad_after,
            "correlation_length_m": self.correlation_length,
            "square_std_m": self.square_std,
            "square_side_m": self.square_side,
            "vertical_step": self.vertical_step,
            "remarks": list(self.remarks),
        }

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
        return cls(
            transform=Transform.from_dict(document["transform"]),
            covariance=np.array(document["covariance"], dtype=np.float64),
            degrees_of_freedom=np.array([p["degrees_of_freedom"] for p in document["parameters"].values()]),
            candidates=tuple(Candidate(**candidate) for candidate in document["candidates"]),
            n_observations=document["n_observations"],
            n_used=document["n_used"],
            n_effective=document["n_effective"],
            overlap_share=document["overlap_share"],
            stable_share=document["stable_share"],
            median_before=document["residual_median_before_m"],
            nmad_before=document["residual_nmad_before_m"],
            median_after=document["residual_median_after_m"],
            nmad_after=document["residual_nmad_after_m"],
            correlation_length=document["correlation_length_m"],
            square_std=document["square_std_m"],
            square_side=document["square_side_m"],
            vertical_step=document["vertical_step"],
            remarks=tuple(document["remarks"]),
        )
