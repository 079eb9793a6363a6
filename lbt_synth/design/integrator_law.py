"""What an integrator has beside its gain: leak, zero, second integrator, and margins to keep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np

from lbt_synth.design.certificate import LEVEL_SETS, Check
from lbt_synth.design.claims import Claim, Evidence
from lbt_synth.errors import ProblemError
from lbt_synth.linear import Controller, hinf_norm
from lbt_synth.loop import ClosedLoop, close_loop
from lbt_synth.loop.margins import phase_margin_deg
from lbt_synth.models import LoopHardware
from lbt_synth.validation import Positive, check_fields, frozen_copy

MARGIN_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class IntegratorLaw:
    """The control law ``gain (1 - c z^-1) / (1 - leak z^-1)^integrators``, and its demands.

    Without a zero, ``c = 0``; else ``c = exp(-2 pi zero_hz / frame_rate)``. The defaults are the
    pure integrator. One integrator with a zero is a PI controller of proportional gain
    ``c gain`` and integral gain ``(1 - c) gain``. Two integrators with a zero are an integrator
    with a lag compensator: below the zero the loop gain falls with the square of the frequency.

    Parameters
    ----------
    leak : float, optional
        Part of a command that is left after a frame, the pole of each integrator; 1 keeps all.
    integrators : int, optional
        Number of integrators, 1 or 2.
    zero_hz : float, optional
        Corner frequency of the zero [Hz].
    phase_margin_deg : float, optional
        Least phase margin of the loop [deg].
    modulus_margin : float, optional
        Least modulus margin of the loop.

    Raises
    ------
    ProblemError
        If a value is out of range.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800)
    >>> law = lbt.design.IntegratorLaw(leak=0.99, phase_margin_deg=45)
    >>> round(lbt.integrator(path, law=law).gain, 3)
    0.527
    """

    leak: Annotated[float, ("above", 0), ("at_most", 1)] = 1.0
    integrators: Annotated[int, ("at_least", 1), ("at_most", 2)] = 1
    zero_hz: Positive | None = None
    phase_margin_deg: Annotated[float, ("above", 0), ("below", 180)] | None = None
    modulus_margin: Annotated[float, ("above", 0), ("below", 1)] | None = None

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def is_pure(self) -> bool:
        """Whether it is one integrator without leak or zero."""
        return (self.leak, self.integrators, self.zero_hz) == (1.0, 1, None)

    @property
    def demands(self) -> dict[str, float]:
        """The margins that are demanded, by the name of their field."""
        named = {name: getattr(self, name) for name in ("phase_margin_deg", "modulus_margin")}
        return {name: least for name, least in named.items() if least is not None}

    def changes(self) -> dict[str, Any]:
        """Return the fields that are not those of the pure integrator."""
        usual = asdict(IntegratorLaw())
        return {name: value for name, value in asdict(self).items() if value != usual[name]}

    def controller(self, hardware: LoopHardware, gain: float) -> Controller:
        """Return the controller of a gain.

        Raises
        ------
        ProblemError
            If the zero is not below half the frame rate.
        """
        nyquist_hz = hardware.frame_rate_hz / 2
        if self.zero_hz is not None and not self.zero_hz < nyquist_hz:
            raise ProblemError(
                f"zero_hz must be below half the frame rate, {nyquist_hz:g} Hz; "
                f"got {self.zero_hz:g}."
            )
        c = 0.0 if self.zero_hz is None else float(np.exp(-np.pi * self.zero_hz / nyquist_hz))
        a, reconstructor = self.leak, np.linalg.pinv(hardware.sensor @ hardware.influence)
        D = 0.0
        if self.integrators == 1:  # c may be above the leak: the zero is then a lead
            A, B, C, D = [[a]], [[1.0]], [[1 - c / a]], c / a
        else:
            A, B, C = [[a, 0.0], [a - c, a]], [[1.0], [1.0]], [[0.0, 1.0]]
        each = np.eye(len(reconstructor))
        return Controller(
            A=frozen_copy(np.kron(A, each)),
            B=frozen_copy(np.kron(B, gain * reconstructor)),
            C=frozen_copy(np.kron(C, each)),
            D=frozen_copy(D * gain * reconstructor),
            dt_s=hardware.dt_s,
        )

    def margins(self, loop: ClosedLoop) -> dict[str, float]:
        """Return the margins of a stable loop that are demanded, by the names of the demands."""
        found = {}
        if self.phase_margin_deg is not None:
            found["phase_margin_deg"] = phase_margin_deg(loop)
        if self.modulus_margin is not None:
            found["modulus_margin"] = 1 / hinf_norm(loop.output_sensitivity()).upper
        return found


PURE = IntegratorLaw()


def _margin_claim(name: str, margin: str, unit: str, how: str) -> Claim:
    """Return the claim of a margin that the loop keeps."""

    def checks(evidence: Evidence, demanded: float) -> Iterator[Check]:
        design = evidence.design
        achieved = design.law.margins(close_loop(design.hardware, design.controller))[name]
        label = f"{margin} demanded over achieved, less 1"
        yield Check(label, demanded / achieved - 1, MARGIN_TOLERANCE, how)

    return Claim(name=name, heading=f"{margin} demanded", unit=unit, checks=checks)


LAW_CLAIMS = (
    Claim(name="gain", heading="gain"),
    Claim(name="leak", heading="left of a command after a frame"),
    Claim(name="integrators", heading="integrators"),
    Claim(name="zero_hz", heading="corner of the zero", unit="Hz"),
    _margin_claim("phase_margin_deg", "phase margin", "deg", "each measurement broken in turn"),
    _margin_claim("modulus_margin", "modulus margin", "", LEVEL_SETS),
)
