"""How a channel follows the lines of a band: weighted least squares with both noises.

Given the wavefront, the readings of a channel are normal with the mean ``expected F`` and the
variance ``noise + F* unseen F``: what the wavefront leaves open of the lines moves the channel,
too. The factors F are found with these weights, in turn with the noise, whose median is robust
against lines of the channel's own. An error of a sensor gain moves all factors in one direction;
it has its own part in their errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbt_synth.identification.accelerometers.line_bands import LineBand
from lbt_synth.validation import ComplexArray, FloatArray

_STEPS = 30
_INDEPENDENT = 2 / 3  # of the values of a sine-tapered transform
_NEIGHBOURS = -0.5  # their correlation
_DOUBT = 0.01  # chance below which a channel moves at a line more than its noise explains
_FLOOR = 1e-9  # of a channel's power


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BandFit:
    """Factors of one channel for the lines of a band."""

    readings: ComplexArray  # (f,): without the lines of other bands
    factors: ComplexArray  # (lines,)
    variances: FloatArray  # (lines,): of the complex factors, for the gains of the model
    slopes: ComplexArray  # (lines, axes): of the factors, for a standard error of each sensor gain
    chances: FloatArray  # (lines,): that a channel without a line would show as much
    coherences: FloatArray  # (lines,)
    noise: FloatArray  # (lines,): density near each line [(m/s^2)^2/Hz]
    weights: FloatArray  # (f,): inverse variances

    def errors(self, j: int) -> tuple[float, float]:
        """Return the standard errors of a factor along itself, and across: of size and phase."""
        turned = self.slopes[j] * np.exp(-1j * np.angle(self.factors[j]))
        scatter = self.variances[j] / 2
        along, across = (np.sqrt(scatter + np.sum(part**2)) for part in (turned.real, turned.imag))
        return float(along), float(across)


def fit_band(band: LineBand, channel: int, others: ComplexArray) -> BandFit:
    """Fit the factors of a channel for the lines of a band, given those of all other lines."""
    own, whole = list(band.lines), others.copy()
    whole[own] = 0
    a, x = band.readings[:, channel] - band.expected @ whole, band.expected[:, own]
    factors = whole[own]
    power = float(np.mean(np.abs(a) ** 2))
    noise, open_part = power, np.zeros(len(a))
    for _ in range(_STEPS):
        level = np.median(np.abs(a - x @ factors) ** 2 / (noise + open_part)) / np.log(2)
        noise = max(noise * float(level), _FLOOR * power)
        weights = 1 / (noise + open_part)
        info = x.conj().T @ (weights[:, None] * x)
        factors = np.asarray(
            np.linalg.lstsq(info, x.conj().T @ (weights * a))[0], dtype=np.complex128
        )
        whole[own] = factors
        open_part = np.einsum("j,fjk,k->f", whole.conj(), band.unseen, whole).real
    inverse = np.linalg.pinv(info)
    variances = np.diag(inverse @ _spread(np.sqrt(weights)[:, None] * x, band) @ inverse).real
    change = np.einsum("fja,j->fa", band.moved, whole)
    slopes = np.asarray(-inverse @ (x.conj().T @ (weights[:, None] * change)))
    return _judge(band, a, factors, variances, slopes, noise, weights)


def _spread(rows: ComplexArray, band: LineBand) -> ComplexArray:
    """Return the covariance of ``rows^H n`` for tapered white noise n of variance 1."""
    across = _NEIGHBOURS * (rows[:-1].conj().T @ (band.follows[:, None] * rows[1:]))
    return np.asarray(rows.conj().T @ rows + across + across.conj().T)


def _judge(
    band: LineBand,
    a: ComplexArray,
    factors: ComplexArray,
    variances: FloatArray,
    slopes: ComplexArray,
    noise: float,
    weights: FloatArray,
) -> BandFit:
    """Test each line, with larger errors where the channel moves in its own way there."""
    from scipy.special import gammaincc

    x, lines = band.expected[:, list(band.lines)], len(factors)
    error = a - x @ factors
    variances, own = variances.copy(), np.full(lines, noise)
    chances, coherences = np.ones(lines), np.zeros(lines)
    for j in range(lines):
        share = np.abs(x[:, j]) ** 2 * weights
        share = share / max(share.sum(), np.finfo(float).tiny)
        values = max(_INDEPENDENT / float(np.sum(share**2)), 1.0)
        excess = float(share @ (np.abs(error) ** 2 * weights))
        left = max(values - 1, 0.5)
        more, degrees = max(excess * values / left, 1.0), max(_INDEPENDENT * len(a) - lines, 1.0)
        ratio = abs(factors[j]) ** 2 / max(variances[j], np.finfo(float).tiny)
        if gammaincc(left, excess * values) < _DOUBT:
            ratio, degrees = ratio / more, left
            own[j] += max(float(share @ (np.abs(error) ** 2 - 1 / weights)), 0.0)
        variances[j] *= more
        chances[j] = np.exp(-degrees * np.log1p(ratio / degrees))
        core = band.core[:, j]
        alone = error[core] + x[core, j] * factors[j]
        powers = np.sum(np.abs(alone) ** 2) * np.sum(np.abs(x[core, j]) ** 2)
        coherences[j] = abs(np.vdot(x[core, j], alone)) ** 2 / max(powers, np.finfo(float).tiny)
    return BandFit(
        readings=a,
        factors=factors,
        variances=variances,
        slopes=slopes,
        chances=chances,
        coherences=coherences,
        noise=own,
        weights=weights,
    )
