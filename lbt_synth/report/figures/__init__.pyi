from .loops import loop_figure as loop_figure
from .records import identification_figure as identification_figure
from .studies import robustness_map_figure as robustness_map_figure
