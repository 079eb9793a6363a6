"""Export a controller as a configuration that pyRTC starts."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.design import Check, Design
from lbt_synth.errors import ProblemError
from lbt_synth.files import save_gain
from lbt_synth.interop.export_checks import (
    Exported,
    join_labels,
    provenance_lines,
    rehearsal_error,
    write_export,
)
from lbt_synth.interop.modes import all_modes
from lbt_synth.interop.pyrtc.pol_filter import InnerLoop, pol_filter
from lbt_synth.interop.target import CERTIFICATE, Arithmetic, Target
from lbt_synth.interop.written_loop import prove_written, require_proved
from lbt_synth.storage.atomic_files import make_directory
from lbt_synth.validation import FloatArray

_FIT_SECONDS = 20.0  # of pseudo-open-loop series that fit_predictor identifies
_CONFIG, _GAIN, _RESPONSE = "config.yaml", "gain.fits", "interaction_matrix.npz"
_HINT = "Design with less accurate models, or for lower sensor gains."
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


def export_pyrtc(
    path: str | os.PathLike[str],
    design: Design,
    *,
    modes: int | None = None,
    other_gain: float | None = None,
    gain_digest: str | None = None,
) -> Exported:
    """Write a folder with a configuration that pyRTC starts, and all that it refers to.

    The gain file goes into the folder; inside pyRTC it is certified again before it runs. pyRTC
    computes signals and commands in single precision, and the predictor is a stable filter in
    double precision. The loop is closed around that arithmetic before anything is written.

    Parameters
    ----------
    path : path-like
        Folder to write; it is made if its parent is there.
    design : Design
        Design with as many measurements as commands.
    modes : int, optional
        Modes of the loop; by default those of the design, which come first. Further ones get no
        command, without ``other_gain``.
    other_gain : float, optional
        Gain of an integrator for each further mode.
    gain_digest : str, optional
        SHA-256 of the gain file, for the certificate (64 hexadecimal digits).

    Returns
    -------
    Exported
        Configuration, gain file, interaction matrix and certificate, the error of the commands
        in pyRTC's arithmetic, and the checks.

    Raises
    ------
    OutputError
        If the folder or a file cannot be written.
    ProblemError
        If the design is not of such a loop.
    CertificateError
        If the certificate that the design carries has a failed check.
    NumericalError
        If a check fails in the arithmetic of pyRTC; ``residual`` holds its value.

    Examples
    --------
    >>> import lbt_synth as lbt, tempfile, pathlib
    >>> slow = lbt.integrator(lbt.LoopHardware(frame_rate_hz=800), gain=0.5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     written = lbt.interop.export_pyrtc(pathlib.Path(folder) / "slow", slow)
    ...     sorted(file.name for file in written.files)
    ['config.yaml', 'config.yaml.certificate.json', 'gain.fits', 'interaction_matrix.npz']
    """
    folder = Path(path)
    if not isinstance(design, Design):
        raise ProblemError(
            "pyRTC's configuration names one gain file, for the first modes, and one gain for all "
            f"others; got {type(design).__name__}. Give a design, modes and other_gain."
        )
    whole = all_modes(
        design, _CONFIG, modes=modes, other_gain=other_gain, hardware=None, modal=False
    )
    found = pol_filter(design)
    origin = "\n".join(f"# {line}" for line in join_labels(provenance_lines(design, gain_digest)))
    checks: list[Check] = []
    worst = 0.0
    for part in whole.parts:
        proved = prove_written(part.design, *pol_filter(part.design).as_computed())
        require_proved(proved, "the arithmetic of pyRTC", _HINT)
        checks += whole.name_checks(part, proved)
        worst = max(worst, rehearsal_error(part.design, InnerLoop(part.design)))
    make_directory(folder, parents=False)
    contents = {
        _CONFIG: _SYSTEM.format(
            origin=origin,
            size=whole.count,
            response=_RESPONSE,
            gain=_GAIN,
            delay=found.delay_frames,
            fit=int(_FIT_SECONDS / found.system.dt_s),
            other_gain=float(other_gain or 0.0),
        ).encode(),
        _RESPONSE: _response_bytes(found.response, whole.count),
        _GAIN: save_gain(folder / _GAIN, design).read_bytes(),
    }
    return write_export(
        {folder / name: content for name, content in contents.items()},
        target="pyrtc",
        arithmetic=TARGET.arithmetic,
        checks=checks,
        gain_digest=gain_digest,
        delay_frames=found.delay_frames,
        modes=whole.count,
        error=worst,
        start=lambda limit: InnerLoop(design, limit),
    )


def _response_bytes(response: FloatArray, modes: int) -> bytes:
    """Write an interaction matrix as pyRTC does: the matrix, and a record of what it is."""
    whole = block_diag(response, np.eye(modes - len(response)))
    record = {"format": 2, "kind": "interaction_matrix", "image_axes": "yx"}
    buffer = io.BytesIO()
    np.savez(buffer, data=whole, pyrtc_calibration=np.array(json.dumps(record)))
    return buffer.getvalue()


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
    write=export_pyrtc,
    contents=(_CONFIG, _GAIN, _RESPONSE, _CONFIG + CERTIFICATE),
)
