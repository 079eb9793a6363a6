"""The target pyRTC: a folder with a configuration that it starts, and all that it refers to.

The gain file goes into the folder; inside pyRTC it is certified again before it runs.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.design import Design
from lbt_synth.files import save_gain
from lbt_synth.interop.pipeline import CERTIFICATE, Arithmetic, Target, join_labels
from lbt_synth.interop.pyrtc.pol_filter import InnerLoop, PolFilter, filter_of, pol_filter
from lbt_synth.linear import Controller
from lbt_synth.storage.array_file import open_fits

_FIT_SECONDS = 20.0  # of pseudo-open-loop series that fit_predictor identifies
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
    fit_frames: {fit}
    other_gain: {other_gain!r}  # of the integrator of each further mode
"""


def _write(
    folder: Path,
    whole: tuple[PolFilter, ...],
    design: Design,
    origin: Sequence[tuple[str, str]],
    *,
    modes: int | None,
    other_gain: float | None,
    **_: Any,
) -> dict[Path, bytes]:
    """Return configuration, gain file, and interaction matrix as pyRTC writes it."""
    first = whole[0]
    count = len(first.response) if modes is None else modes
    config = _SYSTEM.format(
        origin="\n".join(f"# {line}" for line in join_labels(origin)),
        size=count,
        response=_RESPONSE,
        gain=_GAIN,
        delay=first.delay_frames,
        fit=int(_FIT_SECONDS / first.system.dt_s),
        other_gain=float(other_gain or 0.0),
    )
    matrix = block_diag(first.response, np.eye(count - len(first.response)))
    record = {"format": 2, "kind": "interaction_matrix", "image_axes": "yx"}
    buffer = io.BytesIO()
    np.savez(buffer, data=matrix, pyrtc_calibration=np.array(json.dumps(record)))
    with TemporaryDirectory() as place:
        gain = save_gain(Path(place) / _GAIN, design).read_bytes()
    contents = {_CONFIG: config.encode(), _RESPONSE: buffer.getvalue(), _GAIN: gain}
    return {folder / name: content for name, content in contents.items()}


def _read(files: Mapping[Path, bytes], like: tuple[PolFilter, ...]) -> tuple[PolFilter, ...]:
    """Return the filter of the controller and of the interaction matrix in the files."""
    named = {path.name: content for path, content in files.items()}
    with open_fits(named[_GAIN]) as units:
        held = {name: np.array(units[name].data, dtype=np.float64) for name in "ABCD"}
    m = len(like[0].response)
    response = np.load(io.BytesIO(named[_RESPONSE]))["data"][:m, :m]
    hardware = like[0].hardware
    controller = Controller(**held, dt_s=hardware.dt_s)
    return filter_of(hardware, controller, response), *like[1:]


TARGET = Target(
    arithmetic=Arithmetic(
        program="pyRTC, its loop predictive_integrator",
        precision="single for signals and commands, double in the controller",
        sums="matrix products, in an order of their library",
        state="of a stable filter, fed with the residual and the command sent delay_frames before",
        clipping="predictor.command_limit in the controller; what the corrector clips is not seen",
        limits="as many measurements as commands",
    ),
    file="folder with the configuration, the gain file and their certificate",
    options={"modes": None, "other_gain": None},
    round=lambda designs, **_: [(pol_filter(design),) for design in designs],
    write=_write,
    read=_read,
    computed=lambda _, filters: filters[0].as_computed(),
    start=lambda filters, limit: InnerLoop(filters[0], limit),
    single=lambda filters: filters,
    join=lambda numbers, parts, count: tuple(filters[0] for filters in numbers),
    split=lambda whole, parts, numbers: [[(one,)] for one in whole],
    facts=lambda whole, **_: {"delay_frames": whole[0].delay_frames},
    hint="Design with less accurate models, or for lower sensor gains.",
    contents=(_CONFIG, _GAIN, _RESPONSE, _CONFIG + CERTIFICATE),
    modal=False,
    mixed=False,
)
