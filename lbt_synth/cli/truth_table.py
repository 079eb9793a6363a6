"""What a design leaves in the truth of a configuration, beside reference designs and the limit."""

from __future__ import annotations

from collections.abc import Collection

from lbt_synth.cli.output import Report
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.loop import least_residual
from lbt_synth.loop.least_residuals.residual_limit import ResidualLimit, limit_or_none
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.studies import compare_in_truth

_WITHOUT = ("worst_nm", "above_band_limit_percent", "method")  # columns
_NAME = "this design"


def say_limit(limit: ResidualLimit, config: Config) -> str:
    """Return the sentence on the limit of a truth, and on what other sensors can add to it."""
    least = nm_text(limit.rms_nm, ".6g", unit="nm rms")
    suite = config.hardware.suite
    if not suite.sensors:
        return f"least residual of any linear controller in the truth: {least}"
    said = f"least residual of any linear controller of the loop's own sensor in the truth: {least}"
    floor = limit_or_none(lambda: least_residual(config.hardware, config.truth))
    if floor is None:
        return f"{said}; with the other sensors it is less"
    why = ", even if accelerometers knew all vibrations in advance" * bool(suite.channels)
    return (
        f"{said}; of all sensors not less than {nm_text(floor.rms_nm, '.6g', unit='nm rms')}{why}"
    )


def add_truth(
    report: Report, design: Design, config: Config, *, without: Collection[str] = ()
) -> None:
    """Add what a design leaves in the truth, beside reference designs and the limit.

    A reference design that the design is itself is left out.
    """
    if config.truth.drifts:
        report.notes.append(
            "note: a vibration of the truth drifts, so that its residual has no exact value; "
            "lbt-synth simulate runs it."
        )
        return
    found = compare_in_truth({_NAME: design}, config, without=without)
    caption = f"In the truth of {config.source.name}; {config.imaging.label}"
    report.add_rows("truth", caption, found.rows, without=_WITHOUT)
    report.data |= {
        "truth_limit_nm": None if found.limit is None else found.limit.rms_nm,
        "wavelength_um": config.imaging.wavelength_um,
        "truth_warnings": found.warnings[_NAME],
    }
    if found.limit is not None:
        report.notes.append(say_limit(found.limit, config))
    report.notes += [f"warning: {text}." for text in found.warnings[_NAME]]
    report.notes += [f"note: {text}" for text in found.notes]
