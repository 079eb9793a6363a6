"""Records from files of any origin, from telemetry, and from a second file with the commands.

The facts and units of the source stand beside those of the call.
"""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np

from lbt_synth.errors import ProblemError, TelemetryError
from lbt_synth.files import Telemetry, load_telemetry
from lbt_synth.files.telemetry.aot import NO_LOOPS
from lbt_synth.identification.records.clock import SAME_FRAME
from lbt_synth.identification.records.columns import (
    UNITS,
    VOLTS,
    Column,
    clock_factor,
    nm_unit,
    parse_unit,
    same_unit,
    unit_to_show,
)
from lbt_synth.identification.records.contents import (
    CLOCKS,
    FITS,
    Contents,
    Roles,
    choose_axes,
    choose_columns,
    join_names,
    name_in_errors,
    number_axes,
    read_contents,
)
from lbt_synth.identification.records.from_series import loop_record
from lbt_synth.identification.records.record import LoopRecord, SpectrumRecord
from lbt_synth.models import PositionLoop
from lbt_synth.storage.array_file import read_cards
from lbt_synth.storage.input_files import LARGEST_TEXT_BYTES, open_input
from lbt_synth.validation import FloatArray, file_path

_TELEMETRY_CARDS = ("LBTTELEM", "AOT-VERS")  # of this package, and of the AOT standard
_TELEMETRY_ARRAYS = {"META", "MEASURE"}
_FOREIGN = "timing"  # key of metadata in telemetry of other programs
_STATED_GAIN, _READ_WITH = "stated_sensor_gain", "commands_read_with"  # of a record that was read
_CONDITION = float(np.finfo(np.float64).eps ** -0.5)  # beyond, an inverse is half rounding
_FACTS = ("frame_rate_hz", "diameter_m", "delay_frames", "obstruction")


def load_record(
    source: str | os.PathLike[str] | Telemetry,
    *,
    frame_rate_hz: float | None = None,
    delay_frames: float | None = None,
    unit: str | None = None,
    command_unit: str | None = None,
    diameter_m: float | None = None,
    obstruction: float | None = None,
    mirror: PositionLoop | None = None,
    averages: int | None = None,
    axes: Sequence[int] | None = None,
    columns: Mapping[str, Any] | None = None,
    commands: str | os.PathLike[str] | None = None,
    loop: str | int | None = None,
) -> LoopRecord | SpectrumRecord:
    r"""Read what a loop recorded: FITS, NPY, NPZ, CSV, HDF5, MATLAB, IDL, or telemetry.

    Telemetry of this package and of the AOT standard is recognised; its measurements and commands
    become modes by its matrices. In other files, series are found by the names of columns, arrays
    and HDUs, rates and units by names and headers, as the page on records lists them. What the
    source does not tell has to be given; the notes of the record say how it was read.

    Parameters
    ----------
    source : path-like or Telemetry
        Telemetry, or a file that ends in .fits, .fit, .fts, .npy, .npz, .csv, .tsv, .txt, .dat,
        .mat, .sav, .h5 or .hdf5 (which need the extra ``hdf5``, as MATLAB 7.3 does).
    frame_rate_hz, unit, command_unit : optional
        As for :func:`loop_record`, where the source does not tell them; another unit is refused.
        That of a spectrum is nm^2/Hz or nm/sqrt(Hz) and so on.
    delay_frames, diameter_m, obstruction, mirror : optional
        As for :func:`loop_record`, in place of those of the source as the frame rate is.
    averages : int, optional
        Periodograms that were averaged in a spectrum.
    axes : sequence of int, optional
        Which columns of several, or which modes of telemetry, are the axes; from 0.
    columns : mapping, optional
        What names do not tell: names or numbers (from 0) of columns under "measurements" and
        "commands" of a closed loop, "open_loop" (the open-loop or pseudo-open-loop series),
        "frequency" and "density" of a spectrum, and "times" and "frame_numbers".
    commands : path-like, optional
        Another file, with the commands. Rows are matched by the frame counters of both files, else
        by their times; without these there is one for each row.
    loop : str or int, optional
        Name or number (from 0) of a control loop of the AOT standard; the first by default.

    Returns
    -------
    LoopRecord or SpectrumRecord
        The record, in nm.

    Raises
    ------
    TelemetryError
        If a file is missing, damaged, or of another kind.
    ProblemError
        If a fact is missing from both the file and the call, or the two contradict.

    Examples
    --------
    >>> import lbt_synth as lbt, tempfile, pathlib
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder) / "night.csv"
    ...     _ = file.write_text("time_s,tip_mas,command_tip_mas\n0.000,3,0\n0.001,4,1\n0.002,,2\n")
    ...     seen = lbt.load_record(file, delay_frames=1, diameter_m=8.22)
    >>> seen.frame_rate_hz, seen.usable.tolist(), seen.measurements[0].round(2).tolist()
    (1000.0, [False, True, False], [29.89])
    """
    telemetry = source if isinstance(source, Telemetry) else None
    if telemetry is None:
        file_path(source, "a record, unless loop_record makes it of arrays,")
    name = str(source if telemetry is None else telemetry.metadata.get("name", "telemetry"))
    stated: dict[str, Any] = {
        "frame_rate_hz": frame_rate_hz,
        "delay_frames": delay_frames,
        "unit": unit,
        "command_unit": command_unit,
        "diameter_m": diameter_m,
        "obstruction": obstruction,
        "averages": averages,
        "source": name,
    }
    with name_in_errors(path := Path(name)):
        if telemetry is None and is_telemetry(path):
            telemetry = load_telemetry(path, loop=loop)
        elif loop is not None:
            raise ProblemError(NO_LOOPS)
        if telemetry is not None:
            if columns is not None or commands is not None:
                raise ProblemError(
                    "telemetry says what its series are: neither columns nor commands may be "
                    "given. Choose its modes with axes."
                )
            return _telemetry_record(telemetry, axes=axes, mirror=mirror, **stated)
        contents = read_contents(path)
        if commands is not None:
            _join_commands(contents, Path(commands))
        roles = choose_columns(contents, axes=axes, columns=columns)
        if "density" in roles:
            return _build_spectrum(roles, contents, **stated)
        return _build_loop(roles, contents, mirror=mirror, **stated)


