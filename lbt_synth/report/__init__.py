"""Contents of the pages that people read: designs, studies."""

from lbt_synth.report.designs import DesignReport, design_report
from lbt_synth.report.designs_assessment import DesignAssessment
from lbt_synth.report.designs_page import write_report
from lbt_synth.report.study_files import write_study_page

__all__ = [
    "DesignAssessment",
    "DesignReport",
    "design_report",
    "write_report",
    "write_study_page",
]
