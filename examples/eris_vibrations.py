"""From a vibration spectrum of VLT/ERIS to controllers, judged on that spectrum.

``examples/data/eris_vibrations_psd.fits`` has lines of both axes between 5 and 100 Hz upon a
background that is a formula. The lines are identified; with turbulence and a sensor they
make a model; an integrator, a Kalman filter, an H-infinity filter and a controller for bands of
frequencies are designed for it. Each meets the spectrum of the file itself, not the
model's, as it is and with all lines shifted by half a hertz.

Run: python examples/eris_vibrations.py [folder] [averages]

It writes eris_*.png into the folder, out/ by default; averages says how much a line has to stand
out, 2 by default.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import lbt_synth as lbt
from lbt_synth.report.draw import GUIDE, drawing, line_style, name_axes, save_figure

FILE = Path(__file__).parent / "data" / "eris_vibrations_psd.fits"
COLUMNS = {"frequency": 0, "density": (1, 2)}
BACKGROUND_NM2_HZ = 4e4  # at 1 Hz, falling with the square of the frequency; see docs/eris.md

# Assumed: the file tells nothing of all this.
FRAME_RATE_HZ = 1000.0
DELAY_FRAMES = 2.0
NOISE_NM = 15.0  # a frame and axis
AVERAGES = 2  # periodograms; see docs/eris.md
AIR = lbt.Atmosphere(
    seeing_arcsec=0.8, outer_scale_m=22.0, wind_speed_m_s=10.0, diameter_m=8.0, obstruction=0.14
)
WAVELENGTHS_UM = (1.25, 1.65, 2.2)  # of J, H and K; modes other than tip and tilt are perfect
SHIFT_HZ = 0.5
BANDS = (  # of the robust design: half a hertz around the strongest lines
    lbt.design.shaping.VibrationBand(low_hz=9.5, high_hz=10.5, rms_nm=27.0),
    lbt.design.shaping.VibrationBand(low_hz=45.0, high_hz=46.0, rms_nm=11.0),
    lbt.design.shaping.VibrationBand(low_hz=47.6, high_hz=48.9, rms_nm=26.0),
    lbt.design.shaping.VibrationBand(low_hz=72.0, high_hz=73.1, rms_nm=12.0),
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Disturbance:
    """What the loop meets, in parts that add up: one spectrum an axis each.

    Attributes
    ----------
    turbulence, background, lines : tuple of Spectrum
        The assumed atmosphere; the formula in the file; what the file has beyond it.
    """

    turbulence: tuple[lbt.models.Spectrum, ...]
    background: tuple[lbt.models.Spectrum, ...]
    lines: tuple[lbt.models.Spectrum, ...]

    @property
    def whole(self) -> lbt.Truth:
        """All of it, with the noise of the sensor."""
        parts = zip(self.turbulence, self.background, self.lines, strict=True)
        return lbt.Truth(
            turbulence=[lbt.models.SumSpectrum(parts=list(each)) for each in parts],
            noise_nm=NOISE_NM,
        )


def record(averages: int | None = AVERAGES) -> lbt.identification.SpectrumRecord:
    """Read the file; its columns have no names, and it does not tell their unit.

    The rows are taken for frequency, tip and tilt.
    """
    found = lbt.load_record(FILE, columns=COLUMNS, unit="nm^2/Hz", averages=averages)
    assert isinstance(found, lbt.identification.SpectrumRecord)
    return found


def peaks(frequency_hz: np.ndarray, density_nm2_hz: np.ndarray) -> list[tuple[float, float]]:
    """Centres [Hz] and rms [nm] of all runs of bins above the background."""
    step = float(np.median(np.diff(frequency_hz)))
    excess = (density_nm2_hz - BACKGROUND_NM2_HZ / frequency_hz**2) * step
    above = excess > 0.01 * step * density_nm2_hz
    edges = np.flatnonzero(np.diff(np.concatenate([[0], above.astype(int), [0]])))
    runs = [slice(start, stop) for start, stop in edges.reshape(-1, 2)]
    return [
        (
            float(np.average(frequency_hz[run], weights=excess[run])),
            float(np.sqrt(np.sum(excess[run]))),
        )
        for run in runs
    ]


def disturbance(seen: lbt.identification.SpectrumRecord, *, shift_hz: float = 0.0) -> Disturbance:
    """Take the file apart, and move its lines."""
    f = seen.frequency_hz
    formula = BACKGROUND_NM2_HZ / f**2
    columns = seen.density_nm2_hz.T
    return Disturbance(
        turbulence=(AIR,) * seen.axes,
        background=tuple(
            lbt.models.TabulatedSpectrum(frequency_hz=f, density_nm2_hz=np.minimum(column, formula))
            for column in columns
        ),
        lines=tuple(
            lbt.models.TabulatedSpectrum(
                frequency_hz=f + shift_hz, density_nm2_hz=np.maximum(column - formula, 0.0)
            )
            for column in columns
        ),
    )


def composed(model: lbt.identification.IdentifiedModel) -> lbt.models.TipTiltPlant:
    """Make a plant of the identified spectrum, the turbulence and the noise of a sensor.

    The slow part of the identified spectrum, which is that of the background, takes the place
    of the turbulence. The turbulence, an AR2 process, is one more resonance of each axis.
    """
    air = lbt.models.ar2_turbulence(AIR, frame_rate_hz=FRAME_RATE_HZ, noise_nm=NOISE_NM)
    pole = np.log(np.roots([1.0, *-air.coefficients])[0].astype(complex)) * FRAME_RATE_HZ
    vibrations = []
    for i in range(len(model.axes)):
        along = tuple(float(i == j) for j in range(len(model.axes)))
        vibrations.append(
            lbt.Vibration(
                frequency_hz=float(abs(pole)) / (2 * np.pi),
                damping=float(-pole.real / abs(pole)),
                rms_nm=air.rms_nm,
                direction=along,
            )
        )
    return lbt.tip_tilt_plant(
        frame_rate_hz=FRAME_RATE_HZ,
        delay_frames=DELAY_FRAMES,
        turbulence=[axis.turbulence for axis in model.axes],
        vibrations=[*vibrations, *(part.vibration() for part in model.parts)],
        noise_nm=NOISE_NM,
    )


def designs(plant: lbt.models.TipTiltPlant, met: Disturbance) -> dict[str, lbt.Design]:
    """Design for the model; only the robust one takes bands and the spectra without lines."""
    f = np.geomspace(0.02, 0.499 * FRAME_RATE_HZ, 300)  # a gain file keeps tables, no sums
    slow = lbt.models.SumSpectrum(parts=[met.turbulence[0], met.background[0]]).psd(f)
    table = lbt.models.TabulatedSpectrum(frequency_hz=f, density_nm2_hz=slow)
    return {
        "integrator": lbt.integrator(plant.hardware, truth=plant),
        "Kalman": lbt.kalman(plant),
        "H-infinity": lbt.hinf(plant, gamma_ratio=1.2, route="riccati"),
        "robust": lbt.robust(plant, bands=BANDS, turbulence=table),
    }


def residual(loop: lbt.loop.ClosedLoop, met: Disturbance) -> dict[str, np.ndarray]:
    """Return the covariances [nm^2] that each part of the disturbance and the noise leave."""

    def left(spectra: tuple[lbt.models.Spectrum, ...] | None, noise_nm: float = 0.0) -> np.ndarray:
        budget = lbt.residual_budget(
            loop, lbt.Truth(turbulence=spectra, noise_nm=noise_nm), frame_means=True
        )
        return np.asarray(budget.total_nm2)

    parts = {
        "turbulence": left(met.turbulence),
        "background": left(met.background),
        "lines": left(met.lines),
        "noise": left(None, NOISE_NM),
    }
    return parts | {"total": sum(parts.values(), np.zeros_like(parts["noise"]))}


def rms(covariance_nm2: np.ndarray) -> float:
    """Return the deviation over both axes [nm]."""
    return float(np.sqrt(np.trace(covariance_nm2)))


def strehls(covariance_nm2: np.ndarray) -> list[float]:
    """Return the Strehl ratios [%] of J, H and K."""
    return [
        100
        * lbt.loop.jitter_strehl(
            covariance_nm2, imaging=lbt.Imaging(obstruction=AIR.obstruction, wavelength_um=wave)
        )
        for wave in WAVELENGTHS_UM
    ]


def print_lines(
    seen: lbt.identification.SpectrumRecord, model: lbt.identification.IdentifiedModel
) -> None:
    """Print identified lines beside the peaks of the file."""
    f = seen.frequency_hz
    inside = float(np.sqrt(accumulated(f, BACKGROUND_NM2_HZ / f**2)[-1]))
    for i, axis in enumerate(model.axes):
        column = seen.density_nm2_hz[:, i]
        found = peaks(seen.frequency_hz, column)
        beyond = np.sqrt(sum(size**2 for _, size in found))
        print(
            f"{('tip', 'tilt')[i]}: {seen.rms_nm[i]:.1f} nm in the file: the formula "
            f"{inside:.1f} nm, {len(found)} runs of bins above it {beyond:.1f} nm"
        )
        slow = axis.turbulence_fit
        print(
            f"  slow part {slow.rms_nm:.0f} +- {slow.rms_error_nm:.0f} nm, white part "
            f"{axis.noise_nm:.1f} +- {axis.noise_error_nm:.1f} nm a frame"
        )
        names: dict[int, str] = {}
        for line in axis.lines:
            nearest = min(range(len(found)), key=lambda j: abs(found[j][0] - line.frequency_hz))
            names[nearest] = names.get(nearest, "") + (
                f"{line.frequency_hz:12.3f} +- {line.frequency_error_hz:.3f} "
                f"{line.rms_nm:6.1f} +- {line.rms_error_nm:.1f}"
            )
        strongest = sorted(size for _, size in found)[-14:]
        print("  peak of the file [Hz, nm]   identified [Hz, nm]")
        for j, (place, size) in enumerate(found):
            if size in strongest or j in names:
                print(f"  {place:9.3f} {size:6.1f}        {names.get(j, '         -')}")
    for note in model.notes:
        print(f"note: {note}")


def print_table(rows: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Print the residual of each part, and the Strehl ratios."""
    names = ("turbulence", "background", "lines", "noise", "total")
    print(f"{'[nm rms over both axes]':28s}" + "".join(f"{name:>11s}" for name in names), end="")
    print("".join(f"{'S ' + band + ' [%]':>9s}" for band in "JHK"))
    for name, parts in rows.items():
        print(f"{name:28s}" + "".join(f"{rms(parts[key]):11.1f}" for key in names), end="")
        print("".join(f"{value:9.1f}" for value in strehls(parts["total"])))


