"""What designs leave in the truth of a configuration, beside reference designs and the limit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.errors import LbtSynthError
from lbt_synth.loop import residual_budget
from lbt_synth.loop.least_residuals.residual_limit import ResidualLimit
from lbt_synth.methods.registry import reference_methods
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.studies.limits import LimitRow, limits

_SAME = 1e-6  # relative difference of residuals of one design
_CLEAR = 0.01  # of the residual's variance by which a reference has to be better
# Residual in the truth over what the design expects: at least twice the variance. A mirror that is
# slower than a Kalman filter believes stays below (1.2 in examples/lbt_slow_mirror.yaml).
_SURPRISING = 1.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruthComparison:
    """Designs in the truth of a configuration."""

    rows: tuple[LimitRow, ...]  # the designs, then the reference designs that are none of them
    # the least residual of any linear controller; None where the modes do not decouple
    limit: ResidualLimit | None
    # what is wrong with a design in this truth: an unstable loop, a residual far above what the
    # design expects, and demands that cost residual
    warnings: Mapping[str, tuple[str, ...]]
    notes: tuple[str, ...]  # why reference designs are missing


def compare_in_truth(designs: Mapping[str, Design], config: Config) -> TruthComparison:
    """Compare designs in the truth of a configuration with its reference designs.

    The reference designs are made for the configuration: the best integrator, the Kalman filter
    and the H-infinity filter.

    Parameters
    ----------
    designs : mapping of str to Design
        Designs by name.
    config : Config
        The configuration; its truth must be stationary.

    Returns
    -------
    TruthComparison
        Exact residuals, the limit, and warnings.

    Raises
    ------
    ProblemError
        If a design or a vibration does not fit the loop, or a vibration drifts.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> slow = config.design("integrator", gain=0.2)
    >>> found = lbt.studies.compare_in_truth({"slow": slow}, config)
    >>> [row.design for row in found.rows], round(found.limit.rms_nm, 2)
    (['slow', 'integrator', 'kalman', 'hinf'], 10.84)
    """
    references: dict[str, Design] = {}
    notes = []
    for method in reference_methods():
        name = f"{method.name} (reference)" if method.name in designs else method.name
        try:
            references[name] = config.design(method.name, **method.reference_options)
        except LbtSynthError as error:
            notes.append(f"{method.name} is left out: {error}")
    study = limits({**designs, **references}, config.hardware, config.truth, config.imaging)
    means_nm = {name: _means_nm(design, config) for name, design in designs.items()}
    ours, theirs = study.rows[: len(designs)], study.rows[len(designs) :]
    others = [row for row in theirs if not any(_is_same(row, own) for own in ours)]
    better = {row.design: (references[row.design], row.residual_nm) for row in others}
    return TruthComparison(
        rows=(*ours, *others),
        limit=study.limit,
        warnings={
            row.design: tuple(_warnings(designs[row.design], row, means_nm[row.design], better))
            for row in ours
        },
        notes=tuple(notes),
    )


def _means_nm(design: Design, config: Config) -> float:
    """Return what a design leaves in means over frames, as it expects it; nan if unstable."""
    loop = design.close(config.hardware, sensor_gain=config.truth.sensor_gain)
    if not loop.is_stable:
        return np.nan
    return residual_budget(loop, config.truth, frame_means=True).rms_nm


def _is_same(row: LimitRow, other: LimitRow) -> bool:
    return abs(row.residual_nm - other.residual_nm) <= _SAME * other.residual_nm


def _warnings(
    design: Design, row: LimitRow, means_nm: float, others: Mapping[str, tuple[Design, float]]
) -> Iterator[str]:
    """Yield what is wrong with a design in the truth, where it leaves some mean over frames."""
    if not row.stable:
        yield "the loop is unstable in the truth"
        return
    expected_nm = design.expected_residual_nm
    surprises = False
    if expected_nm is not None and means_nm > _SURPRISING * expected_nm:
        surprises = True
        yield (
            f"the truth leaves {nm_text(means_nm)} in means over frames, where the design expects "
            f"{nm_text(expected_nm)}: it has power that the design was not made for"
        )
    for name, (other, residual_nm) in others.items():
        if not residual_nm**2 < (1 - _CLEAR) * row.residual_nm**2:
            continue
        violated = design.violated_demands(other.controller)
        if violated is None:
            return
        if violated:
            yield f"{name} leaves less in the truth; it violates: {'; '.join(violated)}"
        elif not surprises:
            yield (
                f"{name} leaves less in the truth, where each vibration is at one frequency; "
                "this design is for all frequencies of its bands"
            )
