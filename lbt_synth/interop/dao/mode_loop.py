"""The loop of one mode around a direct form: what it leaves, and what its arithmetic adds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.design.shaping.channel import Channel, laguerre_basis
from lbt_synth.design.shaping.objectives import (
    ResidualVariance,
    VibrationBand,
    leaves,
    spectrum_of,
)
from lbt_synth.design.shaping.specification import Specification
from lbt_synth.design.shaping.uncertainty import SensorGainRange
from lbt_synth.interop.written_loop import ROUNDOFF
from lbt_synth.models import LoopHardware
from lbt_synth.validation import ComplexArray, FloatArray

# Mean square of the relative error of an operation. The error is uniform within half a step, and a
# step is 2^-24 to 2^-23 of the number: of normal numbers of any size the mean square is at most
# 0.544 of what it would be if all steps were the widest, of a sinusoid 0.66.
ROUNDING = 2 / 3 * ROUNDOFF["single"] ** 2 / 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scenario:
    """What disturbs one mode at a sensor gain, at the loop's frequencies."""

    sensor_gain: float
    phase_nm2: FloatArray  # (F,) power of turbulence and skirts at each node
    noise_nm2: FloatArray  # (F,)
    line_nm: FloatArray  # (F,) rms of the vibration that may be there, or 0
    spread_nm2: FloatArray  # (F,) its power, spread evenly over its band


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DirectFormLoop:
    """One mode, whose controller is ``c = (b_0 .. b_M, a_1 .. a_M)``.

    With the path of the loop L (delay and mirror) and the polynomials in ``z^-1``
    ``b = sum b_j z^-j`` and ``a = 1 - sum a_i z^-i``, the loop at the sensor gain g has the
    polynomial ``p = a + g L b``; it leaves ``a / p`` of the phase and ``L b / p`` of the noise.
    """

    powers: ComplexArray  # (F, M + 1), z^-j at each node
    path: ComplexArray  # (F,)
    path_taps: FloatArray  # of the path, in powers of z^-1
    shares: FloatArray  # (F,) of the frequencies that a node stands for; their sum is 1
    scenarios: tuple[Scenario, ...]
    low: float  # ends of the sensor gains for which the loop is to be stable
    high: float

    @property
    def order(self) -> int:
        """M."""
        return int(self.powers.shape[1]) - 1

    def polynomials(self, c: FloatArray, sensor_gain: float) -> tuple[ComplexArray, ...]:
        """Return a, b and p at the nodes, (F,) each."""
        b = self.powers @ c[: self.order + 1]
        a = 1 - self.powers[:, 1:] @ c[self.order + 1 :]
        return a, b, a + sensor_gain * self.path * b

    def residuals_nm(self, c: FloatArray) -> FloatArray:
        """Return the rms of the residual in each scenario, in exact arithmetic [nm]."""
        found = []
        for s in self.scenarios:
            a, b, p = self.polynomials(c, s.sensor_gain)
            variance = s.phase_nm2 @ np.abs(a / p) ** 2
            variance += s.noise_nm2 @ np.abs(self.path * b / p) ** 2
            found.append(np.sqrt(variance + np.max(s.line_nm * np.abs(a / p)) ** 2))
        return np.array(found)

    def rounding_matrix(self, c: FloatArray, s: Scenario) -> FloatArray:
        """Return the matrix V with which ``c' V c`` is the variance of the sums' rounding [nm^2].

        Each product and each partial sum is rounded. Their sizes are those of the measurements and
        commands that the loop around c remembers.
        """
        a, b, p = self.polynomials(c, s.sensor_gain)
        memory = np.hstack([self.powers * (a / p)[:, None], self.powers[:, 1:] * (b / p)[:, None]])
        phase = s.phase_nm2 + s.spread_nm2
        size = np.sqrt(s.sensor_gain**2 * phase + s.noise_nm2)[:, None] * memory
        moments = (size.conj().T @ size).real
        index = np.arange(c.size)
        after = c.size - np.maximum(np.maximum.outer(index, index), 1)  # sums that hold both terms
        variance: FloatArray = ROUNDING * (moments * after + np.diag(np.diag(moments)))
        return variance

    def sums_nm2(self, c: FloatArray, sensor_gain: float) -> float:
        """Return the variance of the rounding of the sums at a sensor gain of a scenario."""
        (scenario,) = (s for s in self.scenarios if s.sensor_gain == sensor_gain)
        return float(c @ self.rounding_matrix(c, scenario) @ c)

    def rounding_nm(self, c: FloatArray) -> FloatArray:
        """Return the rms of the residual that the arithmetic adds in each scenario [nm]."""
        found = []
        for s in self.scenarios:
            p = self.polynomials(c, s.sensor_gain)[2]
            gain = self.shares @ np.abs(self.path / p) ** 2
            found.append(np.sqrt(self.sums_nm2(c, s.sensor_gain) * gain))
        return np.array(found)

    def slopes(self, c: FloatArray) -> FloatArray:
        """Return the relative change of p with each coefficient, at all sensor gains, as reals."""
        parts = []
        for gain in {1.0, self.low, self.high, *(s.sensor_gain for s in self.scenarios)}:
            p = self.polynomials(c, gain)[2][:, None]
            on_b = gain * self.path[:, None] * self.powers
            parts.append(np.hstack([on_b, -self.powers[:, 1:]]) / p)
        both = np.concatenate(parts)
        return np.concatenate([both.real, both.imag])

    def radius(self, c: FloatArray, sensor_gains: FloatArray) -> float:
        """Return the largest spectral radius over sensor gains."""
        M, extra = self.order, self.path_taps.size - 1
        a = np.concatenate([[1.0], -c[M + 1 :], np.zeros(extra)])
        coefficients = a + np.asarray(sensor_gains)[:, None] * np.convolve(
            self.path_taps, c[: M + 1]
        )
        companion = np.tile(np.eye(M + extra, k=-1), (len(sensor_gains), 1, 1))
        companion[:, 0] = -coefficients[:, 1:] / coefficients[:, :1]
        return float(np.max(np.abs(np.linalg.eigvals(companion))))