def is_telemetry(path: str | os.PathLike[str]) -> bool:
    """Whether a file is telemetry of this package or of the AOT standard."""
    path = Path(path)
    try:
        with open_input(path, TelemetryError) as stream:
            if path.suffix.lower() in FITS:
                header = io.BytesIO(stream.read(LARGEST_TEXT_BYTES))
                return bool(read_cards(header, _TELEMETRY_CARDS))
            names = ZipFile(stream).namelist() if path.suffix.lower() == ".npz" else []
            return {Path(name).stem for name in names} >= _TELEMETRY_ARRAYS
    except Exception:  # zipfile raises many kinds; read_contents reports the error
        return False


def _telemetry_record(
    telemetry: Telemetry,
    *,
    axes: Sequence[int] | None,
    mirror: PositionLoop | None,
    **stated: Any,
) -> LoopRecord:
    """Make a record of tip and tilt; ``stated`` are facts, None where the telemetry has to tell."""
    n, what = telemetry.modes, "modes"
    if (loops := telemetry.metadata.get("aot_loops")) is not None:
        what += f" of {telemetry.metadata['aot_loop']}, the one taken of the control loops {loops}"
    chosen = choose_axes(axes, n, what)
    facts = {name: value for name in _FACTS if (value := getattr(telemetry, name)) is not None}
    contents = Contents(facts={name: {"the telemetry": value} for name, value in facts.items()})
    roles: Roles = {}
    for role, find, word in (
        ("measurements", _inverse_response, "the inverse of the interaction matrix"),
        ("commands", _influence, "the influence matrix"),
    ):
        recorded_unit = getattr(telemetry, f"{role.removesuffix('s')}_unit")
        if (series := getattr(telemetry, role)) is None:
            continue
        unit, said = recorded_unit if parse_unit(recorded_unit) else None, f"in {recorded_unit!r}"
        if (matrix := find(telemetry)) is not None:
            series, said = series @ matrix.T, f"behind {word}"
            # the modes of our own telemetry are in nm
            unit = "nm" if unit or _FOREIGN not in telemetry.metadata else None
            contents.notes.append(f"{role}: {word} times what was recorded")
        columns = [Column(name=f"mode {k} {said}", values=series[:, k], unit=unit) for k in chosen]
        roles[role] = columns
    if telemetry.times_s is not None:
        roles["times"] = [Column(name="times_s", values=telemetry.times_s, unit="s")]
    if max(n, telemetry.measurements.shape[1], telemetry.n_commands) > len(chosen):
        contents.notes.append(f"axes are modes {', '.join(map(str, chosen))} of {n}")
    if _FOREIGN in telemetry.metadata:
        contents.notes.append(
            "of another program: that y(k) is of the exposure of frame k-1 is taken for granted"
        )
    if loops is not None:
        contents.notes.append(f"{what}; loop takes another")
    mirror = telemetry.mirror if mirror is None else mirror
    record = _build_loop(roles, contents, mirror=mirror, **stated)
    gains = tuple(map(float, str(telemetry.metadata.get(_STATED_GAIN, "")).split()))
    return replace(
        record,
        imaging_wavelength_um=telemetry.imaging_wavelength_um,
        shown_unit=record.shown_unit if telemetry.shown_unit == "nm" else telemetry.shown_unit,
        stated_gain=tuple(gains[k] for k in chosen) if len(gains) == n else gains,
        read_with=str(telemetry.metadata.get(_READ_WITH, "")),
    )


