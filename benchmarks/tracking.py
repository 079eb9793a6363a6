"""The tables and the figure of docs/tracking.md.

Run with ``python benchmarks/tracking.py`` from the repository (ten minutes). With a directory
as its argument it writes the figure there.
"""

import sys
import time
from dataclasses import dataclass

import numpy as np

import lbt_synth as lbt
from lbt_synth.identification.tracking.evidence import prediction_errors
from lbt_synth.loop.simulation.disturbances import draw_disturbance, draw_noise
from lbt_synth.loop.simulation.run import step_loop
from lbt_synth.models.plant.tip_tilt import with_vibrations
from lbt_synth.report.figures.style import save_figure

CONFIG = lbt.load_config("examples/lbt.yaml")
RATE_HZ, RMS_NM = 800.0, 797.0
FROM_HZ, TO_HZ, DRIFT_S, SETTLE_S = 17.0, 23.0, 60.0, 10.0
WINDOW_S, UPDATE_S = 4.0, 1.0


@dataclass(frozen=True, kw_only=True)
class Case:
    """A loop and what shakes it."""

    name: str
    plant: lbt.models.TipTiltPlant
    turbulence: lbt.models.Spectrum
    damping: float | None
    sensor_gain: float = 1.0

    @property
    def line(self) -> lbt.models.DriftingVibration:
        """The vibration that drifts."""
        return lbt.models.DriftingVibration(
            start_hz=FROM_HZ,
            end_hz=TO_HZ,
            duration_s=DRIFT_S,
            rms_nm=RMS_NM,
            damping=self.damping,
            direction=(1,),
        )

    def truth(self, *lines: object) -> lbt.Truth:
        """Return the truth with these vibrations."""
        noise_nm = float(np.sqrt(self.plant.R[0, 0]))
        return lbt.Truth(
            turbulence=self.turbulence,
            vibrations=lines,
            noise_nm=noise_nm,
            sensor_gain=self.sensor_gain,
        )

    def design(self, frequency_hz: float) -> lbt.design.FilterDesign:
        """Return the filter for a frequency."""
        (line,) = self.plant.vibrations
        return lbt.kalman(with_vibrations(self.plant, [line.at_frequency(frequency_hz)]))


def axis(
    turbulence: lbt.models.ARModel, noise_nm: float, damping: float = 0.01
) -> lbt.models.TipTiltPlant:
    """One axis of the LBT, designed for 20 Hz."""
    line = lbt.Vibration(frequency_hz=20, damping=damping, rms_nm=RMS_NM, direction=(1,))
    return lbt.tip_tilt_plant(
        frame_rate_hz=RATE_HZ, turbulence=turbulence, vibrations=[line], noise_nm=noise_nm, modes=1
    )


def cases() -> list[Case]:
    """The cases of the table."""
    out = []
    for noise_nm in (15.5, 60.0):
        air = lbt.models.ar2_turbulence(CONFIG.atmosphere, frame_rate_hz=RATE_HZ, noise_nm=noise_nm)
        for name, damping in (("sinusoid", None), ("resonance", 0.01)):
            plant = axis(air, noise_nm)
            out.append(
                Case(
                    name=f"{name}, noise {noise_nm:g} nm",
                    plant=plant,
                    turbulence=air,
                    damping=damping,
                )
            )
    ar1 = lbt.models.ar1_turbulence(CONFIG.atmosphere, frame_rate_hz=RATE_HZ)
    papers = axis(ar1, 15.5, 0.0051)
    return out + [
        Case(
            name=f"paper's model, gain {gain:g}, {name}",
            plant=papers,
            damping=damping,
            turbulence=CONFIG.atmosphere,
            sensor_gain=gain,
        )
        for gain, name, damping in (
            (1.0, "sinusoid", None),
            (0.358, "sinusoid", None),
            (0.358, "resonance", 0.01),
        )
    ]


class Told:
    """The filter that is told the true frequency at each update; the rest as in the tracker."""

    def __init__(self, case: Case) -> None:
        self._case, self._every = case, round(UPDATE_S * RATE_HZ)
        self._running = lbt.identification.SwitchedController(
            self._at(-SETTLE_S), memory_s=WINDOW_S
        )

    def _at(self, time_s: float) -> lbt.design.FilterDesign:
        return self._case.design(float(self._case.line.frequency_hz_at(time_s)))

    def reset(self) -> None:
        """Begin again."""
        self._running.reset()

    def step(self, y: np.ndarray) -> np.ndarray:
        """Run a frame, and be told the frequency once in a while."""
        command = self._running.step(y)
        if self._running.frames % self._every == 0:
            self._running.switch(self._at(self._running.frames / RATE_HZ - SETTLE_S))
        return command