def figure(
    seen: lbt.identification.SpectrumRecord,
    loops: Mapping[str, lbt.loop.ClosedLoop],
    met: Disturbance,
) -> Any:
    """Draw what the loops reject, and what they leave accumulated over the frequencies."""
    f = np.union1d(np.geomspace(0.5, 499.0, 1500), seen.frequency_hz)
    whole = met.whole.turbulence_per_mode(seen.axes)
    noise = 2 * NOISE_NM**2 / FRAME_RATE_HZ
    axes = (
        (("density", "nm²/Hz"), {"yscale": "log", "ylim": (0.1, 1e6)}),
        (("rejection", "-"), {"yscale": "log", "ylim": (5e-3, 5.0)}),
        (("residual up to the frequency", "nm rms"), {}),
    )
    heights = [height for height in (2.1, 2.1, 2.6) for _ in range(seen.axes)]
    with drawing(heights, columns=seen.axes) as panels:
        for i in range(seen.axes):
            density, column = whole[i].psd(f), panels[i :: seen.axes]
            for panel, (y, scale), title in zip(
                column, axes, (("tip", "tilt")[i], "", ""), strict=True
            ):
                name_axes(panel, ("frequency", "Hz"), y, title, xscale="log", **scale)
                panel.set_xlim(0.5, 499.0)
            spectrum, rejection, total = column
            spectrum.plot(f, density, label="disturbance", **line_style(None, linewidth=0.7))
            spectrum.axhline(noise, label="noise", linestyle=":", **GUIDE)
            rejection.axhline(1.0, **GUIDE)
            for look, (name, loop) in enumerate(loops.items()):
                rejected = np.abs(loop.sensitivity(f)[:, i, i]) ** 2
                passed = np.abs(loop.noise_transfer(f)[:, i, i]) ** 2
                left = accumulated(f, rejected * density + passed * noise)
                rejection.plot(f, np.sqrt(rejected), label=name, **line_style(look, linewidth=0.9))
                total.plot(f, np.sqrt(left), label=name, **line_style(look))
            total.set_ylim(bottom=0)
    return panels[0].figure