def telemetry_of_record(record: LoopRecord) -> Telemetry:
    """Return a record as telemetry, from which it can be read again without any other fact."""
    y, u = record.measurements, record.commands
    gains = " ".join(f"{gain:.9g}" for gain in record.stated_gain)
    stated = {_STATED_GAIN: gains, _READ_WITH: record.read_with}
    return Telemetry(
        frame_rate_hz=record.frame_rate_hz,
        delay_frames=record.delay_frames,
        mirror=None if record.delay_frames is None else record.mirror,
        measurements=np.where(record.measured[:, None], y, np.nan),
        commands=None if u is None else np.where(record.commanded[:, None], u, np.nan),
        diameter_m=record.diameter_m,
        obstruction=record.obstruction,
        imaging_wavelength_um=record.imaging_wavelength_um,
        shown_unit=record.shown_unit,
        metadata={name: text for name, text in stated.items() if text},
    )


def _inverse_response(seen: Telemetry) -> FloatArray | None:
    """Return the matrix from measurements to modes, None for the identity."""
    n, q, response = seen.modes, seen.measurements.shape[1], seen.interaction_matrix
    if (response is None and q != n) or (response is not None and q > n > 2):
        raise ProblemError(
            f"this telemetry has {q} measurements and {n} modes: slopes without modal "
            "coefficients. Multiply them by the reconstructor of the loop.",
            in_python="As Telemetry(measurements=slopes @ reconstructor.T).",
        )
    # of other programs, the units are in the matrix
    gains = np.ones(n) if response is None or _FOREIGN in seen.metadata else np.diag(response)
    if response is None or (np.array_equal(response, np.diag(gains)) and np.all(gains > 0)):
        return None  # the record has a sensor gain of its own
    if q < n or np.linalg.cond(response) > _CONDITION:
        raise ProblemError(
            f"the interaction matrix {response.shape} has no inverse: the {q} measurements do not "
            f"tell {n} modes apart. Give telemetry of tip and tilt alone."
        )
    return np.asarray(np.linalg.pinv(response), dtype=np.float64)


def _influence(seen: Telemetry) -> FloatArray | None:
    """Return the matrix from commands to modes, None for the identity."""
    n, m, influence = seen.modes, seen.n_commands, seen.influence_matrix
    if influence is None and m != n:
        raise ProblemError(
            f"this telemetry has {m} commands of {n} modes, and no influence matrix (modes, "
            "commands).",
            in_python="Give it to Telemetry(influence_matrix=...).",
        )
    return None if influence is None or np.array_equal(influence, np.eye(n)) else influence


