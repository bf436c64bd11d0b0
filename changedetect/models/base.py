"""The protocol every surface model follows, and what it returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, Self, runtime_checkable

if TYPE_CHECKING:
    from pathlib import Path

    from changedetect.typing import Coordinates, FloatArray

__all__ = ["Prediction", "SurfaceModel"]


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """
    A surface evaluated at n places.

    Attributes
    ----------
    elevation : array, shape (n,), m, float64
        NaN where no data supports an answer.
    elevation_std : array, shape (n,), m
        Standard deviation of the surface itself.
    noise_std : array, shape (n,), m
        Standard deviation of one observation about the surface. A new observation scatters by
        sqrt(elevation_std**2 + noise_std**2).
    n_effective : array, shape (n,)
        Effective number of observations behind the answer; 0 where there is none.
    age_days : array, shape (n,), days
        Survey time of the model minus the time the surface there was last observed; 0 where the newest epoch
        saw it.
    """

    elevation: FloatArray
    elevation_std: FloatArray
    noise_std: FloatArray
    n_effective: FloatArray
    age_days: FloatArray


@runtime_checkable
class SurfaceModel(Protocol):
    """A continuous surface learned from scattered observations, epoch after epoch."""

    def fit(
        self,
        coordinates: Coordinates,
        elevation: FloatArray,
        sigma: FloatArray | None = None,
        survey_time: float | None = None,
    ) -> Self:
        """Forget everything, then learn; `survey_time` in days since 1970-01-01."""
        ...

    def partial_fit(
        self,
        coordinates: Coordinates,
        elevation: FloatArray,
        sigma: FloatArray | None = None,
        survey_time: float | None = None,
    ) -> Self:
        """Learn more; a later `survey_time` starts a new epoch, None continues the present one."""
        ...

    def predict(self, coordinates: Coordinates) -> Prediction:
        """Evaluate the surface."""
        ...

    def copy(self) -> Self:
        """Return a model that shares no state with this one."""
        ...

    def save(self, directory: Path) -> None:
        """Persist into a folder."""
        ...

    @classmethod
    def load(cls, directory: Path) -> Self:
        """Read a model back; its predictions are bit-identical."""
        ...
