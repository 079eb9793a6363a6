"""The figures of the paper's tables and of one run end to end."""

import numpy as np
from support.end_to_end import make_table
from support.plants import LBT_YAML

import lbt_synth as lbt
from lbt_synth.report.figures.end_to_end import end_to_end_figure, end_to_end_table_figure


def test_the_figure_has_a_panel_a_controller():
    figure = end_to_end_table_figure(make_table())
    assert [axis.get_title(loc="left") for axis in figure.axes] == ["Kalman", "H∞", "slow"]
    assert figure.axes[0].lines[0].get_label() == "Agapito et al. 2008"


def test_a_run_has_three_panels_and_a_colour_bar():
    rng = np.random.default_rng(0)
    run = lbt.interop.EndToEndRun(
        system=lbt.load_config(LBT_YAML).end_to_end.system,
        strehl_series=np.full(40, 0.8),
        other_modes_series=np.full(40, 0.9),
        **{
            name: rng.normal(size=(40, 672)) for name in ("measurements", "commands", "residual_nm")
        },
        psf=np.eye(60),
        psf_pixel_mas=18.4,
        seed=0,
        settle_frames=400,
        seconds=1.0,
    )
    assert len(end_to_end_figure(run).axes) == 4