def _join_commands(contents: Contents, path: Path) -> None:
    """Add the commands of another file, in place of those of the first."""
    other = read_contents(path)
    named = [column for column in other.columns if column.role == "commands"] or [
        column for column in other.columns if column.role in (None, "measurements")
    ]
    if not named:
        raise TelemetryError(f"{path} holds no commands.", path=path)
    named = _lay_beside(contents, other, named, path)
    if any(column.axis is None for column in named):
        named = number_axes(named)
    columns = [column for column in contents.columns if column.role != "commands"]
    if not any(column.role in ("measurements", "open_loop") for column in columns):
        plain = number_axes([column for column in columns if column.role is None])
        columns = [column for column in columns if column.role is not None]
        columns += [replace(column, role="measurements") for column in plain]
    contents.columns = columns + [replace(column, role="commands") for column in named]
    # a unit is that of its own file
    contents.facts["command_unit"] = other.facts.pop("unit", {})
    for fact, places in other.facts.items():
        for where, value in places.items():
            contents.facts.setdefault(fact, {})[f"{where} in {path.name}"] = value
    contents.notes += [f"commands are from {path}", *other.notes]


def _lay_beside(
    contents: Contents, other: Contents, commands: list[Column], path: Path
) -> list[Column]:
    """Return the commands in the rows of the measurements, by counters, times or row by row."""
    for role in CLOCKS:
        clocks = [c for file in (contents, other) for c in file.columns if c.role == role]
        if len(clocks) != 2:
            continue
        frame, command_frame = (clock_factor(c.unit, "s") * c.values for c in clocks)
        steps = np.diff(command_frame)
        row = np.searchsorted(command_frame[:-1] + steps / 2, frame)
        far = ~(np.abs(command_frame[row] - frame) < SAME_FRAME * np.median(steps))
        if not np.all(steps > 0) or far.all():
            raise TelemetryError(
                f"the commands in {path} must have {role.replace('_', ' ')} that rise, and are "
                f"those of measurements; got {command_frame[0]:.12g} to {command_frame[-1]:.12g}, "
                f"and {frame[0]:.12g} to {frame[-1]:.12g}. Give files of the same frames.",
                path=path,
            )
        contents.notes.append(
            f"commands were laid beside the measurements by {clocks[1].name}: "
            f"{int(np.sum(~far))} of {len(far)} rows have one"
        )
        return [replace(c, values=np.where(far, np.nan, c.values[row])) for c in commands]
    rows = sorted({len(column.values) for column in (*contents.columns, *commands)})
    if len(rows) > 1:
        raise TelemetryError(
            f"{path} must have as many frames as the measurements; got "
            f"{', '.join(map(str, rows))}. Or give both files a counter of frames.",
            path=path,
        )
    return commands


def _build_loop(
    roles: Roles,
    contents: Contents,
    *,
    unit: str | None,
    command_unit: str | None,
    mirror: PositionLoop | None,
    source: str,
    **stated: Any,
) -> LoopRecord:
    """Make a record of series; ``stated`` are facts, None where the source has to tell."""
    if stated["averages"] is not None:
        raise ProblemError("averages are only for a spectrum; got a record of series.")
    (role, columns), commands = next(iter(roles.items())), roles.get("commands")
    facts = {name: contents.find_fact(name, stated[name]) for name in _FACTS}
    units = {role: _find_unit(columns, unit, contents)}
    if commands is not None:
        units["commands"] = (
            _find_unit(commands, command_unit, contents, "command_unit") or unit or ""
        )
    _require_facts(roles, units, facts)
    (clock,), (counter,) = (roles.get(name, [None]) for name in ("times", "frame_numbers"))
    times = None
    if clock is not None:
        times = clock_factor(clock.unit, "s") * clock.values
        if not times.any() and facts["frame_rate_hz"] is not None:
            contents.notes.append(f"{clock.name} is zero in all rows and was left out")
            times = None
        elif not clock.unit:
            contents.notes.append(f"{clock.name} was taken for seconds")
    return loop_record(
        _stack_columns(columns),
        None if commands is None else _stack_columns(commands),
        unit=units[role],
        command_unit=units.get("commands"),
        mirror=mirror,
        times_s=times,
        frame_numbers=None if counter is None else counter.values,
        notes=contents.notes,
        source=source,
        **facts,
    )


