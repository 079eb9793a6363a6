"""
A study on Dask
===============

How do controllers fare over a thousand nights? A study draws seeing, wind, vibration and sensor
gain from distributions, and evaluates every controller in each of them, exactly.
"""

import csv
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from distributed import Client

import lbt_synth as lbt

folder = Path(tempfile.mkdtemp())
(folder / "lbt.yaml").write_text(lbt.config.telescope_template("lbt"))
(folder / "study.yaml").write_text("""\
version: 1
config: lbt.yaml
samples: 1024
seed: 1
controllers:
  integrator: {design: integrator, gain: 0.4}
  kalman: {design: kalman}
  hinf: {design: hinf, gamma_ratio: 1.2}
parameters:
  atmosphere.seeing_arcsec: {uniform: [0.5, 1.5]}
  atmosphere.wind_speed_m_s: {uniform: [5, 30]}
  truth.sensor_gain: {uniform: [0.4, 1.1]}
""")

# %%
# Any executor runs a study. The client of a cluster is one; here the cluster is two threads of
# this process. What is finished is on disk: a study that is killed goes on where it was.

study = lbt.studies.load_study(folder / "study.yaml")
with Client(processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None) as client:
    run = lbt.studies.run_study(study, folder, executor=client.get_executor())
print(f"{run.computed} samples computed")

# %%
# The results are a table with one row per night. A loop that is unstable counts as no light: the
# H-infinity filter needs to know its sensor gain.

with run.results.open() as file:
    rows = list(csv.DictReader(file))
figure, axes = plt.subplots(layout="constrained")
for name in ("integrator", "kalman", "hinf"):
    strehl = np.sort(np.nan_to_num([float(row[f"{name}.strehl"] or "nan") for row in rows]))
    axes.plot(100 * strehl, np.linspace(0, 100, strehl.size), label=name)
axes.set(xlabel="Strehl ratio [%]", ylabel="nights below it [%]", title="1024 nights")
axes.legend()
