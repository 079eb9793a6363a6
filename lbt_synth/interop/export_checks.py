"""Checks before an export: the certificate, and a rehearsal of the file beside the controller."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lbt_synth.design import Design, certify_loop
from lbt_synth.errors import CertificateError, NumericalError, ProblemError
from lbt_synth.interop.arithmetic_cost import block_matrix
from lbt_synth.linear import Controller
from lbt_synth.loop.simulation.run import SteppedController, step_loop
from lbt_synth.validation import FloatArray, require_instance

FRAMES = 2000
_POLE = 0.99  # of the random phase that disturbs the rehearsed loop


def require_exportable(design: Design, written: Controller | None = None) -> None:
    """Refuse a design that is not certified, or whose loop is unstable with the written numbers."""
    require_instance(design, Design)
    if not design.certificate.passed:
        failed = tuple(check.name for check in design.certificate.checks if not check.passed)
        raise CertificateError(
            f"only a certified design is exported; this one failed: {'; '.join(failed)}.",
            failed=failed,
        )
    if design.hardware is None:
        return
    check = certify_loop(design.hardware, written or design.controller)
    if not check.passed:
        raise NumericalError(
            "the loop closed around the numbers as they would be written is unstable: "
            f"{check.name} {check.value:.12g}, limit {check.limit:.12g}. Try double precision.",
            residual=check.value,
        )


class MatrixForm:
    """A controller in new-state form, stepped in a given precision."""

    def __init__(self, controller: Controller, dtype: Any) -> None:
        with np.errstate(over="ignore"):  # what does not fit becomes infinite, and is noticed
            self._matrices = [getattr(controller, name).astype(dtype) for name in "ABCD"]
        self._dtype = dtype
        self.reset()

    def reset(self) -> None:
        """Set the state to zero."""
        self._state = np.zeros(len(self._matrices[0]), dtype=self._dtype)

    def step(self, y: FloatArray) -> FloatArray:
        """Take y(k), return u(k)."""
        A, B, C, D = self._matrices
        measured = y.astype(self._dtype)
        self._state = A @ self._state + B @ measured
        return np.asarray(C @ self._state + D @ measured, dtype=np.float64)


class WrittenTerms:
    """A controller stepped as the C source is written: term by term, each rounded.

    In each row of ``[A, B]`` and ``[C, D]`` the terms that are not zero are added from left to
    right, as one statement of the straight-line source does and as the loops over whole matrices
    do, which add zeros besides.
    """

    def __init__(self, controller: Controller, dtype: Any) -> None:
        with np.errstate(over="ignore"):  # what does not fit becomes infinite, and is noticed
            whole = block_matrix(controller).astype(dtype)
        n = controller.n_states
        self._rows = [_list_terms(whole[:n]), _list_terms(whole[n:])]
        self._dtype, self._n = dtype, n
        self.reset()

    def reset(self) -> None:
        """Set the state to zero."""
        self._state = np.zeros(self._n, dtype=self._dtype)

    def step(self, y: FloatArray) -> FloatArray:
        """Take y(k), return u(k)."""
        (old_places, old), (new_places, new) = self._rows
        measured = y.astype(self._dtype)
        known = np.concatenate([self._state, measured])
        self._state = np.add.accumulate(old * known[old_places])[-1]
        known = np.concatenate([self._state, measured])
        return np.asarray(np.add.accumulate(new * known[new_places])[-1], dtype=np.float64)


def _list_terms(rows: npt.NDArray[Any]) -> tuple[npt.NDArray[np.intp], npt.NDArray[Any]]:
    """Places and factors of the terms, (longest row, rows); short rows end with zeros."""
    length = max(1, int(np.max(np.count_nonzero(rows, axis=1), initial=0)))
    places = np.argsort(rows == 0, axis=1, kind="stable")[:, :length]
    return places.T, np.ascontiguousarray(np.take_along_axis(rows, places, axis=1).T)


def rehearsal_error(design: Design, other: SteppedController) -> float:
    """Largest difference of commands from the controller's, over the largest command.

    Both close the loop of the design around the same disturbance (a process of the first
    order) and noise; a controller alone may be unstable, so only its loop can be compared.
    A design without a loop is fed white noise.
    """
    rng = np.random.default_rng(0)
    hardware = design.hardware
    q, m = design.controller.B.shape[1], len(design.controller.C)
    own = design.controller.start()
    with np.errstate(all="ignore"):  # what overflows is found to be infinite
        if hardware is None:
            series = rng.standard_normal((FRAMES, q))
            expected = np.array([own.step(y) for y in series])
            found = np.array([other.step(y) for y in series])
        else:
            total = rng.standard_normal((1, FRAMES, hardware.modes))
            for k in range(1, FRAMES):
                total[0, k] = _POLE * total[0, k - 1] + np.sqrt(1 - _POLE**2) * total[0, k]
            noise = 0.1 * rng.standard_normal((1, FRAMES, q))
            n = hardware.modes
            expected = step_loop(own, 1.0, hardware, total, noise)[0, :, n : n + m]
            try:
                found = step_loop(other, 1.0, hardware, total, noise)[0, :, n : n + m]
            except ProblemError:
                return float("inf")
        size = float(np.max(np.abs(expected)))
        error = float(np.max(np.abs(found - expected)))
    if not np.isfinite(error):
        return float("inf")
    return error / size if size > 0 else error
