"""Settings of co-registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from changedetect.coregistration.transform import KINDS, Kind

__all__ = ["AlignmentSettings"]


@dataclass(frozen=True, kw_only=True)
class AlignmentSettings:
    """
    How an epoch is aligned to its reference.

    Attributes
    ----------
    kind : {"auto", "vertical", "shift", "shift_tilt", "rigid", "similarity"}
        Transform to fit; "auto" takes the simplest that suffices.
    largest_kind : {"vertical", "shift", "shift_tilt", "rigid", "similarity"}
        The most that "auto" considers.
    significance : float
        "auto" takes a simpler kind unless what it leaves out differs from zero at this level.
    max_observations : int
        Observations to work with, spread evenly over the ground; at most about so many.
    min_observations : int
        Fewer on stable ground are refused.
    min_effective : float
        Fewer independent ones, given how their errors correlate in space, are refused.
    max_parameter_std_m : float or None, m
        A shift less certain than this, or a tilt, rotation or scale whose effect at the rms radius of the ground is,
        counts as not determined. None: half the reach of the reference.
    datum_step_min_m : float, m
        Smaller vertical shifts are not called a datum step.

    Raises
    ------
    ValueError
        A value is out of its range.
    """

    kind: Literal["auto"] | Kind = "auto"
    largest_kind: Kind = "similarity"
    significance: float = 0.01
    max_observations: int = 100_000
    min_observations: int = 50
    min_effective: float = 8.0
    max_parameter_std_m: float | None = None
    datum_step_min_m: float = 0.1

    def __post_init__(self) -> None:
        kinds = ", ".join(KINDS)
        limit = self.max_parameter_std_m
        checks = {
            f"kind is auto, {kinds}; got {self.kind!r}": self.kind in ("auto", *KINDS),
            f"largest_kind is {kinds}; got {self.largest_kind!r}": self.largest_kind in KINDS,
            f"significance lies between 0 and 0.5; got {self.significance!r}": 0.0 < self.significance < 0.5,
            f"max_observations is at least 1000; got {self.max_observations!r}": self.max_observations >= 1000,
            f"min_observations is at least 10; got {self.min_observations!r}": self.min_observations >= 10,
            f"min_effective is at least 1; got {self.min_effective!r}": self.min_effective >= 1.0,
            f"max_parameter_std_m is positive, or None; got {limit!r}": limit is None or limit > 0.0,
            f"datum_step_min_m is not negative; got {self.datum_step_min_m!r}": self.datum_step_min_m >= 0.0,
        }
        for requirement, is_met in checks.items():
            if not is_met:
                msg = f"Alignment setting {requirement}."
                raise ValueError(msg)
