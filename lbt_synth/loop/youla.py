"""Controllers from filters of the pseudo-open-loop measurement (the Youla parameter).

The path from command to measurement is a known delay, so the measurement that there would
be without any correction is known to the controller::

    ybar(k) = y(k) + sensor_matrix influence_matrix (c[0] u(k-1) + c[1] u(k-2) + ...)

Every controller that stabilises the loop is a stable filter from ybar to u, and the closed
loop is affine in that filter (D. C. Youla, H. A. Jabr, J. J. Bongiorno, IEEE Trans. Autom.
Control 21, 319 (1976), doi:10.1109/TAC.1976.1101223).
"""

from __future__ import annotations

import numpy as np

from lbt_synth.errors import DimensionError
from lbt_synth.models.hardware import LoopHardware
from lbt_synth.statespace import Controller


def youla_controller(hardware: LoopHardware, parameter: Controller) -> Controller:
    """Return the controller from y to u of a filter from the pseudo-open-loop ybar to u.

    Parameters
    ----------
    hardware : LoopHardware
        The loop; its sensor matrix is what the controller believes.
    parameter : Controller
        Stable filter from ybar(k) to u(k), in new-state form.

    Returns
    -------
    Controller
        In new-state form, with the past commands as further states.

    Raises
    ------
    DimensionError
        If the filter does not fit the loop.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> last = lbt.Controller(A=0.0, B=1.0, C=1.0, D=0.0, dt_s=1 / 800)   # u(k) = ybar(k)
    >>> controller = lbt.youla_controller(path, last)
    >>> bool(lbt.close_loop(path, controller).spectral_radius < 1e-3)
    True
    """
    m, q = hardware.n_commands, hardware.n_measurements
    if (len(parameter.C), parameter.B.shape[1]) != (m, q):
        raise DimensionError(
            f"the filter must map {q} measurements to {m} commands; got "
            f"{parameter.B.shape[1]} to {len(parameter.C)}."
        )
    A, B, C, D = parameter.A, parameter.B, parameter.C, parameter.D
    n, taps = len(A), hardware.mirror_taps
    response = hardware.sensor @ hardware.influence
    # without feedthrough the newest past command is read from the state: u(k-1) = C x(k)
    strict = not np.any(D)
    stored = len(taps) - 1 if strict else len(taps)
    size = n + stored * m
    past = np.zeros((len(taps) * m, size))  # u(k-1), u(k-2), ... from the state
    if strict:
        past[:m, :n] = C
        past[m:, n:] = np.eye(stored * m)
    else:
        past[:, n:] = np.eye(stored * m)
    believed = np.hstack([tap * response for tap in taps]) @ past  # ybar = y + believed s
    new_state = np.hstack([A, np.zeros((n, size - n))]) + B @ believed
    command = C @ new_state + D @ believed
    entry = np.vstack([B, np.zeros((size - n, q))])
    older = past[: stored * m] if strict else np.vstack([command, past[: (stored - 1) * m]])
    read = np.hstack([C, np.zeros((m, size - n))])
    if not strict:
        entry[n : n + m] = C @ B + D
        read = np.zeros((m, size))
        read[:, n : n + m] = np.eye(m)
    return Controller(
        A=np.vstack([new_state, older]),
        B=entry,
        C=read,
        D=np.zeros((m, q)),
        dt_s=hardware.dt_s,
    )
