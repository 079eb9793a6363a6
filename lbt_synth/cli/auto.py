"""The command auto: from a record to a gain file, tested on unseen data."""

from __future__ import annotations

from argparse import Namespace

from lbt_synth.cli import loop_records
from lbt_synth.cli.loop_inputs import choose_unit
from lbt_synth.cli.output import Report
from lbt_synth.cli.streams import count_progress
from lbt_synth.files.gain_file.store import require_gain_name
from lbt_synth.identification import LoopRecord, design_from_record
from lbt_synth.identification.auto import LEAST_SECONDS, RecordedDesign
from lbt_synth.identification.prediction.comparison import RAN
from lbt_synth.loop import Imaging, loop_margins


def run(arguments: Namespace) -> Report:
    """Identify a loop, design its controller, test it on unseen data, write its gain file."""
    gain = require_gain_name(arguments.output)
    places = loop_records.find_places(arguments, arguments.model, gain=gain)
    record = loop_records.require_series(
        loop_records.read_record(arguments, LEAST_SECONDS), "auto tests its design on"
    )
    choose_unit(arguments, record.diameter_m)
    loop_records.require_comparable(arguments, record)
    channels, values, notes = None, None, tuple[str, ...]()
    if arguments.accelerometers is not None:
        channels, values, notes = loop_records.read_accelerations(arguments, record)
    imaging = loop_records.record_imaging(arguments, record)
    with count_progress(total=3, what="identifying and designing") as count:
        found = design_from_record(
            record,
            method=arguments.method,
            gamma_ratio=arguments.gamma_ratio,
            imaging=imaging,
            accept_record=arguments.accept_record,
            command_scale_known=loop_records.is_scale_known(record),
            accelerations=values,
            channels=channels,
            progress=count,
            **loop_records.identification_options(arguments, record),
        )
    found = loop_records.with_repair(record, found)
    report = Report(data={"source": str(arguments.file)})
    loop_records.add_record(report, record)
    loop_records.add_model(report, found.model)
    report.data["method"] = found.design.method
    report.notes += [f"note: {note}." for note in notes]
    if found.channels:
        title = "Accelerometers: residual on the second half of the record"
        report.add_rows("accelerometers", title, list(found.channels))
    _add_comparison(report, found, record, imaging)
    loop = found.design.close(found.model.hardware)
    report.data["certificate"] = found.design.certificate.passed
    report.notes.append(
        f"certified: spectral radius of the loop {loop.spectral_radius:.6f}, modulus margin "
        f"{loop_margins(loop).modulus:.3f}."
    )
    report.notes += [f"assumes: {assumption}." for assumption in found.design.assumptions]
    report.data["assumptions"] = found.design.assumptions
    loop_records.write_files(report, places, arguments, record, found.model, found)
    return report


def _add_comparison(
    report: Report, found: RecordedDesign, record: LoopRecord, imaging: Imaging
) -> None:
    """Add what the second half of the data says of a design from the first."""
    table = found.held_out
    report.add_rows(
        "held_out",
        f"Residual on the second half of the record, by models of the first; {imaging.label}",
        list(table.entries),
    )
    report.notes += [f"note: {note}" for note in table.notes]
    best = table[found.name]
    report.data |= {"gain_over_what_ran": None, "wavelength_um": imaging.wavelength_um}
    if record.commands is not None:
        ran = table[RAN]
        before, after = (row.replayed.text for row in (ran, best) if row.replayed is not None)
        strehl = ""
        if ran.strehl >= 0 and best.strehl >= 0:
            strehl = f"; {imaging.label} (tip and tilt) {ran.strehl:.3f} -> {best.strehl:.3f}"
        report.notes.append(f"gain over what ran, on unseen data: {before} -> {after}{strehl}.")
        report.data["gain_over_what_ran"] = {
            "residual_nm": [ran.replayed_nm, best.replayed_nm],
            "strehl": [ran.strehl, best.strehl],
        }
    if best.contradicts_model:
        more = "more" if best.deviations > 0 else "less"
        report.notes.append(
            f"warning: on unseen data the {found.name} leaves {more} than the model expects, by "
            f"{abs(best.deviations):.1f} standard errors: the disturbance changed, or the model "
            "leaves something out."
        )
    report.notes += [loop_records.marked_note(note) for note in found.notes]
