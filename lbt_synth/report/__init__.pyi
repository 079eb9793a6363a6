from . import figures as figures
from .designs.page import write_report as write_report
from .designs.report import design_report as design_report
from .study import write_study_page as write_study_page
