"""The paper's tables as printed there, and the parameters of the comparison with it.

G. Agapito, F. Quiros-Pacheco, P. Tesi, A. Riccardi, S. Esposito, "Optimal filtering techniques
for the adaptive optics system of the LBT" (2008).

The paper gives its Table I, the vibration (80 mas at 20 Hz) and the delay. It does not give
the noise, the damping, the weights, gamma, the integrator's gain or the optical gain of the
pyramid. Those marked *fitted* were chosen to reproduce the tables; other sets fit as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import field, replace
from typing import NamedTuple

import numpy as np

from lbt_synth.design import Design, FilterDesign, hinf, integrator, kalman, optimal_integrator
from lbt_synth.loop import Imaging, close_loop
from lbt_synth.methods.hinf import METHOD as HINF
from lbt_synth.methods.kalman import METHOD as KALMAN
from lbt_synth.models import (
    ARModel,
    Atmosphere,
    SinusoidalVibration,
    TipTiltPlant,
    Truth,
    Vibration,
    ar1_turbulence,
    nm_per_mas,
    tip_tilt_plant,
)
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import column, table_row
from lbt_synth.studies.grid import loop_columns
from lbt_synth.studies.robustness import RobustnessRow, robustness
from lbt_synth.validation import set_fields

VIBRATION_HZ = 20.0


class PublishedRow(NamedTuple):
    """Strehl ratios [%] at 2.2 um for a model frequency [Hz]."""

    model_hz: float
    kalman: float
    hinf: float
    classical: float = math.nan
    vibration: bool = True
    table: str = "III"

    @property
    def error_hz(self) -> float | None:
        """Frequency of the vibration less that of the model [Hz]; None without one."""
        return VIBRATION_HZ - self.model_hz if self.vibration else None

    @property
    def label(self) -> str:
        """Name of the row."""
        if self.table == "III":
            return f"{self.model_hz:.1f} Hz"
        return "vibration" if self.vibration else "no vibration"


TABLE_II = (
    PublishedRow(20.0, 80.7, 80.4, classical=84.1, vibration=False, table="II"),
    PublishedRow(20.0, 80.4, 80.2, classical=30.9, table="II"),
)

TABLE_III = (
    PublishedRow(16.5, 22.4, 30.9),
    PublishedRow(17.0, 25.5, 36.4),
    PublishedRow(17.5, 30.6, 43.7),
    PublishedRow(18.0, 39.1, 52.7),
    PublishedRow(18.5, 51.0, 62.8),
    PublishedRow(19.0, 65.0, 71.3),
    PublishedRow(19.5, 76.8, 78.4),
    PublishedRow(20.0, 80.4, 80.2),
    PublishedRow(20.5, 77.8, 78.4),
    PublishedRow(21.0, 70.1, 74.1),
    PublishedRow(21.5, 61.0, 67.6),
    PublishedRow(22.0, 52.8, 60.7),
    PublishedRow(22.5, 46.1, 54.5),
    PublishedRow(23.0, 40.9, 48.9),
    PublishedRow(23.5, 36.9, 44.6),
)


# given in the paper
DIAMETER_M = 8.22
OBSTRUCTION = 0.11
FRAME_RATE_HZ = 800.0
DELAY_FRAMES = 2.0
VIBRATION_MAS = 80.0
WAVELENGTH_UM = 2.2
ATMOSPHERE = Atmosphere(
    seeing_arcsec=0.8, outer_scale_m=22.0, wind_speed_m_s=20.0, diameter_m=DIAMETER_M
)

# derived from the paper's Table I
NOISE_NM = 15.5  # photons, read noise and modulation, at unit optical gain
VIBRATION_NM = VIBRATION_MAS * nm_per_mas(DIAMETER_M)  # "80 mas" read as the rms

# fitted to Tables II and III
TRUTH_SENSOR_GAIN = 0.358  # optical gain of the pyramid, unknown to the filters
OTHER_MODES_STREHL = 0.845
KALMAN_DAMPING = 0.0051
CLASSICAL_EFFECTIVE_GAIN = 0.31  # integrator gain times optical gain, with the vibration

PAPER_TRUTH = Truth(
    turbulence=ATMOSPHERE,
    vibrations=(SinusoidalVibration(frequency_hz=VIBRATION_HZ, rms_nm=VIBRATION_NM),),
    noise_nm=NOISE_NM,
    sensor_gain=TRUTH_SENSOR_GAIN,
)


def turbulence_model() -> ARModel:
    """AR1 model of the turbulence: pole and variance of the paper's Table I."""
    return ar1_turbulence(ATMOSPHERE, frame_rate_hz=FRAME_RATE_HZ)


