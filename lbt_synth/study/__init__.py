"""Robustness studies: samples of a configuration, evaluated on any number of processes."""

from lbt_synth.study.batch import evaluate_samples
from lbt_synth.study.load import load_study
from lbt_synth.study.result import BatchResult, Failure
from lbt_synth.study.study import Parameter, Study, StudyController

__all__ = [
    "BatchResult",
    "Failure",
    "Parameter",
    "Study",
    "StudyController",
    "evaluate_samples",
    "load_study",
]