def accumulated(f: np.ndarray, density: np.ndarray) -> np.ndarray:
    """Integral of a density up to each frequency."""
    steps = np.diff(f) * (density[1:] + density[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])


def main(folder: str = "out", averages: int = AVERAGES) -> None:
    """Print the tables and draw the figures."""
    seen = record(averages)
    model = lbt.identify(seen, frame_rate_hz=FRAME_RATE_HZ, delay_frames=DELAY_FRAMES)
    print_lines(seen, model)
    met, moved = disturbance(seen), disturbance(seen, shift_hz=SHIFT_HZ)
    plant = composed(model)
    made = designs(plant, met)
    loops = {name: lbt.close_loop(plant.hardware, each.controller) for name, each in made.items()}

    print("\nunder the spectrum of the file")
    print_table({name: residual(loop, met) for name, loop in loops.items()})
    limit = lbt.loop.least_residual(plant.hardware, met.whole, frame_means=True)
    print(f"{'any linear controller':28s}{'at least':>44s}{limit.rms_nm:11.1f}", end="")
    best = np.diag(limit.variance_nm2)
    print("".join(f"{value:9.1f}" for value in strehls(best)))

    print(f"\nwith all lines {SHIFT_HZ} Hz higher")
    print_table({name: residual(loop, moved) for name, loop in loops.items()})
    print("\nunder the model; certificate; states of the controller; modulus margin")
    for name, loop in loops.items():
        passed = "passed" if made[name].certificate.passed else "failed"
        budget = lbt.residual_budget(loop, plant)
        states = made[name].controller.n_states
        margin = lbt.loop_margins(loop).modulus
        print(f"{name:28s}{budget.rms_nm:11.1f} nm   {passed}{states:8d}{margin:8.2f}")

    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    for name, drawn in (
        ("eris_identified.png", lbt.report.figures.identification_figure(model)),
        ("eris_residual.png", figure(seen, loops, met)),
    ):
        print("wrote", save_figure(drawn, out / name))


if __name__ == "__main__":
    main(*sys.argv[1:2], *map(int, sys.argv[2:3]))
