from . import figures as figures
from .designs import design_page as design_page
from .page.html import write_page as write_page
from .pages import study_page as study_page
