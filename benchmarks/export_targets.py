"""The designs of the examples in each target, proved and run in its arithmetic.

From the repository::

    python benchmarks/export_targets.py              # the proof: loss, or the limit that refuses
    python benchmarks/export_targets.py frames       # a million frames in closed loop
    python benchmarks/export_targets.py frames cacao # of one target
"""

from __future__ import annotations

import ctypes
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import lbt_synth as lbt
from lbt_synth.interop import Exported
from lbt_synth.interop.dao.export import InnerLoop
from lbt_synth.interop.pipeline import target_named, target_names
from lbt_synth.linear.block_filtering import filter_series

Array = npt.NDArray[Any]
LOOPS, FRAMES, SETTLE, RATE_HZ = 200, 5000, 2000, 800.0
TURBULENCE_NM, VIBRATION_NM, NOISE_NM, POLE = 592.0, 797.0, 15.5, 0.9886
CASES: dict[str, tuple[str, dict[str, str]]] = {
    "C, double": ("c", {}),
    "C, single": ("c", {"precision": "single"}),
    "C, single, estimator": ("c", {"precision": "single", "form": "estimator"}),
    "MATLAB": ("matlab", {}),
    "dao": ("dao", {}),
    "cacao": ("cacao", {}),
}
DRIVER = """
#include "k.h"
/* Parallel loops of two frames: y from the residual of the last frame, (loops, frames, 2). */
void run(int loops, int frames, double gain, const double *phase, const double *noise, double *out)
{
    for (int l = 0; l < loops; l++) {
        k_state state;
        k_real y[2], u[2] = {0, 0};
        double residual[2] = {0, 0}, held[2] = {0, 0};

        k_reset(&state);
        for (int k = 0; k < frames; k++) {
            for (int i = 0; i < 2; i++) y[i] = (k_real)(gain * residual[i] + noise[2 * k + i]);
            STEP;
            for (int i = 0; i < 2; i++) {
                out[2 * k + i] = residual[i] = phase[2 * k + i] - held[i];
                held[i] = (double)u[i];
            }
        }
        phase += 2 * frames, noise += 2 * frames, out += 2 * frames;
    }
}
"""


def designs() -> dict[str, lbt.Design]:
    """Return the designs of the examples."""
    one, other = (lbt.load_config(f"examples/{name}.yaml") for name in ("lbt", "lbt_robust"))
    made = {name: one.design(name) for name in ("kalman", "hinf", "lqg", "integrator")}
    return made | {"robust": other.design("robust")}


def export(design: lbt.Design, target: str, options: dict[str, str], folder: Path) -> Exported:
    """Export a design."""
    return lbt.interop.export(target_named(target).path_in(folder), design, target, **options)


def worst_loss(design: lbt.Design, target: str, options: dict[str, str], folder: Path) -> str:
    """Export a design; return the largest loss of its residual, or what refuses it."""
    try:
        written = export(design, target, options, folder)
    except lbt.errors.LbtSynthError as error:
        found = str(error).partition("; ")[2] or str(error)
        return "refused: " + found.partition(", limit")[0].partition(". ")[0]
    losses = [c.value for c in written.checks if c.name.startswith("residual")]
    return f"{max(losses, key=abs):.1e}"


def proof(folder: Path) -> None:
    """Print the table of losses."""
    made = designs()
    others = {
        name: (name, {}) for name in target_names() if name not in {t for t, _ in CASES.values()}
    }
    print("| | " + " | ".join(made) + " |\n|---" + "|---:" * len(made) + "|")
    for name, (target, options) in (CASES | others).items():
        cells = [worst_loss(design, target, options, folder) for design in made.values()]
        print(f"| {name} | " + " | ".join(cells) + " |")


