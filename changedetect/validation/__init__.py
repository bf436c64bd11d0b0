"""Surface models judged by observations they have not seen: hold-outs, scores, cost."""

from changedetect.validation.comparison import compare_methods, plan_comparison
from changedetect.validation.methods import Method, known_methods
from changedetect.validation.results import Comparison, ComparisonOptions
from changedetect.validation.scores import Scores, score
from changedetect.validation.splits import hold_out_blocks, hold_out_random

__all__ = [
    "Comparison",
    "ComparisonOptions",
    "Method",
    "Scores",
    "compare_methods",
    "hold_out_blocks",
    "hold_out_random",
    "known_methods",
    "plan_comparison",
    "score",
]
