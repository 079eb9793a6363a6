"""Robustness studies: controllers on many samples of what the loop may meet."""

from lbt_synth.study.statistics import ControllerStatistics, StudyStatistics, study_statistics
from lbt_synth.study.summary import summary_tables
from lbt_synth.study.variance import first_order_index

__all__ = [
    "ControllerStatistics",
    "StudyStatistics",
    "first_order_index",
    "study_statistics",
    "summary_tables",
]