def shaped_mode_loop(
    hardware: LoopHardware, specification: Specification, order: int
) -> DirectFormLoop:
    """Return the loop of one mode of a shaped design, at the frequencies that it was shaped at."""
    single = hardware.single_mode()
    channel = Channel(hardware=single, basis=laguerre_basis(1, 0.0, dt_s=single.dt_s))
    grid = specification.grid(channel, fineness=2)
    terms = leaves(specification.objective)
    bands = [term for term in terms if isinstance(term, VibrationBand)]
    inside = [grid.within(band.low_hz, band.high_hz) for band in bands]
    more = np.concatenate([grid.points_hz, *inside])
    f = np.concatenate([grid.nodes_hz, more])
    width = np.concatenate([grid.weights_hz, np.zeros(more.size)])
    scenarios = []
    for gain in sorted({term.sensor_gain for term in terms}, reverse=True):
        phase, noise, line, spread = np.zeros((4, f.size))
        for term in terms:
            if term.sensor_gain != gain:
                continue
            spectrum = spectrum_of(term, single.frame_rate_hz)
            phase += 0.0 if spectrum is None else width * spectrum.psd(f)
            if isinstance(term, ResidualVariance):
                noise += width / channel.nyquist_hz * term.noise_nm**2
            else:
                covered = (f >= term.low_hz) & (f <= term.high_hz)
                line = np.hypot(line, np.where(covered, term.rms_nm, 0.0))
                evenly = np.where(covered, width, 0.0)
                spread += term.rms_nm**2 * evenly / np.sum(evenly)
        scenarios.append(
            Scenario(
                sensor_gain=gain, phase_nm2=phase, noise_nm2=noise, line_nm=line, spread_nm2=spread
            )
        )
    ranges = [d for d in specification.demands if isinstance(d, SensorGainRange)]
    powers = np.exp(-2j * np.pi * np.outer(f * single.dt_s, np.arange(order + 1)))
    taps = np.concatenate([[0.0], single.mirror_taps])
    return DirectFormLoop(
        powers=powers,
        path=np.exp(-2j * np.pi * np.outer(f * single.dt_s, np.arange(taps.size))) @ taps,
        path_taps=taps,
        shares=width / channel.nyquist_hz,
        scenarios=tuple(scenarios),
        low=min([1.0, *(r.low for r in ranges)]),
        high=max([1.0, *(r.high for r in ranges)]),
    )
