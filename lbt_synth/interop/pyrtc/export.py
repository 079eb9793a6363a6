"""The target pyRTC: a folder with a configuration that it starts, and all that it refers to.

pyRTC measures ``residual(k) = phase - c[0] u(k-1) - c[1] u(k-2) - ..``, in units of its commands,
and gives the predictor ``residual(k) + u(k-d)``, with the command that it sent d frames before. The
filter of that series is the controller in its own loop, and nothing winds up; where the answer c of
the mirror is not a delay of d frames, it corrects the series by the commands that it sent.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from lbt_synth.design import Design
from lbt_synth.design.result import require_hardware
from lbt_synth.errors import ProblemError
from lbt_synth.files import save_gain
from lbt_synth.interop.pipeline import CERTIFICATE, Target
from lbt_synth.interop.proof import ROUNDOFF, Written, filter_of_history
from lbt_synth.linear import Controller, StateSpace
from lbt_synth.loop import close_loop
from lbt_synth.models import LoopHardware
from lbt_synth.storage.array_file import open_fits
from lbt_synth.validation import FloatArray

_LARGEST_CONDITION = 1e4  # of the response; its inverse is held in single precision
_CONFIG, _GAIN, _RESPONSE = "config.yaml", "gain.fits", "interaction_matrix.npz"
_SYSTEM = """\
{origin}
#
# wfs, slopes and wfc stand in for hardware, which a simulation drives. Replace them and
# loop.im_file by those of your system. Residuals are in units of the commands, and the first modes
# of the loop are those of the gain file.
manager:
  mode: soft-rtc
wfs:
  class_name: pyrtc.component.Component
slopes:
  class_name: lbt_synth.interop.pyrtc.plugin.SimulatedTelescope
  signal_size: {size}
wfc:
  class_name: pyrtc.wavefront_corrector.WavefrontCorrector
  name: simulated
  num_actuators: {size}
  num_modes: {size}
loop:
  class_name: lbt_synth.interop.pyrtc.plugin.Loop  # that of pyRTC; the name registers lbt_synth
  functions: [predictive_integrator]
  im_file: {response}
  gain: 1.0  # a smaller one is another loop than the one that was designed
  predictor:
    type: lbt_synth
    gain_file: {gain}
    delay_frames: {delay}
    other_gain: {other_gain!r}  # of the integrator of each further mode
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PolFilter:
    """A controller in the units of pyRTC's commands."""

    hardware: LoopHardware  # of its loop, whose sensor and mirror are of modes
    delay_frames: int  # after which pyRTC takes a command away
    response: FloatArray  # from commands to measurements, (m, m): its interaction matrix
    # what the last commands, u(k-1) first, are of the correction that measurement k sees, (frames,)
    taps: FloatArray
    system: StateSpace  # from phase and noise without a correction to the command, (m,); stable

    @property
    def reconstructor(self) -> FloatArray:
        """From measurements to residuals, (m, m), in the precision of pyRTC."""
        return np.linalg.pinv(self.response).astype(np.float32).astype(np.float64)

    @property
    def tap_error(self) -> FloatArray:
        """Return what pyRTC leaves of the last commands in its series, (frames,)."""
        out = self.taps.copy()
        out[self.delay_frames - 1] -= 1
        return out

    def as_computed(self) -> Written:
        """Return the controller that pyRTC's loop computes, and what its arithmetic adds."""
        R = self.reconstructor
        controller, entry = filter_of_history(self.hardware, self.system)
        controller = replace(controller, B=controller.B @ R)

        def variance(_gain: float, measured: FloatArray, commands: FloatArray) -> FloatArray:
            """Bound the rounding of the signal, of its product, of the sum and of the command."""
            terms = np.abs(R) * measured
            residual = np.sum(terms, axis=1)
            sums = 2 * np.sum(terms**2, axis=1) + np.sum(np.cumsum(terms, axis=1) ** 2, axis=1)
            squares = [commands**2, sums + (residual + commands) ** 2]
            return np.asarray(ROUNDOFF["single"] ** 2 / 3 * np.concatenate(squares))

        return Written(controllers={frozenset(): controller}, entry=entry, variance=variance)


