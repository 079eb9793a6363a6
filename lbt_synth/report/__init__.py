"""Contents of the pages that people read: designs, studies."""

from lbt_synth.report.study_files import write_study_page

__all__ = ["write_study_page"]
