"""The sentences on timing and units that every telemetry file carries."""

_CONVENTION = (
    "Row k of every series is frame k of 1/frame_rate_hz. "
    "y(k) = sensor_gain S phi_res(k-1) + noise(k): the measurement of frame k is of the exposure "
    "of frame k-1. u(k) is the command computed from y up to y(k). "
    "phi_res(k) = phi_tot(k) - phi_cor(k), {correction}. S is the interaction matrix, N the "
    "influence matrix, each the identity where it is not given. Where slopes are recorded, "
    "slopes(k) = sensor_gain S phi_res(k-1) + noise(k), y(k) = reconstructor slopes(k). "
    "Units: nm rms of wavefront, unless a unit is given."
)
CONVENTION = _CONVENTION.format(
    correction="phi_cor(k) = N u(k-d+1), d = delay_frames from the "
    "middle of an exposure to the middle of the command computed from it; for d = j+1+f, "
    "phi_cor(k) = N ((1-f) u(k-j) + f u(k-j-1))"
)
MOVING_CONVENTION = _CONVENTION.format(
    correction="phi_cor(k) = N (c0 u(k) + c1 u(k-1) + c2 u(k-2) + ...) with the mirror taps c "
    "recorded here: the weights of the commands in the position of a mirror that does not settle "
    "at once, averaged over exposure k. They hold the whole delay: d = delay_frames as it would be "
    "with a mirror that settles at once, and the mirror's lag after it"
)
