"""The numbers of a report: designs side by side in the loop of a configuration."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from lbt_synth import studies
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import ProblemError
from lbt_synth.loop.simulation.run import settling_frames
from lbt_synth.report import provenance
from lbt_synth.report.designs.assessment import DesignAssessment, assess_design, require_compatible
from lbt_synth.report.designs.simulation import DesignSimulation, simulate_design
from lbt_synth.report.figures.loop import frequency_grid
from lbt_synth.studies import LimitRow
from lbt_synth.studies.limits import LimitStudy, TruthComparison
from lbt_synth.validation import FloatArray, frozen_copy, require_instance

_CONVEX_ROUTES = ("sdp", "lmi")
_MOST_DESIGNS = 36  # more lines cannot be distinguished


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
    frequency_hz: FloatArray  # (f,): frequencies of the transfer functions [Hz]
    # (e,): frequency errors, truth less design [Hz]; only 0 where the truth has no vibration
    errors_hz: FloatArray
    files: tuple[provenance.SourceFile, ...]  # digests of the files that were read
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
    advance: Callable[[int], object] | None = None,
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
    advance : callable, optional
        Called with a number of steps whenever they are done; there are :func:`count_steps` of them.

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
    (True, '152 nm, Strehl 0.70')
    """
    require_instance(config, Config)
    if not 1 <= len(designs) <= _MOST_DESIGNS:
        raise ProblemError(f"a report needs 1 to {_MOST_DESIGNS} designs; got {len(designs)}.")
    for name, design in designs.items():
        require_instance(design, Design)
        provenance.require_letters(name, "name of a design")
        require_compatible(name, design, config.hardware)
    made = provenance.creation_time()
    source, content = provenance.read_source(config.source, "configuration")
    files = [source]
    for name, path in (gain_files or {}).items():
        files.append(provenance.read_source(Path(path), f"gain file of {name}")[0])
    count = advance or (lambda _: None)
    truth, hardware = config.truth, config.hardware
    errors = frequency_errors(config)
    grid = frozen_copy(frequency_grid(hardware.frame_rate_hz, truth.lines_hz))
    assessments = []
    for name, design in designs.items():
        assessments.append(assess_design(name, design, config, frequency_hz=grid, errors_hz=errors))
        count(1)
    limits = studies.limits(designs, hardware, truth, config.imaging, errors_hz=list(errors))
    count(1)
    compared = studies.compare_in_truth(designs, config)
    count(1)
    stable = [one for one in assessments if one.stable]
    settle = [settling_frames(one.spectral_radius) for one in stable]
    simulations = {}
    for one in stable:  # all settle as the slowest, so that one seed is the same weather for all
        simulations[one.name] = simulate_design(one.design, config, settle_frames=max(settle))
        count(1)
    solved = any(design.solver.route in _CONVEX_ROUTES for design in designs.values())
    return DesignReport(
        config=config,
        config_text=content.decode("utf-8-sig", errors="replace"),
        assessments=tuple(assessments),
        simulations=simulations,
        limits=limits,
        truth=compared,
        frequency_hz=grid,
        errors_hz=errors,
        files=tuple(files),
        versions=provenance.program_versions(("cvxpy", "clarabel") if solved else ()),
        made=made,
    )


def count_steps(designs: int) -> int:
    """Return the number of steps that a report of so many designs takes at most."""
    return 2 * designs + 2


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
