from . import figures as figures
from .designs.page import design_page as design_page
from .designs.report import design_report as design_report
from .page.html import write_page as write_page
from .study import study_page as study_page