def disturbance(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return phase and noise of each loop, (loops, frames, 2) [nm]."""
    total = FRAMES + SETTLE
    air = rng.standard_normal((LOOPS, total, 2)) * np.sqrt(1 - POLE**2)
    air[:, 0] = rng.standard_normal((LOOPS, 2))
    for k in range(1, total):
        air[:, k] += POLE * air[:, k - 1]
    turns = rng.uniform(16.5, 23.5, (LOOPS, 1)) / RATE_HZ * np.arange(total)
    air *= TURBULENCE_NM
    air[..., 0] += VIBRATION_NM * np.sqrt(2) * np.sin(2 * np.pi * (turns + rng.random((LOOPS, 1))))
    return air, NOISE_NM * rng.standard_normal(air.shape)


def run_c(files: tuple[Path, ...], gain: float, phase: Array, noise: Array) -> Array:
    """Run the compiled source."""
    step = (
        "k_step(&state, y, u, u)" if "*applied" in files[1].read_text() else "k_step(&state, y, u)"
    )
    folder, library = (
        files[0].parent,
        files[0].with_name(f"k{len(list(files[0].parent.iterdir()))}.so"),
    )
    (folder / "driver.c").write_text(DRIVER.replace("STEP", step))
    command = ["cc", "-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC"]
    subprocess.run([*command, files[0], folder / "driver.c", "-o", library], check=True)
    out, (loops, frames, _) = np.zeros_like(phase), phase.shape
    arrays = (ctypes.c_void_p(a.ctypes.data) for a in (phase, noise, out))
    ctypes.CDLL(str(library)).run(loops, frames, ctypes.c_double(gain), *arrays)
    return out


def run_steps(step: Any, gain: float, phase: Array, noise: Array) -> Array:
    """Run ``step(y) -> u`` of all loops at once, (loops, 2)."""
    residual, held = np.zeros((2, *phase[:, 0].shape))
    out = np.zeros_like(phase)
    for k in range(phase.shape[1]):
        u = step(gain * residual + noise[:, k])
        residual, held = phase[:, k] - held, u
        out[:, k] = residual
    return out


def run_target(target: str, options: dict[str, str], written: Exported, *series: Any) -> Array:
    """Run what was written in the arithmetic of its target."""
    files = written.files
    if target == "c":
        return run_c(files, *series)
    if target == "matlab":
        from scipy.io import loadmat

        form = loadmat(files[0])["textbook"][0, 0]
        state = [np.zeros((LOOPS, len(form["A"])))]

        def textbook(y: Array) -> Array:
            u = state[0] @ form["C"].T + y @ form["D"].T
            state[0] = state[0] @ form["A"].T + y @ form["B"].T
            return np.asarray(u)

        return run_steps(textbook, *series)
    if target == "cacao":
        twins = [written.start(np.inf) for _ in range(LOOPS)]
        return run_steps(lambda y: np.array(list(map(step_twin, twins, y))), *series)
    rows = np.tile(np.load(files[0]), (1, LOOPS))
    loop = InnerLoop(rows)
    return run_steps(lambda y: loop.step(y.ravel()).reshape(y.shape), *series)


def step_twin(twin: Any, y: Array) -> Array:
    """Take y(k) of one loop, return u(k)."""
    return np.asarray(twin.step(y))


def million(folder: Path, targets: list[str]) -> None:
    """Print the arithmetic's noise in a million frames, beside its bound."""
    made = designs()
    phase, noise = disturbance(np.random.default_rng(0))
    print(f"{LOOPS * FRAMES:.0e} frames; parts of the residual")
    print(
        "| design | target | sensor gain | difference from the design | loss | bound of rounding |"
    )
    print("|---|---|---:|---:|---:|---:|")
    for name, design in made.items():
        for case, (target, options) in CASES.items():
            if targets and target not in targets:
                continue
            try:
                written = export(design, target, options, folder)
            except lbt.errors.LbtSynthError:
                continue
            bounds = [c for c in written.checks if c.name.startswith("residual")]
            for check in (bounds[0], bounds[-1]) if len(bounds) > 1 else bounds:
                gain = float(check.name.split("gain ")[1].split(",")[0])
                loop = lbt.close_loop(design.hardware, design.controller, sensor_gain=gain)
                own = filter_series(loop.system, np.concatenate([phase, noise], axis=2))
                own = own[:, SETTLE:, :2]
                found = run_target(target, options, written, gain, phase, noise)[:, SETTLE:]
                size = np.sqrt(np.mean(own**2))
                apart = np.sqrt(np.mean((found - own) ** 2)) / size
                loss = np.sqrt(np.mean(found**2)) / size - 1
                bound = check.computed_by.split("at most ")[1].split()[0]
                print(
                    f"| {name} | {case} | {gain:g} | {apart:.1e} | {loss:.1e} | {bound} |",
                    flush=True,
                )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        if sys.argv[1:2] == ["frames"]:
            million(Path(place), sys.argv[2:])
        else:
            proof(Path(place))
