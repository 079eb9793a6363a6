"""A stack of designs of one mode each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lbt_synth.design.certificate import Certificate
from lbt_synth.design.filter_design import FilterDesign
from lbt_synth.design.modal.banks import Bank, make_banks
from lbt_synth.design.result import require_hardware
from lbt_synth.models import LoopHardware
from lbt_synth.validation import FloatArray, IntArray, integer

if TYPE_CHECKING:
    from lbt_synth.design.modal.mixed_controller import MixedController


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModalFilters:
    """A Kalman filter for each of n modes, made by :func:`modal_filters`.

    Attributes
    ----------
    designs : tuple of FilterDesign
        The different designs of one mode, each with its claims and its certificate.
    which : (n,) ndarray of int
        Design of each mode.
    rms_nm : (n,) ndarray
        Residual that each mode's loop leaves in the image under its own model [nm rms].
    certificate : Certificate
        That the stack is what its designs are: the loops of all modes, closed as arrays, leave
        what each design's loop leaves. ``rms_per_output`` is each mode's estimation error.
    """

    designs: tuple[FilterDesign, ...]
    which: IntArray
    rms_nm: FloatArray
    certificate: Certificate

    @property
    def n_modes(self) -> int:
        """Number of modes n."""
        return int(self.which.size)

    @property
    def dt_s(self) -> float:
        """Frame period [s]."""
        return self.hardware.dt_s

    @property
    def hardware(self) -> LoopHardware:
        """Loop that the filters are designed for, of one mode with a unit sensor."""
        return require_hardware(self.designs[0], "a modal filter").single_mode()

    def design(self, mode: int) -> FilterDesign:
        """Return the design of one mode, from 0; any other is a ProblemError."""
        number = integer(mode, "mode", at_least=0, at_most=self.n_modes - 1)
        return self.designs[int(self.which[number])]

    def banks(self) -> tuple[Bank, ...]:
        """Return the controllers, those of the same size together."""
        return make_banks([design.controller for design in self.designs], self.which)

    def start(self) -> MixedController:
        """Return running controllers with zero states, to be stepped frame by frame."""
        from lbt_synth.design.modal.mixed_controller import MixedController

        modes = range(self.n_modes)
        return MixedController(filter=self, gains=np.zeros(self.n_modes), filtered=modes)
