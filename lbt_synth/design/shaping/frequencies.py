"""Frequencies at which a specification is imposed: bands, nodes of quadrature, points of bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lbt_synth.design.shaping.channel import Channel
from lbt_synth.linear.convex_functions import Discs
from lbt_synth.linear.quadrature import gauss_panels
from lbt_synth.models import ARModel, Spectrum
from lbt_synth.models.spectra import breakpoints_below
from lbt_synth.validation import ComplexArray, FloatArray

ROOM = 1e-3  # part of a bound that the programme leaves for what lies between its points
_ORDER = 5
_BAND_POINTS = 15
_MOST_EDGES = 400


def band_text(low_hz: float, high_hz: float) -> str:
    """Return a band in words."""
    return f"{low_hz:g}-{high_hz:g} Hz"


def discs(frequency_hz: FloatArray, rows: ComplexArray, centre: float, radius: float) -> Discs:
    """Return discs ``|centre + rows c| <= radius`` at frequencies."""
    centres = np.full(frequency_hz.size, centre, dtype=np.complex128)
    radii = np.full(frequency_hz.size, radius)
    return Discs(frequency_hz=frequency_hz, rows=rows, centres=centres, radii=radii)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grid:
    """Nodes of the quadrature for variances, and points at which bounds are imposed."""

    nodes_hz: FloatArray  # (F,), from 0 to the Nyquist frequency
    weights_hz: FloatArray  # (F,)
    points_hz: FloatArray  # (P,), more are added until the bounds hold between them

    def within(self, low_hz: float, high_hz: float) -> FloatArray:
        """Points of a band, with its ends and some more."""
        inside = self.points_hz[(self.points_hz > low_hz) & (self.points_hz < high_hz)]
        return np.unique(np.concatenate([inside, np.linspace(low_hz, high_hz, _BAND_POINTS)]))


def first_grid(
    channel: Channel,
    bands: Sequence[tuple[float, float]],
    spectra: Sequence[Spectrum],
    fineness: int,
) -> Grid:
    """Lay panels: geometric at low frequencies, finer in the bands and at slow poles."""
    rate, nyquist = channel.hardware.frame_rate_hz, channel.nyquist_hz
    edges = [
        np.array([0.0]),
        np.geomspace(6e-5, 0.01, 13 * fineness + 1) * rate,
        np.geomspace(0.0125, 0.5, 24 * fineness + 1) * rate,
        *(_thin_spectrum_edges(spectrum, nyquist) for spectrum in spectra),
    ]
    for low, high in bands:
        width = high - low
        ends = max(low - width, 0), min(high + width, nyquist)
        edges.append(np.linspace(*ends, 12 * fineness + 1))
    for pole in channel.basis.poles:
        centre, width = abs(np.angle(pole)), 1 - abs(pole)
        if width < 0.05:
            offsets = np.array([-4.0, -1.0, 1.0, 4.0]) * width
            edges.append((centre + offsets) / (2 * np.pi) * rate)
    every = np.unique(np.clip(np.concatenate(edges), 0, nyquist))
    every = every[np.concatenate([[True], np.diff(every) > 1e-8 * nyquist])]
    nodes, weights = gauss_panels(every, _ORDER)
    points = np.unique(np.concatenate([np.linspace(0, nyquist, 128 * fineness), every]))
    return Grid(nodes_hz=nodes, weights_hz=weights, points_hz=points)


def fine_frequencies(channel: Channel, count: int) -> FloatArray:
    """Frequencies at which the bounds are checked between the points [Hz]."""
    poles, even = channel.basis.poles, np.linspace(0, 0.5, count)
    low = np.geomspace(1e-5, 0.1, count // 2)
    centres, widths = np.abs(np.angle(poles)) / (2 * np.pi), (1 - np.abs(poles)) / (2 * np.pi)
    offsets = np.linspace(-3, 3, 13)
    near = (centres[:, None] + widths[:, None] * offsets).ravel()
    turns = np.unique(np.clip(np.concatenate([even, low, near]), 0, 0.5))
    return turns * channel.hardware.frame_rate_hz


def spectrum_edges(spectrum: Spectrum | None, nyquist_hz: float) -> FloatArray:
    """Frequencies at which a spectrum has kinks or lines, for panels of a quadrature [Hz]."""
    if spectrum is None:
        return np.zeros(0)
    if isinstance(spectrum, ARModel):
        poles = np.linalg.eigvals(spectrum.companion)
        centres, widths = np.abs(np.angle(poles)), 1 - np.abs(poles)
        offsets = np.array([-16.0, -4.0, -1.0, 0.0, 1.0, 4.0, 16.0])
        angles = (centres[:, None] + widths[:, None] * offsets).ravel()
        return np.asarray(np.clip(angles * spectrum.frame_rate_hz / (2 * np.pi), 0, nyquist_hz))
    return breakpoints_below(spectrum, nyquist_hz)


def _thin_spectrum_edges(spectrum: Spectrum, nyquist_hz: float) -> FloatArray:
    """Return these edges, of many only as many as a programme can carry: the highest [Hz]."""
    edges = spectrum_edges(spectrum, nyquist_hz)
    if edges.size <= _MOST_EDGES:
        return edges
    power = np.asarray(spectrum.psd(edges)) * np.gradient(edges)
    high = np.argsort(power)[-_MOST_EDGES // 2 :]
    even = np.arange(0, edges.size, max(edges.size // (_MOST_EDGES // 2), 1))
    return np.asarray(edges[np.unique(np.concatenate([high, even]))])
