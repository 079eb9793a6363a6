"""What a study costs besides its evaluation: processor time a sample, and memory.

``python benchmarks/study.py [samples] [jobs]``; the evaluation costs nothing.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np

import lbt_synth as lbt
from lbt_synth.storage.thread_limits import WorkerPool

STUDY = """
version: 1
config: lbt.yaml
samples: {samples}
controllers: {{a: {{design: kalman}}, b: {{design: integrator, gain: 0.5}}}}
parameters:
  truth.vibrations[0].rms_mas: {{uniform: [40, 100]}}
  atmosphere.seeing_arcsec: {{uniform: [0.5, 1.2]}}
  truth.sensor_gain: {{normal: {{mean: 0.8, deviation: 0.1, low: 0.4, high: 1.2}}}}
  error.delay_frames: {{uniform: [0, 0.3]}}
  error.noise_factor: {{uniform: [0.9, 1.1]}}
"""


def nothing(study: lbt.studies.Study, values: np.ndarray, start: int) -> tuple[dict, list]:
    """Numbers of as many digits as results have."""
    columns = {n: np.abs(values[:, 0] * (i + 1) / 7) for i, n in enumerate(study.result_columns)}
    return columns, []


def main(samples: int = 1_000_000, jobs: int = 1) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "study.yaml").write_text(STUDY.format(samples=samples))
        source = Path(__file__).parents[1] / "examples" / "lbt.yaml"
        (folder / "lbt.yaml").write_bytes(source.read_bytes())
        study = lbt.studies.load_study(folder / "study.yaml")
        before = time.process_time()
        with WorkerPool(jobs) if jobs > 1 else nullcontext() as pool:
            run = lbt.studies.run_study(study, folder, executor=pool, evaluate=nothing)
        spent = time.process_time() - before
        memory = [
            resource.getrusage(who).ru_maxrss / 1e3
            for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
        ]
        print(
            f"{samples} samples, {jobs} processes: {run.seconds:.1f} s, of the client's processor "
            f"{1e6 * spent / samples:.1f} us a sample; {memory[0]:.0f} MB, a worker {memory[1]:.0f}"
        )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
