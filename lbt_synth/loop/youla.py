"""Controllers made of a filter of the pseudo-open-loop measurement, the Youla parameter.

The path from command to measurement is known, and so is the measurement ybar that there would
be without any correction::

    ybar(k) = y(k) + sensor_matrix influence_matrix (c[0] u(k-1) + c[1] u(k-2) + ...)

with the mirror's taps c (computed by its states where it has dynamics). Every controller that
stabilises the loop is a stable filter from ybar to u, and the closed loop is affine in that
filter (D. C. Youla, H. A. Jabr, J. J. Bongiorno, IEEE Trans. Autom.
Control 21, 319 (1976), doi:10.1109/TAC.1976.1101223).
"""

from __future__ import annotations

import numpy as np

from lbt_synth.errors import DimensionError
from lbt_synth.linear import Controller
from lbt_synth.models import LoopHardware


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
        In new-state form, with the mirror (its past commands, if it settles) as further states.

    Raises
    ------
    DimensionError
        If the filter does not fit the loop.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, modes=1)
    >>> last = lbt.Controller(A=0.0, B=1.0, C=1.0, D=0.0, dt_s=1 / 800)  # u(k) = ybar(k)
    >>> controller = lbt.loop.youla_controller(path, last)
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
    mirror, n = hardware.mirror_system.whole, len(A)
    A_mirror, B_mirror, C_mirror = mirror.repeated(m)
    # Without feedthrough the last command is read from the state: u(k-1) = C x(k)
    stored = m if np.any(D) else 0
    size = n + stored + mirror.n_states * m
    last = np.zeros((m, size))  # reads u(k-1) from the state [x, u(k-1) if stored, mirror]
    if stored:
        last[:, n : n + m] = np.eye(m)
    else:
        last[:, :n] = C
    position = mirror.D * last
    position[:, n + stored :] += C_mirror
    correction = hardware.sensor @ hardware.influence @ position  # ybar = y + correction s
    next_mirror = B_mirror @ last
    next_mirror[:, n + stored :] += A_mirror
    next_filter = np.hstack([A, np.zeros((n, size - n))]) + B @ correction
    rows, entry = [next_filter], np.zeros((size, q))
    entry[:n] = B
    if stored:
        rows.append(C @ next_filter + D @ correction)
        entry[n : n + m] = C @ B + D
    applied = entry @ (mirror.D * hardware.sensor @ hardware.influence)
    applied[n + stored :] += B_mirror
    # the rows that read u(k-1) from the old state read u(k) from the new one
    whole, D = np.vstack([*rows, next_mirror]), np.zeros((m, q))
    return Controller(A=whole, B=entry, C=last, D=D, dt_s=hardware.dt_s, applied=applied)
