"""The command identify: from a record to a configuration."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth.cli import loop_records
from lbt_synth.cli.loop_inputs import choose_unit
from lbt_synth.cli.output import Report
from lbt_synth.errors import LbtSynthError
from lbt_synth.identification import LoopRecord, SpectrumRecord, accelerometer_transfers, identify
from lbt_synth.identification.accelerometers.transfers import AccelerometerTransfers


def run(arguments: Namespace) -> Report:
    """Identify a loop from its record; write a configuration and, by default, a figure."""
    places = loop_records.find_places(arguments, arguments.output)
    record = loop_records.read_record(arguments)
    choose_unit(arguments, record.diameter_m)
    loop_records.require_comparable(arguments, record)
    options = loop_records.identification_options(arguments, record)
    doubts: tuple[str, ...] = ()
    if isinstance(record, LoopRecord):
        doubts = loop_records.judge_record(arguments, record)
    if isinstance(record, SpectrumRecord):  # it does not hold the timing of the loop
        options |= {name: getattr(arguments, name) for name in ("frame_rate_hz", "delay_frames")}
    model = identify(record, **options)
    report = Report(data={"source": str(arguments.file)})
    loop_records.add_record(report, record)
    loop_records.add_model(report, model)
    found: AccelerometerTransfers | None = None
    if arguments.accelerometers is not None and isinstance(record, LoopRecord):
        channels, values, notes = loop_records.read_accelerations(arguments, record)
        report.notes += [f"note: {note}." for note in notes]
        try:
            found = accelerometer_transfers(model, record, values, channels=channels)
        except LbtSynthError as error:  # the model is not lost
            report.notes.append(f"warning: the accelerometers were not compared: {error}")
        else:
            loop_records.add_accelerometers(report, found)
    report.notes += [loop_records.marked_note(doubt) for doubt in doubts]
    loop_records.write_files(report, places, arguments, record, model, accelerometers=found)
    return report
