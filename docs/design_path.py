"""Draw the path of a design, and that of a sensor gain: ``python docs/design_path.py``."""

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

# title, detail and what stands below of each box
DESIGN = (
    ("configuration", "YAML, units in keys", "lbt.config"),
    ("plant", "turbulence, vibrations,\nsensor, delay, mirror", "lbt.models"),
    ("gain", "Riccati, LMI or SDP", "lbt.linear"),
    ("certificate", "by other means\nthan the solver", "lbt.design"),
    ("gain file", "FITS, NPZ", "lbt.files"),
    ("loop", "residual, margins,\nStrehl in the truth", "lbt.loop"),
)
GAIN = (
    ("residual phase", "1 nm rms wavefront", "in the truth"),
    ("sensor", "shows g nm of it:\nits optical gain", "truth.sensor_gain"),
    ("raw measurement y", "g nm, in records and\nin real-time computers", "--sensor-gain"),
    ("controller", "its matrices hold the\ngain that it assumes", "model.sensor_gain"),
    ("loop", "stable for the factors\ng over the assumed gain", "stable gain factors"),
)
WIDTH, HEIGHT, GAP = 1.75, 1.15, 0.45
INK, PAPER, ACCENT = "#222222", "#f4f4f0", "#0072b2"


def draw(steps: tuple[tuple[str, str, str], ...]) -> Figure:
    """Return the figure: boxes, left to right, with a name below each."""
    total = len(steps) * WIDTH + (len(steps) - 1) * GAP
    figure = Figure(figsize=(total + 0.3, HEIGHT + 0.75), dpi=110)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(-0.15, total + 0.15)
    axes.set_ylim(-0.6, HEIGHT + 0.15)
    axes.set_axis_off()
    for i, (title, detail, name) in enumerate(steps):
        left = i * (WIDTH + GAP)
        axes.add_patch(
            FancyBboxPatch(
                (left, 0),
                WIDTH,
                HEIGHT,
                boxstyle="round,pad=0,rounding_size=0.1",
                facecolor=PAPER,
                edgecolor=INK,
                linewidth=1.2,
            )
        )
        middle = left + WIDTH / 2
        axes.text(middle, HEIGHT - 0.25, title, ha="center", va="center", weight="bold", color=INK)
        axes.text(middle, 0.4, detail, ha="center", va="center", fontsize=8.5, color=INK)
        axes.text(middle, -0.28, name, ha="center", va="center", family="monospace", color=ACCENT)
        if i:
            axes.annotate(
                "",
                (left, HEIGHT / 2),
                (left - GAP, HEIGHT / 2),
                arrowprops={"arrowstyle": "-|>", "color": INK, "shrinkA": 2, "shrinkB": 2},
            )
    return figure


if __name__ == "__main__":
    for name, steps in (("design_path", DESIGN), ("sensor_gain", GAIN)):
        target = Path(__file__).parent / "figures" / f"{name}.png"
        draw(steps).savefig(target)
        print(target)
