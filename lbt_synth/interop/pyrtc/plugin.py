"""What pyRTC takes from us, by its names in a configuration; the only module that imports pyrtc."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lbt_synth.errors import ProblemError
from lbt_synth.interop.pyrtc.predictor import GainFilePredictor
from lbt_synth.validation import FloatArray

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

    Parameters
    ----------
    conf : dict
        Section of the configuration; ``signal_size`` is its number of measurements.
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
                found = self._corrector.read_after_publication(seen, timeout=_ANSWER_SECONDS)
            except TimeoutError:
                raise ProblemError(
                    f"pyRTC's loop must answer within {_ANSWER_SECONDS:g} s; it sent no command. "
                    "Start it, and read its log."
                ) from None
            if found.frame_id == frame:
                return -np.asarray(found.payload[: measured.size], dtype=np.float64)
            seen = found.count
