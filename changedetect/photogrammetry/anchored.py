"""
A flight adjusted to earlier ones that stay as they are.

What was published of earlier flights must not move when a new one comes. Their poses are therefore held, and the ground
points both see bind the new flight to them, as control points would: the new flight takes over the error of the old
ones instead of adding its own, and the difference is as good as that of flights adjusted together. The covariance heeds
that the held poses are not exact (consider parameters [1]_): with G the change of the new poses per change of the held
ones, P_new = H^-1 + G C G' and cov(new, held) = G C.

References
----------
.. [1] Schmidt (1966), Application of state-space methods to navigation problems, Advances in Control Systems 3.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from changedetect.errors import InputDataError
from changedetect.kernels.projection import N_CALIBRATION
from changedetect.photogrammetry.adjustment import Adjustment, adjust
from changedetect.photogrammetry.block import ImageBlock, Observations
from changedetect.photogrammetry.common_error import CommonError, common_error, error_factor, point_modes
from changedetect.photogrammetry.joint import count_shared, drop_changed, shared_between_flights
from changedetect.photogrammetry.ties import Features, PairMatches, join_matches, match_pairs, overlapping_pairs

if TYPE_CHECKING:
    from changedetect.navigation.frame import LocalFrame
    from changedetect.photogrammetry.orientation import Matching, OrientationSettings, Oriented, Step
    from changedetect.typing import FloatArray, IntArray

__all__ = ["Anchor", "AnchoredFlight", "FinishedFlight", "orient_to_anchors"]

logger = logging.getLogger(__name__)

#: Held poses get this many times their information: they move by a thousandth of their standard deviation.
_HELD = 1e6


@dataclass(frozen=True)
class FinishedFlight:
    """
    A flight as it was published.

    Attributes
    ----------
    adjustment : Adjustment
        Of this flight alone: its photos, lens and points.
    origin : LocalFrame
        Frame it is in.
    cross : dict of str to array, shape (6 n + 9, 6 m + 9)
        Covariance of its poses and lens with those of each flight it was adjusted to, by that flight's name; all axes
        are those of `origin`.
    """

    adjustment: Adjustment
    origin: LocalFrame
    cross: Mapping[str, FloatArray] = field(default_factory=dict)

    def in_frame(self, target: LocalFrame) -> FinishedFlight:
        """Give the flight in another local frame."""
        if target == self.origin:
            return self
        a = self.adjustment
        geodetic = self.origin.to_geodetic(a.points)
        points = target.to_enu(geodetic[:, 0], geodetic[:, 1], geodetic[:, 2])
        turn = target.rotation_from_ecef @ self.origin.rotation_from_ecef.T
        whole = _turning(turn, len(a.camera_covariance))
        moved = replace(
            a,
            block=a.block.moved_to(self.origin, target),
            points=points,
            camera_covariance=whole @ a.camera_covariance @ whole.T,
        )
        cross = {name: whole @ c @ _turning(turn, c.shape[1]).T for name, c in self.cross.items()}
        return FinishedFlight(moved, target, cross)


@dataclass(frozen=True)
class Anchor:
    """
    An earlier flight that a new one is adjusted to.

    Attributes
    ----------
    name : str
        For messages.
    finished : FinishedFlight
    features : sequence of Features
        Of each photo.
    pairs : sequence of PairMatches
        Matches among its photos.
    """

    name: str
    finished: FinishedFlight
    features: Sequence[Features]
    pairs: Sequence[PairMatches]


@dataclass(frozen=True)
class AnchoredFlight:
    """
    Result of adjusting a flight to earlier ones.

    Attributes
    ----------
    finished : FinishedFlight
        The new flight.
    n_shared, n_moved : dict of str to int
        Ground points that bind it to each anchor, and those left out because their ground changed.
    differences : dict of str to CommonError
        Of the new flight less each anchor that binds it, in the frame of the new flight; anchors with too few shared
        points are missing.
    moved : array, shape (n, 3), ENU, m
        Places of the points left out.
    """

    finished: FinishedFlight
    n_shared: dict[str, int]
    n_moved: dict[str, int]
    differences: dict[str, CommonError]
    moved: FloatArray


def orient_to_anchors(
    flight: tuple[ImageBlock, FloatArray, Sequence[Features], Matching, Oriented],
    anchors: Sequence[Anchor],
    name: str,
    origin: LocalFrame,
    position_std: float,
    settings: OrientationSettings,
    *,
    on_step: Step | None = None,
) -> AnchoredFlight:
    """
    Adjust a flight to earlier ones, whose poses are held.

    Parameters
    ----------
    flight : (block, information, features, matching, oriented)
        The new flight; block with the poses of navigation.
    anchors : sequence of Anchor
    name : str
        Of the new flight, for messages.
    origin : LocalFrame
        Frame of the new flight.
    position_std : float, m
        How far the flights may lie apart.
    settings : OrientationSettings
    on_step : callable, optional

    Returns
    -------
    anchored : AnchoredFlight

    Raises
    ------
    InputDataError
        No anchor shares enough ground.
    """
    held = [anchor.finished.in_frame(origin) for anchor in anchors]
    for finished, anchor in zip(held, anchors, strict=True):
        _require_one_lens(finished, anchor.name)
    problem = _Problem(flight, held, anchors, settings)
    shared, counts = problem.shared(position_std, on_step)
    bound = [k for k, count in enumerate(counts) if count >= settings.joint.min_shared]
    if not bound:
        poorest = ", ".join(f"{anchor.name}: {count}" for anchor, count in zip(anchors, counts, strict=True))
        msg = (
            f"Flight {name} shares too few ground points with earlier flights ({poorest}); at least "
            f"{settings.joint.min_shared} are needed to adjust it to one. Do they show the same ground?"
        )
        raise InputDataError(msg)
    if len(bound) < len(anchors):
        dropped = ", ".join(anchor.name for k, anchor in enumerate(anchors) if k not in bound)
        logger.warning("%s shares too few ground points with %s to be adjusted to it", name, dropped)
        chosen = [anchors[k] for k in bound]
        again = orient_to_anchors(flight, chosen, name, origin, position_std, settings, on_step=on_step)
        lacking = {anchors[k].name: counts[k] for k in range(len(anchors)) if k not in bound}
        return replace(again, n_shared=lacking | again.n_shared, n_moved=dict.fromkeys(lacking, 0) | again.n_moved)
    return problem.solve(shared, name, origin, on_step)


class _Problem:
    """The new flight's photos first, then those of each anchor."""

    def __init__(
        self,
        flight: tuple[ImageBlock, FloatArray, Sequence[Features], Matching, Oriented],
        finished: Sequence[FinishedFlight],
        anchors: Sequence[Anchor],
        settings: OrientationSettings,
    ) -> None:
        block, information, features, matching, oriented = flight
        held = [flight.adjustment for flight in finished]
        self.settings, self.anchors, self.finished, self.held = settings, anchors, finished, held
        self.oriented, self.matching = oriented, matching
        lens = replace(block, intrinsics=oriented.adjustment.block.intrinsics)  # calibrated, if so asked
        self.given = ImageBlock.join([lens, *(a.block for a in held)])
        self.start = ImageBlock.join([oriented.adjustment.block, *(a.block for a in held)])
        inner = [_held_information(a) for a in held]
        self.information: FloatArray = block_diag(information, *inner)
        self.sizes = [len(block), *(len(a.block) for a in held)]
        self._n_own_lens = N_CALIBRATION * len(lens.intrinsics)
        self.first = np.concatenate([[0], np.cumsum(self.sizes)]).astype(np.int64)
        self.features = [*features, *(f for anchor in anchors for f in anchor.features)]

    def shared(self, position_std: float, on_step: Step | None) -> tuple[Observations, list[int]]:
        """Points seen by the new flight and an anchor, and how many there are for each anchor."""
        ground, ties = self.matching.ground, self.settings.ties
        flight = self.start.flight
        candidates = [
            (i, j)
            for i, j in overlapping_pairs(self.start, ground, ties.min_overlap)
            if (flight[i] == 0) != (flight[j] == 0)
        ]
        done = iter(range(1, len(candidates) + 1))

        def on_pair() -> None:
            if on_step is not None:
                on_step(next(done, len(candidates)), len(candidates), "ties to earlier flights")

        between = match_pairs(
            self.features,
            self.start,
            ground,
            candidates,
            ties,
            position_std=position_std,
            workers=self.settings.workers,
            on_pair=on_pair,
        )
        within = list(self.matching.pairs)
        for anchor, first in zip(self.anchors, self.first[1:], strict=False):
            within += [PairMatches(p.first + int(first), p.second + int(first), p.match) for p in anchor.pairs]
        shared = shared_between_flights(self.given, join_matches(self.features, within + between, ties.sigma))
        seen = count_shared(self.given, shared)
        return shared, [int(seen[0, k + 1]) for k in range(len(self.anchors))]

    def solve(self, shared: Observations, name: str, origin: LocalFrame, on_step: Step | None) -> AnchoredFlight:
        """Adjust, leave out ground that changed, adjust again."""
        settings, own = self.settings, self.oriented.observations
        total = 2 + settings.adjustment.rounds
        done = iter(range(1, total + 1))

        def on_round() -> None:
            if on_step is not None:
                on_step(next(done, total), total, "adjustment to earlier flights")

        rough = replace(settings.adjustment, rounds=2, min_views=2, heeds_contradiction=False)
        both = Observations.join([own, shared])
        first = adjust(self.given, both, self.information, rough, start=self.start, on_round=on_round)
        is_shared = first.origin >= own.n_points
        kept, _ = first.observations.keep(is_shared[first.observations.point])
        names = (name, *(anchor.name for anchor in self.anchors))
        unmoved, moved = drop_changed(first.block, kept, settings.joint, names)
        before, after = count_shared(self.given, kept), count_shared(self.given, unmoved)
        last = replace(settings.adjustment, lens=(), min_views=settings.min_views, heeds_contradiction=False)
        both = Observations.join([own, unmoved])
        final = adjust(self.given, both, self.information, last, start=first.block, on_round=on_round)
        covariance = self._considered(final)
        mine = np.flatnonzero(final.origin < own.n_points)
        new = self._rows(0)
        cross = {a.name: covariance[np.ix_(new, self._rows(k))] for k, a in enumerate(self.anchors, start=1)}
        finished = FinishedFlight(self._own_part(final, covariance, mine), origin, cross)
        factor = error_factor(covariance)
        later = point_modes(final, mine, factor)
        differences = {}
        for k, (anchor, adjusted) in enumerate(zip(self.anchors, self.held, strict=True), start=1):
            rows = self._rows(k)
            earlier = point_modes(adjusted, np.arange(len(adjusted.points)), np.ascontiguousarray(factor[rows]))
            differences[anchor.name] = common_error(later, earlier)
        counts = range(1, len(names))
        return AnchoredFlight(
            finished,
            {names[k]: int(after[0, k]) for k in counts},
            {names[k]: int(before[0, k] - after[0, k]) for k in counts},
            differences,
            moved,
        )

    def _rows(self, flight: int) -> IntArray:
        """Unknowns of a flight's poses and lens."""
        n_images = int(self.first[-1])
        poses = np.arange(6 * self.first[flight], 6 * self.first[flight + 1])
        lenses = np.flatnonzero(np.isin(np.arange(len(self.given.intrinsics)), self._lenses(flight)))
        inner = [6 * n_images + N_CALIBRATION * lens + np.arange(N_CALIBRATION) for lens in lenses]
        return np.concatenate([poses, *inner]).astype(np.int64)

    def _lenses(self, flight: int) -> IntArray:
        return np.unique(self.given.lens[self.first[flight] : self.first[flight + 1]])

    def _considered(self, final: Adjustment) -> FloatArray:
        """
        Covariance of all poses and lenses, the held ones with the covariance they were published with.

        The new poses follow the held ones, their lenses and the new flight's lens, whose covariance is that of its
        adjustment alone.
        """
        new, n = self._rows(0), len(final.camera_covariance)
        poses, lenses = np.arange(6 * self.first[1], 6 * self.first[-1]), np.arange(6 * self.first[-1], n)
        held = np.concatenate([poses, lenses[self._n_own_lens :]])
        doubt = np.diag(final.camera_covariance)[lenses] * np.any(final.lens_slope != 0, axis=0)
        narrow = final.camera_covariance - (final.lens_slope * doubt) @ final.lens_slope.T
        cross = narrow[np.ix_(new, poses)]
        gain = np.linalg.solve(narrow[np.ix_(poses, poses)], cross.T).T
        out = np.zeros((n, n))
        for k, a in enumerate(self.held, start=1):
            rows = self._rows(k)
            out[np.ix_(rows, rows)] = a.camera_covariance
            for j, other in enumerate(self.anchors, start=1):
                between = self.finished[k - 1].cross.get(other.name)
                if between is not None:
                    out[np.ix_(rows, self._rows(j))] = between
                    out[np.ix_(self._rows(j), rows)] = between.T
        own = self._n_own_lens
        slope = final.lens_slope[new]
        follows = np.hstack([gain, slope[:, own:]])
        lens = self.oriented.adjustment.camera_covariance[-own:, -own:]
        known = narrow[np.ix_(new, new)] - gain @ cross.T + slope[:, :own] @ lens @ slope[:, :own].T
        out[np.ix_(new, new)] = known + follows @ out[np.ix_(held, held)] @ follows.T
        out[np.ix_(new, held)] = follows @ out[np.ix_(held, held)]
        out[np.ix_(held, new)] = out[np.ix_(new, held)].T
        return np.asarray(0.5 * (out + out.T))

    def _own_part(self, final: Adjustment, covariance: FloatArray, mine: IntArray) -> Adjustment:
        """The new flight without its anchors."""
        rows, n = self._rows(0), self.sizes[0]
        chosen = np.zeros(len(final.points), dtype=bool)
        chosen[mine] = True
        mask = chosen[final.observations.point]
        observations, kept = final.observations.keep(mask, min_views=1)
        lenses = self.oriented.adjustment.block.intrinsics.shape[0]
        return replace(
            final,
            block=replace(
                final.block.select(np.arange(n)),
                intrinsics=final.block.intrinsics[:lenses],
                size=final.block.size[:lenses],
            ),
            points=final.points[kept],
            observations=observations,
            weight=final.weight[mask],
            origin=final.origin[kept],
            camera_covariance=covariance[np.ix_(rows, rows)],
            lens_correction=self.oriented.adjustment.lens_correction,
            lens_std=self.oriented.adjustment.lens_std,
            boresight=final.boresight[:1],
            boresight_std=final.boresight_std[:1],
            pose_correction=final.pose_correction[:n],
            prior_chi2=final.prior_chi2 * len(final.block) / n,  # the held poses do not deviate
        )


def _turning(turn: FloatArray, size: int) -> FloatArray:
    """Rotation of the axes of all poses, lens parameters (the last ones) left alone."""
    whole = np.eye(size)
    n = (size - N_CALIBRATION) // 3
    whole[: 3 * n, : 3 * n] = np.kron(np.eye(n), turn)
    return whole


def _require_one_lens(flight: FinishedFlight, name: str) -> None:
    lenses = len(flight.adjustment.block.intrinsics)
    if lenses != 1:
        msg = f"Flight {name} was taken with {lenses} lenses; flights can be adjusted to those taken with one."
        raise InputDataError(msg)


def _held_information(adjustment: Adjustment) -> FloatArray:
    """Information that holds the poses of a published flight."""
    n = 6 * len(adjustment.block)
    covariance = adjustment.camera_covariance[:n, :n]
    std = np.sqrt(np.diag(covariance))
    inverse = np.linalg.inv(covariance / np.outer(std, std)) / np.outer(std, std)
    return np.asarray(0.5 * _HELD * (inverse + inverse.T))
