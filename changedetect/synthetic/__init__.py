"""
Terrains and surveys with known truth.

A `Scene` is the truth about a site: elevation at every stage, noise, changes, each a `Surface` that can be evaluated
anywhere. `survey_points` and `survey_dem` observe it; `simulate_programme` does so epoch after epoch. Everything is
drawn from seeded generators and stays in memory: writing files is the caller's business.
"""

from __future__ import annotations

from changedetect.synthetic.noise import CanopyNoise, EastwardNoise, SlopeNoise
from changedetect.synthetic.patches import Change, ChangePatch, Ellipse, Footprint, Rectangle, ScarpRetreat
from changedetect.synthetic.programmes import (
    DEMO_SEED,
    EpochPlan,
    SimulatedEpoch,
    SimulatedProgramme,
    TrueVolume,
    benchmark_dems,
    benchmark_points,
    demo_programme,
    simulate_programme,
)
from changedetect.synthetic.scenes import Scene, coast_scene, dem_scene, demo_scene, patch_scene, trees_scene
from changedetect.synthetic.surfaces import Constant, Plane, PlaneWaves, Surface, SurfaceSum, rasterize
from changedetect.synthetic.surveys import (
    CorrelatedError,
    DemSurvey,
    Survey,
    SurveyDesign,
    SurveyErrors,
    survey_dem,
    survey_points,
)
from changedetect.synthetic.terrain import (
    Channel,
    DuneCrests,
    Scarp,
    Trees,
    analytic_ground,
    correlated_field,
    fractal_ground,
    random_trees,
)

__all__ = [
    "DEMO_SEED",
    "CanopyNoise",
    "Change",
    "ChangePatch",
    "Channel",
    "Constant",
    "CorrelatedError",
    "DemSurvey",
    "DuneCrests",
    "EastwardNoise",
    "Ellipse",
    "EpochPlan",
    "Footprint",
    "Plane",
    "PlaneWaves",
    "Rectangle",
    "Scarp",
    "ScarpRetreat",
    "Scene",
    "SimulatedEpoch",
    "SimulatedProgramme",
    "SlopeNoise",
    "Surface",
    "SurfaceSum",
    "Survey",
    "SurveyDesign",
    "SurveyErrors",
    "Trees",
    "TrueVolume",
    "analytic_ground",
    "benchmark_dems",
    "benchmark_points",
    "coast_scene",
    "correlated_field",
    "dem_scene",
    "demo_programme",
    "demo_scene",
    "fractal_ground",
    "patch_scene",
    "random_trees",
    "rasterize",
    "simulate_programme",
    "survey_dem",
    "survey_points",
    "trees_scene",
]
