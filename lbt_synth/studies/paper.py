"""The tables of Agapito et al. (2008): as printed there, by our analysis, and end to end.

G. Agapito, F. Quiros-Pacheco, P. Tesi, A. Riccardi, S. Esposito, "Optimal filtering techniques
for the adaptive optics system of the LBT" (2008).

The paper gives its Table I, the vibration (80 mas at 20 Hz) and the delay. It does not give
the noise, the damping, the weights, gamma, the integrator's gain or the optical gain of the
pyramid. Those marked *fitted* were chosen to reproduce the tables; other sets fit as well.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import lbt_synth
from lbt_synth.design import Design, FilterDesign, hinf, integrator, kalman
from lbt_synth.errors import ProblemError
from lbt_synth.interop import run_end_to_end
from lbt_synth.interop.specula.optics import Calibration, EndToEndSetup, calibrate, specula_version
from lbt_synth.interop.specula.simulation import mix_controller
from lbt_synth.loop import Imaging, close_loop
from lbt_synth.methods.registry import HINF, KALMAN
from lbt_synth.methods.request import reference_design
from lbt_synth.models import (
    ARModel,
    Atmosphere,
    LoopHardware,
    SinusoidalVibration,
    TipTiltPlant,
    Truth,
    Vibration,
    ar1_turbulence,
    nm_per_mas,
    tip_tilt_plant,
)
from lbt_synth.models.plant.tip_tilt import retuned_plant
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts, fact, facts
from lbt_synth.studies.grid import Sweep
from lbt_synth.studies.robustness import loop_row
from lbt_synth.validation import FloatArray, choice

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
# end to end, without and with the vibration: "by increasing the integrator's gain"; 0.56 times the
# optical gain of the loop, 0.55, is the effective gain that fits Table II
END_TO_END_GAINS = (0.5, 0.56)

PAPER_TRUTH = Truth(
    turbulence=ATMOSPHERE,
    vibrations=(SinusoidalVibration(frequency_hz=VIBRATION_HZ, rms_nm=VIBRATION_NM),),
    noise_nm=NOISE_NM,
    sensor_gain=TRUTH_SENSOR_GAIN,
)
IMAGING = Imaging(
    diameter_m=DIAMETER_M,
    obstruction=OBSTRUCTION,
    wavelength_um=WAVELENGTH_UM,
    other_modes=OTHER_MODES_STREHL,
)


def turbulence_model() -> ARModel:
    """AR1 model of the turbulence: pole and variance of the paper's Table I."""
    return ar1_turbulence(ATMOSPHERE, frame_rate_hz=FRAME_RATE_HZ)


# the H-infinity filters' own weights, in units of the measurement noise
HINF_VIBRATION_WEIGHT = 0.2508
HINF_TURBULENCE_WEIGHT = 2.374
HINF_GAMMA = 7.324


def filter_problems() -> dict[str, tuple[TipTiltPlant, dict[str, float]]]:
    """Plant of each of the paper's two filters, and the bound [nm] that it takes, by method.

    That of the Kalman filters has von Karman variance and 80 mas rms on either axis, that of the
    H-infinity filters the same dynamics with fitted weights.
    """
    air = turbulence_model()
    weighted = replace(air, driving_rms_nm=HINF_TURBULENCE_WEIGHT * NOISE_NM)
    unit = Vibration(frequency_hz=VIBRATION_HZ, damping=KALMAN_DAMPING, rms_nm=1.0)
    weight_nm = HINF_VIBRATION_WEIGHT * NOISE_NM / unit.ar_model(FRAME_RATE_HZ).driving_rms_nm
    bound = {"gamma": HINF_GAMMA * NOISE_NM}
    return {
        KALMAN.name: (_plant(air, VIBRATION_NM), {}),
        HINF.name: (_plant(weighted, weight_nm), bound),
    }


