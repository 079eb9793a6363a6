"""The command identify: from a record to a configuration."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from lbt_synth.cli.identification_files import (
    figure_path,
    model_text,
    require_model_name,
    require_places,
)
from lbt_synth.cli.identification_tables import add_model, add_record
from lbt_synth.cli.output import Report
from lbt_synth.cli.progress import show_spinner
from lbt_synth.cli.record_arguments import identification_options, read_record
from lbt_synth.identification import SpectrumRecord, identify
from lbt_synth.report.figures import identification_figure
from lbt_synth.report.figures.style import save_figure
from lbt_synth.storage.atomic_files import write_atomically


def run(arguments: Namespace) -> Report:
    """Identify a loop from its record, and write a configuration and a figure."""
    output = require_model_name(Path(arguments.output))
    figure_file = figure_path(arguments, output)
    require_places(arguments, output, figure_file)
    record = read_record(arguments)
    options = identification_options(arguments, record)
    if isinstance(record, SpectrumRecord):
        options["frame_rate_hz"] = arguments.frame_rate_hz
        options["delay_frames"] = arguments.delay_frames
    with show_spinner("identifying", quiet=arguments.json):
        model = identify(record, **options)
    report = Report(data={"source": str(arguments.file)})
    add_record(report, record)
    add_model(report, model)
    # everything is computed before the first file is written
    text = model_text(model, arguments, record)
    figure = None if figure_file is None else identification_figure(model)
    report.note_written(write_atomically(output, text), "model")
    if figure_file is not None:
        report.note_written(save_figure(figure, figure_file), "figure")
    return report
