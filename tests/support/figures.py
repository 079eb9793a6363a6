"""What tests read out of figures."""


def legend(axis):
    """Names of what is drawn in a plot, in order; the figure's legend shows those of all plots."""

    def names(one):
        return one.get_legend_handles_labels()[1]

    (shown,) = axis.figure.legends
    everywhere = dict.fromkeys(name for one in axis.figure.axes for name in names(one))
    assert sorted(text.get_text() for text in shown.get_texts()) == sorted(everywhere)
    return list(dict.fromkeys(names(axis)))
