"""Fits of one kind: what is put in is found, without bias from the reference's own noise."""

import numpy as np
import pytest
import rolling_ground as rolling

from changedetect.coregistration.estimation import instruments, solve
from changedetect.coregistration.sample import Sample
from changedetect.coregistration.transform import Transform


def _sample(cloud):
    return Sample.of(cloud, np.zeros(len(cloud), dtype=np.int64))


def _solved(kind, smoothing=8.0, reference=None, **how):
    sample = _sample(rolling.epoch(**how))
    start = Transform("vertical", sample.centre, (0.0,)).as_kind(kind)
    return solve(sample, reference or rolling.reference(noise=0.0), start, smoothing), sample


@pytest.mark.parametrize("shift", [(0.3, -0.2, 0.4), (3.0, 2.0, -5.0)])
def test_a_shift_without_noise_is_found_to_the_interpolation_error(shift):
    fit, _ = _solved("shift", shift=shift, noise=0.0, margin=10.0)
    assert fit.is_converged
    np.testing.assert_allclose(fit.transform.shift, shift, rtol=0, atol=2e-4)


def test_a_rotation_and_scale_without_noise_are_found():
    turn, scale = (1e-3, -2e-3, 4e-3), 2e-3
    fit, _ = _solved("rigid_scale", shift=(0.3, -0.2, 0.4), turn=turn, scale=scale, noise=0.0, margin=10.0)
    assert fit.is_converged
    np.testing.assert_allclose(fit.transform.parameters[3:6], turn, rtol=0, atol=5e-6)
    assert fit.transform["scale"] == pytest.approx(scale, abs=5e-6)


def test_a_tilt_without_noise_is_found():
    fit, _ = _solved("shift_tilt", shift=(0.3, -0.2, 0.4), tilt=(1e-3, -2e-3), noise=0.0, margin=10.0)
    np.testing.assert_allclose(fit.transform.parameters[3:], (1e-3, -2e-3), rtol=0, atol=1e-5)


def test_noise_of_the_reference_does_not_draw_the_shift_to_half_a_cell():
    # with the gradient itself in place of the instruments the shift comes out at about 0.73
    found = []
    for seed in range(6):
        reference = rolling.reference(seed, noise=0.08)
        fit, _ = _solved("shift", None, reference, seed=seed, shift=(0.7, 0.0, 0.0), noise=0.02)
        found.append(fit.transform.shift)
    np.testing.assert_allclose(np.mean(found, axis=0), (0.7, 0.0, 0.0), rtol=0, atol=0.006)


def test_instruments_less_their_local_mean_do_not_follow_long_slopes():
    fit, sample = _solved("shift", noise=0.0)
    plain, detail = instruments(sample, fit, None), instruments(sample, fit, 2.0)
    rows = sample.squares.row[sample.squares.member]
    lower = rows < np.median(rows)
    left = sample.squares.column[sample.squares.member] < 5
    corner = lower & left
    assert abs(detail[corner, 0].mean()) < 0.3 * abs(plain[corner, 0].mean())
    np.testing.assert_array_equal(detail[:, 2], plain[:, 2])


def test_a_fit_on_flat_ground_does_not_pretend_to_converge_to_a_shift():
    reference = rolling.reference(noise=0.0, surface=rolling.flat)
    fit, _ = _solved("shift", reference=reference, surface=rolling.flat, shift=(0.5, 0.0, 0.2), noise=0.02)
    np.testing.assert_allclose(fit.transform.shift, (0.0, 0.0, 0.2), rtol=0, atol=2e-3)
