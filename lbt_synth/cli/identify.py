"""Commands that read what a loop recorded: identify and auto."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lbt_synth.cli.output import Report, TableText, counting, fixed, working
from lbt_synth.config import identified_config
from lbt_synth.config.write import config_text
from lbt_synth.errors import OutputError, ProblemError
from lbt_synth.files import save_gain
from lbt_synth.files.gain_file.store import require_gain_name
from lbt_synth.identification import (
    IdentifiedAxis,
    IdentifiedModel,
    LinePrior,
    LoopRecord,
    RecordedDesign,
    SpectrumRecord,
    design_from_record,
    identify,
    lines_of_accelerometer,
    load_lines,
    load_record,
    require_length,
)
from lbt_synth.identification.prediction.table import RAN
from lbt_synth.identification.records.health import HEADINGS
from lbt_synth.identification.records.line_priors import load_accelerations
from lbt_synth.loop import Imaging, close_loop, loop_margins
from lbt_synth.report.figures import identification_figure
from lbt_synth.report.figures.style import require_figure_name, save_figure
from lbt_synth.storage.atomic_files import require_writable, write_atomically

_AXES = ("tip", "tilt")
_YAML = (".yaml", ".yml")
_FAR = 4.0  # standard errors


def identify_command(arguments: Namespace) -> Report:
    """Identify a loop from its record and write a configuration."""
    output = Path(arguments.output)
    if output.suffix.lower() not in _YAML:
        raise OutputError(f"a model must end in .yaml or .yml; got {output.name!r}.", path=output)
    figure = _figure_name(arguments, output)
    _require_places(arguments, output, figure)
    record = _record(arguments)
    with working("identifying", quiet=arguments.json):
        model = identify(record, **_options(arguments, record), **_of_spectra(arguments, record))
    report = Report(data={"source": str(arguments.file)})
    _tell_record(report, record)
    _tell_model(report, model)
    text = _model_text(model, arguments, record)
    drawn = None if figure is None else identification_figure(model)
    write_atomically(output, text)
    _note_written(report, "model", output)
    if figure is not None:
        save_figure(drawn, figure)
        _note_written(report, "figure", figure)
    return report


def auto(arguments: Namespace) -> Report:
    """Identify a loop, design its controller, test it on unseen data, write its gain file."""
    output = Path(require_gain_name(arguments.output))
    figure = _figure_name(arguments, output)
    model_file = output.with_suffix(".yaml") if arguments.model is None else Path(arguments.model)
    if model_file.suffix.lower() not in _YAML:
        raise OutputError(
            f"a model must end in .yaml or .yml; got {model_file.name!r}.", path=model_file
        )
    _require_places(arguments, output, model_file, figure)
    record = _record(arguments)
    if isinstance(record, SpectrumRecord):
        raise ProblemError(
            "auto tests its design on the recorded series; got a spectrum. Try lbt-synth identify "
            "and lbt-synth design."
        )
    with counting(total=3, what="identifying and designing", quiet=arguments.json) as count:
        made = design_from_record(
            record,
            method=arguments.method,
            gamma_ratio=arguments.gamma_ratio,
            imaging=_imaging(arguments, record),
            progress=count,
            **_options(arguments, record),
        )
    report = Report(data={"source": str(arguments.file)})
    _tell_record(report, record)
    _tell_model(report, made.model)
    _tell_test(report, made, record)
    # all is made before the first file is written
    text = _model_text(made.model, arguments, record)
    drawn = None
    if figure is not None:
        drawn = identification_figure(made.model, designs={made.name: made.design})
    save_gain(output, made.design)
    _note_written(report, "file", output)
    write_atomically(model_file, text)
    _note_written(report, "model", model_file)
    if figure is not None:
        save_figure(drawn, figure)
        _note_written(report, "figure", figure)
    return report


def _figure_name(arguments: Namespace, output: Path) -> Path | None:
    if arguments.no_figure:
        if arguments.figure is not None:
            raise ProblemError("give one of --figure and --no-figure, not both.")
        return None
    return require_figure_name(
        output.with_suffix(".png") if arguments.figure is None else arguments.figure
    )


def _require_places(arguments: Namespace, *outputs: Path | None) -> None:
    """Refuse outputs that cannot be written, replace an input, or each other."""
    places = [place for place in outputs if place is not None]
    if len({place.resolve() for place in places}) < len(places):
        raise OutputError(f"each output needs a name of its own; got {places[0]} twice.")
    given = (arguments.file, arguments.commands, arguments.lines_file, arguments.accelerometers)
    require_writable(*places, inputs=[name for name in given if name is not None])


def _record(arguments: Namespace) -> LoopRecord | SpectrumRecord:
    record = load_record(
        arguments.file,
        kind=None if arguments.kind is None else arguments.kind.replace("-", "_"),
        frame_rate_hz=None if arguments.kind == "spectrum" else arguments.frame_rate_hz,
        delay_frames=arguments.delay_frames,
        unit=arguments.unit,
        command_unit=arguments.command_unit,
        diameter_m=arguments.diameter_m,
        obstruction=arguments.obstruction,
        axes=arguments.axes,
        averages=arguments.averages,
        columns=_columns(arguments.columns),
        commands=arguments.commands,
    )
    if isinstance(record, LoopRecord):
        record = record.bridged()
        require_length(record)
    return record


def _columns(given: Sequence[str] | None) -> dict[str, list[str | int]] | None:
    """Read ROLE=NAME[,NAME] pairs."""
    if given is None:
        return None
    out: dict[str, list[str | int]] = {}
    for pair in given:
        role, equals, names = pair.partition("=")
        if not equals or not role or not names:
            raise ProblemError(
                f"--columns takes ROLE=NAME or ROLE=NAME,NAME, as in measurements=tip,tilt or "
                f"commands=3,4; got {pair!r}."
            )
        out[role] = [int(name) if name.isdecimal() else name for name in names.split(",")]
    return out


def _options(arguments: Namespace, record: LoopRecord | SpectrumRecord) -> dict[str, Any]:
    """Return what the identification is told."""
    options: dict[str, Any] = {
        "announced": _announced(arguments, record),
        "lowest_line_hz": arguments.lowest_line_hz,
        "most_lines": arguments.most_lines,
    }
    if isinstance(record, LoopRecord):
        options["sensor_gain"] = arguments.sensor_gain
        options["assumed_gain"] = arguments.assumed_gain
    elif arguments.sensor_gain is not None:
        raise ProblemError("a spectrum is of the phase: it has no sensor gain to be given.")
    return options


def _of_spectra(arguments: Namespace, record: LoopRecord | SpectrumRecord) -> dict[str, Any]:
    if isinstance(record, LoopRecord):
        return {}
    return {"frame_rate_hz": arguments.frame_rate_hz, "delay_frames": arguments.delay_frames}


def _announced(arguments: Namespace, record: LoopRecord | SpectrumRecord) -> tuple[LinePrior, ...]:
    """Lines known beforehand, from the arguments, a file, and accelerometers."""
    lines: list[LinePrior] = []
    if arguments.lines_hz is not None:
        lines += load_lines([(f, arguments.lines_error_hz) for f in arguments.lines_hz])
    if arguments.lines_file is not None:
        lines += load_lines(arguments.lines_file)
    if arguments.accelerometers is not None:
        if isinstance(record, SpectrumRecord):
            raise ProblemError(
                "accelerometers are compared with the recorded series; got a spectrum. Give their "
                "lines by --lines-hz."
            )
        lines += lines_of_accelerometer(
            load_accelerations(arguments.accelerometers),
            record.pseudo_open_loop(),
            record.frame_rate_hz,
            usable=record.usable,
        )
    return tuple(lines)


def _imaging(arguments: Namespace, record: LoopRecord) -> Imaging:
    obstruction = record.obstruction
    return Imaging(
        diameter_m=record.diameter_m,
        obstruction=0.0 if obstruction is None else obstruction,
        wavelength_um=arguments.wavelength_um,
    )


def _tell_record(report: Report, record: LoopRecord | SpectrumRecord) -> None:
    if isinstance(record, SpectrumRecord):
        f = record.frequency_hz
        report.notes += [f"note: {note}" for note in record.notes]
        report.data["record"] = {"kind": "spectrum", "frequencies": f.size, "notes": record.notes}
        report.tables.append(
            TableText(
                title=f"Spectra of {record.axes} {_plural('axis', record.axes)}",
                headings=("axis", "from [Hz]", "to [Hz]", "rms [nm]"),
                rows=[
                    (_axis(i, record.axes), float(f[0]), float(f[-1]), fixed(float(rms), 1))
                    for i, rms in enumerate(record.rms_nm)
                ],
            )
        )
        return
    health = record.health
    kind = "open loop" if record.commands is None else "closed loop"
    report.data["record"] = {
        "kind": kind,
        "frames": record.frames,
        "usable": health.usable,
        "frame_rate_hz": record.frame_rate_hz,
        "delay_frames": record.delay_frames,
        "findings": [asdict(found) for found in health.findings],
        "notes": health.notes,
    }
    rows = [
        (row[0], row[1], "both" if row[2] is None else _axis(row[2], record.axes), *row[3:])
        for row in health.rows()
    ]
    if rows:
        report.tables.append(
            TableText(
                title=f"Record: {record.duration_s:.4g} s, {kind}, {record.axes} "
                f"{_plural('axis', record.axes)}: {health.summary()}",
                headings=HEADINGS,
                rows=rows,
            )
        )
    else:
        report.notes.append(
            f"record: {record.duration_s:.4g} s, {kind}, {record.axes} "
            f"{_plural('axis', record.axes)}; {health.summary()}"
        )
    report.notes += [f"note: {note}" for note in health.notes]


def _plural(word: str, count: int) -> str:
    return word if count == 1 else f"{word[:-2]}es"


def _axis(i: int, count: int) -> str:
    return _AXES[i] if count == len(_AXES) else "-"


def _tell_model(report: Report, model: IdentifiedModel) -> None:
    count = len(model.axes)
    ground: list[tuple[Any, ...]] = []
    lines: list[tuple[Any, ...]] = []
    for i, axis in enumerate(model.axes):
        ground += _background_rows(_axis(i, count), axis)
        lines += [
            (
                _axis(i, count),
                fixed(line.frequency_hz, 3),
                f"{line.frequency_error_hz:.2g}",
                f"{line.damping:.3g}" if line.resolved else f"< {line.damping:.2g}",
                f"{line.damping_error:.2g}" if line.resolved else None,
                fixed(line.rms_nm, 2),
                f"{line.rms_error_nm:.2g}",
                f"{line.prominence:.3g}",
                line.kind + (", announced" if line.announced else ""),
            )
            for line in axis.parts
        ]
    report.tables.append(
        TableText(
            title="Turbulence, noise and sensor",
            headings=("quantity", "axis", "value", "error", "unit"),
            rows=ground,
        )
    )
    if lines:
        report.tables.append(
            TableText(
                title="Vibrations",
                headings=(
                    "axis",
                    "f [Hz]",
                    "+-",
                    "damping",
                    "+-",
                    "rms [nm]",
                    "+-",
                    "over the rest",
                    "origin",
                ),
                rows=lines,
            )
        )
    else:
        report.notes.append("no vibration stands out of the turbulence and the noise.")
    report.notes += [_marked(note) for note in model.notes]
    for i, axis in enumerate(model.axes):
        where = f"{_AXES[i]}: " if count == len(_AXES) else ""
        report.notes.append(f"{where}sensor gain {axis.sensor_gain_note}.")
        report.notes.append(f"{where}{_whiteness(axis)}")
    report.data["axes"] = [_axis_data(axis) for axis in model.axes]
    report.data["model_notes"] = model.notes


def _marked(note: str) -> str:
    return note if note.startswith("warning") else f"note: {note}"


def _background_rows(name: str, axis: IdentifiedAxis) -> list[tuple[Any, ...]]:
    slow = axis.turbulence_fit
    rows: list[tuple[Any, ...]] = [
        ("turbulence, rms", name, fixed(slow.rms_nm, 1), f"{slow.rms_error_nm:.2g}", "nm"),
        (
            "turbulence, frequency",
            name,
            f"{slow.frequency_hz:.4g}",
            f"{slow.frequency_error_hz:.2g}",
            "Hz",
        ),
        ("turbulence, damping", name, f"{slow.damping:.3g}", f"{slow.damping_error:.2g}", ""),
    ]
    if slow.corner_hz is not None and slow.corner_error_hz is not None:
        rows.append(
            (
                "turbulence, roll-off",
                name,
                f"{slow.corner_hz:.3g}",
                f"{slow.corner_error_hz:.2g}",
                "Hz",
            )
        )
    error = axis.sensor_gain_error
    rows += [
        ("noise a frame", name, fixed(axis.noise_nm, 3), f"{axis.noise_error_nm:.2g}", "nm"),
        (
            "sensor gain",
            name,
            fixed(axis.sensor_gain, 4),
            None if error is None else f"{error:.2g}",
            "",
        ),
    ]
    return rows


def _whiteness(axis: IdentifiedAxis) -> str:
    test = axis.whiteness
    if test.white:
        return f"innovations are white (p = {test.p_value:.2g}, {test.correlation_p_value:.2g})."
    return (
        f"innovations are not white: their cumulative power is off by up to "
        f"{100 * test.deviation:.2g} % (p = {test.p_value:.1g}, of the autocorrelation "
        f"{test.correlation_p_value:.1g}). The model leaves something out; see the figure."
    )


def _axis_data(axis: IdentifiedAxis) -> dict[str, Any]:
    return {
        "turbulence": asdict(axis.turbulence_fit)
        | {
            "coefficients": axis.turbulence.coefficients,
            "driving_rms_nm": axis.turbulence.driving_rms_nm,
        },
        "vibrations": [asdict(line) for line in axis.parts],
        "noise_nm": axis.noise_nm,
        "noise_error_nm": axis.noise_error_nm,
        "sensor_gain": axis.sensor_gain,
        "sensor_gain_error": axis.sensor_gain_error,
        "sensor_gain_note": axis.sensor_gain_note,
        "whiteness": {
            "deviation": axis.whiteness.deviation,
            "p_value": axis.whiteness.p_value,
            "correlation_p_value": axis.whiteness.correlation_p_value,
            "white": axis.whiteness.white,
        },
    }


def _tell_test(report: Report, made: RecordedDesign, record: LoopRecord) -> None:
    """Tell what the second half of the data says of a design from the first."""
    table = made.held_out
    rows: list[tuple[Any, ...]] = []
    data: list[dict[str, Any]] = []
    for entry in table.entries:
        rows.append(
            (
                entry.name,
                fixed(entry.replayed_nm, 2),
                fixed(entry.replayed_error_nm, 2),
                fixed(entry.model_nm, 2),
                fixed(entry.ratio, 3),
                fixed(entry.strehl, 3),
                fixed(entry.model_strehl, 3),
            )
        )
        data.append(
            {
                "name": entry.name,
                "data_nm": entry.replayed_nm,
                "data_error_nm": entry.replayed_error_nm,
                "model_nm": entry.model_nm,
                "strehl": entry.strehl,
                "model_strehl": entry.model_strehl,
            }
        )
    report.tables.append(
        TableText(
            title="Residual on the second half of the record, by models of the first",
            headings=(
                "controller",
                "data [nm]",
                "+-",
                "model [nm]",
                "data/model",
                "Strehl, data",
                "Strehl, model",
            ),
            rows=rows,
        )
    )
    report.notes += [f"note: {note}" for note in table.notes]
    report.data["held_out"] = data
    best = table[made.name]
    report.data["gain_over_what_ran"] = None
    if record.commands is not None:
        ran = table[RAN]
        report.notes.append(
            f"gain over what ran, on unseen data: residual {ran.replayed_nm:.4g} -> "
            f"{best.replayed_nm:.4g} nm, Strehl ratio of tip and tilt {ran.strehl:.3f} -> "
            f"{best.strehl:.3f}."
        )
        report.data["gain_over_what_ran"] = {
            "residual_nm": [ran.replayed_nm, best.replayed_nm],
            "strehl": [ran.strehl, best.strehl],
        }
    if abs(best.deviations) > _FAR:
        more = "more" if best.deviations > 0 else "less"
        report.notes.append(
            f"warning: on unseen data the {made.name} leaves {more} than the model expects, by "
            f"{abs(best.deviations):.1f} standard errors: the disturbance changed, or the model "
            "leaves something out."
        )
    report.notes += [_marked(note) for note in made.notes]
    loop = close_loop(made.model.hardware, made.design.controller)
    margins = loop_margins(loop)
    report.data["certificate"] = made.design.certificate.passed
    report.notes.append(
        f"certified: spectral radius of the loop {loop.spectral_radius:.6f}, modulus margin "
        f"{margins.modulus:.3f}."
    )


def _model_text(
    model: IdentifiedModel, arguments: Namespace, record: LoopRecord | SpectrumRecord
) -> bytes:
    """Return the configuration of what was identified."""
    obstruction = record.obstruction if isinstance(record, LoopRecord) else arguments.obstruction
    if obstruction is not None and record.diameter_m is None:
        raise ProblemError("--obstruction is a fraction of the diameter; give --diameter-m.")
    source = ascii(Path(arguments.file).name)[1:-1]
    settings, comments = identified_config(
        model,
        diameter_m=record.diameter_m,
        obstruction=obstruction,
        wavelength_um=arguments.wavelength_um,
        title=f"Identified from {source} by lbt-synth {arguments.command}.",
    )
    return config_text(settings, comments).encode()


def _note_written(report: Report, key: str, path: Path) -> None:
    report.data[key] = str(path)
    report.notes.append(f"written: {path}")