def _require_facts(
    roles: Roles, units: Mapping[str, str], facts: Mapping[str, Any], kind: str = "loop"
) -> None:
    """Refuse series of which facts are missing, all of them in one message."""
    bare = [role for role, unit in units.items() if not unit]
    option = "command_unit" if bare == ["commands"] else "unit"
    names = join_names([column for role in bare for column in roles[role]])
    angles = any(unit and unit.base == "mas" for unit in map(parse_unit, units.values()))
    has_times = any(column.unit for column in roles.get("times", ()))
    no_rate = facts["frame_rate_hz"] is None and not has_times and kind == "loop"
    no_delay = "commands" in roles and facts["delay_frames"] is None
    lacks = {
        f"the unit of {names}: give {option} ({UNITS[kind]})": bare,
        "the telescope, by which angles become nm: give diameter_m": (
            angles and facts["diameter_m"] is None
        ),
        "the frame rate: give frame_rate_hz, or times whose name has a unit": no_rate,
        "the total delay: give delay_frames": no_delay,
    }
    missing = [text for text, is_missing in lacks.items() if is_missing]
    if len(missing) > no_delay:
        volts = VOLTS if bare and option == "command_unit" else {}
        raise ProblemError(f"nothing tells {'; '.join(missing)}.", **volts)


def _find_unit(
    columns: Sequence[Column], stated: str | None, contents: Contents, option: str = "unit"
) -> str:
    """Return the unit of some columns by their names or headers, the source, or the call."""
    places = contents.facts.get(option, contents.facts.get("unit", {}))
    of_file = list(dict.fromkeys(map(str, places.values())))
    units = {column.unit or (of_file[0] if of_file else "") for column in columns}
    if len(units) > 1 or len(of_file) > 1:
        raise ProblemError(
            f"{join_names(columns)} must all have the same unit; got "
            f"{', '.join(sorted(units.union(of_file)))}."
        )
    (unit,) = units
    if unit and stated is not None and not same_unit(unit, stated):
        raise ProblemError(
            f"{option} must be that of the data, {unit!r}; got {stated!r}.",
            at_terminal="Leave it out; --show-unit is the unit of what is shown.",
        )
    return str(unit or stated or "")


def _stack_columns(chosen: Sequence[Column]) -> FloatArray:
    sizes = {len(column.values) for column in chosen}
    if len(sizes) > 1:
        raise ProblemError(
            f"{' and '.join(column.name for column in chosen)} must be equally long; got "
            f"{' and '.join(map(str, sorted(sizes)))} rows."
        )
    return np.column_stack([column.values for column in chosen])


def _build_spectrum(
    roles: Roles, contents: Contents, *, unit: str | None, source: str, **stated: Any
) -> SpectrumRecord:
    """Make a record of densities; ``stated`` are facts, None where the source has to tell."""
    densities, (frequency,) = roles["density"], roles["frequency"]
    names = ("frame_rate_hz", "diameter_m", "averages")
    facts = {name: contents.find_fact(name, stated[name]) for name in names}
    density_unit = _find_unit(densities, unit, contents)
    _require_facts(roles, {"density": density_unit}, facts, "spectrum")
    _, power, factor = nm_unit(density_unit, diameter_m=facts["diameter_m"], kind="spectrum")
    if not frequency.unit:
        contents.notes.append("frequencies were taken for Hz")
    table = _stack_columns([frequency, *densities])
    complete = np.all(np.isfinite(table), axis=1)
    if not complete.all():
        contents.notes.append(f"{int(np.sum(~complete))} rows with gaps were left out")
    table = table[complete]
    density = factor * table[:, 1:]
    if power == 1:
        contents.notes.append("amplitude densities were squared")
        density = density * np.abs(density)  # a negative one stays negative, and is refused
    return SpectrumRecord(
        frequency_hz=clock_factor(frequency.unit, "Hz") * table[:, 0],
        density_nm2_hz=density,
        shown_unit=unit_to_show(density_unit),
        notes=tuple(dict.fromkeys(contents.notes)),
        source=source,
        **facts,
    )