def imaging() -> Imaging:
    """Camera at 2.2 um behind the 8.22 m pupil."""
    return Imaging(
        diameter_m=DIAMETER_M,
        obstruction=OBSTRUCTION,
        wavelength_um=WAVELENGTH_UM,
        other_modes=OTHER_MODES_STREHL,
    )


# the H-infinity filters' own weights, in units of the measurement noise
HINF_DAMPING = KALMAN_DAMPING
HINF_VIBRATION_WEIGHT = 0.2508
HINF_TURBULENCE_WEIGHT = 2.374
HINF_GAMMA = 7.324


def kalman_plant() -> TipTiltPlant:
    """Plant of the Kalman filters: von Karman variance, 80 mas rms on either axis."""
    return _plant(turbulence_model(), VIBRATION_NM, KALMAN_DAMPING)


def hinf_plant() -> TipTiltPlant:
    """Plant of the H-infinity filters: the same dynamics, fitted weights."""
    turbulence = ARModel(
        coefficients=turbulence_model().coefficients,
        driving_rms_nm=HINF_TURBULENCE_WEIGHT * NOISE_NM,
        frame_rate_hz=FRAME_RATE_HZ,
    )
    unit = Vibration(frequency_hz=VIBRATION_HZ, damping=HINF_DAMPING, rms_nm=1.0)
    driving = unit.ar_model(FRAME_RATE_HZ).driving_rms_nm
    return _plant(turbulence, HINF_VIBRATION_WEIGHT * NOISE_NM / driving, HINF_DAMPING)


def filter_problems() -> dict[str, tuple[TipTiltPlant, dict[str, float]]]:
    """Plant of each of the paper's two filters, and the bound [nm] that it takes, by method."""
    bound = {"gamma": HINF_GAMMA * NOISE_NM}
    return {KALMAN.name: (kalman_plant(), {}), HINF.name: (hinf_plant(), bound)}


def _plant(turbulence: ARModel, vibration_nm: float, damping: float) -> TipTiltPlant:
    return tip_tilt_plant(
        frame_rate_hz=FRAME_RATE_HZ,
        delay_frames=DELAY_FRAMES,
        turbulence=turbulence,
        noise_nm=NOISE_NM,
        vibrations=[
            Vibration(
                frequency_hz=VIBRATION_HZ,
                damping=damping,
                rms_nm=vibration_nm,
                direction=direction,
            )
            for direction in ((1.0, 0.0), (0.0, 1.0))
        ],
    )


