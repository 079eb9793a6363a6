"""The command limits: designs beside the least residual of any linear controller."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth import studies
from lbt_synth.cli.display import load_shown
from lbt_synth.cli.loop_inputs import load_designs, named_difference_notes
from lbt_synth.cli.output import Report
from lbt_synth.cli.output_files import require_outputs, write_outputs
from lbt_synth.cli.progress import show_spinner
from lbt_synth.cli.truth_table import say_limit
from lbt_synth.config import Config
from lbt_synth.design import Design
from lbt_synth.methods.registry import reference_methods
from lbt_synth.report.figures.studies import limits_figure
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.studies.limits import LimitStudy


def run(arguments: Namespace) -> Report:
    """Compare designs with the least residual of any linear controller."""
    require_outputs(arguments.output, inputs=[arguments.config, *arguments.gains])
    config = load_shown(arguments)
    files = load_designs(arguments.gains, any_sensors=True)
    with show_spinner("comparing", quiet=arguments.json):
        designs = _config_designs(config)
        designs |= {f"{name} (file)" if name in designs else name: d for name, d in files.items()}
        study = studies.limits(
            designs, config.hardware, config.truth, config.imaging, errors_hz=config.errors_hz
        )
    no_band = () if study.band is not None else ("above_band_limit_percent",)
    report = Report()
    report.add_rows(
        "rows",
        f"Distance to the limits of any linear controller; {config.imaging.label}",
        study.rows,
        without=no_band,
        hidden=() if study.shift_hz.size else ("worst_nm",),
    )
    report.data["limit_nm"] = None if study.limit is None else study.limit.rms_nm
    if study.band is not None:
        report.data |= {
            "band_hz": study.band_hz,
            "band_limit_nm": study.band.rms_nm,
            "band_achieved_nm": study.band.achieved_nm,
        }
    report.notes += [*_limit_notes(study, config), *_design_notes(config, designs, study)]
    write_outputs(
        report, arguments.output, study.rows, figure=lambda: limits_figure(study), without=no_band
    )
    return report


def _config_designs(config: Config) -> dict[str, Design]:
    return {
        method.name: config.design(method.name, **method.in_comparison)
        for method in reference_methods()
    }


def _limit_notes(study: LimitStudy, config: Config) -> list[str]:
    if study.limit is None:
        return [
            "note: the limit of this loop cannot be computed; its modes have to decouple, with "
            "vibrations along principal axes of the sensor's noise."
        ]
    notes = [
        say_limit(study.limit, config)
        + (
            " (of sinusoids of known frequency, what moves within frames)"
            if study.band is not None
            else ""
        )
    ]
    if study.band is not None and study.band_hz is not None:
        low, high = study.band_hz
        notes.append(
            f"least worst residual with the vibration anywhere from {low:g} to {high:g} Hz: "
            f"{nm_text(study.band.rms_nm, '.6g', unit='nm rms')} (a filter of infinite order "
            f"achieves {nm_text(study.band.achieved_nm, '.6g')})"
        )
    return notes


def _design_notes(config: Config, designs: dict[str, Design], study: LimitStudy) -> list[str]:
    """Warn of rows that compare something else than they seem to."""
    notes = []
    if config.truth.vibrations and not config.plant.vibrations:
        notes.append(
            "note: kalman and hinf are designed without a vibration, as model.vibrations is "
            "missing; the truth has one."
        )
    if study.band is None and len(config.truth.vibrations) > 1:
        notes.append("note: the limit over a range of frequencies is that of a single sinusoid.")
    return notes + named_difference_notes(config, designs)
