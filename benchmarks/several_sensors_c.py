"""A frame of an exported filter of several sensors beside exported filters of one rate.

Both filters of one rate take the applied commands: that of a phase in which only the fast sensors
are due, of the same order; and the Kalman filter of the loop's own sensor alone, of about that
order. Ratios are medians of runs in turn.
"""

from __future__ import annotations

import argparse
import ctypes
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import lbt_synth as lbt
from lbt_synth.interop.c.terms import source_terms

sys.path.insert(0, "tests")
from support.exports import bare_design

DRIVER = """
#define _POSIX_C_SOURCE 199309L
#include <time.h>
#include "ctl.h"
double time_frames(const unsigned char *fresh, int period, int frames);
double time_frames(const unsigned char *fresh, int period, int frames)
{
    struct timespec a, b;
    static ctl_state state;
    ctl_real y[CTL_MEASUREMENTS] = {0}, u[CTL_COMMANDS] = {0};
    volatile ctl_real sink;
    int k;
    (void)fresh; (void)period;
    ctl_reset(&state);
    clock_gettime(CLOCK_MONOTONIC, &a);
    for (k = 0; k < frames; k++) {
        y[0] = (ctl_real)(k % 7 - 3);
        STEP;
    }
    clock_gettime(CLOCK_MONOTONIC, &b);
    sink = u[0];
    (void)sink;
    return (double)(b.tv_sec - a.tv_sec) + 1e-9 * (double)(b.tv_nsec - a.tv_nsec);
}
"""


def built(design: lbt.Design, step: str, precision: str, **options: str) -> ctypes.CDLL:
    """The exported source, compiled by itself and called by a driver in another file."""
    with tempfile.TemporaryDirectory() as folder:
        at = Path(folder)
        lbt.interop.export(at / "ctl.c", design, "c", precision=precision, **options)
        (at / "driver.c").write_text(DRIVER)
        flags = ["-std=c99", "-O2", "-shared", "-fPIC", f"-DSTEP={step}"]
        command = ["gcc", *flags, "ctl.c", "driver.c", "-o", "ctl.so"]
        subprocess.run(command, cwd=at, check=True)
        library = ctypes.CDLL(str(at / "ctl.so"))
    library.time_frames.restype = ctypes.c_double
    return library


def one_phase(design: lbt.design.FilterDesign) -> lbt.Design:
    """The filter of a phase in which only the fast sensors are due, as one of a single rate."""
    terms = source_terms(design)
    own = terms.controller()
    whole = terms.transition[1] + own.B[1] @ terms.innovation[1]
    A, applied = np.split(whole, [len(whole)], axis=1)
    B = np.hstack([own.B[1], applied])
    D = np.zeros((len(own.C[1]), B.shape[1]))
    return bare_design(lbt.Controller(A=A, B=B, C=own.C[1], D=D))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=200_000)
    parser.add_argument("--repeats", type=int, default=25)
    options = parser.parse_args()
    config = lbt.load_config("examples/several_sensors.yaml")
    design = config.design("kalman")
    states = design.controller.n_states
    own = config.plant.own_sensor_alone()
    lines = -(-(states - own.n_states) // 4) + 1
    alone = lbt.kalman(lbt.models.spread_plant(own, half_width_hz=3.5, lines=lines))
    read, rows = design.problem.read, design.problem.hardware.suite.rows(config.hardware)
    fresh = np.array([[row[own.start] for own in rows.values()] for row in read], dtype=np.uint8)
    pointer, period = ctypes.c_void_p(fresh.ctypes.data), len(fresh)
    cases = {
        "several sensors": (design, "ctl_step(&state, y, fresh + k % period * CTL_SENSORS, u, u)"),
        "one phase": (one_phase(design), "ctl_step(&state, y, u)"),
        "own sensor alone": (alone, "ctl_step(&state, y, u, u)"),
    }
    print("| precision | filter | states | measurements | ns per frame | ratio |")
    print("|---|---|---:|---:|---:|---:|")
    for precision in ("double", "single"):
        libraries = [
            built(design, step, precision, **({"form": "estimator"} if design is alone else {}))
            for design, step in cases.values()
        ]
        times = np.array(
            [
                [each.time_frames(pointer, period, options.frames) for each in libraries]
                for _ in range(options.repeats)
            ]
        )
        for (name, (design, _)), own in zip(cases.items(), times.T, strict=True):
            q, n = design.controller.D.shape[-1], design.controller.n_states
            q -= 2 * (name == "one phase")  # the last two are applied commands
            ratio = statistics.median(times[:, 0] / own)
            ns = 1e9 * statistics.median(own) / options.frames
            print(f"| {precision} | {name} | {n} | {q} | {ns:.0f} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