def _plant(turbulence: ARModel, vibration_nm: float) -> TipTiltPlant:
    line = Vibration(frequency_hz=VIBRATION_HZ, damping=KALMAN_DAMPING, rms_nm=vibration_nm)
    return tip_tilt_plant(
        frame_rate_hz=FRAME_RATE_HZ,
        delay_frames=DELAY_FRAMES,
        turbulence=turbulence,
        noise_nm=NOISE_NM,
        vibrations=[replace(line, direction=along) for along in ((1.0, 0.0), (0.0, 1.0))],
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


def paper_filters() -> tuple[FilterDesign, FilterDesign]:
    """Kalman and H-infinity filter at the true frequency, with the weights of Table III."""
    problems = filter_problems()
    plant, bound = problems[HINF.name]
    return kalman(problems[KALMAN.name][0]), hinf(plant, gamma=bound["gamma"])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PaperRow:
    """One row of a table for one controller."""

    table: str  # "II" or "III"
    label: str
    method: str
    name: str  # that no other design with another vibration has
    error_hz: float | None  # true frequency less the model's; None without vibration
    paper: float  # the paper's Strehl ratio [%], or nan
    hardware: LoopHardware
    design: Design  # of tip and tilt
    truth: Truth


def plan_rows(
    hardware: LoopHardware | None = None,
    gains: tuple[float, float] | None = None,
    designs: Mapping[str, Design] | None = None,
    tables: Sequence[str] = ("II", "III"),
) -> Iterator[PaperRow]:
    """Yield the rows of both tables, for the paper's controllers and for fixed designs.

    The paper's filters follow the frequency of the model; under the fixed ones the vibration moves
    instead, by the same error. The gains are those of the integrator of Table II without and with
    the vibration.
    """
    for table in tables:
        choice(table, "tables", ("II", "III"))
    problems = filter_problems()
    hardware = hardware or problems[KALMAN.name][0].hardware
    if gains is None:  # the paper raised the gain for the vibration
        best = integrator(hardware, truth=replace(PAPER_TRUTH, vibrations=()))
        gains = best.gain, CLASSICAL_EFFECTIVE_GAIN / TRUTH_SENSOR_GAIN
    for line in (line for line in (*TABLE_II, *TABLE_III) if line.table in tables):
        moved_hz = VIBRATION_HZ + (line.error_hz or 0.0)
        plans: list[tuple[str, str, Design, float, float]] = []
        if line.table == "II":
            classical = integrator(hardware, gain=gains[line.vibration])
            plans.append(("classical", "classical", classical, moved_hz, line.classical))
        for method, (plant, bound) in problems.items():
            plant = retuned_plant(plant, line.model_hz - VIBRATION_HZ, hold="driving")
            design, name = reference_design(method, plant, bound), f"{method}-{line.model_hz:g}hz"
            plans.append((name, method, design, VIBRATION_HZ, getattr(line, method)))
        plans += [(name, name, d, moved_hz, math.nan) for name, d in (designs or {}).items()]
        for name, method, design, shakes_hz, paper in plans:
            shake = SinusoidalVibration(frequency_hz=shakes_hz, rms_nm=VIBRATION_NM)
            yield PaperRow(
                table=line.table,
                label=line.label,
                method=method,
                name=f"{name}-vibration-{f'{shakes_hz:g}hz' if line.vibration else 'none'}",
                error_hz=line.error_hz,
                paper=paper,
                hardware=hardware,
                design=design,
                truth=replace(PAPER_TRUTH, vibrations=(shake,) * line.vibration),
            )


def modal_row(
    row: PaperRow, camera: Imaging = IMAGING, sensor_gain: float = TRUTH_SENSOR_GAIN
) -> Facts:
    """Return what the modal analysis says of a row, at a real sensor gain."""
    loop = close_loop(row.hardware, row.design.controller, sensor_gain=sensor_gain)
    truth = replace(row.truth, sensor_gain=sensor_gain)
    return loop_row(row.method, row.error_hz or 0.0, loop, truth, camera, frame_means=True)


def table_entry(row: PaperRow, modal: Facts) -> Facts:
    """Put the Strehl ratio of the modal analysis of a row beside the paper's [%]."""
    ours = 100 * modal.strehl
    return facts(
        label=fact(row.label, "row", key="row"),
        method=fact(row.method, "method"),
        ours=fact(ours, "ours", format=".1f", key="strehl_percent"),
        paper=fact(row.paper, "paper", format=".1f", key="paper_strehl_percent"),
        difference=fact(ours - row.paper, "difference", format="+.1f", key="difference_points"),
    )


Planned = list[tuple[PaperRow, dict[str, dict[str, Any]]]]  # rows, and their runs by name
_NUMBERS = ("strehl", "tip_tilt_gain", "tip_rms_nm", "tilt_rms_nm", "other_modes_strehl")


def plan_cases(
    setup: EndToEndSetup,
    designs: Mapping[str, Design] | None = None,
    *,
    seeds: Sequence[int] = (0, 1, 2),
    row_seeds: Sequence[int] = (0,),
    tables: Sequence[str] = ("II", "III"),
) -> Planned:
    """Plan the rows of both tables for a system, each with its runs by name, one for each seed.

    The seeds are those of Table II and of the row at 20 Hz, and those of the other rows.
    """
    hardware = setup.hardware
    if (hardware.frame_rate_hz, hardware.delay_frames) != (FRAME_RATE_HZ, DELAY_FRAMES):
        raise ProblemError(
            f"the paper's loop runs at {FRAME_RATE_HZ:g} Hz with a delay of {DELAY_FRAMES:g} "
            f"frames; got {hardware.frame_rate_hz:g} Hz and {hardware.delay_frames:g} frames."
        )
    for name, design in (designs or {}).items():
        mix_controller(setup, design)  # refuses a filter of another loop or of other sizes
        if name in ("classical", *filter_problems()):
            raise ProblemError(f"the name {name} is taken by the paper's own; rename the file.")
    planned = []
    for row in plan_rows(hardware, END_TO_END_GAINS, designs, tables):
        shaken = replace(setup, vibrations=row.truth.vibrations, motions=())
        several = row.table == "II" or row.error_hz == 0
        runs = {
            f"{row.name}-seed-{seed}": {
                "setup": replace(shaken, seed=seed),
                "controller": row.design.controller,
            }
            for seed in (seeds if several else row_seeds)
        }
        planned.append((row, runs))
    return planned


def end_to_end_tables(
    setup: EndToEndSetup,
    planned: Planned,
    directory: str | os.PathLike[str],
    *,
    executor: Executor | None = None,
    workers: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[Facts]:
    """Run planned rows of Agapito et al. 2008 end to end, or what is missing of them.

    Each run has a file of its own in an existing directory: started again with the same arguments,
    only the missing ones run. All controllers of a row meet the same air, vibrations and noise.
    Each row and controller has the mean and the scatter over seeds of its Strehl ratio [points],
    beside that of the paper and of the modal analysis with what was measured [%].
    """
    cases = all_cases(planned)
    calibrated = lru_cache(partial(calibrate, setup))  # once for all processes
    versions = {"lbt-synth": lbt_synth.__version__, "specula": specula_version()}
    content = json.dumps({"versions": versions, "cases": cases}, sort_keys=True, default=_plain)
    waiting = list(cases.values())
    sweep = Sweep(
        folder=Path(directory),
        columns=_NUMBERS,
        rows=len(cases),
        digest=hashlib.sha256(content.encode()).hexdigest(),
    )
    runs, _ = sweep.run(
        _run_cases,
        lambda some: (waiting[slice(*some)], calibrated()),
        part_rows=1,
        executor=executor,
        workers=workers,
        progress=progress,
    )
    results = {
        name: dict(zip(_NUMBERS, row, strict=True))
        for name, row in zip(cases, runs.results.tolist(), strict=True)
    }
    return make_entries(planned, results, setup)


def _run_cases(
    cases: Sequence[Mapping[str, Any]], calibration: Calibration
) -> tuple[dict[str, FloatArray], list[Any]]:
    """Return the main numbers of some runs."""
    runs = [run_end_to_end(**case, calibration=calibration).summary() for case in cases]
    return {name: np.array([run[name] for run in runs]) for name in _NUMBERS}, []


def _plain(value: Any) -> Any:
    """Return an array or a dataclass as what JSON can hold."""
    if is_dataclass(value):
        return {entry.name: getattr(value, entry.name) for entry in fields(value)}
    return value.tolist()


def all_cases(planned: Planned) -> dict[str, dict[str, Any]]:
    """Return the runs of all rows, each once."""
    return {name: case for _, cases in planned for name, case in cases.items()}


def make_entries(
    planned: Planned, results: Mapping[str, Mapping[str, Any]], setup: EndToEndSetup
) -> list[Facts]:
    """Make the entries of the tables from the results of their runs."""
    entries, percent, rms = [], {"format": ".1f"}, {"unit": "nm", "format": ".0f"}
    for row, cases in planned:
        runs = [results[name] for name in cases]
        strehls, gain, tip, tilt, others = (np.array([run[n] for run in runs]) for n in _NUMBERS)
        scatter = 100 * float(np.std(strehls, ddof=1)) if strehls.size > 1 else np.nan
        modal = float(np.mean([_predict_strehl(row, run, setup) for run in runs]))
        other_modes = {"unit": "%", "key": "other_modes_strehl_percent", **percent}
        entry = facts(
            table=fact(row.table),
            label=fact(row.label, "row", key="row"),
            method=fact(row.method, "method"),
            error_hz=fact(row.error_hz, unit="Hz"),
            strehl=fact(
                100 * float(np.mean(strehls)), "end to end", key="strehl_percent", **percent
            ),
            scatter=fact(scatter, "scatter", key="scatter_points", **percent),
            seeds=fact(strehls.size, "seeds"),
            paper=fact(row.paper, "paper", key="paper_strehl_percent", **percent),
            modal=fact(modal, "modal", key="modal_strehl_percent", **percent),
            optical_gain=fact(float(np.mean(gain)), "optical gain", format=".3f"),
            tip_rms_nm=fact(float(np.mean(tip**2) ** 0.5), "tip", **rms),
            tilt_rms_nm=fact(float(np.mean(tilt**2) ** 0.5), "tilt", **rms),
            other_modes=fact(100 * float(np.mean(others)), "other modes", **other_modes),
        )
        entries.append(entry)
    return entries


def _predict_strehl(row: PaperRow, run: Mapping[str, Any], setup: EndToEndSetup) -> float:
    """Return the Strehl ratio of the modal analysis [%], with the gain measured in a run."""
    if run["tip_tilt_gain"] <= 0:
        return 0.0
    camera = Imaging(
        diameter_m=setup.diameter_m,
        obstruction=setup.obstruction,
        wavelength_um=setup.imaging_wavelength_um,
        other_modes=run["other_modes_strehl"],
    )
    modal = modal_row(row, camera, run["tip_tilt_gain"])
    return 100 * modal.strehl if modal.stable else 0.0


def rms_differences(table: Sequence[Facts], column: str, reference: str) -> dict[str, float]:
    """Return the rms of one column less another over a table, by controller [points]."""
    differences: dict[str, list[float]] = {}
    for entry in table:
        difference = getattr(entry, column) - getattr(entry, reference)
        differences.setdefault(entry.method, []).append(difference)
    return {method: float(np.sqrt(np.mean(np.square(d)))) for method, d in differences.items()}
