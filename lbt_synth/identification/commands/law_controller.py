"""The controller that a recorded control law is, to close loops with it again."""

from __future__ import annotations

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.identification.commands.control_law import ControlLaw
from lbt_synth.linear import Controller
from lbt_synth.validation import number


def law_controller(law: ControlLaw, frame_rate_hz: float) -> Controller:
    """Return a control law as a controller.

    Parameters
    ----------
    law : ControlLaw
        The law.
    frame_rate_hz : float
        Frame rate [Hz].

    Returns
    -------
    Controller
        Its state holds past commands and measurements.

    Raises
    ------
    ProblemError
        If there is no law, or it knows measurements of the future.

    Examples
    --------
    >>> import numpy as np
    >>> from lbt_synth.identification.commands.control_law import fit_control_law
    >>> y = np.random.default_rng(1).standard_normal((2000, 1))
    >>> again = law_controller(fit_control_law(y, 0.3 * np.cumsum(y, axis=0)), 500).start()
    >>> [round(float(again.step([1.0])[0]), 6) for _ in range(3)]
    [0.3, 0.6, 0.9]
    """
    rate = number(frame_rate_hz, "frame_rate_hz", above=0)
    if law.kind == "none" or law.lag_frames < 0:
        why = (
            "the commands do not follow from the measurements"
            if law.kind == "none"
            else f"its commands know measurements of {-law.lag_frames} frames later"
        )
        raise ProblemError(f"a controller needs a law that can run; got one where {why}.")
    axes, lags = len(law.gain), law.taps.shape[1]
    last = law.lag_frames + lags - 1
    slots = max(law.order, 1)  # of u(k-1), u(k-2), ...; then last of y(k-1), y(k-2), ...
    size = axes * (slots + last)
    A, B = np.zeros((size, size)), np.zeros((size, axes))
    each = np.arange(axes)
    for j in range(law.order):
        A[each, axes * j + each] = law.past[:, j]
    for index in range(lags):
        lag = law.lag_frames + index
        if lag:
            column = axes * (slots + lag - 1)
            A[:axes, column : column + axes] += law.taps[:, index]
        else:
            B[:axes] += law.taps[:, index]
    for slot in range(1, slots):
        A[axes * slot + each, axes * (slot - 1) + each] = 1.0
    if last:
        B[axes * slots + each, each] = 1.0
    for slot in range(slots + 1, slots + last):
        A[axes * slot + each, axes * (slot - 1) + each] = 1.0
    return Controller(A=A, B=B, C=np.eye(axes, size), D=np.zeros((axes, axes)), dt_s=1 / rate)