class InnerLoop:
    """A filter as pyRTC runs it from a flat mirror: signals and commands in single precision."""

    def __init__(self, whole: PolFilter, limit: float = np.inf) -> None:
        self._whole, self._limit, self.tap_error = whole, limit, whole.tap_error
        self._reconstructor = whole.reconstructor.astype(np.float32)
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._state = np.zeros(self._whole.system.n_states)
        # commands that were sent, the last first
        self._sent = np.zeros((len(self.tap_error), len(self._whole.response)))

    def step(self, y: ArrayLike) -> FloatArray:
        """Take y(k), (m,), return u(k), (m,)."""
        residual = self._reconstructor @ np.asarray(y, dtype=np.float32)
        pol = residual + self._sent[self._whole.delay_frames - 1].astype(np.float32)
        return self.step_pol(pol.astype(np.float64))

    def step_pol(self, pol: FloatArray, *, flat: bool = False) -> FloatArray:
        """Take pyRTC's series, (m,), and send u, or zeros; repeat u for what is not finite."""
        s, u = self._whole.system, self._sent[0]
        if np.isfinite(pol).all():
            seen = pol + self.tap_error @ self._sent
            u = np.clip(s.C @ self._state + s.D @ seen, -self._limit, self._limit)
            self._state = s.A @ self._state + s.B @ seen
        sent = 0 * u if flat else u.astype(np.float32).astype(np.float64)
        self._sent = np.vstack([sent, self._sent[:-1]])
        return np.asarray(sent)


def pol_filter(design: Design) -> PolFilter:
    """Return the filter that gives a design's commands in pyRTC; refuse a loop it cannot hold."""
    hardware = require_hardware(design, "pyRTC")
    response = hardware.sensor @ hardware.influence
    q, m = response.shape
    if q != m or np.linalg.cond(response) > _LARGEST_CONDITION:
        raise ProblemError(
            "pyRTC's predictors get one residual per command, so that the commands must show in "
            f"as many measurements; got {q} measurements of {m} commands, with a condition number "
            f"of {np.linalg.cond(response):.3g} (limit {_LARGEST_CONDITION:g}). Design for the "
            "modes."
        )
    return filter_of(hardware, design.controller, response)


def filter_of(hardware: LoopHardware, own: Controller, response: FloatArray) -> PolFilter:
    """Return the filter of a controller, for a response (m, m) from commands to measurements."""
    A, B, C, D = (np.ascontiguousarray(matrix) for matrix in (own.A, own.B, own.C, own.D))
    own = replace(own, A=A, B=B @ response, C=C, D=D @ response)
    modal = replace(hardware, sensor_matrix=None, influence_matrix=None, modes=len(response))
    delay = max(1, int(hardware.delay_frames + 0.5))
    taps = np.zeros(max(delay, len(hardware.mirror_taps)))
    taps[: len(hardware.mirror_taps)] = hardware.mirror_taps
    return PolFilter(
        hardware=modal,
        delay_frames=delay,
        response=response,
        taps=taps,
        system=close_loop(modal, own).path("noise", "command"),
    )


def _write(
    folder: Path,
    whole: PolFilter,
    design: Design,
    origin: Sequence[str],
    *,
    modes: int | None,
    other_gain: float | None,
    **_: Any,
) -> dict[Path, bytes]:
    """Return configuration, gain file, and interaction matrix as pyRTC writes it."""
    count = len(whole.response) if modes is None else modes
    config = _SYSTEM.format(
        origin="\n".join(f"# {line}" for line in origin),
        size=count,
        response=_RESPONSE,
        gain=_GAIN,
        delay=whole.delay_frames,
        other_gain=float(other_gain or 0.0),
    )
    matrix = block_diag(whole.response, np.eye(count - len(whole.response)))
    record = {"format": 2, "kind": "interaction_matrix", "image_axes": "yx"}
    buffer = io.BytesIO()
    np.savez(buffer, data=matrix, pyrtc_calibration=np.array(json.dumps(record)))
    with TemporaryDirectory() as place:
        gain = save_gain(Path(place) / _GAIN, design).read_bytes()
    contents = {_CONFIG: config.encode(), _RESPONSE: buffer.getvalue(), _GAIN: gain}
    return {folder / name: content for name, content in contents.items()}


def _read(files: Mapping[Path, bytes], like: PolFilter) -> PolFilter:
    """Return the filter of the controller and of the interaction matrix in the files."""
    named = {path.name: content for path, content in files.items()}
    with open_fits(named[_GAIN]) as units:
        held = {name: np.array(units[name].data, dtype=np.float64) for name in "ABCD"}
    m = len(like.response)
    response = np.load(io.BytesIO(named[_RESPONSE]))["data"][:m, :m]
    controller = Controller(**held, dt_s=like.hardware.dt_s)
    return filter_of(like.hardware, controller, response)


TARGET = Target(
    precision="single for signals and commands, double in the controller",
    options={"modes": None, "other_gain": None},
    round=lambda designs, **_: [pol_filter(design) for design in designs],
    write=_write,
    read=_read,
    computed=lambda _, numbers: numbers.as_computed(),
    start=InnerLoop,
    facts=lambda whole, **_: {"delay_frames": whole.delay_frames},
    hint="Design with less accurate models, or for lower sensor gains.",
    contents=(_CONFIG, _GAIN, _RESPONSE, _CONFIG + CERTIFICATE),
)
