"""The facts of disturbances, as plants and truths show them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from lbt_synth.models.ar_model import ARModel
from lbt_synth.models.spectra import Spectrum
from lbt_synth.models.vibration import DriftingVibration, TrueVibration
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import column, table_row
from lbt_synth.validation import FloatArray

_DIGITS = ".4g"
_MOST_LINES = 6  # vibrations that are listed, the strongest


@table_row
class DisturbanceFacts:
    """Turbulence, vibrations and noise, in words."""

    turbulence: str = column("turbulence")
    vibrations: str = column("vibrations")
    noise_nm: str = column("noise per frame")
    sensor_gain: float | None = column("sensor gain over the assumed one")


def disturbance_facts(
    turbulence: Iterable[Spectrum | None],
    vibrations: Sequence[TrueVibration],
    noise_nm: FloatArray,
    sensor_gain: float | None = None,
) -> DisturbanceFacts:
    """Return the facts of disturbances; what axes have in common is said once."""
    return DisturbanceFacts(
        turbulence=_join(_spectrum_text(each) for each in turbulence),
        vibrations=_vibrations_text(vibrations),
        noise_nm=_join(nm_text(noise, _DIGITS) for noise in np.ravel(noise_nm)),
        sensor_gain=sensor_gain,
    )


def _join(texts: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(texts))


def _spectrum_text(spectrum: Spectrum | None) -> str:
    if spectrum is None:
        return "none"
    if isinstance(spectrum, ARModel):
        return f"AR{spectrum.order} {nm_text(spectrum.rms_nm, _DIGITS)}"
    rms_nm = getattr(spectrum, "tilt_rms_nm", None)
    size = f" {nm_text(rms_nm, _DIGITS)}" if isinstance(rms_nm, float) else ""
    return f"{type(spectrum).__name__}{size}"


def _vibrations_text(vibrations: Sequence[TrueVibration]) -> str:
    """Return size and frequency of the strongest vibrations, by frequency."""
    strongest = sorted(vibrations, key=lambda line: -line.rms_nm)[:_MOST_LINES]
    texts = sorted((_frequency(line), line.rms_nm) for line in strongest)
    more = len(vibrations) - len(strongest)
    listed = [
        f"{nm_text(rms_nm, _DIGITS)} at {frequency_hz:.4g} Hz" for frequency_hz, rms_nm in texts
    ]
    return ", ".join(listed + ([f"{more} more"] if more else []))


def _frequency(line: TrueVibration) -> float:
    return line.start_hz if isinstance(line, DriftingVibration) else line.frequency_hz
