"""The evidence that one of several filters leaves less than the one that runs.

All rivals predict the same measurements, each with its own sensor gain. A filter whose corrections
would have been c' instead of the c that were made expects ``S (c' - c)`` of the measurement y, S
its sensor matrix; ``y + S (c - c')`` is its error. A filter is judged on frames after those that
it was made from (A. P. Dawid, J. R. Stat. Soc. A 147, 278 (1984), doi:10.2307/2981683).

The standard error of a mean difference is that of the means of equal batches of frames, which are
nearly independent where a batch is longer than the correlation (B. Schmeiser, Oper. Res. 30, 556
(1982), doi:10.1287/opre.30.3.556). Then their mean over its error follows Student's t.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from lbt_synth.design import FilterDesign
from lbt_synth.linear import StateSpace
from lbt_synth.linear.block_filtering import filter_series
from lbt_synth.models import TipTiltPlant
from lbt_synth.models.loop_hardware import past_corrections
from lbt_synth.validation import FloatArray

BATCHES = 8
_SHORTEST_S = 0.4  # of the last frames that are tested
_DOUBLINGS = 3  # the longest are 3.2 s
LONGEST_S = _SHORTEST_S * 2**_DOUBLINGS
FALSE_ALARM = 0.003  # probability that equal filters pass one test
_LEAST_SHARE = 0.01  # of the mean square: less is not worth an exchange


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """How much less a rival leaves than the filter that runs.

    Attributes
    ----------
    rival : int
        The rival.
    share : float
        Part of the running filter's mean square that it saves.
    seconds : float
        Length of the last frames on which it does.
    """

    rival: int
    share: float
    seconds: float


def prediction_errors(
    design: FilterDesign, measurements: FloatArray, corrections: FloatArray
) -> FloatArray:
    """Return the errors (frames, q) with which a filter, from rest, expects measurements.

    They are what would be left if it ran and its sensor gain was right: ``y + S (c - c')`` [nm] of
    measurements y (frames, q) and the corrections c (frames, n) in them.

    Examples
    --------
    What ran from the beginning expects nothing of a measurement: its error is the measurement.

    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> from lbt_synth.identification.tracking.evidence import prediction_errors
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10, frame_rate_hz=500)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=500, turbulence=slow, noise_nm=5.0, modes=1)
    >>> running = lbt.identification.SwitchedController(lbt.kalman(plant))
    >>> y = np.random.default_rng(0).standard_normal((50, 1))
    >>> _ = [running.step(one) for one in y]
    >>> bool(np.allclose(prediction_errors(running.design, *running.window()), y))
    True
    """
    plant = design.problem
    assert isinstance(plant, TipTiltPlant)
    hw, K = plant.hardware, design.gain_predictor
    F, to_command = plant.A - K @ plant.C, hw.projector @ plant.L
    estimator = StateSpace(A=F, B=K, C=to_command @ F, D=to_command @ K)  # gives u(k)
    commands = filter_series(estimator, measurements + corrections @ hw.sensor.T)
    own = past_corrections(hw.mirror_taps, commands) @ hw.influence.T
    return np.asarray(measurements + (corrections - own) @ hw.sensor.T)


def find_better(losses: FloatArray, running: int, frame_rate_hz: float) -> Evidence | None:
    """Return the rival that clearly leaves least, or None if the running filter should stay.

    A rival leaves clearly less if, over the last 0.4, 0.8, 1.6 or 3.2 s, its mean loss is less by
    at least 1 % and by so many standard errors as equal filters reach with a probability of 1 %.

    Losses (rivals, frames) are the squares of what each leaves of the same frames, oldest first.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.identification.tracking.evidence import find_better
    >>> losses = np.random.default_rng(0).chisquare(1, (2, 800))
    >>> find_better(losses, 0, 800.0) is None
    True
    >>> losses[0, -400:] *= 2
    >>> found = find_better(losses, 0, 800.0)
    >>> found.rival, found.seconds
    (1, 0.4)
    """
    limit = float(student.ppf(1 - FALSE_ALARM, BATCHES - 1)) / np.sqrt(BATCHES)
    best = None
    for doubling in range(_DOUBLINGS + 1):
        batch = max(1, round(_SHORTEST_S * 2**doubling * frame_rate_hz / BATCHES))
        frames = BATCHES * batch
        if frames > losses.shape[1]:
            break
        means = losses[:, -frames:].reshape(len(losses), BATCHES, batch).mean(axis=2)
        less, level = means[running] - means, means[running].mean()
        least = np.maximum(limit * less.std(axis=1, ddof=1), _LEAST_SHARE * level)
        saved = np.where(less.mean(axis=1) > least, less.mean(axis=1), 0.0)
        rival = int(np.argmax(saved))
        if saved[rival] > (best.share * level if best else 0.0):
            share = float(saved[rival] / level)
            best = Evidence(rival=rival, share=share, seconds=frames / frame_rate_hz)
    return best
