"""Five controllers and the limit, over the vibration's frequency and the sensor gain.

Run with ``python benchmarks/robustness.py`` from the repository (some minutes). Prints the table
of docs/robustness.md and writes its figure to docs/figures/robustness_story.png.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import minimize

import lbt_synth as lbt
from lbt_synth.loop.band_limit import least_worst_residual
from lbt_synth.report.draw import house_style
from lbt_synth.studies import paper as paper
from lbt_synth.studies.limits import limits
from lbt_synth.studies.paper import paper_filters

ERRORS = np.arange(-7, 8) / 2
GAINS = [1.0, 0.7, 0.5, 0.358]
CAMERA = replace(paper.IMAGING, other_modes=0.841)
TRUTH = replace(paper.PAPER_TRUTH, sensor_gain=1.0)
AR2 = lbt.models.ar2_turbulence(
    paper.ATMOSPHERE, frame_rate_hz=paper.FRAME_RATE_HZ, noise_nm=paper.NOISE_NM
)


def plant(turbulence: lbt.models.ARModel, damping: float, rms_nm: float) -> lbt.models.TipTiltPlant:
    """One line at 20 Hz on either axis."""
    return lbt.tip_tilt_plant(
        frame_rate_hz=paper.FRAME_RATE_HZ,
        turbulence=turbulence,
        noise_nm=paper.NOISE_NM,
        vibrations=[
            lbt.Vibration(frequency_hz=20, damping=damping, rms_nm=rms_nm, direction=d)
            for d in ((1.0, 0.0), (0.0, 1.0))
        ],
    )


def worst_strehl(design: lbt.Design, errors=ERRORS) -> np.ndarray:
    """Worst Strehl ratio over the rows, at each sensor gain [%]; 0 where unstable."""
    found = lbt.studies.robustness_map(design, TRUTH, CAMERA, errors_hz=errors, sensor_gains=GAINS)
    return 100 * np.min(np.nan_to_num(found.strehl[0]), axis=1)


def tuned(make, start: list[float], what: str) -> lbt.Design:
    """Design whose mean over the gains of the worst Strehl ratio is largest."""

    def cost(x: np.ndarray) -> float:
        try:
            return -float(np.mean(worst_strehl(make(*np.exp(x)), ERRORS[::2])))
        except (lbt.errors.SynthesisError, lbt.errors.ProblemError):
            return 0.0

    options = {"maxfev": 90, "xatol": 1e-2}
    parameters = np.exp(minimize(cost, np.log(start), method="Nelder-Mead", options=options).x)
    print(f"{what}: damping {parameters[0]:.4f}, rms {parameters[1]:.1f} nm")
    return make(*parameters)


def multi_mode(damping: float, rms_nm: float) -> lbt.design.FilterDesign:
    """Kalman filter of AR2 turbulence and five lines from 16.5 to 23.5 Hz."""
    return lbt.kalman(
        lbt.models.spread_plant(plant(AR2, damping, rms_nm), half_width_hz=3.5, lines=5)
    )


def designs() -> dict[str, lbt.Design]:
    """The five, from the paper's to the shaped one."""
    kalman, hinf = paper_filters()
    slow = paper.turbulence_model()
    return {
        "Kalman of the paper": kalman,
        "H-infinity of the paper": hinf,
        "Kalman, tuned": tuned(
            lambda k, rms: lbt.kalman(plant(slow, k, rms)), [0.1, 800.0], "Kalman, AR1 turbulence"
        ),
        "Kalman, AR2, five lines, tuned": tuned(
            multi_mode, [0.02, 400.0], "Kalman, AR2 turbulence, five lines"
        ),
        "shaped": lbt.load_config("examples/lbt_robust.yaml").design("robust"),
    }


def limit_strehl(residual_nm: float) -> float:
    """Strehl ratio of a residual shared evenly by the axes [%]."""
    return 100 * lbt.strehl(np.eye(2) * residual_nm**2 / 2, CAMERA)


def main() -> None:
    """Print the table, draw the figure."""
    every = designs()
    bands = {
        gain: least_worst_residual(
            every["shaped"].hardware,
            replace(TRUTH, vibrations=(), sensor_gain=gain),
            band_hz=(16.5, 23.5),
            rms_nm=paper.VIBRATION_NM,
        ).rms_nm
        for gain in GAINS
    }
    print(
        "| controller | worst Strehl ratio [%] at 1 | 0.7 | 0.5 | 0.358 | stable sensor gains ",
        end="",
    )
    print("| modulus margin | states | worst residual [nm] | above the limit [%] |")
    study = limits(every, every["shaped"].hardware, TRUTH, CAMERA, errors_hz=ERRORS)
    for (name, design), row in zip(every.items(), study.rows, strict=True):
        margins = lbt.loop_margins(lbt.close_loop(design.hardware, design.controller))
        strehls = " | ".join(f"{s:.2f}" for s in worst_strehl(design))
        print(
            f"| {name} | {strehls} | {margins.gain_low:.2f}-{margins.gain_high:.2f} "
            f"| {margins.modulus:.2f} | {design.controller.n_states // 2} "
            f"| {row.worst_nm:.1f} | {row.above_band_limit_percent:.0f} |"
        )
    print("| limit |", *(f"{limit_strehl(bands[g]):.2f} |" for g in GAINS), f"{bands[1.0]:.1f} nm")
    draw(every, bands)


def draw(every: dict[str, lbt.Design], bands: dict[float, float]) -> None:
    """Strehl ratio over the true frequency, at two sensor gains."""
    shifts = np.linspace(-3.5, 3.5, 71)
    styles = ["-", "--", "-.", (0, (1, 1)), "-"]
    colours = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "black"]
    with house_style():
        figure, axes = plt.subplots(1, 2, figsize=(9, 4), sharey=True, layout="constrained")
        for axis, gain in zip(axes, (1.0, 0.358), strict=True):
            for (name, design), style, colour in zip(every.items(), styles, colours, strict=True):
                found = lbt.studies.robustness_map(
                    design, TRUTH, CAMERA, errors_hz=shifts, sensor_gains=[gain]
                )
                axis.plot(20 + shifts, 100 * found.strehl[0, 0], ls=style, color=colour, label=name)
            axis.axhline(
                limit_strehl(bands[gain]),
                color="0.4",
                lw=0.8,
                label="limit, any of these frequencies",
            )
            axis.set_title(f"sensor gain {gain:g}")
            axis.set_xlabel("frequency of the true vibration [Hz]")
        axes[0].set_ylabel("Strehl ratio [%]")
        axes[0].set_ylim(0, 90)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
        figure.savefig("docs/figures/robustness_story.png", dpi=150)


if __name__ == "__main__":
    main()
