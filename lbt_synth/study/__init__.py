"""Robustness studies: samples of a configuration, on any number of processes, and what they say."""

from lbt_synth.study.batch import evaluate_samples
from lbt_synth.study.estimate import Estimate, estimate_study
from lbt_synth.study.load import load_study
from lbt_synth.study.replay import Replay, replay_row
from lbt_synth.study.result import BatchResult, Failure
from lbt_synth.study.run import StudyRun, run_study
from lbt_synth.study.statistics import ControllerStatistics, StudyStatistics, study_statistics
from lbt_synth.study.study import Parameter, Study, StudyController
from lbt_synth.study.summary import summary_tables
from lbt_synth.study.variance import first_order_index

__all__ = [
    "BatchResult",
    "ControllerStatistics",
    "Estimate",
    "Failure",
    "Parameter",
    "Replay",
    "Study",
    "StudyController",
    "StudyRun",
    "StudyStatistics",
    "estimate_study",
    "evaluate_samples",
    "first_order_index",
    "load_study",
    "replay_row",
    "run_study",
    "study_statistics",
    "summary_tables",
]
