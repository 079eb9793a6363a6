"""Contents of the pages that people read."""

from lbt_synth.report.designs import DesignReport, design_report
from lbt_synth.report.designs_assessment import DesignAssessment
from lbt_synth.report.designs_page import write_report

__all__ = ["DesignAssessment", "DesignReport", "design_report", "write_report"]
