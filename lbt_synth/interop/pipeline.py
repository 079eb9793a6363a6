"""The one export: a design in the form that another program loads, proved in its arithmetic.

A folder of this room whose ``export`` module has a ``TARGET`` is a target; nothing else lists them.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import partial
from importlib import import_module
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, TypeAlias

import numpy as np

import lbt_synth
from lbt_synth.design import Check, Design, IntegratorLaw, integrator
from lbt_synth.design.modal import MixedController, ModalFilters
from lbt_synth.design.modal.stack import name_modes
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import CertificateError, NumericalError, ProblemError
from lbt_synth.interop.proof import FRAMES, LOSS, Written, prove_written, rehearsal_error
from lbt_synth.linear.controller import as_controller
from lbt_synth.loop import close_loop
from lbt_synth.loop.disturbances import Disturbance
from lbt_synth.loop.simulation import Simulation, SteppedController, settling_frames, simulate
from lbt_synth.models import LoopHardware
from lbt_synth.storage.atomic_files import make_directory, require_ending, write_together
from lbt_synth.storage.rows import json_record
from lbt_synth.validation import FloatArray, choice, integer, number, require_instance

CERTIFICATE = ".certificate.json"  # added to the name of what is written: its certificate
# without *, \ and ? no text ends a comment, splices lines or makes a trigraph
_UNSAFE = re.compile(r"[^A-Za-z0-9 ._,:;+\-=()<>%'/\[\]|]")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_MOST_SETTLING = 0.25  # part of the frames that the loops may settle in

ModalDesign: TypeAlias = Design | MixedController | ModalFilters


class ModeDesign(NamedTuple):
    """A design, and the modes that it controls; one of a single mode controls each of them."""

    design: Design
    modes: tuple[int, ...]

    @property
    def copies(self) -> list[tuple[int, ...]]:
        """The modes of each copy of the controller."""
        single = len(self.design.controller.C) == 1
        return [(mode,) for mode in self.modes] if single else [self.modes]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target:
    """A program that runs our controllers: how it rounds, writes and reads the numbers of a design.

    ``whole`` are the numbers of a file, of all its modes.
    """

    precision: str  # of its sums, unless an option says
    # round(designs, **options) returns the numbers of each design, in a type of the target
    round: Callable[..., list[Any]]
    # write(place, whole, design, origin, gain_digest=..., **options) returns the content of files
    write: Callable[..., dict[Path, bytes]]
    read: Callable[[Mapping[Path, bytes], Any], Any]  # read(files, whole), which has the sizes
    computed: Callable[[Design, Any], Written]  # what is proved of the numbers of a design
    # start(numbers, limit) returns a twin, which clips where the program knows the limit
    start: Callable[[Any, float], SteppedController]
    options: Mapping[str, Any] = field(default_factory=dict)  # of export, with their defaults
    # join(numbers, parts, count) returns the numbers of a file; without it it holds one design
    join: Callable[[Sequence[Any], Sequence[ModeDesign], int], Any] | None = None
    facts: Callable[..., Mapping[str, Any]] = lambda _, **options: {}  # facts(whole, **options)
    remark: Callable[[Design, Any], str] = lambda *_: ""  # what a user is told, or nothing
    hint: str  # what to try where the proof fails
    endings: tuple[str, ...] = ()  # of a file
    beside: tuple[str, ...] = ()  # endings of what goes beside it
    contents: tuple[str, ...] = ()  # names in a folder
    modal: bool = True  # whether measurements and commands of one design must be the modes, too
    reads_others: bool = False  # whether a design may read further sensors

    def path_in(self, folder: Path) -> Path:
        """Return a path in a folder that can be written."""
        return folder / "".join(["k", *self.endings[:1]])

    def places(self, output: Path) -> list[Path]:
        """Return what an export to a path writes."""
        if self.contents:
            return [output / name for name in self.contents] if output.is_dir() else [output]
        beside = [output.with_suffix(ending) for ending in self.beside]
        return [output, *beside, output.with_name(output.name + CERTIFICATE)]


def target_names() -> tuple[str, ...]:
    """Return the names of the targets, sorted, without loading them."""
    exports = Path(__file__).parent.glob("*/export.py")
    return tuple(sorted(path.parent.name for path in exports))


def target_named(name: str) -> Target:
    """Return one target."""
    folder = choice(name, "target", target_names())
    target: Target = import_module(f"lbt_synth.interop.{folder}.export").TARGET
    return target


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Exported:
    """Files that were written, and how far they are from the controller."""

    files: tuple[Path, ...]  # the certificate is the last one
    # largest difference of commands from the controller's in the arithmetic of the file, over the
    # largest command: in the closed loop where the design is of one, on white noise elsewhere
    error: float
    start: Callable[[float], SteppedController]  # what was written, from the limit of the stroke
    checks: tuple[Check, ...]  # the proof in the loop, with the numbers of the file
    notes: tuple[str, ...]  # what a user should know of the export


def export(
    path: str | PathLike[str],
    design: ModalDesign,
    target: str,
    *,
    modes: int | None = None,
    other_gain: float | None = None,
    gain_digest: str | None = None,
    **options: Any,
) -> Exported:
    """Write a controller in the form that another program loads, with a certificate beside it.

    The numbers of the design are rounded to the precision of the target, and the file is read back
    before it is written. The loop is closed around what was read, over the sensor gains of the
    design, and the rounding of the sums counts as noise: residual and margins are kept within
    1 %, and so are the demands on a robust design. The target's arithmetic runs beside the
    controller, too. All files are written, or none; the same design gives the same bytes.

    Units are those of the design: nm rms of wavefront for a loop whose sensor and influence
    matrices are the identity. {doc}`export` says how each program computes and how its file is
    used.

    Parameters
    ----------
    path : path-like
        File to write: ``.c`` (the header goes beside it), ``.fits`` for cacao, ``.npy`` for dao,
        ``.mat`` for MATLAB; for pyRTC a folder, whose parent is there. The
        certificate has the name of the file and ``.certificate.json``.
    design : Design, MixedController or ModalFilters
        The design. Targets ``c``, ``cacao`` and ``dao`` also take a design with integrators for
        the other modes, or a filter for each mode.
    target : {"c", "cacao", "dao", "matlab", "pyrtc"}
        The program that loads the file.
    modes : int, optional
        Modes of the program; by default those of the design, which come first. Further ones get
        the command 0, without ``other_gain``. Not for ``matlab``.
    other_gain : float, optional
        Gain of an integrator for each further mode.
    gain_digest : str, optional
        SHA-256 of the gain file, for the certificate (64 hexadecimal digits).
    **options
        Of one target. For ``c``: form ("plain" assumes that commands were applied, "estimator" is
        given those that were, :func:`~lbt_synth.linear.estimator_form`; a design of several sensors
        has that form alone), precision ("double" or "single") and name (the prefix of the C names;
        by default that of the file). For ``dao``: order (M of the RTC's configuration; by default
        20, or what the design needs). For ``cacao``: steps (of the history; by default as many as
        the proof needs).

    Returns
    -------
    Exported
        The ``files``, of which the certificate is the last; ``error``, the largest difference of
        commands from the controller's over the largest command; ``checks``, the proof in the
        arithmetic of the target; ``start(limit)``, what was written, stepped; and ``notes``.

    Raises
    ------
    OutputError
        If the ending is another one, or a file cannot be written.
    ProblemError
        If the target cannot hold the design, or an option is out of its range or of another target.
    CertificateError
        If the certificate that the design carries has a failed check.
    NumericalError
        If the commands overflow, or a check fails in the arithmetic of the target; ``residual``
        holds its value.

    Examples
    --------
    >>> import lbt_synth as lbt, numpy as np, tempfile, pathlib
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     written = lbt.interop.export(pathlib.Path(folder) / "slow.c", slow, "c")
    ...     [file.name for file in written.files]
    ['slow.c', 'slow.h', 'slow.c.certificate.json']
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder) / "slow.npy"
    ...     _ = lbt.interop.export(file, slow, "dao", order=1, modes=3)
    ...     np.load(file).tolist()
    [[0.5, 0.5, 0.0], [0.0, 0.0, 0.0], [1.0, 1.0, 0.0]]
    """
    program = target_named(target)
    mode_options = {"modes": modes, "other_gain": other_gain}
    options |= {name: value for name, value in mode_options.items() if value is not None}
    if unknown := options.keys() - program.options.keys():
        raise ProblemError(f"{min(unknown)} is no option of target {target}. Leave it out.")
    settings = {"precision": program.precision, **program.options, **options}
    place = Path(path)
    if program.endings:
        place = require_ending(path, f"a file for {target}", program.endings)
    parts, count = _designs_of_modes(design, program, target, modes, other_gain)
    first = parts[0].design
    origin = _provenance_lines(first, gain_digest)
    numbers = program.round([part.design for part in parts], **settings)
    file_numbers = program.join(numbers, parts, count) if program.join else numbers[0]
    pairs = list(zip(parts, numbers, strict=True))
    error = max(rehearsal_error(part.design, program.start(held, np.inf)) for part, held in pairs)
    files = program.write(place, file_numbers, first, origin, gain_digest=gain_digest, **settings)
    again = program.read(files, file_numbers)
    if not _is_same(again, file_numbers):
        raise NumericalError(
            "the file must hold the numbers that are proved; what is read from it is another.",
            status="arithmetic",
        )
    checks = _proved(program, pairs, error)
    failed = next((check for check in checks if not check.passed), None)
    if failed is not None or not np.isfinite(error):
        what, value = f"the commands grow beyond all numbers within {FRAMES} frames", error
        if failed is not None:
            value = failed.value
            what = f"{failed.name} is {value:.6g}, limit {failed.limit:.6g}"
        raise NumericalError(
            "the loop must keep what its design promises in the arithmetic of "
            f"{target} ({settings['precision']} precision); {what}. {program.hint}",
            status="arithmetic",
            residual=value,
        )
    remarks = [program.remark(part.design, held) for part, held in pairs]
    notes = list(dict.fromkeys(filter(None, remarks)))
    if program.contents:
        make_directory(place, parents=False)
    settings |= {"modes": count, "notes": notes, **program.facts(file_numbers, **settings)}
    kept = {name: value for name, value in sorted(settings.items()) if value is not None}
    certificate = _certificate(files, target, checks, gain_digest, kept)
    return Exported(
        files=write_together(dict((*files.items(), *certificate.items()))),
        error=error,
        start=lambda limit: program.start(again, limit),
        checks=checks,
        notes=tuple(notes),
    )


def require_exportable(design: Design, *, reads_others: bool = False) -> None:
    """Refuse a design that is not certified, or that reads sensors which a target does not know."""
    require_instance(design, Design)
    if not design.certificate.passed:
        failed = tuple(check.name for check in design.certificate.checks if not check.passed)
        raise CertificateError(
            f"only a certified design is exported; this one failed: {'; '.join(failed)}.",
            failed=failed,
        )
    if design.other_sensors and not reads_others:
        raise ProblemError(
            f"this design reads {', '.join(design.other_sensors)} beside the loop's own sensor, "
            "each when it is due; what this target loads has one matrix, for a loop of one sensor. "
            "Export it to C."
        )


def require_modal(design: Design) -> int:
    """Return the number of modes of a design that measures, with a gain each, and moves modes."""
    hardware = require_hardware(design, "an export of modes")
    sensor, identity = hardware.sensor, np.eye(hardware.modes)
    own = "the RTC reconstructs modes and projects them on actuators itself. Design for the modes."
    if sensor.shape != identity.shape or np.any(sensor != np.diag(np.diag(sensor))):
        raise ProblemError(f"sensor_matrix must be diagonal, a gain for each mode: {own}")
    if not np.array_equal(hardware.influence, identity):
        raise ProblemError(f"influence_matrix must be the identity: {own}")
    return hardware.modes


def _designs_of_modes(
    design: ModalDesign, program: Target, target: str, modes: int | None, other_gain: float | None
) -> tuple[list[ModeDesign], int]:
    """Return the designs of a file, each certified, and the number of its modes."""
    mixed, modal = program.join is not None, program.modal or modes is not None
    if isinstance(design, ModalFilters):
        count = design.n_modes
        design = MixedController(filter=design, gains=np.zeros(count), filtered=range(count))
    if isinstance(design, MixedController):
        if not mixed:
            raise ProblemError(
                f"target {target} holds one design, for the first modes, and at most one gain for "
                f"all others; got {type(design).__name__}. Give a design."
            )
        if other_gain is not None:
            raise ProblemError("other_gain goes with a design; here each mode has its own gain.")
        parts, controlled = _designs_of_mixture(design), design.n_modes
        for part in parts:
            require_exportable(part.design)
    else:
        require_exportable(design, reads_others=program.reads_others)
        if design.other_sensors and (modes is not None or other_gain is not None):
            raise ProblemError(
                "modes and other_gain go with a design of one sensor; got one of several. Leave "
                "them out."
            )
        several = other_gain is not None or (mixed and modal)
        controlled = require_modal(design) if several else len(design.controller.C)
        parts = [ModeDesign(design, tuple(range(controlled)))]
    count = controlled if modes is None else integer(modes, "modes", at_least=controlled)
    if other_gain is not None:
        if count == controlled:
            raise ProblemError(
                f"other_gain needs modes, the number of those of the RTC, above the {controlled} "
                "of the design. Give modes, or leave other_gain out."
            )
        single = require_hardware(parts[0].design, "an export of modes").single_mode()
        others = integrator(single, gain=number(other_gain, "other_gain", above=0))
        parts.append(ModeDesign(others, tuple(range(controlled, count))))
    return parts, count


def _designs_of_mixture(control: MixedController) -> list[ModeDesign]:
    """Return the design of each mode; modes that get no command have none."""
    loop, kind = control.hardware, type(control.filter).__name__
    if loop is None:
        raise ProblemError(f"the filter must be a certified design or ModalFilters; got {kind}.")
    designs: list[ModeDesign] = []
    if hasattr(control.filter, "designs"):
        filtered, which = np.array(control.filtered), control.filter.which
        designs += [
            ModeDesign(design, tuple(filtered[which == i].tolist()))
            for i, design in enumerate(control.filter.designs)
        ]
    else:
        require_modal(control.filter)
        designs.append(ModeDesign(control.filter, tuple(control.filtered)))
    laws: dict[tuple[float, float], list[int]] = {}
    for mode in np.setdiff1d(np.arange(control.n_modes), control.filtered).tolist():
        laws.setdefault((float(control.gains[mode]), float(control.leak[mode])), []).append(mode)
    single = loop.single_mode()
    for (gain, leak), modes in laws.items():
        if gain > 0:
            law = integrator(single, gain=gain, law=IntegratorLaw(leak=leak))
            designs.append(ModeDesign(law, tuple(modes)))
    return designs


def _is_same(one: Any, other: Any) -> bool:
    """Return whether the numbers of a target are the same, in whatever holds them."""
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(_is_same, one, other))
    if isinstance(one, Mapping):
        return one.keys() == other.keys() and all(_is_same(one[key], other[key]) for key in one)
    if is_dataclass(one):
        names = (entry.name for entry in fields(one))
        return all(_is_same(getattr(one, name), getattr(other, name)) for name in names)
    return bool(one == other)


def _proved(
    program: Target, pairs: Sequence[tuple[ModeDesign, Any]], error: float
) -> tuple[Check, ...]:
    """Check the loop of each design with its numbers in the file."""
    checks: list[Check] = []
    controlled = sum(len(part.modes) for part, _ in pairs)
    for part, numbers in pairs:
        alone = len(part.modes) < controlled
        modes = f" ({name_modes(np.array(part.modes))})" if alone else ""
        proof = list(prove_written(part.design, program.computed(part.design, numbers)))
        if part.design.other_sensors:
            how = "a run in which each sensor is missing for a while"
            proof.append(Check("commands in a rehearsal, difference", error, LOSS, how))
        checks += (replace(check, name=f"{check.name}{modes}") for check in proof)
    return tuple(checks)


def _provenance_lines(design: Design, gain_digest: str | None) -> list[str]:
    """Return labelled lines on a file: version, method, gain file, loop, units, certificate."""
    if gain_digest is not None and not _DIGEST.fullmatch(str(gain_digest)):
        raise ProblemError(
            "gain_digest must be the SHA-256 of a gain file, 64 hexadecimal digits; "
            f"got {gain_digest!r}."
        )
    lines = [
        ("written by", f"lbt_synth {lbt_synth.__version__}"),
        ("method", f"{design.method} ({design.solver.route})"),
        ("gain file", "not named" if gain_digest is None else f"SHA-256 {gain_digest}"),
    ]
    hardware = design.hardware
    if hardware is None:
        lines += [("sampling", f"{design.controller.dt_s!r} s"), ("units", "those of the problem")]
    else:
        lines += [
            ("frame rate", f"{hardware.frame_rate_hz!r} Hz"),
            ("delay", f"{hardware.delay_frames!r} frames in total"),
            ("units", "y: nm rms wavefront where the sensor matrix is the identity;"),
            ("", "u: nm rms wavefront where the influence matrix is"),
        ]
    if hardware is not None and design.other_sensors and hardware.suite.channels:
        lines.append(("", "channels of accelerometers: metres per second squared"))
    checks = design.certificate.checks
    lines.append(("certificate", f"{len(checks)} checks passed"))
    lines += [("", f"{c.name}: {c.value:.6g} (limit {c.limit:.6g})") for c in checks]
    return [f"{label:<11}  {comment_text(text)}" for label, text in lines]


def comment_text(text: str) -> str:
    """Return text without what could end a comment of C."""
    return _UNSAFE.sub("_", text)


def _certificate(
    files: Mapping[Path, bytes],
    target: str,
    checks: Sequence[Check],
    gain_digest: str | None,
    facts: Mapping[str, Any],
) -> dict[Path, bytes]:
    """Return the certificate of files, named after the first one; facts are what they depend on."""
    digests = {path.name: hashlib.sha256(content).hexdigest() for path, content in files.items()}
    first, *others = files
    certificate = {
        "target": target,
        "file": first.name,
        "file_sha256": digests[first.name],
        **({"others_sha256": {o.name: digests[o.name] for o in others}} if others else {}),
        "gain_sha256": gain_digest,
        **facts,
        "checks": [json_record(check) for check in checks],
    }
    text = json.dumps(certificate, indent=2, allow_nan=False) + "\n"
    return {first.with_name(first.name + CERTIFICATE): text.encode()}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rehearsal:
    """A target and the design itself on the same series, after both loops have settled."""

    target: Simulation  # in its arithmetic; commands are as they were applied
    design: Simulation  # in double precision
    settle_frames: int  # at the beginning, left out
    stroke: float  # largest modulus of a command, or infinity
    checks: tuple[Check, ...]  # the proof of what the target runs, as in its certificate

    @property
    def differences(self) -> FloatArray:
        """Commands of the target less those of the design, (frames, m)."""
        return np.asarray(self.target.commands[0] - self.design.commands[0])

    def clipped_frames(self, run: Simulation) -> int:
        """Return the frames of a run in which a command reached the stroke."""
        return int(np.sum(np.any(np.abs(run.commands[0]) >= self.stroke, axis=1)))


def rehearse(
    design: Design,
    target: str,
    disturbance: Disturbance,
    *,
    hardware: LoopHardware,
    stroke: float | None = None,
) -> Rehearsal:
    """Run what is exported to a target in its arithmetic, and the design in double precision.

    Both loops run frame by frame on the phase and noise of one case, with a mirror that clips at
    the stroke.
    """
    controller = as_controller(design)
    limit = np.inf if stroke is None else number(stroke, "stroke", above=0, at_most=1e30)
    loop = close_loop(hardware, controller, sensor_gain=disturbance.sensor_gain)
    loop.require_stable()
    settle = min(settling_frames(loop.spectral_radius), int(_MOST_SETTLING * disturbance.frames))
    with TemporaryDirectory() as folder:
        exported = export(target_named(target).path_in(Path(folder)), design, target)
    run = partial(simulate, hardware=hardware, settle_frames=settle, stroke=stroke)
    try:
        with np.errstate(all="ignore"):  # what overflows is found to be infinite
            runs = [run(c, disturbance) for c in (exported.start(limit), controller.start())]
    except ProblemError as error:
        raise NumericalError(
            f"in the arithmetic of {target} the loop grows beyond all numbers: {error}",
            status="arithmetic",
        ) from error
    return Rehearsal(
        target=runs[0], design=runs[1], settle_frames=settle, stroke=limit, checks=exported.checks
    )
