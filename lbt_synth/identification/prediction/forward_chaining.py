"""Forward chaining: train on the past of a record, score on what follows, several times.

The usable frames after the first half are divided into as many tests as there are splits. What is
tested on one of them is trained on everything before it, sensor gain and noise included, so that
all that compete on a split see the same pseudo-open-loop series and the same frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from lbt_synth.design import Design
from lbt_synth.errors import LbtSynthError, ProblemError
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.fit.identify import identify
from lbt_synth.identification.prediction.residual import (
    ResidualEstimate,
    estimate_residual,
    gather,
    replay,
    settled_test,
)
from lbt_synth.identification.records.record import LoopRecord
from lbt_synth.identification.stretches import Stretches, forward_splits
from lbt_synth.linear import Controller
from lbt_synth.linear.held_controller import as_controller
from lbt_synth.loop import close_loop
from lbt_synth.models import LoopHardware
from lbt_synth.validation import FloatArray, require_instance

_LEAST_TEST_S = 1.0


def record_splits(
    record: LoopRecord, splits: int, *, first_share: float = 0.5
) -> tuple[tuple[Stretches, Stretches], ...]:
    """Return the :func:`forward_splits` of a record; refuse tests of less than a second."""
    require_instance(record, LoopRecord)
    pairs = forward_splits(
        record.stretches(), record.frames, splits=splits, first_share=first_share
    )
    least = round(_LEAST_TEST_S * record.frame_rate_hz)
    shortest = min(sum(stop - start for start, stop in test) for _, test in pairs)
    if shortest < least:
        raise ProblemError(
            f"each test needs {least} usable frames ({_LEAST_TEST_S:g} s); with {splits} splits "
            f"the shortest has {shortest}. Record more, or split less."
        )
    return pairs


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ForwardSplit:
    """One split of a record: its past, with the model that it gives, and the frames after it.

    Attributes
    ----------
    record : LoopRecord
        The record.
    training, test : tuple of (start, stop)
        Frames to learn from; frames that count, all of them later.
    replayed : tuple of (start, stop)
        For each stretch of the test, the frames that a replay runs over: from where the usable
        frames before it begin.
    model : IdentifiedModel
        Identified from the training.
    open_loop : (frames, axes) ndarray
        The pseudo-open-loop series z(k) with the sensor gains of the model [nm].
    """

    record: LoopRecord
    training: Stretches
    test: Stretches
    replayed: Stretches
    model: IdentifiedModel
    open_loop: FloatArray

    @property
    def hardware(self) -> LoopHardware:
        """The loop, with the sensor gains of the model."""
        return self.model.hardware

    @property
    def noise_nm2(self) -> FloatArray:
        """Covariance of the noise in the series, (axes, axes) [nm^2]."""
        return np.diag([(axis.noise_nm / axis.sensor_gain) ** 2 for axis in self.model.axes])

    def replay(self, controller: Controller) -> FloatArray:
        """Return the measured residual of a controller in the test, (frames, axes) [nm].

        The controller, from y(k) to u(k), runs from the equilibrium for the first of the usable
        frames before the test. UnstableLoopError refuses one whose loop is unstable.
        """
        loop = close_loop(self.hardware, controller)
        loop.require_stable()
        return gather(replay(loop, self.open_loop, self.replayed), self.test)


def forward_split(
    record: LoopRecord, training: Stretches, test: Stretches, model: IdentifiedModel
) -> ForwardSplit:
    """Return a split with the model of its training, and the frames of its test that count."""
    kept, replayed = settled_test(record.stretches(), test, record.frame_rate_hz)
    return ForwardSplit(
        record=record,
        training=training,
        test=kept,
        replayed=replayed,
        model=model,
        open_loop=record.pseudo_open_loop(model.sensor_gains),
    )


def forward_chain(
    record: LoopRecord,
    designs: Mapping[str, Callable[[ForwardSplit], Controller | Design]],
    *,
    splits: int = 3,
    first_share: float = 0.5,
    first_model: IdentifiedModel | None = None,
    identify_past: Callable[..., IdentifiedModel] | None = None,
    **options: Any,
) -> tuple[dict[str, ResidualEstimate], dict[str, str]]:
    """Design controllers from the past of a record, and compare them on what followed.

    Parameters
    ----------
    record : LoopRecord
        The record; its delay must be known.
    designs : mapping of str to callable
        From a :class:`ForwardSplit`, of which they may use the training, to a controller. One that
        fails on a split, or whose loop is unstable, is left out.
    splits : int, optional
        Pairs of training and test.
    first_share : float, optional
        Part of the usable frames that the first pair trains on, in (0, 1); tests share the rest.
    first_model : IdentifiedModel, optional
        The model of the first training, if it is known.
    identify_past : callable, optional
        Identifies the ``stretches=`` of a later training from a model of its past, ``start=``;
        :func:`identify` with the options by default.
    **options
        Those of :func:`identify`.

    Returns
    -------
    residuals : dict of str to ResidualEstimate
        What they leave of all tests, one after the other; that of least residual is the first.
        :meth:`ResidualEstimate.above` compares two, and :meth:`ResidualEstimate.within` returns
        the share of one test.
    failures : dict of str to str
        Why others are not among them.

    Raises
    ------
    ProblemError
        If a value is out of range, frames are too few, or no design is left.
    NumericalError
        If a fit fails.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.99], driving_rms_nm=4.0, frame_rate_hz=500)
    >>> line = lbt.Vibration(frequency_hz=40, damping=0.005, rms_nm=50)
    >>> truth = lbt.Truth(turbulence=slow, vibrations=(line,), noise_nm=5.0)
    >>> path = lbt.LoopHardware(frame_rate_hz=500)
    >>> ran = lbt.integrator(path, gain=0.3)
    >>> run = lbt.simulate(ran.controller, truth, hardware=path, frames=20_000)
    >>> record = lbt.identification.loop_record(
    ...     run.measurements[0], run.commands[0], frame_rate_hz=500, delay_frames=2, unit="nm"
    ... )
    >>> residuals, _ = lbt.identification.forward_chain(
    ...     record, {"ran": lambda _: ran, "filter": lambda split: lbt.kalman(split.model.plant())}
    ... )
    >>> difference, error = residuals["ran"].above(residuals["filter"])
    >>> list(residuals), bool(difference > 2 * error)
    (['filter', 'ran'], True)
    """
    identified = identify_past or partial(identify, record, **options)
    measured: dict[str, list[FloatArray]] = {name: [] for name in designs}
    failures: dict[str, str] = {}
    stretches: Stretches = ()
    model, noise, frames = first_model, list[FloatArray](), list[int]()
    for training, test in record_splits(record, splits, first_share=first_share):
        if model is None or stretches:
            model = identified(stretches=training, start=model)
        split = forward_split(record, training, test, model)
        for name, build in designs.items():
            if name in failures:
                continue
            try:
                measured[name].append(split.replay(as_controller(build(split))))
            except LbtSynthError as error:
                failures[name] = str(error)
        stretches += split.test
        noise.append(split.noise_nm2)
        frames.append(sum(stop - start for start, stop in split.test))
    if failures.keys() == designs.keys():
        reasons = "; ".join(f"{name}: {why}" for name, why in failures.items())
        raise ProblemError(f"no design can be compared on this record: {reasons or 'none given.'}")
    mean = np.average(noise, axis=0, weights=frames)
    residuals = {
        name: estimate_residual(np.concatenate(series), stretches, mean, np.zeros_like(mean))
        for name, series in measured.items()
        if name not in failures
    }
    return dict(sorted(residuals.items(), key=lambda row: row[1].total_nm2)), failures
