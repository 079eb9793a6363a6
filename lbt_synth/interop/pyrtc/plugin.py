"""What pyRTC takes from us, by its names in a configuration; the only module that imports pyrtc."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lbt_synth.design import integrator
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import ProblemError
from lbt_synth.files import load_gain
from lbt_synth.interop.pyrtc.export import InnerLoop, pol_filter
from lbt_synth.validation import FloatArray, integer, number

PREDICTOR = "lbt_synth"
_ANSWER_SECONDS = 20.0  # a first frame may compile code


def register() -> Any:
    """Return ``pyrtc.predictive`` with our predictor among its own."""
    from pyrtc import predictive

    predictive.ModalPredictor.register(GainFilePredictor)
    predictive.register_predictor(PREDICTOR)(GainFilePredictor)
    return predictive


def __getattr__(name: str) -> Any:
    """Return pyRTC's own Loop; every process that takes it from here knows our predictor."""
    if name != "Loop":
        raise AttributeError(f"module {__name__} has no attribute {name}")
    from pyrtc.loop import Loop

    register()
    return Loop


class SimulatedTelescope:
    """Stands in for sensor and mirror: :func:`lbt_synth.simulate` closes the loop of pyRTC.

    To the simulation it is a controller: each measurement goes out as the stream ``signal``, and
    the command comes from the stream ``wfc``, with the number of the same frame.
    """

    def __init__(self, conf: dict[str, Any]) -> None:
        from pyrtc.streams import create_stream, open_stream

        names = {**conf.get("output_streams", {}), **conf.get("input_streams", {})}
        size = int(conf["signal_size"])
        self._signal = create_stream(names.get("signal", "signal"), (size,), np.float32)
        self._corrector = open_stream(names.get("wfc", "wfc"))
        self.alive, self.running = True, False
        self.reset()

    def start(self) -> None:
        """Be ready; the simulation gives the frames."""
        self.running = True

    def stop(self) -> None:
        """Pause; there is nothing that runs."""
        self.running = False

    def close(self) -> None:
        """Let go of the streams."""
        self.alive = self.running = False
        self._signal.close()
        self._corrector.close()

    def reset(self) -> None:
        """Flatten the mirror."""
        self._signal.write(np.zeros(self._signal.shape, dtype=np.float32))
        self._corrector.write(np.zeros(self._corrector.shape, dtype=np.float32))

    def step(self, y: ArrayLike) -> FloatArray:
        """Send the measurements y(k), (q,), return the command u(k) of the loop, (q,)."""
        measured = np.asarray(y)
        signal = np.zeros(self._signal.shape, dtype=np.float32)
        signal[: measured.size] = measured
        frame, seen = self._signal.frame_id + 1, self._corrector.count
        self._signal.write(signal, frame_id=frame)
        while True:
            try:
                answer = self._corrector.read_after_publication(seen, timeout=_ANSWER_SECONDS)
            except TimeoutError:
                raise ProblemError(
                    f"pyRTC's loop must answer within {_ANSWER_SECONDS:g} s; it sent no command. "
                    "Start it, and read its log."
                ) from None
            if answer.frame_id == frame:
                return -np.asarray(answer.payload[: measured.size], dtype=np.float64)
            seen = answer.count


class GainFilePredictor:
    """The controller of a gain file, which is certified again before it runs.

    The first frames, which fill the loop's memory of commands, get the command 0. A residual that
    is not finite leaves the filter as it is, and repeats the last command.
    """

    def __init__(
        self,
        num_modes: int,  # of the loop; those of the gain file come first
        horizon: int = 2,  # frames to the residual that shows a command: delay_frames of the loop
        *,
        gain_file: str,
        other_gain: float = 0.0,  # of the integrator of each further mode
        command_limit: float | None = None,  # the loop does not see what a corrector clips
    ) -> None:
        self.num_modes = integer(num_modes, "num_modes", at_least=1)
        self.horizon = integer(horizon, "predictor.delay_frames", at_least=1)
        self.fitted = False
        self._sent: NDArray[np.float32]  # to the further modes, the last command first
        self._other_gain = number(other_gain, "predictor.other_gain", at_least=0)
        self._limit = np.inf
        if command_limit is not None:
            self._limit = number(command_limit, "predictor.command_limit", above=0)
        self._gain_file, series = gain_file, pol_filter(design := load_gain(gain_file))
        if series.delay_frames != self.horizon:
            raise ProblemError(
                f"predictor.delay_frames must be {series.delay_frames}, that of {gain_file}; "
                f"got {self.horizon}. Design for the delay of this loop."
            )
        self._own = len(series.response)
        if self._own > self.num_modes:
            raise ProblemError(
                f"the loop must control at least the {self._own} modes of {gain_file}; got "
                f"{self.num_modes}. Lower loop.num_dropped_modes, or raise wfc.num_modes."
            )
        if self._other_gain > 0:  # refused where its loop is unstable
            hardware = require_hardware(design, "pyRTC")
            integrator(hardware.single_mode(), gain=self._other_gain)
        self._filter = InnerLoop(series, self._limit)
        self.reset()

    def fit(self, pol_history: ArrayLike) -> GainFilePredictor:
        """Refuse to identify within the loop."""
        raise ProblemError(
            f"the controller of {self._gain_file} does not change while the loop runs. Record the "
            "loop, and try lbt-synth auto on the record."
        )

    def update(self, pol: ArrayLike) -> None:
        """Take the pseudo-open-loop values of a frame, (modes,)."""
        now = np.asarray(pol, dtype=np.float64).reshape(self.num_modes)
        flat, own, rest = self._frames < self.horizon, slice(self._own), slice(self._own, None)
        self._command[own] = self._filter.step_pol(now[own], flat=flat)
        if not flat and np.isfinite(now[rest]).all():
            residual = now[rest] - self._sent[-1]
            moved = self._command[rest] + self._other_gain * residual
            self._command[rest] = np.clip(moved, -self._limit, self._limit)
        self._sent = np.vstack([self._command[rest].astype(np.float32), self._sent[:-1]])
        self._frames += 1

    def predict(self) -> FloatArray:
        """Return the command with pyRTC's sign, the phase that it will cancel, (modes,)."""
        return self._command.copy()

    def reset(self) -> None:
        """Forget the past."""
        self._filter.reset()
        self._command: FloatArray = np.zeros(self.num_modes)
        rest = self.num_modes - self._own
        self._sent = np.zeros((self.horizon, rest), dtype=np.float32)
        self._frames: int = 0
