"""One rendered flight, matched and oriented once for all tests that look at it."""

from __future__ import annotations

import pytest
from photogrammetry import rendered

from changedetect.photogrammetry.block import ImageBlock
from changedetect.photogrammetry.orientation import OrientationSettings, match_flight, orient_flight
from changedetect.photogrammetry.priors import pose_information
from changedetect.photogrammetry.ties import TieSettings, detect_features
from changedetect.photogrammetry.tracks import TrackSettings

SETTINGS = OrientationSettings(tracks=TrackSettings(n_features=400), ties=TieSettings(n_features=500))


class Case:
    """A flight and what became of it."""

    def __init__(self, seed, **options):
        self.flown = rendered.fly(seed, n_photos=4, **options)
        self.poses = rendered.perturbed(self.flown.truth, seed + 100)
        self.settings = SETTINGS
        self.block = ImageBlock.from_poses(self.poses, rendered.CAMERA)
        self.true_block = ImageBlock.from_poses(self.flown.truth, rendered.CAMERA)
        self.information = pose_information(self.poses, common_std=0.5)
        self.features = detect_features(self.flown, len(self.block), SETTINGS.ties)
        self.matching = match_flight(self.flown, self.features, self.block, (0.3, 0.003), SETTINGS)
        self.oriented = orient_flight(self.flown, self.block, self.information, self.matching, SETTINGS)


@pytest.fixture(scope="session")
def case():
    return Case(0)


@pytest.fixture(scope="session")
def later_case():
    """The same ground with a mound, flown again."""
    return Case(1, ground=rendered.raised_hills, prefix="q")
