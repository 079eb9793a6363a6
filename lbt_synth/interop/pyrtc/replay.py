"""The predictors of pyRTC on a recorded series."""

from __future__ import annotations

from importlib import metadata

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import MissingExtraError, ProblemError
from lbt_synth.validation import FloatArray, integer, matrix

_DISTRIBUTION = "pyrtcao"  # the distribution pyrtc on PyPI is another program


def pyrtc_version() -> str | None:
    """Return the version of pyRTC that is installed, or None."""
    try:
        return metadata.version(_DISTRIBUTION)
    except metadata.PackageNotFoundError:
        return None


def pyrtc_commands(
    kind: str, training: ArrayLike, series: ArrayLike, *, horizon: int = 2
) -> FloatArray:
    """Return the commands of a predictor of pyRTC, fitted to one series and run over another.

    Its loop subtracts the applied command from the residual, as a replay does; the prediction is
    the command.

    Parameters
    ----------
    kind : str
        Name of the predictor in pyRTC, such as ``ar_kalman`` or ``least_squares``.
    training : (frames, modes) array_like
        Contiguous pseudo-open-loop series to fit it to [nm].
    series : (frames, modes) array_like
        Series that it runs over [nm].
    horizon : int, optional
        Whole frames ahead that it predicts: the delay of the loop.

    Returns
    -------
    (frames, modes) ndarray
        u(k), which depends on the series up to frame k [nm].

    Raises
    ------
    MissingExtraError
        If pyRTC is not installed: ``pip install "lbt-synth[pyrtc]"``.
    ProblemError
        If pyRTC refuses the predictor or the series.

    Examples
    --------
    >>> from lbt_synth.interop import pyrtc_commands
    >>> pyrtc_commands("persistence", [[1.0]], [[2.0]], horizon=0)
    Traceback (most recent call last):
        ...
    lbt_synth.errors.ProblemError: horizon must be at least 1; got 0.
    """
    past, now = matrix(training, "training"), matrix(series, "series")
    frames_ahead = integer(horizon, "horizon", at_least=1)
    if pyrtc_version() is None:
        raise MissingExtraError(
            'the predictors of pyRTC need pyrtcao; try: pip install "lbt-synth[pyrtc]".',
            extra="pyrtc",
        )
    from lbt_synth.interop.pyrtc import plugin

    try:
        options = {"type": kind, "horizon": frames_ahead}
        predictor = plugin.register().make_predictor(options, past.shape[1])
        predictor.fit(past)
        predictor.reset()
        commands = np.zeros(now.shape)
        for k, measured in enumerate(now):
            predictor.update(measured)
            commands[k] = predictor.predict()
    except (ValueError, np.linalg.LinAlgError) as error:
        raise ProblemError(f"pyRTC's predictor {kind} failed: {error}.") from error
    return commands
