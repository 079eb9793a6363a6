"""Export a controller as C99 source and header, rendered from the templates in this folder."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import NumericalError, OutputError, ProblemError
from lbt_synth.interop.arithmetic_cost import frame_cost, has_straight_line_form
from lbt_synth.interop.c.arithmetic import join, read_source
from lbt_synth.interop.c.masked_export import export_masked
from lbt_synth.interop.c.source_text import (
    exact_constant,
    render_source,
    round_to_single,
    wrap_sum,
)
from lbt_synth.interop.export_checks import (
    FRAMES,
    Exported,
    provenance_lines,
    require_certified,
    require_exportable,
    write_export,
)
from lbt_synth.interop.modes import ModalDesign, all_modes
from lbt_synth.interop.target import Arithmetic, Target
from lbt_synth.interop.written_loop import ROUNDOFF, require_proved
from lbt_synth.linear import Controller, estimator_form
from lbt_synth.models import LoopHardware
from lbt_synth.validation import FloatArray, choice

_IDENTIFIER = re.compile(r"[A-Za-z](?:_?[A-Za-z0-9])*")
_SOURCE = re.compile(r"[A-Za-z0-9._+-]*\.c")
_LONGEST = 25  # C99 distinguishes identifiers by 31 characters, six of them "_reset"


def export_c(
    path: str | os.PathLike[str],
    design: ModalDesign,
    *,
    form: str | None = None,
    precision: str = "double",
    name: str | None = None,
    modes: int | None = None,
    other_gain: float | None = None,
    hardware: LoopHardware | None = None,
    gain_digest: str | None = None,
) -> Exported:
    """Write a controller as a C99 source file and its header, both or none.

    The source needs no library, allocates nothing, and has no state of its own: it is passed
    in. ``<name>_reset(&state)`` sets the state to zero; ``<name>_step(&state, y, u)`` computes
    ``x(k+1) = A x(k) + B y(k)``, ``u(k) = C x(k+1) + D y(k)``, in the same number of operations
    each frame, and returns 0. If a measurement is not finite it returns 1: u is the last command
    again, and the state stays. In estimator form ``<name>_step(&state, y, applied, u)`` takes the
    commands that were applied in the last frame, too, and is stable by itself: nothing winds up
    where commands are clipped or the loop is open. Coefficients are exact (hexadecimal). Units are
    those of the design: nm rms of wavefront for a loop whose sensor and influence matrices are the
    identity.

    A design of several sensors has the estimator form, with all its fall-backs:
    ``<name>_step(&state, y, fresh, applied, u)``, where ``fresh`` says for each sensor or channel
    whether its reading is new and good. It returns flags on what it did not read.

    Parameters
    ----------
    path : path-like
        Source file to write, ending in ``.c``; the header, ending in ``.h``, goes beside it.
    design : Design, MixedController or ModalFilters
        The design; or, for unit sensor and influence matrices, a design with integrators for the
        other modes, or a filter for each mode.
    form : {"plain", "estimator"}, optional
        Whether the controller assumes that its commands were applied, or is given those that
        were (:func:`~lbt_synth.linear.estimator_form`). The default is ``estimator`` for a design
        of several sensors, which has no other form, and ``plain`` for others.
    precision : {"double", "single"}, optional
        Type of all numbers, ``double`` or ``float``. Coefficients are rounded to it.
    name : str, optional
        Prefix of the C names; by default the name of the file without its ending.
    modes : int, optional
        Measurements and commands of the source; by default those of the design. Further modes get
        the command 0, without ``other_gain``.
    other_gain : float, optional
        Gain of an integrator for each further mode.
    hardware : LoopHardware, optional
        Loop of the integrators, where no filter says which.
    gain_digest : str, optional
        SHA-256 of the gain file, for the comment (64 hexadecimal digits).

    Returns
    -------
    Exported
        Source, header and certificate, and the error of the chosen precision and of single:
        terms are added in the order of the source, by a processor that rounds each of them.

    Raises
    ------
    OutputError
        If the ending is not ``.c``, or a file cannot be written.
    ProblemError
        If the name is no C identifier, or a coefficient does not fit single precision.
    CertificateError
        If the certificate that the design carries has a failed check.
    NumericalError
        If the loop is unstable with the rounded coefficients, the commands of a frame overflow,
        a check of the loop fails in the arithmetic of the source, or there is no estimator form.

    Examples
    --------
    >>> import lbt_synth as lbt, tempfile, pathlib
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     written = lbt.interop.export_c(pathlib.Path(folder) / "slow.c", slow)
    ...     [file.name for file in written.files]
    ['slow.c', 'slow.h', 'slow.c.certificate.json']
    """
    target = _source_path(path)
    header = target.with_suffix(".h")
    choice(precision, "precision", ("double", "single"))
    prefix = require_identifier(target.stem if name is None else name)
    form = _checked_form(design, form)
    if isinstance(design, Design) and design.other_sensors:
        _require_one_sensor(modes, other_gain)
        require_certified(design)
        return export_masked(
            target,
            design,
            name=prefix,
            precision=precision,
            gain_digest=gain_digest,
            arithmetic=TARGET.arithmetic,
        )
    single = precision == "single"
    whole = all_modes(
        design,
        "C source of all modes",
        modes=modes,
        other_gain=other_gain,
        hardware=hardware,
        modal=modes is not None,
    )
    given = form == "estimator"  # the applied commands
    parts = [_written_part(part.design, given=given, single=single) for part in whole.parts]
    joined = join(whole, parts, applied=given)
    errors = {kind: joined.rehearsal_error(kind) for kind in (np.float64, np.float32)}
    kind = np.float32 if single else np.float64
    error = errors[kind]
    _require_finite(error, precision)
    lines = provenance_lines(whole.parts[0].design, gain_digest)
    if single:  # in double precision the figure would depend on this machine's matrix products
        lines.append(("precision", f"single: commands within {error:.1e} of the largest one"))
    texts = render_code(
        prefix,
        header.name,
        joined.controller,
        lines,
        applied=joined.applied,
        single=single,
        gain_digest=gain_digest,
    )
    checks = joined.prove(*read_source(*texts), ROUNDOFF[precision])
    require_proved(checks, f"{precision} precision", "Try double precision.")
    source, declarations = (text.encode("ascii") for text in texts)
    return write_export(
        {target: source, header: declarations},
        target="c",
        arithmetic=TARGET.arithmetic,
        checks=checks,
        gain_digest=gain_digest,
        form=form,
        precision=precision,
        error=error,
        error_single=errors[np.float32],
        start=lambda _: joined.start(kind),
        cost=frame_cost(joined.controller),
    )


def _require_one_sensor(modes: int | None, other_gain: float | None) -> None:
    """Refuse options of designs of one sensor."""
    if modes is not None or other_gain is not None:
        raise ProblemError(
            "modes and other_gain go with a design of one sensor; got one of several. Leave them "
            "out."
        )


def _source_path(path: str | os.PathLike[str]) -> Path:
    """Return the path of the source, whose name compilers must take."""
    target = Path(path)
    if not _SOURCE.fullmatch(target.name):
        raise OutputError(
            "C source must end in .c, and its name have letters, digits and . _ + - only; got "
            f"{target.name!r}.",
            path=target,
        )
    return target


def _checked_form(design: ModalDesign, form: str | None) -> str:
    """Return the form of the source; a filter of several sensors has one."""
    several = isinstance(design, Design) and bool(design.other_sensors)
    if form is None:
        return "estimator" if several else "plain"
    choice(form, "form", ("plain", "estimator"))
    if several and form == "plain":
        raise ProblemError(
            "a design of several sensors is exported in estimator form alone, which is given the "
            "applied commands; got form=plain. Leave it out."
        )
    return form


def _require_finite(error: float, precision: str) -> None:
    """Refuse commands that grow beyond all numbers of a precision."""
    if not math.isfinite(error):
        hint = {"single": "Try double precision.", "double": "Scale the states of the controller."}
        raise NumericalError(
            f"the commands must stay finite in {precision} precision; they grew beyond all "
            f"numbers within {FRAMES} frames. {hint[precision]}",
            status="arithmetic",
            residual=error,
        )


def _written_part(design: Design, *, given: bool, single: bool) -> Controller:
    """Return what is written; in estimator form its last inputs are the applied commands."""
    written = design.controller
    if given:
        if design.hardware is None:
            raise ProblemError(
                "the estimator form needs the design of a loop: a bare filter has no commands to "
                "be applied. Export it with form=plain."
            )
        own = estimator_form(design)
        inputs = np.hstack([own.B, own.applied])
        D = np.zeros((len(own.C), inputs.shape[1]))
        written = Controller(A=own.A, B=inputs, C=own.C, D=D, dt_s=own.dt_s)
    if single:
        matrices = {name: getattr(written, name) for name in "ABCD"}
        written = Controller(**round_to_single(matrices), dt_s=written.dt_s)
    if not given:
        require_exportable(design, written)
    return written


def require_identifier(name: str) -> str:
    """Return a prefix whose names are C and C++ identifiers that no standard reserves."""
    if not isinstance(name, str) or not _IDENTIFIER.fullmatch(name) or len(name) > _LONGEST:
        raise ProblemError(
            f"the prefix of the C names must begin with a letter, hold letters, digits and single "
            f"underscores between them, and have at most {_LONGEST} characters; got {name!r}. "
            "Give another name."
        )
    return name


def render_code(
    prefix: str,
    header_name: str,
    controller: Controller,
    provenance: Sequence[tuple[str, str]],
    *,
    applied: int,
    single: bool,
    gain_digest: str | None,
) -> tuple[str, str]:
    """Return the source and the header; ``provenance`` begins the comment of both.

    The last ``applied`` inputs of the controller are the commands that were applied.
    """
    values = {
        "p": prefix,
        "P": prefix.upper(),
        "n": controller.n_states,
        "q": controller.B.shape[1] - applied,
        "m": len(controller.C),
        "applied": applied,
        "controller": controller,
        "matrices": _split_inputs(controller, applied),
        "provenance": provenance,
        "cost": frame_cost(controller),
        "header_name": header_name,
        "gain_digest": gain_digest,
        "straight_line": _write_out(
            prefix, controller, applied, zero=exact_constant(0.0, single=single)
        )
        if has_straight_line_form(controller)
        else None,
    }
    return render_source("controller", single=single, **values)


def _split_inputs(controller: Controller, applied: int) -> dict[str, FloatArray]:
    """Return A, B, C and D by name, and L, the columns of the applied commands."""
    q = controller.B.shape[1] - applied
    B, L = np.hsplit(controller.B, [q])
    return {"A": controller.A, "B": B, "L": L, "C": controller.C, "D": controller.D[:, :q]}


def _write_out(prefix: str, controller: Controller, applied: int, *, zero: str) -> dict[str, Any]:
    """Return one frame with each non-zero term written out; factors of 1 and -1 are signs."""
    n, q = controller.n_states, controller.B.shape[1] - applied
    coefficients: list[tuple[str, float]] = []
    sums: dict[str, str] = {}
    # a command is computed from the new state n0, n1, ...
    for result, state, on_state, on_y in (("n", "x", "A", "B"), ("u", "n", "C", "D")):
        rows = np.hstack([getattr(controller, on_state), getattr(controller, on_y)])
        for i, row in enumerate(rows.tolist()):
            terms: list[tuple[str, str]] = []
            for j in np.flatnonzero(row):
                name, place = f"{state}{j}", f"{on_state}[{i}][{j}]"
                if j >= n:
                    name, place = f"y{j - n}", f"{on_y}[{i}][{j - n}]"
                if j >= n + q:
                    name, place = f"a{j - n - q}", f"L[{i}][{j - n - q}]"
                factor = ""
                if abs(row[j]) != 1:
                    factor = f"c[{len(coefficients)}] * "
                    coefficients.append((place, row[j]))
                terms.append(("-" if row[j] == -1 else "+", factor + name))
            start = f"    const {prefix}_real {result}{i} ="
            sums[f"{result}{i}"] = wrap_sum(terms or [("+", zero)], len(start))
    used = np.flatnonzero(np.vstack([controller.B, controller.D]).any(axis=0)).tolist()
    return {
        "states": np.flatnonzero(controller.A.any(axis=0)).tolist(),
        "measurements": [i for i in used if i < q],
        "applied": [i - q for i in used if i >= q],
        "coefficients": coefficients,
        "sums": sums,
    }


TARGET = Target(
    arithmetic=Arithmetic(
        program="real-time computers, from C99 source",
        precision="double or single",
        sums="each row of [A, B] and of [C, D] from left to right",
        state="new state: x(k+1) = A x(k) + B y(k), u(k) = C x(k+1) + D y(k)",
        clipping="yours: the estimator form takes the applied commands, the plain form none",
        limits="none",
    ),
    file="source and header (.c, .h)",
    write=export_c,
    endings=(".c", ".h"),
)
