"""Guesses of how the commands of a record reach its measurements, and the likelihood of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from lbt_synth.identification.commands.coarse_spectrum import (
    CoarseAxis,
    CoarseFit,
    coarse_axis,
    fit_guesses,
    fit_profile,
    segment_transforms,
)
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.models.loop_hardware import past_corrections
from lbt_synth.validation import ComplexArray, FloatArray

GuessKind: TypeAlias = Literal["as given", "matrix", "shift", "increments"]
SHIFTS = (-3, -2, -1, 1, 2, 3)  # frames
_SIGNS = ((1, 1), (-1, -1), (1, -1), (-1, 1))
_MARGIN = 5  # frames of a stretch, on either side, that no shift leaves
_SHORTEST = 512
_NATURAL_GAINS = np.array([0.2, 0.7, 2.0])  # starts, of the natural gain
_NATURAL = 0.4
_STEADY = 1e-24  # of the measured power
_ENOUGH = 1.5  # mean deviance of a band that the coarse spectrum describes


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Guess:
    """How recorded commands may reach the measurements."""

    kind: GuessKind
    matrix: FloatArray | None = None  # from commands to the axes of the measurements, (axes, axes)
    shift_frames: int = 0  # by which the delay is longer than given

    @property
    def is_simple(self) -> bool:
        """Whether the matrix, if there is one, has only signs and exchanged axes."""
        return self.matrix is None or bool(np.all(np.isin(np.abs(self.matrix), (0, 1))))

    def unturned_corrections(self, record: LoopRecord) -> FloatArray:
        """Return the corrections in the measurements, but for the matrix, (frames, axes) [nm]."""
        assert record.commands is not None
        u = record.commands
        if self.kind == "increments":
            u = np.cumsum(u, axis=0)
        return np.roll(past_corrections(record.mirror_taps, u), self.shift_frames, axis=0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison:
    """Guesses on one record."""

    guesses: tuple[Guess, ...]
    axis_contrast: FloatArray  # minus the log-likelihood of each axis, (axes, guesses)
    gain: FloatArray  # best gain of the sensor, (axes, guesses)
    misfit: FloatArray  # mean deviance of a band: about 1 if the coarse spectrum fits, (guesses,)

    @property
    def contrast(self) -> FloatArray:
        """Minus the log-likelihood of each guess, (guesses,)."""
        return np.asarray(self.axis_contrast.sum(axis=0))

    def dispersion(self, i: int) -> float:
        """Return the factor by which a misfit of guess i raises what decides, at least 1."""
        return max(1.0, float(self.misfit[i]) / _ENOUGH)


def list_guesses(record: LoopRecord, *, earliest_frames: float) -> list[Guess]:
    """Return the guesses for a record, the first as given.

    ``earliest_frames`` is the least total delay at which a correction still follows from the
    past of the measurements.
    """
    assert record.delay_frames is not None
    out = [Guess(kind="as given")]
    out += [Guess(kind="matrix", matrix=matrix) for matrix in _matrices(record.axes)]
    least = earliest_frames - record.delay_frames
    out += [Guess(kind="shift", shift_frames=shift) for shift in SHIFTS if shift >= least]
    out.append(Guess(kind="increments"))
    return out


def _matrices(axes: int) -> list[FloatArray]:
    """Return the signs and exchanges from commands to the axes of the measurements."""
    if axes == 1:
        return [-np.eye(1)]
    plain = [np.diag(np.array(signs, dtype=float)) for signs in _SIGNS]
    return [*plain[1:], *(signs[:, ::-1] for signs in plain)]


class CoarseRecord:
    """The transforms of one record, on which guesses are compared; none without ``stretches``.

    ``resonances`` are known ones that the spectra of the axes may show, by frequency [Hz] and
    damping ratio.
    """

    def __init__(
        self,
        record: LoopRecord,
        resonances: Sequence[Sequence[tuple[float, float]]] | None = None,
    ) -> None:
        self.record = record
        self.resonances = [()] * record.axes if resonances is None else resonances
        trimmed = [(a + _MARGIN, b - _MARGIN) for a, b in record.stretches()]
        self.stretches = [(a, b) for a, b in trimmed if b - a >= _SHORTEST]
        self._known: dict[tuple[bool, int], ComplexArray] = {}
        if self.stretches:
            every = self._transform(record.measurements)
            self.frequency_hz, self.measured, self.independent = every

    def _transform(self, series: FloatArray) -> tuple[FloatArray, ComplexArray, float]:
        return segment_transforms(series, self.stretches, self.record.frame_rate_hz)

    def transform(self, guess: Guess) -> ComplexArray:
        """Return the transforms of the corrections of a guess, (axes, segments, f)."""
        key = (guess.kind == "increments", guess.shift_frames)
        if key not in self._known:
            self._known[key] = self._transform(guess.unturned_corrections(self.record))[1]
        out = self._known[key]
        return out if guess.matrix is None else np.tensordot(guess.matrix, out, 1)

    def corrections(self, guess: Guess) -> FloatArray:
        """Return the corrections of a guess as series, (frames, axes) [nm]."""
        out = guess.unturned_corrections(self.record)
        return out if guess.matrix is None else out @ guess.matrix.T

    def compare(self, guesses: Sequence[Guess]) -> Comparison:
        """Return the likelihood of each guess, at its best gains."""
        corrections = np.array([self.transform(guess) for guess in guesses])
        fits = [self._fit_axis(i, corrections[:, i]) for i in range(self.record.axes)]
        contrast, gain, misfit = (np.array(values) for values in zip(*fits, strict=True))
        return Comparison(
            guesses=tuple(guesses),
            axis_contrast=contrast,
            gain=gain,
            misfit=np.mean(misfit, axis=0),
        )

    def profile(self, guess: Guess, gains: FloatArray) -> FloatArray:
        """Return the contrasts (axes, n) at gains (axes, n)."""
        each = enumerate(zip(self.transform(guess), gains, strict=True))
        return np.array([fit_profile(self._axis(i, c[None]), g)[0] for i, (c, g) in each])

    def unrelated(self) -> float:
        """Return the contrast of commands that do not reach the measurements."""
        nothing = np.zeros((self.record.axes, 1))
        return float(np.sum(self.profile(Guess(kind="as given"), nothing)))

    def _axis(self, i: int, corrections: ComplexArray) -> CoarseAxis:
        """Return the bands of one axis, for all guesses of its corrections."""
        return coarse_axis(
            self.frequency_hz,
            self.measured[i],
            corrections,
            independent=self.independent,
            frame_rate_hz=self.record.frame_rate_hz,
            resonances=self.resonances[i],
        )

    def _fit_axis(self, i: int, corrections: ComplexArray) -> CoarseFit:
        """Fit all guesses of one axis, from multiples of the gain that is natural for each."""
        high = self.frequency_hz > 0.05 * self.record.frame_rate_hz
        level = np.mean(abs(self.measured[i][:, high]) ** 2)
        steps = np.mean(abs(corrections[..., high]) ** 2, axis=(1, 2))
        least = max(_STEADY * level, np.finfo(float).tiny)  # clipped commands may hardly move
        natural = _NATURAL * np.sqrt(level / np.maximum(steps, least))
        return fit_guesses(self._axis(i, corrections), natural[:, None] * _NATURAL_GAINS)
