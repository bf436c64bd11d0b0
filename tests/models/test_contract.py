"""Every surface model is put through every check of the contract."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest

from changedetect.models import checks
from changedetect.models.checks import CHECKS, ContractViolationError, check_surface_model
from changedetect.models.comparators import (
    BlockMean,
    DelaunayLinear,
    ExactGPR,
    LocalGPR,
    NeighbourKriging,
    SparseGPR,
    comparators,
)
from changedetect.models.lwpr import LWPRSurface
from changedetect.models.reference import ReferenceLWPR

#: Small subsamples for covariances: a contract is about behaviour, and every check fits several times.
QUICK = {"n_blocks": 6, "block_size": 40}

#: Every surface model of the project, by name: a factory of fresh models. Add new ones here.
MODELS = {
    "lwpr": LWPRSurface,
    "reference": ReferenceLWPR,
    "gpr_rbf": partial(ExactGPR, kernel="rbf", n_subsample=150),
    "gpr_matern32": partial(ExactGPR, kernel="matern32", n_subsample=150),
    "local_gpr": partial(LocalGPR, **QUICK),
    "lgpr_without_overlap": partial(LocalGPR, overlap=0.0, points_per_model=100, **QUICK),
    "sparse_gpr": partial(SparseGPR, n_inducing=150, **QUICK),
    "sparse_gpr_variational": partial(SparseGPR, n_inducing=150, approximation="sgpr", **QUICK),
    "kriging": partial(NeighbourKriging, **QUICK),
    "delaunay": DelaunayLinear,
    "block_mean": BlockMean,
}

#: (model, check) pairs that a model does not promise, each with the reason. Nothing else is left out.
EXEMPT = {
    ("block_mean", "check_surface_is_learned"): "the slope inside a block counts as noise and is not followed",
    ("reference", "check_translation_changes_little"): (
        "learning one sample at a time depends on their order, which follows from the coordinates"
    ),
}

PROMISES = [
    pytest.param(factory, check, id=f"{name}-{check.__name__.removeprefix('check_')}")
    for name, factory in MODELS.items()
    for check in CHECKS
    if (name, check.__name__) not in EXEMPT
]


@pytest.mark.parametrize(("factory", "check"), PROMISES)
def test_model_keeps_its_promises(factory, check):
    check(factory)


def test_exemptions_name_models_and_checks_that_exist():
    names = {check.__name__ for check in CHECKS}
    for model, check in EXEMPT:
        assert model in MODELS
        assert check in names


def test_every_comparator_is_under_contract():
    assert set(comparators()) <= set(MODELS)


def test_every_check_function_is_run():
    defined = {name for name in vars(checks) if name.startswith("check_")} - {"check_surface_model"}
    assert defined == {check.__name__ for check in CHECKS}


class Meddling(NeighbourKriging):
    def partial_fit(self, coordinates, elevation, sigma=None, survey_time=None):
        elevation -= elevation.mean()
        return super().partial_fit(coordinates, elevation, sigma, survey_time)


def test_a_model_that_writes_into_its_inputs_is_caught():
    with pytest.raises(ContractViolationError, match="an input array was changed"):
        check_surface_model(Meddling)


class Overconfident(NeighbourKriging):
    def predict(self, coordinates):
        answer = super().predict(coordinates)
        return dataclasses.replace(answer, elevation=np.nan_to_num(answer.elevation))


def test_a_model_that_answers_everywhere_is_caught():
    with pytest.raises(ContractViolationError, match="n_effective is not positive at an answer"):
        check_surface_model(Overconfident)
    with pytest.raises(ContractViolationError, match="claimed far from all data"):
        check_surface_model(Overconfident, exempt=["check_prediction_is_well_formed"])


def test_an_exemption_from_an_unknown_check_is_refused():
    with pytest.raises(ValueError, match="No check is called check_colour"):
        check_surface_model(NeighbourKriging, exempt=["check_colour"])
