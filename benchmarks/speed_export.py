"""One frame of exported controllers, compiled, beside a matrix-vector product of the same size."""

from __future__ import annotations

import ctypes
import statistics
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from harness import Row
from scipy.linalg import cython_blas

import lbt_synth as lbt

ROOT = Path(__file__).resolve().parents[1]
FRAMES, REPEATS = 20_000, 15

# Both sides are called through a pointer, as a real-time computer calls a library. The state is
# set back often enough that a controller which is unstable alone stays far from overflow.
DRIVER = """
#define _POSIX_C_SOURCE 199309L
#include <time.h>
#ifdef ESTIMATOR
typedef int step_type(void *, const REAL *, const REAL *, REAL *);
#define STEP step(state, y, u, u)
#else
typedef int step_type(void *, const REAL *, REAL *);
#define STEP step(state, y, u)
#endif
typedef void gemv_type(const char *, const int *, const int *, const REAL *, const REAL *,
                       const int *, const REAL *, const int *, const REAL *, REAL *, const int *);
static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
double time_step(step_type *step, REAL *state, int n, REAL *y, REAL *u, int frames)
{
    const double start = now();
    int k, i;
    for (k = 0; k < frames; k++) {
        if (k % 64 == 0) for (i = 0; i < n; i++) state[i] = (REAL)1;
        y[0] = (REAL)(k % 7 - 3);
        STEP;
    }
    return (now() - start) / frames;
}
double time_gemv(gemv_type *gemv, const REAL *matrix, int rows, int cols, REAL *x, REAL *out,
                 int n, int q, int frames)
{
    const double start = now();
    const REAL one = 1, zero = 0;
    const int stride = 1;
    int k, i;
    for (k = 0; k < frames; k++) {
        if (k % 64 == 0) for (i = 0; i < n; i++) x[i] = (REAL)1;
        x[n] = (REAL)(k % 7 - 3);
        gemv("N", &rows, &cols, &one, matrix, &rows, x, &stride, &zero, out, &stride);
        for (i = 0; i < n; i++) x[i] = out[i];
        for (i = n + q; i < cols; i++) x[i] = out[i - q];
    }
    return (now() - start) / frames;
}
"""


def blas(name: str) -> ctypes.c_void_p:
    """Pointer to a routine of the BLAS that scipy uses."""
    capsule = cython_blas.__pyx_capi__[name]
    get_name = ctypes.pythonapi.PyCapsule_GetName
    get_name.restype, get_name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer = ctypes.pythonapi.PyCapsule_GetPointer
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    return ctypes.c_void_p(pointer(capsule, get_name(capsule)))


def frame(design: lbt.Design, *, single: bool, form: str = "plain") -> Row:
    """Median seconds a frame of both, in turn."""
    k = design.controller
    n, q, m = k.n_states, k.B.shape[1], len(k.C)
    inputs = k
    if form == "estimator":
        own = lbt.linear.estimator_form(k)
        both = np.hstack([own.B, own.applied])
        D = np.zeros((m, both.shape[1]))
        inputs = lbt.Controller(A=own.A, B=both, C=own.C, D=D)
    real, dtype = ("float", np.float32) if single else ("double", np.float64)
    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder)
        precision = "single" if single else "double"
        lbt.interop.export(at / "ctl.c", design, "c", precision=precision, form=form)
        defined = "#define ESTIMATOR\n" if form == "estimator" else ""
        (at / "driver.c").write_text(f"#define REAL {real}\n{defined}{DRIVER}")
        subprocess.run(
            ["cc", "-std=c99", "-O2", "-shared", "-fPIC", "ctl.c", "driver.c", "-o", "ctl.so"],
            cwd=at,
            check=True,
        )
        library = ctypes.CDLL(str(at / "ctl.so"))
    library.time_step.restype = library.time_gemv.restype = ctypes.c_double

    def array(values: object) -> tuple[np.ndarray, ctypes.c_void_p]:
        made = np.array(values, dtype=dtype, order="F")
        return made, ctypes.c_void_p(made.ctypes.data)

    textbook = inputs.to_statespace()  # one product gives the next state and the command
    whole = np.block([[textbook.A, textbook.B], [textbook.C, textbook.D]])
    state, y, u, x, out, matrix = map(
        array,
        (
            *(np.zeros(size) for size in (n + m, q, m, whole.shape[1], n + m)),
            whole,
        ),
    )
    gemv = blas("sgemv" if single else "dgemv")
    mine, theirs = [], []
    for _ in range(REPEATS):
        x[0][n + q :] = u[0][:] = 0.0
        mine.append(library.time_step(library.ctl_step, state[1], n, y[1], u[1], FRAMES))
        size = n + m, whole.shape[1]
        theirs.append(library.time_gemv(gemv, matrix[1], *size, x[1], out[1], n, q, FRAMES))
    scale = np.max(np.abs(out[0][n:]))  # both end in the same frame of the same input
    assert np.max(np.abs(u[0] - out[0][n:])) < (1e-4 if single else 1e-11) * scale
    return {
        "ours_s": statistics.median(mine),
        "peer_s": statistics.median(theirs),
        "ratio": statistics.median(t / m for m, t in zip(mine, theirs, strict=True)),
    }


def compiled_frames() -> dict[str, Row]:
    kalman = lbt.kalman(lbt.load_config(ROOT / "examples" / "lbt.yaml").plant)
    rows = {}
    for single, precision in ((False, "double"), (True, "single")):
        rows[f"Kalman (10 states, {precision})"] = {**frame(kalman, single=single), "bar": 1}
        rows[f"Kalman, estimator form (12 states, {precision})"] = {
            **frame(twelve_states(), single=single, form="estimator"),
            "bar": 1 / 1.3,
        }
    return rows


def twelve_states() -> lbt.Design:
    """A Kalman filter of two axes with turbulence of the second order and a line."""
    config = lbt.load_config(ROOT / "examples" / "lbt_robust.yaml")
    lines = [
        lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=d)
        for d in ((1, 0), (0, 1))
    ]
    plant = lbt.tip_tilt_plant(
        frame_rate_hz=800, turbulence=config.plant.turbulence, noise_nm=15.5, vibrations=lines
    )
    return lbt.kalman(plant)


REALTIME = (
    ("one frame of the exported C (BLAS gemv of the same size)", "controller", compiled_frames),
)
