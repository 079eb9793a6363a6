"""Discrete-time linear systems in textbook form, and their responses.

The matrices may repeat with a period of N samples, as those of sensors that are read at several
rates do: each is then a stack (N, ...), one matrix for each phase t = k mod N.
S. Bittanti, P. Colaneri, "Periodic Systems: Filtering and Control", Springer (2009),
doi:10.1007/978-1-84800-911-0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import matrix_balance

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.linear.lyapunov import join_roots, stationary_covariance, stationary_root
from lbt_synth.linear.matrix_functions import (
    as_stack,
    complex_schur,
    part_labels,
    solve_stack,
    transpose,
)
from lbt_synth.storage.summaries import Summarised
from lbt_synth.storage.warning_filters import ignore_warnings
from lbt_synth.storage.words import count_text
from lbt_synth.validation import (
    ComplexArray,
    FloatArray,
    IntArray,
    matrix,
    number,
    real_array,
    set_fields,
    square,
)

# T, C U, U* B and D, and whether they are those of the dual system; see schur_form
SchurForm: TypeAlias = tuple[ComplexArray, ComplexArray, ComplexArray, FloatArray, bool]

SAMPLE_FIRST = (
    'Sample it first: control.sample_system(system, dt, method="bilinear") keeps the H-infinity '
    "norm, which the default, a zero-order hold, does not."
)

_AGREEMENT = 1e-9  # relative, of partial fractions with solved linear systems at five points
_CHUNK = 60_000  # complex numbers that a frequency response computes at once; they fit a cache


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearSystem(Summarised):
    """Four matrices of matching sizes, or four for each phase of a period; a sampling period."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    dt_s: float = 1.0

    def __post_init__(self) -> None:
        A = square(self.A, "A", stacked=True, may_be_empty=True)
        n, why = A.shape[-1], f"to match A {A.shape}"
        B = matrix(self.B, "B", rows=(n, why), stacked=True)
        C = matrix(self.C, "C", cols=(n, why), stacked=True)
        rows, cols = (C.shape[-2], f"to match C {C.shape}"), (B.shape[-1], f"to match B {B.shape}")
        D = matrix(self.D, "D", rows=rows, cols=cols, stacked=True)
        set_fields(self, dt_s=number(self.dt_s, "dt_s", above=0))
        self._set_phases(1, A=A, B=B, C=C, D=D)

    def _set_phases(self, period: int, **parts: FloatArray) -> None:
        """Set matrices, (n, m) for one phase, (N, n, m) for more; one of all phases is repeated."""
        stacks = {name: as_stack(part) for name, part in parts.items()}
        period = max(period, *(len(stack) for stack in stacks.values()))
        for name, stack in stacks.items():
            if stack.ndim > 3 or len(stack) not in (1, period):
                raise DimensionError(
                    f"{name} must be one matrix, or one for each of {period} phases; got "
                    f"{parts[name].shape}."
                )
            whole = np.broadcast_to(stack, (period, *stack.shape[1:]))
            set_fields(self, **{name: stack[0] if period == 1 else whole})

    @property
    def n_states(self) -> int:
        """Number of states."""
        return int(self.A.shape[-1])

    @property
    def period(self) -> int:
        """Number of phases N after which the matrices repeat; 1 where they are constant."""
        return len(self.A) if self.A.ndim == 3 else 1

    @property
    def monodromy(self) -> FloatArray:
        """Transition over a period, from phase 0 to the next phase 0, (n, n)."""
        out, *others = self.stacks()[0]
        for A in others:
            out = A @ out
        return np.asarray(out)

    def stacks(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return A, B, C and D as stacks (N, ...), of one matrix where the period is 1."""
        return as_stack(self.A), as_stack(self.B), as_stack(self.C), as_stack(self.D)

    def require_one_phase(self, what: str, instead: str) -> None:
        """Refuse a longer period than a sample: say what needs one, and what to try."""
        if self.period > 1:
            raise ProblemError(
                f"{what} needs a period of 1; got one of {self.period} samples. Try {instead}."
            )

    def _brief(self) -> str:
        rate = "" if self.dt_s == 1 else f", {1 / self.dt_s:.6g} Hz"
        phases = "" if self.period == 1 else f", period {self.period}"
        outputs, inputs = self.D.shape[-2:]
        sizes = zip((self.n_states, inputs, outputs), ("state", "input", "output"), strict=True)
        return ", ".join(count_text(*size) for size in sizes) + rate + phases


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StateSpace(LinearSystem):
    """Discrete-time system ``x(k+1) = A x(k) + B u(k)``, ``y(k) = C x(k) + D u(k)``.

    Each matrix may be a stack of one matrix per phase, such as (N, n, n): with a period of N
    samples, the sample k has the matrices of the phase k mod N.

    Parameters
    ----------
    A : (n, n) or (N, n, n) array_like
        State matrix.
    B : (n, m) or (N, n, m) array_like
        Input matrix.
    C : (p, n) or (N, p, n) array_like
        Output matrix.
    D : (p, m) or (N, p, m) array_like
        Feedthrough matrix.
    dt_s : float, optional
        Sampling period [s]; 1 when the samples have no physical rate.

    Raises
    ------
    ProblemError
        If a matrix is not finite or the sizes clash.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> lag = lbt.linear.StateSpace(A=[[0.5]], B=[[1.0]], C=[[1.0]], D=[[0.0]])
    >>> float(abs(lag.frequency_response([0.0])[0, 0, 0]))
    2.0
    """

    @classmethod
    def of(cls, system: Any) -> StateSpace:
        """Take a discrete system of python-control or scipy, or a tuple (A, B, C, D).

        Anything else, and a system in continuous time, raises a ProblemError.
        """
        if isinstance(system, StateSpace):
            return system
        A, B, C, D, dt_s = _system_parts(system)
        return cls(A=A, B=B, C=C, D=D, dt_s=dt_s)

    def to_control(self) -> Any:
        """Return the system as a ``control.StateSpace`` with its sampling period."""
        self.require_one_phase("a system of python-control", "lifted().to_control()")
        import control

        parts = (self.A, self.B, self.C, self.D)
        return control.StateSpace(*parts, self.dt_s, remove_useless_states=False)

    def balanced(self) -> StateSpace:
        """Scale the states by powers of two, which leaves the input-output map as it is.

        Rows and columns of ``[[A, B], [C, 0]]`` are then of similar size, state by state.
        """
        self.require_one_phase("balancing", "lifted().balanced()")
        n = self.n_states
        if n == 0:
            return self
        scale = max(float(np.abs(self.A).max()), 1e-300)
        entry, leaving = np.linalg.norm(self.B, axis=1), np.linalg.norm(self.C, axis=0)
        scaling = balancing_scales(self.A, _rescale(entry, scale), _rescale(leaving, scale))
        units = np.asarray(scaling[:n] / scaling[n], dtype=np.float64)
        if not np.all(np.isfinite(units)):
            return self
        # B and C as a whole share their sizes, too
        large, small = entry / units, leaving * units
        both = float(np.sqrt(max(float(np.max(large)), 1e-300) / max(float(np.max(small)), 1e-300)))
        units = units * np.exp2(np.round(np.log2(both))) if 0 < both < np.inf else units
        rows = units[:, None]
        return replace(self, A=self.A * units / rows, B=self.B / rows, C=self.C * units)

    @property
    def poles(self) -> ComplexArray:
        """Eigenvalues of A, or of the transition over a longer period, (n,)."""
        return np.linalg.eigvals(self.monodromy).astype(np.complex128)

    @property
    def spectral_radius(self) -> float:
        """Largest modulus of the poles: over a period, not over a sample."""
        return float(np.max(np.abs(self.poles), initial=0.0))

    @property
    def radius_per_frame(self) -> float:
        """The spectral radius of a period as a factor per sample."""
        return float(self.spectral_radius ** (1 / self.period))

    def lifted(self) -> StateSpace:
        """Return the system over a period: inputs and outputs of all phases side by side."""
        if self.period == 1:
            return self
        (N, p, m), n = self.D.shape, self.n_states
        reach, inputs = np.eye(n), np.zeros((n, N * m))
        C, D = np.zeros((N * p, n)), np.zeros((N * p, N * m))
        for t in range(N):
            rows, columns = slice(t * p, (t + 1) * p), slice(t * m, (t + 1) * m)
            C[rows], D[rows] = self.C[t] @ reach, self.C[t] @ inputs
            D[rows, columns] = self.D[t]
            reach, inputs = self.A[t] @ reach, self.A[t] @ inputs
            inputs[:, columns] = self.B[t]
        return StateSpace(A=reach, B=inputs, C=C, D=D, dt_s=N * self.dt_s)

    def lifted_compactly(self) -> StateSpace:
        """Return the lifted system with its inputs turned so that few remain.

        Norm and variances are the same, as white noise is turned to white noise.
        """
        system = self.lifted()
        turned = np.linalg.qr(np.vstack([system.B, system.D]).T)[1].T
        return replace(system, B=turned[: self.n_states], D=turned[self.n_states :])

    def covariances(self) -> FloatArray:
        """Return the stationary covariance of x at each phase, for white u of unit variance."""
        transitions, inputs, _, _ = self.stacks()
        drives = inputs @ transpose(inputs)
        whole = np.zeros_like(drives[0])  # of what a period adds
        for A, drive in zip(transitions, drives, strict=True):
            whole = A @ whole @ A.T + drive
        out, P = np.empty_like(transitions), stationary_covariance(self.monodromy, whole)
        for t, (A, drive) in enumerate(zip(transitions, drives, strict=True)):
            out[t] = P
            P = A @ P @ A.T + drive
        return out

    def output_covariances(self) -> FloatArray:
        """Return the stationary covariance of y at each phase, for white u, (N, p, p).

        By roots: a small output of large states keeps its digits.
        """
        s = self.balanced() if self.period == 1 else self
        root, out = stationary_root(s.monodromy, s.lifted().B), []
        for A, B, C, D in zip(*s.stacks(), strict=True):
            rows = np.hstack([C @ root, D])
            out.append(rows @ rows.T)
            root = join_roots(A @ root, B)
        return np.array(out)

    def phase_response(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Complex amplitude of y at each phase for the input ``exp(2 pi i f k dt)``, (f, N, p, m).

        The output is this amplitude times the input's own ``exp``: for one phase it is the
        transfer matrix. Its mean square over the phases is the mean power of the output.
        """
        if self.period == 1:
            return self.frequency_response(frequency_hz)[:, None]
        frequency = np.atleast_1d(real_array(frequency_hz, "frequency_hz"))
        z = np.exp(2j * np.pi * frequency * self.dt_s)
        (p, m), n, N, lifted = self.D.shape[-2:], self.n_states, self.period, self.lifted()
        T, U = complex_schur(lifted.A)
        B = (U.conj().T @ lifted.B).reshape(n, N, m)
        D, step = lifted.D.reshape(N * p, N, m), max(1, _CHUNK // max(p, n, 1))
        out = np.empty((z.size, N, p, m), dtype=np.complex128)
        for start in range(0, z.size, step):
            rows = slice(start, start + step)
            turns = z[rows, None] ** np.arange(N)  # of the input of a period, and of its output
            for j in range(m):
                x = turns @ B[:, :, j].T  # the state at phase 0 repeats as z^N: solve for it
                for i in range(n - 1, -1, -1):
                    x[:, i] = (x[:, i] + x[:, i + 1 :] @ T[i, i + 1 :]) / (z[rows] ** N - T[i, i])
                y = (x @ U.T) @ lifted.C.T + turns @ D[:, :, j].T
                out[rows, :, :, j] = y.reshape(-1, N, p) / turns[:, :, None]
        return out

    def frequency_response(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Transfer matrices (f, p, m), ``D + C (zI - A)^-1 B`` at ``z = exp(2 pi i f dt)``.

        A frequency [Hz] of a pole on the unit circle and a longer period are a ProblemError.
        """
        self.require_one_phase("a transfer matrix", "phase_response(...), or lifted()")
        frequency = np.atleast_1d(real_array(frequency_hz, "frequency_hz"))
        z = np.exp(2j * np.pi * frequency * self.dt_s)
        few = z.size <= self.n_states  # solved one by one, which is more accurate next to a pole
        response = np.empty((z.size, *self.D.shape), dtype=np.complex128)
        response[:] = self.D
        for outputs, inputs, part in split_into_parts(self):
            if part.n_states:
                block = (
                    pointwise_response(part, z)
                    if few
                    else schur_response(schur_form(part.balanced()), z)
                )
                response[:, outputs[:, None], inputs] = block
        undefined = ~np.isfinite(response).all(axis=(1, 2))
        if undefined.any():
            raise ProblemError(
                f"the system has a pole at {frequency[undefined][0]:.9g} Hz, on the unit circle, "
                "and no response there; leave that frequency out."
            )
        return response


def split_into_parts(system: StateSpace) -> list[tuple[IntArray, IntArray, StateSpace]]:
    """Return outputs, inputs and system of the parts that have both and share nothing."""
    labels, parts = part_labels(system.A, system.B, system.C, system.D), []
    for i in range(np.max(np.concatenate(labels)) + 1):
        x, inputs, outputs = (np.flatnonzero(label == i) for label in labels)
        if inputs.size and outputs.size:
            A, B = system.A[np.ix_(x, x)], system.B[np.ix_(x, inputs)]
            C, D = system.C[np.ix_(outputs, x)], system.D[np.ix_(outputs, inputs)]
            parts.append((outputs, inputs, replace(system, A=A, B=B, C=C, D=D)))
    return parts


def balancing_scales(A: FloatArray, entry: FloatArray, leaving: FloatArray) -> FloatArray:
    """Powers of two that balance ``[[|A|, entry], [leaving', 0]]``, (n + 1,)."""
    border = np.block([[np.abs(A), entry[:, None]], [leaving[None, :], np.zeros((1, 1))]])
    # scipy makes a permutation of the scales, which nobody asks for and large ones do not fit
    with ignore_warnings(RuntimeWarning, message="invalid value encountered in cast"):
        _, (scaling, _) = matrix_balance(border, permute=False, separate=True)
    return np.asarray(scaling, dtype=np.float64)


def _rescale(vector: FloatArray, size: float) -> FloatArray:
    largest = float(np.max(vector, initial=0.0))
    return vector * (size / largest) if largest > 0 else vector


def pointwise_response(system: StateSpace, z: ComplexArray) -> ComplexArray:
    """Transfer matrices at points z, by one linear system per point; inf at a pole."""
    n, m = system.B.shape
    pencil = z[:, None, None] * np.eye(n) - system.A
    entry = np.broadcast_to(system.B.astype(np.complex128), (z.size, n, m))
    response = system.C @ solve_stack(pencil, entry) + system.D
    return np.where(np.isnan(response), np.inf, response)


def schur_form(system: StateSpace) -> SchurForm:
    """Return ``T, C U, U* B, D`` with ``A = U T U*``, and whether they are those of the dual.

    U is unitary, so nothing is lost when A is defective, as with every delay. The dual has the
    smaller number of outputs. The system should be balanced.
    """
    A, B, C, D = system.A, system.B, system.C, system.D
    is_dual = bool(len(C) > B.shape[1])
    if is_dual:
        A, B, C, D = A.T, C.T, B.T, D.T
    T, U = complex_schur(A) if len(A) else 2 * (A.astype(np.complex128),)
    return T, C @ U, U.conj().T @ B, D, is_dual


def schur_response(form: SchurForm, z: ComplexArray) -> ComplexArray:
    """Transfer matrices at points z, by one substitution per point; at a pole nothing is finite."""
    T, rows, B, D, is_dual = form
    if is_dual:
        return np.swapaxes(schur_response((T, rows, B, D, False), z), 1, 2)
    p, n = rows.shape
    if not n:
        return np.broadcast_to(D.astype(np.complex128), (z.size, *D.shape))
    out = np.empty((z.size, p, B.shape[1]), dtype=np.complex128)
    step = max(1, _CHUNK // (n * p))
    with np.errstate(all="ignore"):  # the caller reports a pole among the points
        for start in range(0, z.size, step):
            part = z[start : start + step]
            left = np.empty((n, p * part.size), dtype=np.complex128)  # C U (zI - T)^-1
            for i in range(n):
                sums = rows[:, i, None] + (T[:i, i] @ left[:i]).reshape(p, part.size)
                left[i] = (sums / (part - T[i, i])).ravel()
            solved = left.reshape(n, p, part.size).transpose(2, 1, 0)
            out[start : start + step] = solved @ B + D
    return out


def stacked_response(
    matrices: tuple[FloatArray, ...],
) -> Callable[[ComplexArray], ComplexArray]:
    """Return the function from points z to transfer matrices (f, k, m, q) of balanced systems.

    Several ``A, B, C, D`` have partial fractions. Where those of one, whose eigenvectors are nearly
    dependent, fail at some probes, its points are solved one by one.
    """
    rows = np.hstack([part.reshape(len(part), -1) for part in matrices])
    _, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    if first.size < len(rows):  # equal ones are computed once
        respond_once = stacked_response(tuple(part[first] for part in matrices))
        return lambda z: respond_once(z)[:, which.ravel()]
    A, B, C, D = matrices
    if not A.size:
        return lambda z: np.broadcast_to(D.astype(np.complex128), (z.size, *D.shape))
    poles, vectors = np.linalg.eig(A)
    with np.errstate(all="ignore"):  # what is not finite fails the probes
        entries = solve_stack(vectors.astype(np.complex128), B.astype(np.complex128))
        residues = np.einsum("kms,ksq->kmqs", C @ vectors, entries)
        residues = residues.reshape(len(A), D[0].size, A.shape[1])

    def respond(z: ComplexArray) -> ComplexArray:
        planes = np.empty((len(A), D[0].size, z.size), dtype=np.complex128)
        out = np.moveaxis(planes.reshape(*D.shape, z.size), (3, 0), (0, 1))
        out[:] = D
        with np.errstate(all="ignore"):
            for plane, residue, pole in zip(planes, residues, poles, strict=True):
                plane += residue @ (1 / (z - pole[:, None]))
        probes = np.linspace(0, z.size - 1, 5).astype(np.int64)
        pencils = z[probes, None, None, None] * np.eye(A.shape[1]) - A
        direct = C @ np.linalg.solve(pencils, B.astype(np.complex128)) + D
        apart = np.max(np.abs(out[probes] - direct), axis=(0, 2, 3))
        agree = apart <= _AGREEMENT * np.max(np.abs(direct), axis=(0, 2, 3))
        for k in np.flatnonzero(~agree).tolist():
            out[:, k] = pointwise_response(StateSpace(A=A[k], B=B[k], C=C[k], D=D[k]), z)
        return out

    return respond


def _system_parts(system: Any) -> tuple[Any, Any, Any, Any, float]:
    """Return A, B, C, D and the period [s], 1 if none is given, of a discrete system."""
    if isinstance(system, tuple | list) and len(system) == 4:
        return (*system, 1.0)
    library = type(system).__module__.partition(".")[0]
    if library == "scipy" and hasattr(system, "to_ss"):
        system = system.to_ss()
    if library == "control" and not hasattr(system, "A"):
        import control

        system = control.ss(system)
    if not all(hasattr(system, name) for name in "ABCD"):
        raise ProblemError(
            "a system must be a StateSpace, a control.StateSpace, a scipy.signal.StateSpace or a "
            f"tuple (A, B, C, D); got {type(system).__name__}."
        )
    dt = system.dt if hasattr(system, "dt") else getattr(system, "dt_s", 0)
    if dt == 0 or (library == "scipy" and dt is None):  # which python-control has for no period
        raise ProblemError(
            f"the system must be in discrete time; got a continuous one (dt = 0). {SAMPLE_FIRST}"
        )
    period = 1.0 if dt is None or dt is True else float(dt)
    return system.A, system.B, system.C, system.D, period