def study(
    case: Case, seed: int = 1
) -> tuple[dict[str, lbt.loop.Simulation], lbt.identification.TrackingController]:
    """Run the four controllers against the same disturbances."""
    middle = (
        lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=RMS_NM, direction=(1,))
        if case.damping is None
        else lbt.Vibration(frequency_hz=20, damping=case.damping, rms_nm=RMS_NM, direction=(1,))
    )
    hardware = case.plant.hardware
    tracker = lbt.identification.TrackingController(
        case.plant,
        lbt.identification.LineFollower(case.plant),
        window_s=WINDOW_S,
        update_s=UPDATE_S,
    )
    controllers = {
        "tracking": tracker,
        "told the frequency": Told(case),
        "fixed at 20 Hz": case.design(20.0).controller,
        "integrator": lbt.design.optimal_integrator(hardware, case.truth(middle)).controller,
    }
    runs = {
        name: lbt.simulate(
            controller,
            case.truth(case.line),
            hardware=hardware,
            frames=round(DRIFT_S * RATE_HZ),
            seed=seed,
            settle_frames=round(SETTLE_S * RATE_HZ),
        )
        for name, controller in controllers.items()
    }
    return runs, tracker


def table() -> None:
    """Strehl ratios and residuals of all cases, errors of the frequency, times of an update."""
    print(f"Strehl ratio [%] at {CONFIG.imaging.wavelength_um:g} um (residual [nm rms])")
    updates = []
    for case in cases():
        runs, tracker = study(case)
        cells = [
            f"{name} {100 * run.strehl(CONFIG.imaging)[0]:5.2f} ({run.rms_nm[0]:6.1f})"
            for name, run in runs.items()
        ]
        drifting = [u for u in tracker.history if u.middle_s - SETTLE_S >= WINDOW_S]
        times = np.array([u.middle_s for u in drifting]) - SETTLE_S
        fit = [u.fitted_hz[0] for u in drifting] - case.line.frequency_hz_at(times)
        ahead = times + WINDOW_S / 2 + UPDATE_S / 2
        used = [u.frequencies_hz[0] for u in drifting] - case.line.frequency_hz_at(ahead)
        print(f"{case.name:40s}" + ", ".join(cells))
        print(
            f"  kept {tracker.kept} of {len(tracker.history)}; frequency of the windows "
            f"{np.std(fit):.3f} Hz rms, mean {np.mean(fit):+.3f}; of the filters "
            f"{np.std(used):.3f} Hz rms, mean {np.mean(used):+.3f}"
        )
        updates += tracker.history
    for name in ("identify_s", "design_s", "switch_s"):
        taken = [1e3 * getattr(u, name) for u in updates]
        print(f"{name}: median {np.median(taken):.2f} ms, largest {np.max(taken):.2f} ms")


def identifiers() -> None:
    """The same with the whole model found in every window."""
    print("LoopIdentifier: Strehl ratio [%] (residual [nm rms]); times of the fit")
    for case in cases():
        tracker = lbt.identification.TrackingController(
            case.plant, window_s=WINDOW_S, update_s=UPDATE_S
        )
        run = lbt.simulate(
            tracker,
            case.truth(case.line),
            hardware=case.plant.hardware,
            seed=1,
            frames=round(DRIFT_S * RATE_HZ),
            settle_frames=round(SETTLE_S * RATE_HZ),
        )
        taken = [1e3 * update.identify_s for update in tracker.history]
        print(
            f"  {case.name:40s}{100 * run.strehl(CONFIG.imaging)[0]:6.2f} ({run.rms_nm[0]:6.1f}), "
            f"kept {tracker.kept} of {len(taken)}, median {np.median(taken):.0f} ms, largest "
            f"{np.max(taken):.0f} ms"
        )
        for reason in {update.reason for update in tracker.history} - {""}:
            print(f"    {reason}")


def windows() -> None:
    """Strehl ratio for other windows and times between updates, with and without the trend."""
    print("window, update: Strehl ratio [%] with the trend, without")
    for case in cases()[-2:]:
        for window_s, update_s in ((2, 0.5), (2, 1), (4, 1), (4, 2), (8, 1), (8, 4)):
            found = [
                lbt.simulate(
                    lbt.identification.TrackingController(
                        case.plant,
                        lbt.identification.LineFollower(case.plant),
                        window_s=window_s,
                        update_s=update_s,
                        extrapolate=trend,
                        guarded=False,
                    ),
                    case.truth(case.line),
                    hardware=case.plant.hardware,
                    seed=1,
                    frames=round(DRIFT_S * RATE_HZ),
                    settle_frames=round(SETTLE_S * RATE_HZ),
                ).strehl(CONFIG.imaging)[0]
                for trend in (True, False)
            ]
            print(
                f"  {case.name:40s}{window_s:4g} s{update_s:5g} s"
                + "".join(f"{100 * value:8.2f}" for value in found)
            )


