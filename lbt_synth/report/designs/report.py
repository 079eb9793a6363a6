"""The numbers of a report: designs side by side in the loop of a configuration."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np

from lbt_synth import studies
from lbt_synth.config import Config
from lbt_synth.design import Check, Design
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.interop import frame_cost
from lbt_synth.interop.c.terms import FrameCost
from lbt_synth.linear import Controller
from lbt_synth.loop import (
    ClosedLoop,
    LoopMargins,
    ResidualBudget,
    close_loop,
    loop_margins,
    moving_gain,
    residual_budget,
    stable_sensor_gains,
    strehl,
)
from lbt_synth.loop.closed_loop import STABILITY_MARGIN
from lbt_synth.loop.simulation.run import settling_frames
from lbt_synth.loop.stable_range import MovingGain, radii_by_gain
from lbt_synth.models import LoopHardware
from lbt_synth.models.loop_hardware import loop_differences
from lbt_synth.report.designs.simulation import DesignSimulation, simulate_design
from lbt_synth.report.page.blocks import (
    SourceFile,
    creation_time,
    program_versions,
    read_source,
    require_letters,
)
from lbt_synth.studies import LimitRow, RobustnessMap, robustness_map
from lbt_synth.studies.limits import LimitStudy, TruthComparison
from lbt_synth.validation import FloatArray, frozen_copy, require_instance

_CONVEX_ROUTES = ("sdp", "lmi")
_MOST_DESIGNS = 36  # more lines cannot be distinguished
_GAINS = np.geomspace(0.01, 100.0, 400)  # where stable intervals are looked for


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DesignAssessment:
    """What is known exactly of one design in the loop of a configuration."""

    name: str  # its name in the report
    design: Design
    loop: ClosedLoop  # with the real sensor gain
    notes: tuple[str, ...]  # how the loop that it was made for differs from this one
    # None where the loop is unstable: the exact residual, the margins at the real sensor gain, and
    # the intervals around it of a gain that moves
    budget: ResidualBudget | None
    margins: LoopMargins | None
    moving: MovingGain | None
    strehl: float  # Strehl ratio in [0, 1]; nan where the loop is unstable
    # intervals of real sensor gains for which the loop is stable, relative to the sensor matrix of
    # the configuration; searched for between 0.01 and 100 times the assumed one
    sensor_gains: tuple[tuple[float, float], ...]
    checks: tuple[Check, ...]  # the certificate, recomputed
    certificate_error: str  # why it could not be; empty if it could
    cost: FrameCost  # arithmetic of one frame, as exported to C
    curve: RobustnessMap  # Strehl ratio over the frequency error at the real sensor gain
    map: RobustnessMap  # the same over frequency error and real sensor gain

    @property
    def stable(self) -> bool:
        """Whether the loop is stable at the real sensor gain."""
        return self.loop.is_stable

    @property
    def certified(self) -> bool:
        """Whether the certificate could be recomputed, and every check passed."""
        return not self.certificate_error and all(check.passed for check in self.checks)

    @property
    def residual_nm(self) -> float:
        """Exact residual [nm rms]; nan where the loop is unstable."""
        return float("nan") if self.budget is None else self.budget.rms_nm


def assess_design(
    name: str, design: Design, config: Config, errors_hz: FloatArray
) -> DesignAssessment:
    """Assess a design in the loop of a configuration, over frequency errors (e,)."""
    hardware, truth, assumed_gain = config.hardware, config.truth, config.sensor_gain
    sensor_gains = np.unique(config.settings.robustness.sensor_gains)
    loop = close_loop(hardware, design.controller, sensor_gain=truth.sensor_gain)
    stable = loop.is_stable
    budget = residual_budget(loop, truth) if stable else None
    margins = loop_margins(loop) if stable else None
    checks, complaint = _recertify(design)
    mapped = partial(robustness_map, design, truth, config.imaging, hardware=hardware)
    curve, grid = (
        mapped(errors_hz=errors_hz, sensor_gains=gains)
        for gains in ([truth.sensor_gain], sensor_gains / assumed_gain)
    )
    intervals = stable_intervals(loop, design.controller, margins)
    return DesignAssessment(
        name=name,
        design=design,
        loop=loop,
        notes=() if design.hardware is None else tuple(loop_differences(design.hardware, hardware)),
        budget=budget,
        margins=margins,
        moving=moving_gain(loop) if stable else None,
        strehl=float("nan") if budget is None else strehl(budget, config.imaging),
        sensor_gains=tuple((low * assumed_gain, high * assumed_gain) for low, high in intervals),
        checks=checks,
        certificate_error=complaint,
        cost=frame_cost(design),
        curve=curve,
        map=replace(grid, sensor_gains=frozen_copy(sensor_gains)),  # the real ones again
    )


def require_compatible(name: str, design: Design, hardware: LoopHardware) -> None:
    """Refuse a design that cannot be run in a loop."""
    own = design.hardware
    if own is None:
        raise ProblemError(
            f"{name} is a filter of a bare estimation problem; expected a design for a loop. "
            "Design it for the plant of a configuration."
        )
    for what, mine, theirs in (
        ("axes", own.modes, hardware.modes),
        ("measurements", own.n_measurements, hardware.n_measurements),
        ("commands", own.n_commands, hardware.n_commands),
    ):
        if mine != theirs:
            raise ProblemError(
                f"{name} must be for the configuration's {theirs} {what}; got a design for {mine}. "
                "Design it for this configuration."
            )
    if not np.isclose(own.frame_rate_hz, hardware.frame_rate_hz, rtol=1e-9):
        raise ProblemError(
            f"{name} must run at the configuration's {hardware.frame_rate_hz:g} Hz; got a design "
            f"for {own.frame_rate_hz:g} Hz. Design it for this frame rate."
        )


def stable_intervals(
    loop: ClosedLoop, controller: Controller, margins: LoopMargins | None
) -> list[tuple[float, float]]:
    """Intervals of sensor gains for which a loop is stable, in increasing order.

    The interval around the loop's own gain comes from its margins; others are looked for at 400
    gains from 0.01 to 100.
    """
    found = []
    if margins is not None:
        found.append((margins.gain_low * loop.sensor_gain, margins.gain_high * loop.sensor_gain))
    radii = radii_by_gain(loop.hardware, controller)(_GAINS)
    inside = np.nonzero(radii < 1 - STABILITY_MARGIN)[0]
    for run in np.split(inside, np.nonzero(np.diff(inside) > 1)[0] + 1):
        if not run.size:
            continue
        nominal = float(_GAINS[run[np.argmin(radii[run])]])
        if not any(low < nominal < high for low, high in found):
            found.append(stable_sensor_gains(loop.hardware, controller, nominal=nominal))
    return sorted(found)


def _recertify(design: Design) -> tuple[tuple[Check, ...], str]:
    """Return the checks of the recomputed certificate, or why that failed."""
    try:
        return design.recertify().checks, ""
    except (LbtSynthError, ArithmeticError) as error:
        return (), str(error)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DesignReport:
    """Designs in the loop of a configuration: what is known of each, beside the limits."""

    config: Config  # the configuration
    config_text: str  # its file as it was read
    assessments: tuple[DesignAssessment, ...]  # one per design, exact
    simulations: Mapping[str, DesignSimulation]  # of the designs whose loop is stable
    # residuals over the frequency error, and what no linear controller goes below
    limits: LimitStudy
    truth: TruthComparison  # the designs beside reference designs, and what they were not made for
    # (e,): frequency errors, truth less design [Hz]; only 0 where the truth has no vibration
    errors_hz: FloatArray
    files: tuple[SourceFile, ...]  # digests of the files that were read
    versions: tuple[tuple[str, str], ...]  # programs and libraries
    made: datetime  # when

    @property
    def rows(self) -> tuple[tuple[DesignAssessment, LimitRow], ...]:
        """Each design with its distance to the limits."""
        return tuple(zip(self.assessments, self.limits.rows, strict=True))

    @property
    def names(self) -> list[str]:
        """Names of the designs."""
        return [one.name for one in self.assessments]

    @property
    def stable(self) -> tuple[DesignAssessment, ...]:
        """The designs whose loop is stable."""
        return tuple(one for one in self.assessments if one.stable)

    @property
    def real_gain(self) -> float:
        """Real sensor gain, relative to the sensor matrix of the configuration."""
        return self.config.sensor_gain * self.config.truth.sensor_gain


def design_report(
    config: Config,
    designs: Mapping[str, Design],
    *,
    gain_files: Mapping[str, str | os.PathLike[str]] | None = None,
) -> DesignReport:
    """Examine designs in the loop of a configuration.

    Each controller is closed with the configuration's loop as it is, whatever it was designed
    for. Certificates are recomputed.

    Parameters
    ----------
    config : Config
        The configuration.
    designs : mapping of str to Design
        Designs by name.
    gain_files : mapping of str to path-like, optional
        Files that designs came from, whose digests the report gives.

    Returns
    -------
    DesignReport
        The numbers; :func:`write_report` makes pages of them.

    Raises
    ------
    ProblemError
        If there is no design, one does not fit the loop, a name cannot be shown, or a true
        vibration drifts.
    FileError
        If the configuration or a gain file cannot be read.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> slow = lbt.design.optimal_integrator(config.hardware, config.truth)
    >>> report = lbt.report.design_report(config, {"integrator": slow})
    >>> one = report.assessments[0]
    >>> one.certified, f"{one.residual_nm:.0f} nm, Strehl {one.strehl:.2f}"
    (True, '156 nm, Strehl 0.70')
    """
    require_instance(config, Config)
    if not 1 <= len(designs) <= _MOST_DESIGNS:
        raise ProblemError(f"a report needs 1 to {_MOST_DESIGNS} designs; got {len(designs)}.")
    for name, design in designs.items():
        require_instance(design, Design)
        require_letters(name, "name of a design")
        require_compatible(name, design, config.hardware)
    made = creation_time()
    source, content = read_source(config.source, "configuration")
    files = [source]
    for name, path in (gain_files or {}).items():
        files.append(read_source(Path(path), f"gain file of {name}")[0])
    truth, hardware, errors = config.truth, config.hardware, frequency_errors(config)
    assessments = tuple(assess_design(n, design, config, errors) for n, design in designs.items())
    stable = [one for one in assessments if one.stable]
    # all settle as the slowest, so that one seed is the same weather for all
    settle = max((settling_frames(one.loop.spectral_radius) for one in stable), default=0)
    solved = any(design.solver.route in _CONVEX_ROUTES for design in designs.values())
    return DesignReport(
        config=config,
        config_text=content.decode("utf-8-sig", errors="replace"),
        assessments=assessments,
        simulations={
            one.name: simulate_design(one.design, one.loop, config, settle_frames=settle)
            for one in stable
        },
        limits=studies.limits(designs, hardware, truth, config.imaging, errors_hz=list(errors)),
        truth=studies.compare_in_truth(designs, config),
        errors_hz=errors,
        files=tuple(files),
        versions=program_versions(("cvxpy", "clarabel") if solved else ()),
        made=made,
    )


def frequency_errors(config: Config) -> FloatArray:
    """Frequency errors of the configuration and 0, with three more between any two.

    Errors that would move a true vibration to 0 or to the Nyquist frequency are left out.
    Without vibrations there is only 0.
    """
    lines = config.truth.lines_hz
    if not lines:
        return frozen_copy([0.0])
    fine = refine_values([*config.errors_hz, 0.0])
    shifts = [config.truth.frequency_shift_hz(line, 1.0) for line in lines]
    places = np.array(lines) + fine[:, None] * shifts
    nyquist_hz = config.hardware.frame_rate_hz / 2
    return frozen_copy(fine[np.all((places > 0) & (places < nyquist_hz), axis=1)])


def refine_values(values: Sequence[float]) -> FloatArray:
    """Sort values, and add three between any two of them."""
    known = np.unique(values)
    places = np.arange(4 * known.size - 3) / 4
    return np.asarray(np.interp(places, np.arange(known.size), known))
