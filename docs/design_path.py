"""Draw the path of a design for the architecture page: ``python docs/design_path.py``."""

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

STEPS = (
    ("configuration", "YAML, units in keys", "config"),
    ("plant", "turbulence, vibrations,\nsensor, delay, mirror", "models"),
    ("gain", "Riccati, LMI or SDP", "linear"),
    ("certificate", "by other means\nthan the solver", "design"),
    ("gain file", "FITS, NPZ", "files"),
    ("loop", "residual, margins,\nStrehl in the truth", "loop"),
)
WIDTH, HEIGHT, GAP = 1.75, 1.15, 0.45
INK, PAPER, ACCENT = "#222222", "#f4f4f0", "#0072b2"


def draw() -> Figure:
    """Return the figure: six boxes, left to right, with the room of each below."""
    total = len(STEPS) * WIDTH + (len(STEPS) - 1) * GAP
    figure = Figure(figsize=(total + 0.3, HEIGHT + 0.75), dpi=110)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(-0.15, total + 0.15)
    axes.set_ylim(-0.6, HEIGHT + 0.15)
    axes.set_axis_off()
    for i, (title, detail, room) in enumerate(STEPS):
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
        axes.text(
            middle, -0.28, f"lbt.{room}", ha="center", va="center", family="monospace", color=ACCENT
        )
        if i:
            axes.annotate(
                "",
                (left, HEIGHT / 2),
                (left - GAP, HEIGHT / 2),
                arrowprops={"arrowstyle": "-|>", "color": INK, "shrinkA": 2, "shrinkB": 2},
            )
    return figure


if __name__ == "__main__":
    target = Path(__file__).parent / "figures" / "design_path.png"
    draw().savefig(target)
    print(target)
