"""Residuals of several controllers on the same frames, and errors of their differences.

The standard error of a mean of correlated values is that of a circular block bootstrap: blocks of
b neighbours, drawn with replacement from the series closed to a circle (D. N. Politis, J. P.
Romano, in R. LePage, L. Billard (eds.), Exploring the Limits of Bootstrap, Wiley (1992), p. 263).
The variance of the mean over all draws is that of the means of all blocks over the number of
blocks in the series: nothing has to be drawn. The length b is a second or, where the
autocorrelation asks for more, that of least error of this variance
(D. N. Politis, H. White, Econometric Reviews 23, 53 (2004), doi:10.1081/ETC-120028836; corrected
by A. Patton, D. N. Politis, H. White, ibid. 28, 372 (2009), doi:10.1080/07474930802459016).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import DimensionError, ProblemError
from lbt_synth.validation import FloatArray, frozen_copy, integer, number, real_array, set_fields

CHUNK_S = 0.05  # mean squares are kept of so long: less than most blocks, more than most periods
_FEWEST = 8  # values that give an error
_FEWEST_BLOCKS = 4  # in a series
_LEAST_BLOCK = round(1.0 / CHUNK_S)  # chunks of a second
_QUIET_LAGS = 5  # insignificant autocorrelations in a row that end it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairedResiduals:
    """What several controllers leave of the same frames, in chunks of equal length.

    Parameters
    ----------
    squares_nm2 : mapping of str to (chunks,) array_like
        Mean square of the measured residual, noise included, summed over the axes, of each chunk
        of frames, in order [nm^2]; by name of the controller.
    noise_nm2 : float, optional
        Mean variance of the noise in them, summed over the axes [nm^2].

    Raises
    ------
    DimensionError
        If the controllers have different chunks.
    ProblemError
        If there is no controller, or there are fewer than 8 chunks.

    Examples
    --------
    >>> import numpy as np
    >>> import lbt_synth as lbt
    >>> common = np.random.default_rng(0).standard_normal(200) ** 2
    >>> pair = lbt.identification.PairedResiduals(
    ...     squares_nm2={"old": 100 + 50 * common, "new": 90 + 50 * common}, noise_nm2=20
    ... )
    >>> difference, error = pair.above("old", "new")
    >>> bool(abs(difference - 10) < 1e-9), bool(error < 1e-9), pair.best
    (True, True, 'new')
    """

    squares_nm2: Mapping[str, FloatArray]
    noise_nm2: float = 0.0

    def __post_init__(self) -> None:
        given = {
            name: frozen_copy(real_array(series, f"squares_nm2 of {name}"))
            for name, series in self.squares_nm2.items()
        }
        if not given:
            raise ProblemError("a comparison needs at least one controller; got none.")
        shapes = {series.shape for series in given.values()}
        if len(shapes) > 1 or len(next(iter(shapes))) != 1:
            raise DimensionError(
                f"all controllers must have the same chunks of frames; got {sorted(shapes)}."
            )
        if next(iter(shapes))[0] < _FEWEST:
            raise ProblemError(
                f"a comparison needs at least {_FEWEST} chunks of frames; got {shapes.pop()[0]}. "
                "Record more, or split less."
            )
        set_fields(self, squares_nm2=given, noise_nm2=number(self.noise_nm2, "noise_nm2"))

    @property
    def names(self) -> tuple[str, ...]:
        """The controllers, from the least measured residual to the largest."""
        return tuple(sorted(self.squares_nm2, key=self.measured_nm2))

    @property
    def best(self) -> str:
        """The controller of least measured residual."""
        return self.names[0]

    def measured_nm2(self, name: str) -> float:
        """Return the mean square of a measured residual, noise included [nm^2]."""
        return float(np.mean(self._series(name)))

    def residual_nm2(self, name: str) -> float:
        """Return the variance of a residual without noise [nm^2]; may be below 0 by its error."""
        return self.measured_nm2(name) - self.noise_nm2

    def error_nm2(self, name: str) -> float:
        """Return the standard error of a mean square [nm^2]."""
        return _error_of_chunks(self._series(name))

    def above(self, name: str, other: str) -> tuple[float, float]:
        """Return by how much a residual is above another, and its standard error [nm^2].

        On the same frames the noise and most of the disturbance cancel: the error is smaller than
        that of either.
        """
        differences = self._series(name) - self._series(other)
        return float(np.mean(differences)), _error_of_chunks(differences)

    def _series(self, name: str) -> FloatArray:
        if name not in self.squares_nm2:
            raise ProblemError(
                f"the controller must be one of {', '.join(self.squares_nm2)}; got {name!r}."
            )
        return self.squares_nm2[name]


def chunk_squares(measured: FloatArray, frame_rate_hz: float) -> FloatArray:
    """Return the mean squares (chunks,) of a residual (frames, n), summed over the axes.

    Frames at the end that do not fill a chunk are left out.
    """
    frames = max(1, round(CHUNK_S * frame_rate_hz))
    count = len(measured) // frames
    squares = np.sum(measured[: count * frames] ** 2, axis=1)
    return np.asarray(np.mean(squares.reshape(count, frames), axis=1))


def _error_of_chunks(series: FloatArray) -> float:
    """Return the error of the mean of chunks, with blocks of a second at least.

    Lines that beat have autocorrelations too small to be seen at one lag, and too many to matter
    little.
    """
    longest = len(series) // _FEWEST_BLOCKS
    return bootstrap_error(series, min(max(choose_block_length(series), _LEAST_BLOCK), longest))


def bootstrap_error(series: ArrayLike, block: int | None = None) -> float:
    """Return the standard error of a correlated series' mean, by a circular block bootstrap.

    It is that of infinitely many draws, as none are made. The series (n,) has at least 8 values, a
    block at most a quarter of them; by default :func:`choose_block_length`.
    """
    values = real_array(series, "series")
    n = len(values)
    if block is None:
        length = choose_block_length(values)
    else:
        length = integer(block, "block", at_least=1, at_most=n // _FEWEST_BLOCKS)
    sums = np.concatenate([[0.0], np.cumsum(np.concatenate([values, values[: length - 1]]))])
    means = (sums[length:] - sums[:-length]) / length
    # blocks share the mean of the series: one degree of freedom less, as for single values
    return float(np.sqrt(np.mean((means - np.mean(values)) ** 2) / (n / length - 1)))


def choose_block_length(series: ArrayLike) -> int:
    """Return the length of blocks that Politis and White found best for such a series (n,).

    It is at most a quarter of the values, of which there are at least 8.
    """
    values = real_array(series, "series")
    n = len(values)
    if n < _FEWEST:
        raise ProblemError(f"an error needs at least {_FEWEST} values; got {n}.")
    centred = values - np.mean(values)
    most = min(int(np.ceil(np.sqrt(n))) + _QUIET_LAGS, n - 1)
    covariance = np.array([centred[: n - lag] @ centred[lag:] / n for lag in range(most + 1)])
    if covariance[0] <= 0:
        return 1
    quiet = np.abs(covariance[1:] / covariance[0]) < 2 * np.sqrt(np.log10(n) / n)
    rows = np.lib.stride_tricks.sliding_window_view(quiet, min(_QUIET_LAGS, most)).all(axis=1)
    last = int(np.argmax(rows)) if rows.any() else most
    width = max(min(2 * last, most), 1)
    lags = np.arange(1, width + 1)
    flat_top = np.minimum(1.0, 2 * (1 - lags / width)) * covariance[1 : width + 1]
    spectrum = covariance[0] + 2 * np.sum(flat_top)
    slope = 2 * np.sum(lags * flat_top)
    if spectrum <= 0:  # as of a difference: neighbours cancel
        return 1
    length = np.ceil((1.5 * (slope / spectrum) ** 2 * n) ** (1 / 3))
    return int(np.clip(length, 1, n // _FEWEST_BLOCKS))
