"""The distribution of the largest of many scores."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from changedetect.timeseries.null import LARGEST_SCORE, both_exceed_table, interval_p_values


@pytest.mark.parametrize("score", [0.5, 2.0, 3.5])
@pytest.mark.parametrize("column", [8, 40, 90])
def test_the_table_is_that_of_the_bivariate_normal(score, column):
    table = both_exceed_table()
    n, m = table.shape
    rho = 1.0 - (column / (m - 1)) ** 2
    row = round(score / LARGEST_SCORE * (n - 1))
    c = row * LARGEST_SCORE / (n - 1)
    normal = stats.multivariate_normal([0.0, 0.0], [[1.0, rho], [rho, 1.0]])
    both = 2.0 * (normal.cdf([-c, -c]) + stats.norm.cdf(-c) - normal.cdf([-c, c]))
    assert_allclose(table[row, column], both / (2.0 * stats.norm.sf(c)), rtol=2e-3, atol=1e-5)


def test_the_table_ends_where_scores_are_the_same_or_independent():
    table = both_exceed_table()
    assert (table[:, 0] == 1.0).all()
    c = np.linspace(0.0, LARGEST_SCORE, table.shape[0])[:60]
    assert_allclose(table[:60, -1], 2.0 * stats.norm.sf(c), rtol=1e-6, atol=0)
    assert (np.diff(table, axis=1) <= 1e-12).all()


def test_p_values_of_intervals_lie_between_one_contrast_and_all_of_them():
    scores = np.array([2.0, 3.0, 4.0, 6.0, np.nan])
    for m in (3, 7, 14, 50):
        found = interval_p_values(scores, np.full(5, float(m)))
        single = 2.0 * stats.norm.sf(scores[:4])
        assert (found[:4] >= single * (1 - 1e-12)).all()
        assert (found[:4] <= np.minimum(1.0, single * (m - 1) * (m - 2) / 2) * (1 + 1e-12)).all()
        assert math.isnan(found[4])


def test_two_surveys_have_no_interval():
    assert np.isnan(interval_p_values(np.array([3.0]), np.array([2.0]))).all()
