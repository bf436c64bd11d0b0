"""Unchanged ground is what no significant region covers."""

import numpy as np
import pytest
from error_fields import quiet

from changedetect.differencing.coarse import block_means
from changedetect.differencing.correlation import NestedCorrelation
from changedetect.differencing.stable_ground import find_changed

LOCAL, LONGER = NestedCorrelation((1.5,), (1.0,)), NestedCorrelation((8.0,), (1.0,))


def changed(d, local=0.01, correlated=0.03):
    variances = (np.full(d.shape, local**2), np.full(d.shape, correlated**2))
    return find_changed(d, variances, (LOCAL, LONGER), np.inf, 1.0, 1.5)


def test_block_means_leave_out_what_is_not_known():
    values = np.arange(15.0).reshape(3, 5)
    known = np.ones((3, 5), bool)
    known[0, 0] = False
    mean, share = block_means(values, known, 2)
    np.testing.assert_allclose(mean[0, 0], (1.0 + 5.0 + 6.0) / 3.0, rtol=1e-12, atol=0.0)
    np.testing.assert_allclose(share, [[0.75, 1.0, 0.5], [0.5, 0.5, 0.25]], rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("side", [200, 900])
def test_a_changed_patch_is_found_and_quiet_ground_kept(side):
    d = quiet(3, (side, side), correlated=0.03, length=8.0)
    d[50:110, 60:120] += 0.3
    found = changed(d)
    assert found[50:110, 60:120].mean() > 0.95
    found[45:115, 55:125] = False
    assert found.mean() < 0.03


def test_ground_without_change_is_kept_whole():
    assert changed(quiet(4, correlated=0.03, length=8.0)).mean() < 0.03


def test_unknown_ground_is_neither_changed_nor_in_the_way():
    d = quiet(5, correlated=0.03, length=8.0)
    d[:, 150:] = np.nan
    assert changed(d).mean() < 0.03