def parameter_rows() -> tuple[tuple[str, str, str], ...]:
    """Return name, value and origin of each parameter, wavefronts in the unit shown."""
    model = turbulence_model()
    pole, rms_nm = model.coefficients[0], model.rms_nm
    return (
        ("diameter, obstruction", f"{DIAMETER_M} m, {OBSTRUCTION} D", "paper, Table I"),
        (
            "seeing, outer scale, wind",
            f"{ATMOSPHERE.seeing_arcsec:g} arcsec, {ATMOSPHERE.outer_scale_m:g} m, "
            f"{ATMOSPHERE.wind_speed_m_s:g} m/s",
            "paper, Table I",
        ),
        ("frame rate, delay", f"{FRAME_RATE_HZ:g} Hz, {DELAY_FRAMES:g} frames", "paper, Table I"),
        ("vibration", f"{VIBRATION_HZ:g} Hz, {VIBRATION_MAS:g} mas", "paper, section V-C"),
        ("turbulence pole, rms", f"{pole:.5f}, {nm_text(rms_nm, '.1f')}", "derived from Table I"),
        ("measurement noise", f"{nm_text(NOISE_NM, '.1f')} per frame", "derived from Table I"),
        ("80 mas as the rms of a sinusoid", nm_text(VIBRATION_NM, ".1f"), "read so here"),
        ("optical gain of the pyramid", f"{TRUTH_SENSOR_GAIN}", "fitted"),
        ("Strehl of the other modes", f"{OTHER_MODES_STREHL}", "fitted"),
        ("damping of the vibration", f"{KALMAN_DAMPING}", "fitted"),
        ("classical gain x optical gain", f"{CLASSICAL_EFFECTIVE_GAIN}", "fitted"),
        ("H-inf vibration weight / noise", f"{HINF_VIBRATION_WEIGHT}", "fitted"),
        ("H-inf turbulence weight / noise", f"{HINF_TURBULENCE_WEIGHT}", "fitted"),
        ("H-inf gamma / noise", f"{HINF_GAMMA}", "fitted"),
    )


@table_row
class TableEntry:
    """One entry of ``table``, "II" or "III", ours beside the paper's."""

    table: str = field()
    label: str = column(key="row", help="Its row")
    method: str = column(help='"classical", or the method of the filter')
    ours: float = column(key="strehl_percent", help="Strehl ratio [%]")
    paper: float = column(key="paper_strehl_percent", help="Strehl ratio [%]")
    difference: float = column(
        key="difference_points", help="Ours less the paper's [points]", init=False
    )

    def __post_init__(self) -> None:
        set_fields(self, difference=self.ours - self.paper)


def rms_difference(entries: list[TableEntry]) -> float:
    """Root mean square of the differences [points]."""
    return float(np.sqrt(np.mean([entry.difference**2 for entry in entries])))


def paper_filters() -> tuple[FilterDesign, FilterDesign]:
    """Kalman and H-infinity filter at the true frequency, with the weights of Table III."""
    return (
        kalman(kalman_plant()),
        hinf(hinf_plant(), gamma=HINF_GAMMA * NOISE_NM),
    )


def table_ii() -> list[TableEntry]:
    """Table II: three controllers without and with the vibration."""
    filters = paper_filters()
    hardware = kalman_plant().hardware
    entries = []
    for row in TABLE_II:
        lines = PAPER_TRUTH.vibrations if row.vibration else ()
        truth = replace(PAPER_TRUTH, vibrations=lines)
        classical: Design
        if row.vibration:  # the paper raised the gain for this case
            gain = CLASSICAL_EFFECTIVE_GAIN / TRUTH_SENSOR_GAIN
            classical = integrator(hardware, gain=gain)
        else:
            classical = optimal_integrator(hardware, truth)
        named = {"classical": classical, **{design.method: design for design in filters}}
        for method, design in named.items():
            loop = close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
            ours = 100 * loop_columns(loop, truth, imaging(), frame_means=True)["strehl"]
            paper = getattr(row, method)
            entry = TableEntry(table="II", label=row.label, method=method, ours=ours, paper=paper)
            entries.append(entry)
    return entries


def table_iii() -> Iterator[RobustnessRow]:
    """Yield the rows of Table III, two per frequency: Kalman, then H-infinity."""
    for row in TABLE_III:
        for method, (plant, bound) in filter_problems().items():
            yield from robustness(
                plant,
                PAPER_TRUTH,
                imaging(),
                errors_hz=[VIBRATION_HZ - row.model_hz],
                methods=[method],
                gamma=bound.get("gamma"),
                frame_means=True,
            )


def compare_with_paper(rows: list[RobustnessRow]) -> list[TableEntry]:
    """Put rows of :func:`table_iii` beside the paper's."""
    published = {row.error_hz: row for row in TABLE_III}
    return [
        TableEntry(
            table="III",
            label=published[row.error_hz].label,
            method=row.method,
            ours=100 * row.strehl,
            paper=getattr(published[row.error_hz], row.method),
        )
        for row in rows
    ]
