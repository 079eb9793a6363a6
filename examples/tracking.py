"""A vibration that drifts from 17 to 23 Hz, and a filter that follows it.

The loop is one axis of the LBT: 800 Hz, two frames of delay, 15.5 nm of noise, AR2 turbulence.
Run with ``python examples/tracking.py`` from the repository (some seconds).
"""

import lbt_synth as lbt

SETTLE_S, DRIFT_S, RATE_HZ = 10, 60, 800

config = lbt.load_config("examples/lbt.yaml")
turbulence = lbt.models.ar2_turbulence(config.atmosphere, frame_rate_hz=RATE_HZ, noise_nm=15.5)

# what the design believes at first: 20 Hz
line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=797, direction=(1,))
plant = lbt.tip_tilt_plant(
    frame_rate_hz=RATE_HZ, turbulence=turbulence, vibrations=[line], noise_nm=15.5, modes=1
)

# what is there
shake = lbt.models.SinusoidalVibration(
    frequency_hz=17, end_hz=23, duration_s=DRIFT_S, rms_nm=797, direction=(1,)
)
truth = lbt.Truth(turbulence=turbulence, vibrations=(shake,), noise_nm=15.5)

tracker = lbt.identification.TrackingController(plant, window_s=4, update_s=1)
controllers = {"tracking": tracker, "fixed at 20 Hz": lbt.kalman(plant).controller}
for name, controller in controllers.items():
    run = lbt.simulate(
        controller,
        truth,
        hardware=plant.hardware,
        frames=DRIFT_S * RATE_HZ,
        settle_frames=SETTLE_S * RATE_HZ,
        seed=1,
    )
    strehl = 100 * run.strehl(config.imaging)[0]
    print(f"{name:16s} {run.rms_nm[0]:6.1f} nm rms, Strehl ratio {strehl:.2f} %")
for update in tracker.history[::10]:
    middle_s = update.time_s - SETTLE_S - 2  # of the window
    filters = ", ".join(f"{hz:.2f}" for hz in update.frequencies_hz)
    true_hz = shake.frequency_hz_at(middle_s)
    print(f"  {middle_s:5.1f} s: true {true_hz:6.3f} Hz, filter {filters} Hz {update.reason}")
