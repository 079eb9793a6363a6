"""Power of the truth that a design was not made for, and what its loop leaves of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lbt_synth.design import Design
from lbt_synth.design.expected_disturbance import ModeDisturbance
from lbt_synth.design.shaping.frequencies import spectrum_edges
from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.loop import ClosedLoop, residual_budget
from lbt_synth.models import SinusoidalVibration, Spectrum, Truth, Vibration
from lbt_synth.models.vibration import checked_direction, stationary_vibrations
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import column, nm_column, table_row
from lbt_synth.validation import FloatArray, IntArray

_SHARE = 0.05  # of the residual's variance that is worth a warning
_TWICE = 2.0  # the truth's power over the expected one from which it counts as unexpected
_NEAR = 0.02  # half width, over its frequency, of where a sinusoid is expected
_ORDER = 5  # of the quadrature on a panel
_GAP = 1.1  # ratio of frequencies below which two bands are one


@table_row
class UnexpectedPower:
    """A vibration or a band in which the truth has more power than a design expects."""

    what: str = column("what", help="vibration, or turbulence")
    mode: int = column("mode", help="Which mode, from 1")
    low_hz: float = column("from", unit="Hz", format=".4g", help="Where it begins")
    high_hz: float = column("to", unit="Hz", format=".4g", help="Where it ends")
    true_nm: float = nm_column("in the truth", help="Its rms in the truth")
    expected_nm: float = nm_column("expected", help="The rms that the design expects there")
    left_nm: float = nm_column("left", help="What the loop leaves of it, rms")

    def __str__(self) -> str:
        """Return it in words."""
        where = f"from {self.low_hz:.3g} to {self.high_hz:.3g} Hz"
        if self.low_hz == self.high_hz:
            where = f"at {self.low_hz:.4g} Hz"
        return (
            f"the truth has {self.what} {where} on axis {self.mode}, {nm_text(self.true_nm)}, and "
            f"the design expects {nm_text(self.expected_nm)} there: {nm_text(self.left_nm)} are "
            "left"
        )


def unexpected_power(design: Design, loop: ClosedLoop, truth: Truth) -> tuple[UnexpectedPower, ...]:
    """Find power of the truth that a design was not made for and that its loop does not remove.

    Parameters
    ----------
    design : Design
        The design; one that was made for no disturbance, like an integrator, expects none.
    loop : ClosedLoop
        Its loop, stable, with the truth's sensor gain.
    truth : Truth
        What the loop really meets.

    Returns
    -------
    tuple of UnexpectedPower
        Sinusoids, and bands of the spectra, with more than twice the expected power, if what is
        left of each is more than 5 % of the residual's variance; the largest first.

    Raises
    ------
    UnstableLoopError
        If the loop is unstable.
    ProblemError
        If the truth does not fit the loop, or drifts.

    Examples
    --------
    A filter that knows of no vibration:

    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=10, frame_rate_hz=800)
    >>> plant = lbt.tip_tilt_plant(frame_rate_hz=800, turbulence=slow, noise_nm=5.0)
    >>> design = lbt.kalman(plant)
    >>> shaken = lbt.Truth(
    ...     turbulence=slow,
    ...     vibrations=(lbt.models.SinusoidalVibration(frequency_hz=30, rms_nm=100),),
    ...     noise_nm=5.0,
    ... )
    >>> loop = lbt.close_loop(plant.hardware, design.controller)
    >>> found = lbt.studies.unexpected_power(design, loop, shaken)
    >>> [(round(each.low_hz), round(each.true_nm)) for each in found]
    [(30, 100)]
    """
    expected = design.expected_disturbance()
    if expected is None:
        return ()
    least_nm2 = _SHARE * residual_budget(loop, truth).rms_nm ** 2
    found = [*_unexpected_lines(expected, loop, truth), *_unexpected_bands(expected, loop, truth)]
    kept = [each for each in found if each.left_nm**2 > least_nm2]
    return tuple(sorted(kept, key=lambda each: -each.left_nm))


def _unexpected_lines(
    expected: tuple[ModeDisturbance, ...], loop: ClosedLoop, truth: Truth
) -> Iterator[UnexpectedPower]:
    """Yield the sinusoids of the truth beside which less power is expected."""
    for line in stationary_vibrations(truth.vibrations):
        if not isinstance(line, SinusoidalVibration):
            continue
        direction = checked_direction(line, loop.hardware)
        f = line.frequency_hz
        rejected = np.sum(np.abs(loop.sensitivity([f])[0]) ** 2, axis=0)  # of each mode
        for mode, (share, own) in enumerate(zip(direction, expected, strict=True)):
            power = (share * line.rms_nm) ** 2
            there = _expected_power(own, (1 - _NEAR) * f, (1 + _NEAR) * f, loop)
            if power > _TWICE * there:
                yield UnexpectedPower(
                    what="a vibration",
                    mode=mode + 1,
                    low_hz=f,
                    high_hz=f,
                    true_nm=float(np.sqrt(power)),
                    expected_nm=float(np.sqrt(there)),
                    left_nm=float(np.sqrt(power * rejected[mode])),
                )


def _expected_power(own: ModeDisturbance, low_hz: float, high_hz: float, loop: ClosedLoop) -> float:
    """Return the variance that is expected in a band [nm^2]."""
    bands = [band for band in own.bands if band.low_hz <= high_hz and band.high_hz >= low_hz]
    power = max((band.rms_nm**2 for band in bands), default=0.0)
    if own.spectrum is None:
        return power
    nyquist_hz = loop.hardware.frame_rate_hz / 2
    inside = spectrum_edges(own.spectrum, nyquist_hz)
    inside = inside[(inside > low_hz) & (inside < high_hz)]
    grid = np.linspace(low_hz, min(high_hz, nyquist_hz), 33)
    f, weights = gauss_panels(np.unique(np.concatenate([grid, inside])), _ORDER)
    return power + float(weights @ own.spectrum.psd(f))


def _unexpected_bands(
    expected: tuple[ModeDisturbance, ...], loop: ClosedLoop, truth: Truth
) -> Iterator[UnexpectedPower]:
    """Yield random vibrations and bands of turbulence where more power is than is expected."""
    nyquist_hz = loop.hardware.frame_rate_hz / 2
    for mode, own in enumerate(expected):
        parts = _true_parts(loop, truth, mode)
        edges = _panels([spectrum for _, spectrum in parts], own, nyquist_hz)
        f, weights = gauss_panels(edges, _ORDER)
        rejected = np.sum(np.abs(loop.sensitivity(f)[:, :, mode]) ** 2, axis=1)
        powers = [weights * spectrum.psd(f) for _, spectrum in parts]
        there = _by_panel(
            np.zeros(f.size) if own.spectrum is None else weights * own.spectrum.psd(f)
        )
        middle = (edges[1:] + edges[:-1]) / 2
        beyond = sum(map(_by_panel, powers), np.zeros(middle.size)) > _TWICE * there
        for band in own.bands:
            beyond &= (middle < band.low_hz) | (middle > band.high_hz)
        for (line, _), power in zip(parts, powers, strict=True):
            true, left = _by_panel(power), _by_panel(power * rejected)
            every = np.nonzero(beyond)[0]
            for panels in [every] if line is not None else _joined(edges, every):
                if not panels.size:
                    continue
                ends = float(edges[panels[0]]), float(edges[panels[-1] + 1])
                yield UnexpectedPower(
                    what="turbulence" if line is None else "a vibration",
                    mode=mode + 1,
                    low_hz=ends[0] if line is None else line.frequency_hz,
                    high_hz=ends[1] if line is None else line.frequency_hz,
                    true_nm=float(np.sqrt(np.sum(true[panels]))),
                    expected_nm=float(np.sqrt(np.sum(there[panels]))),
                    left_nm=float(np.sqrt(np.sum(left[panels]))),
                )


def _by_panel(values: FloatArray) -> FloatArray:
    """Return the sums of values at nodes over each panel."""
    return np.asarray(values.reshape(-1, _ORDER).sum(axis=1))


def _true_parts(
    loop: ClosedLoop, truth: Truth, mode: int
) -> list[tuple[Vibration | None, Spectrum]]:
    """Return the spectra of a mode: turbulence, beside None, and random vibrations."""
    air = truth.turbulence_per_mode(loop.hardware.modes)[mode]
    out: list[tuple[Vibration | None, Spectrum]] = [] if air is None else [(None, air)]
    for line in stationary_vibrations(truth.vibrations):
        share = abs(checked_direction(line, loop.hardware)[mode])
        if isinstance(line, Vibration) and share:
            own = replace(line, rms_nm=line.rms_nm * share)
            out.append((line, own.ar_model(loop.hardware.frame_rate_hz)))
    return out


def _panels(true: list[Spectrum], own: ModeDisturbance, nyquist_hz: float) -> FloatArray:
    """Return edges of panels: geometric, and finer where a spectrum has lines or kinks [Hz]."""
    spectra = [*true, *([] if own.spectrum is None else [own.spectrum])]
    grid = [np.geomspace(1e-6, 1, 301) * nyquist_hz]
    grid += [spectrum_edges(spectrum, nyquist_hz) for spectrum in spectra]
    grid += [np.array([band.low_hz, band.high_hz]) for band in own.bands]
    edges = np.unique(np.concatenate(grid))
    edges = edges[(edges >= grid[0][0]) & (edges <= nyquist_hz)]
    return np.asarray(edges[np.concatenate([[True], np.diff(edges) > 1e-9 * nyquist_hz])])


def _joined(edges: FloatArray, panels: IntArray) -> Iterator[IntArray]:
    """Yield runs of panels, those that nearly touch together."""
    apart = edges[panels[1:]] > _GAP * edges[panels[:-1] + 1]
    yield from np.split(panels, np.nonzero(apart)[0] + 1)
