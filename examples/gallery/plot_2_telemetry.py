"""
A better controller from the telemetry of a night
=================================================

A loop of the VLT runs with an integrator. Half a minute of its telemetry is enough to identify the
vibrations and to design the filter that replaces it.
"""

import tempfile
from pathlib import Path

import lbt_synth as lbt

# %%
# The template has published numbers of Unit Telescope 4. ``lbt-synth init --telescope vlt`` writes
# the same file.

folder = Path(tempfile.mkdtemp())
file = folder / "vlt.yaml"
file.write_text(lbt.config.telescope_template("vlt"))
config = lbt.load_config(file)
config.truth

# %%
# You have a telemetry file of your own. Here a simulation writes one.

hardware = config.hardware
running = lbt.integrator(hardware, gain=0.3)
night = lbt.simulate(running, config.truth, hardware=hardware, frames=30_000)
telemetry = lbt.files.telemetry_from_simulation(night, hardware)
recorded = lbt.files.save_telemetry(folder / "night.fits", telemetry)

# %%
# From the file alone: turbulence, noise, sensor gain and vibrations, each with its standard error.

record = lbt.load_record(recorded)
model = lbt.identify(record)
model

# %%
# The model is a plant, and the plant gives a filter.

kalman = lbt.kalman(model.plant())
figure = lbt.report.figures.identification_figure(model, designs={"Kalman": kalman})

# %%
# What each of them leaves in the real loop, which the identification has not seen:

for name, design in {"integrator": running, "Kalman": kalman}.items():
    loop = lbt.close_loop(hardware, design, sensor_gain=config.truth.sensor_gain)
    print(f"{name}: {lbt.residual_budget(loop, config.truth).rms_nm:.1f} nm rms")
