"""What competes in a league: each entry is a function from a split to what it leaves of the test.

An entry learns from the training of the split only, and what it leaves of a frame depends on that
frame and those before it. The best integrator in hindsight is the exception: it knows the test.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.identification import (
    ForwardSplit,
    LoopIdentifier,
    RecordedDesign,
    TrackingController,
    design_from_record,
    least_squares_predictor,
    spectral_design,
)
from lbt_synth.interop.pyrtc.replay import pyrtc_commands, pyrtc_version
from lbt_synth.methods.registry import method_named, plant_methods
from lbt_synth.methods.request import PlantInputs, design_request
from lbt_synth.models.loop_hardware import past_corrections
from lbt_synth.studies.league.integrators import hindsight_integrators, optimised_integrators
from lbt_synth.validation import FloatArray, choice

_TAPS = (32, 64)
_ORDERS = (10, 20)
_WINDOW_S = 4.0  # that the tracking controller identifies, at most half the training


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Entry:
    """One that competes."""

    name: str  # as --entries and files call it
    title: str  # in tables
    residual: Callable[[ForwardSplit], FloatArray]  # (frames, axes) of the test [nm]
    missing: str = ""  # why it cannot run here; empty if it can


def all_entries() -> dict[str, Entry]:
    """Return all entries by name; the methods of synthesis are those that need a plant only."""
    missing = "" if pyrtc_version() else 'not installed; try: pip install "lbt-synth[pyrtc]"'
    rivals = [
        Entry(name="ran", title="what ran", residual=_residual_of_what_ran),
        Entry(
            name="best-integrator",
            title="best integrator in hindsight",
            residual=lambda split: split.replay(hindsight_integrators(split)),
        ),
        Entry(
            name="optimised-gain",
            title="optimised modal gain",
            residual=lambda split: split.replay(optimised_integrators(split)),
        ),
        *(
            Entry(
                name=f"least-squares-{taps}",
                title=f"least squares, {taps} taps",
                residual=partial(_residual_of_taps, taps=taps),
            )
            for taps in _TAPS
        ),
        *(
            Entry(
                name=f"data-driven-{order}",
                title=f"data-driven H2, order {order}",
                residual=partial(_residual_of_order, order=order),
            )
            for order in _ORDERS
        ),
        *(
            Entry(
                name=f"pyrtc-{kind.replace('_', '-')}",
                title=f"pyRTC {kind}",
                residual=partial(_residual_of_pyrtc, kind=kind),
                missing=missing,
            )
            for kind in ("ar_kalman", "least_squares")
        ),
    ]
    ours = [
        Entry(
            name=name,
            title=method_named(name).title,
            residual=partial(_residual_of_method, name=name),
        )
        for name in plant_methods()
    ]
    ours += [
        Entry(name="tracking", title="tracking controller", residual=_residual_of_tracking),
        Entry(name="auto", title="automatic design", residual=_residual_of_auto),
    ]
    return {entry.name: entry for entry in (*rivals, *ours)}


def choose_entries(names: Sequence[str] | None) -> dict[str, Entry]:
    """Return the entries of some names, all of them for None, in their order."""
    known = all_entries()
    for name in names or ():
        choice(name, "an entry", tuple(known))
    return {name: entry for name, entry in known.items() if names is None or name in names}


def _residual_of_what_ran(split: ForwardSplit) -> FloatArray:
    if split.record.commands is None:
        raise ProblemError("nothing ran: the record is of an open loop")
    return split.measured()


def _residual_of_taps(split: ForwardSplit, *, taps: int) -> FloatArray:
    found = least_squares_predictor(
        split.open_loop, split.hardware, taps=taps, stretches=split.training
    )
    return split.replay(found.controller)


def _residual_of_order(split: ForwardSplit, *, order: int) -> FloatArray:
    controller = spectral_design(
        split.open_loop, split.hardware, order=order, stretches=split.training
    )
    return split.replay(controller)


def _residual_of_method(split: ForwardSplit, *, name: str) -> FloatArray:
    design = design_request(name, {}).build(PlantInputs(plant=split.model.plant()))
    return split.replay(design.controller)


def _residual_of_auto(split: ForwardSplit) -> FloatArray:
    """Return what the controller leaves that ``auto`` would have designed when the training ended.

    It chooses its method, and refuses what it would not write.
    """
    return split.replay(_design_automatically(split).design.controller)


@lru_cache(maxsize=1)  # of the two entries that need it
def _design_automatically(split: ForwardSplit) -> RecordedDesign:
    return design_from_record(split.past, **split.options)


def _residual_of_pyrtc(split: ForwardSplit, *, kind: str) -> FloatArray:
    """Return what a predictor of pyRTC leaves, with the delay in whole frames."""
    start, stop = max(split.training, key=lambda part: part[1] - part[0])
    horizon = max(1, round(split.hardware.delay_frames))

    def residual(series: FloatArray) -> FloatArray:
        commands = pyrtc_commands(kind, split.open_loop[start:stop], series, horizon=horizon)
        return series - past_corrections(split.hardware.mirror_taps, commands)

    return split.leave(residual)


def _residual_of_tracking(split: ForwardSplit) -> FloatArray:
    """Return what a controller leaves that goes on identifying; it starts two windows before.

    It begins with the automatic design; where there is none, with the model's filter. The sensor
    gain does not move in a league, so it is not looked for.
    """
    rate = split.hardware.frame_rate_hz
    past_s = sum(stop - start for start, stop in split.training) / rate
    window_s = min(_WINDOW_S, past_s / 2)
    try:
        plant = _design_automatically(split).model.plant()
    except LbtSynthError:
        plant = split.model.plant()
    identifier = LoopIdentifier(plant, find_gain=False)
    controller = TrackingController(plant, identifier, window_s=window_s)
    gains, taps = np.array(split.model.sensor_gains), split.hardware.mirror_taps

    def residual(series: FloatArray) -> FloatArray:
        controller.reset()
        left, commands = np.zeros_like(series), np.zeros((len(taps), series.shape[1]))
        for k, open_loop in enumerate(series):
            left[k] = open_loop - taps @ commands
            commands = np.roll(commands, 1, axis=0)
            commands[0] = controller.step(gains * left[k])
        return left

    return split.leave(residual, before=round(2 * window_s * rate))