def frame_times() -> None:
    """Time of a frame of the exchangeable filter, and of the controller alone."""
    case = cases()[0]
    for name, running in (
        ("exchangeable", lbt.identification.SwitchedController(case.design(20.0))),
        ("controller alone", case.design(20.0).controller.start()),
    ):
        y, started = np.zeros(1), time.perf_counter()
        for _ in range(20_000):
            running.step(y)
        print(f"a frame, {name}: {1e6 * (time.perf_counter() - started) / 20_000:.1f} us")
    design, series = case.design(20.0), np.zeros((round(2 * WINDOW_S * RATE_HZ), 1))
    started = time.perf_counter()
    for _ in range(100):
        prediction_errors(design, series, series)
    print(
        f"what a filter would have left of {2 * WINDOW_S:g} s: "
        f"{10 * (time.perf_counter() - started):.1f} ms"
    )


class Exchanged:
    """A filter that another replaces at a frame, in one of several ways."""

    def __init__(
        self, old: lbt.design.FilterDesign, new: lbt.design.FilterDesign, frame: int, how: str
    ) -> None:
        self._designs, self._frame, self._how = (old, new), frame, how
        self.reset()

    def reset(self) -> None:
        """Begin again."""
        old, new = self._designs
        self._k, self._command = 0, np.zeros(1)
        self._switched = lbt.identification.SwitchedController(old, memory_s=WINDOW_S)
        self._old, self._new = old.controller.start(), new.controller.start()
        self._shadow = new.estimator.start()

    def step(self, y: np.ndarray) -> np.ndarray:
        """Run a frame."""
        estimate = self._shadow.step(np.concatenate([y, self._command]))
        if self._how == "replayed":
            if self._k == self._frame:
                self._switched.switch(self._designs[1])
            self._command = self._switched.step(y)
        elif self._k < self._frame:
            self._command = self._old.step(y)
        elif self._how == "in parallel all the time":
            self._command = estimate  # unit mirror: the command is the estimate
        else:
            if self._k == self._frame and self._how == "with the other's state":
                self._new.state = self._old.state.copy()
            self._command = self._new.step(y)
        self._k += 1
        return self._command


def bumps() -> None:
    """What an exchange of filters does to the residual."""
    case, frame, frames, many = cases()[0], 8000, 9600, 20
    hardware = case.plant.hardware
    truth = case.truth(
        lbt.models.SinusoidalVibration(frequency_hz=20, rms_nm=RMS_NM, direction=(1,))
    )
    rng = np.random.default_rng(0)
    size = {"frames": frames, "cases": many, "rng": rng}
    total, noise = draw_disturbance(truth, hardware, **size), draw_noise(truth, hardware, **size)
    hows = "in parallel all the time", "replayed", "with the other's state", "from zero"
    print("exchange 17 -> 20 Hz: rms of the next 20 frames, 0.1 s, largest; difference of commands")
    for how in hows:
        change = Exchanged(case.design(17.0), case.design(20.0), frame, how)
        out = step_loop(change, 1.0, hardware, total, noise)
        residual, commands = out[..., 0], out[..., 1]
        if how == hows[0]:
            reference = commands
        after = residual[:, frame:]
        apart = np.max(np.abs(commands - reference)) / np.max(np.abs(reference))
        print(
            f"  {how:26s}{np.sqrt(np.mean(after[:, :20] ** 2)):8.1f}"
            f"{np.sqrt(np.mean(after[:, :80] ** 2)):8.1f}{np.max(np.abs(after)):8.1f} nm"
            f"{apart:10.1e}"
        )
    same = Exchanged(case.design(19.5), case.design(19.5), frame, "replayed")
    never = lbt.identification.SwitchedController(case.design(19.5), memory_s=WINDOW_S)
    one, other = (step_loop(c, 1.0, hardware, total[:1], noise[:1]) for c in (same, never))
    print(f"  the same filter: {np.max(np.abs(one - other)):g} nm")


def main() -> None:
    """Print the tables, write the figure."""
    table()
    identifiers()
    bumps()
    frame_times()
    windows()
    if len(sys.argv) > 1:
        case = cases()[5]
        runs, tracker = study(case)
        figure = lbt.report.figures.tracking_figure(
            tracker.history, runs, truth=[case.line], start_s=SETTLE_S
        )
        print(save_figure(figure, f"{sys.argv[1]}/tracking.png"))


if __name__ == "__main__":
    main()
