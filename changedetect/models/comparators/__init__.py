"""
Other ways to learn a surface, behind the same protocol: what LWPR is measured against.

`comparators()` lists them; each entry is called to make a fresh model with the settings of the comparison.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from changedetect.models.comparators.base import PointModel
from changedetect.models.comparators.block_mean import BlockMean
from changedetect.models.comparators.delaunay import DelaunayLinear
from changedetect.models.comparators.gpr import ExactGPR
from changedetect.models.comparators.kriging import NeighbourKriging
from changedetect.models.comparators.local_gpr import LocalGPR
from changedetect.models.comparators.sparse_gpr import SparseGPR

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = [
    "BlockMean",
    "Comparator",
    "DelaunayLinear",
    "ExactGPR",
    "LocalGPR",
    "NeighbourKriging",
    "PointModel",
    "SparseGPR",
    "comparators",
]


@dataclass(frozen=True)
class Comparator:
    """
    One method of the comparison; calling it makes a fresh model.

    Attributes
    ----------
    name : str
    title : str
        For tables.
    model : type of PointModel
    settings : mapping of str to object
        What the model is built with.
    requires : str or None
        Package that must be installed and belongs to the extra 'compare'.
    """

    name: str
    title: str
    model: type[PointModel[Any]]
    settings: Mapping[str, Any] = field(default_factory=dict)
    requires: str | None = None

    def __call__(self) -> PointModel[Any]:
        """Make a fresh model."""
        return self.model(**self.settings)

    @property
    def max_points(self) -> int | None:
        """Largest number of observations the method takes; None = no limit."""
        return self().max_points


def comparators() -> dict[str, Comparator]:
    """
    Methods to compare with, by name.

    Returns
    -------
    methods : dict of str to Comparator

    Examples
    --------
    >>> sorted(comparators())
    ['block_mean', 'delaunay', 'gpr_matern32', 'gpr_rbf', 'kriging', 'local_gpr', 'sparse_gpr']
    >>> comparators()["kriging"]()
    NeighbourKriging(max_points=5000000, n_neighbours=30, kernel='matern32', n_blocks=30, block_size=64, random_seed=0)
    """
    methods = (
        Comparator("gpr_rbf", "exact GPR, RBF", ExactGPR, {"kernel": "rbf"}, requires="scikit-learn"),
        Comparator("gpr_matern32", "exact GPR, Matern 3/2", ExactGPR, {"kernel": "matern32"}, requires="scikit-learn"),
        Comparator("local_gpr", "local GPR (LGPR)", LocalGPR),
        Comparator("sparse_gpr", "sparse GPR (FITC, 600 inducing points)", SparseGPR),
        Comparator("kriging", "kriging, 30 nearest neighbours", NeighbourKriging),
        Comparator("delaunay", "Delaunay, linear", DelaunayLinear),
        Comparator("block_mean", "block mean", BlockMean),
    )
    return {method.name: method for method in methods}
