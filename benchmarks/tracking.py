"""The table of docs/tracking.md; run with ``python benchmarks/tracking.py`` from the repository."""

import time

import lbt_synth as lbt

CONFIG = lbt.load_config("examples/lbt.yaml")
RATE_HZ, RMS_NM, DRIFT_S, SETTLE_S = 800, 797.0, 60, 10
TIMES = ((4.0, 1.0), (2.0, 0.5))  # of windows and updates [s]

if __name__ == "__main__":
    print(f"Strehl ratio at {CONFIG.imaging.wavelength_um:g} um [%] (residual [nm rms])")
    for noise_nm in (15.5, 60.0):
        air = lbt.models.ar2_turbulence(CONFIG.atmosphere, frame_rate_hz=RATE_HZ, noise_nm=noise_nm)
        line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=RMS_NM, direction=(1,))
        plant = lbt.tip_tilt_plant(
            frame_rate_hz=RATE_HZ, turbulence=air, vibrations=[line], noise_nm=noise_nm, modes=1
        )
        shake = lbt.models.SinusoidalVibration(
            frequency_hz=17, end_hz=23, duration_s=DRIFT_S, rms_nm=RMS_NM, direction=(1,)
        )
        truth = lbt.Truth(turbulence=air, vibrations=(shake,), noise_nm=noise_nm)
        controllers = {"fixed at 20 Hz": lbt.kalman(plant).controller} | {
            f"windows of {window_s:g} s": lbt.identification.TrackingController(
                plant, window_s=window_s, update_s=update_s
            )
            for window_s, update_s in TIMES
        }
        size = {"frames": DRIFT_S * RATE_HZ, "settle_frames": SETTLE_S * RATE_HZ, "seed": 1}
        for name, controller in controllers.items():
            start_s = time.process_time()
            run = lbt.simulate(controller, truth, hardware=plant.hardware, **size)
            strehl, took_s = run.strehl(CONFIG.imaging)[0], time.process_time() - start_s
            print(
                f"{noise_nm:g} nm, {name}: {100 * strehl:.2f} ({run.rms_nm[0]:.1f}), "
                f"{took_s:.0f} s",
                flush=True,
            )
