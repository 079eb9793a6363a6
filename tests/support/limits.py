"""Loops, processes and their least residuals for tests of the limits."""

import lbt_synth as lbt

RATE = 800.0


class Anonymous:
    """A spectrum that hides what it is."""

    def __init__(self, psd):
        self.psd = psd


def path(delay=2.0, modes=1, **extra):
    return lbt.LoopHardware(frame_rate_hz=RATE, delay_frames=delay, modes=modes, **extra)


def ar(*coefficients, driving=1.0):
    return lbt.models.ARModel(
        coefficients=list(coefficients), driving_rms_nm=driving, frame_rate_hz=RATE
    )


def variance(hardware, *, frame_means=True, **truth):
    """Return the least variance, by default of means over frames, of which theory speaks."""
    limit = lbt.loop.least_residual(hardware, lbt.Truth(**truth), frame_means=frame_means)
    return float(limit.variance_nm2.sum())
