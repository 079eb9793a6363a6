"""The path from command to measurement: mirror, delay, sensor (Agapito et al. 2008, eqs. 1-2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, cast

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.models.mirror.frame_rate_system import MirrorSystem, mirror_system
from lbt_synth.models.mirror.position_loop import PositionLoop
from lbt_synth.models.sensor_suite import OWN_SENSOR_ALONE, SensorSuite
from lbt_synth.storage.rows import column, fill_row, table_row
from lbt_synth.storage.summaries import Summarised
from lbt_synth.storage.words import count_text
from lbt_synth.validation import FloatArray, Positive, check_fields, frozen_copy, integer, matrix

LONGEST_DELAY = 20  # of a loop [frames]; each is a state of every matrix
_MOST_MODES = 10_000
BLIND = 1e-9  # of the largest response to commands, what counts as none: rounding is smaller


@table_row
class LoopFacts:
    """The loop that a design is for."""

    frame_rate_hz: float = column("frame rate", unit="Hz")
    delay_frames: float = column("total delay", unit="frames")
    settling_ms: float | None = column("settling time of the mirror, to 10 %", unit="ms")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LoopHardware(Summarised):
    """Sensor, mirror and delay around which a controller closes the loop.

    In frames k of ``1 / frame_rate_hz``, with d the total delay::

        y(k)       = sensor_matrix phi_res(k-1) + noise(k)
        phi_res(k) = phi_tot(k) - phi_cor(k)
        phi_cor(k) = influence_matrix u(k-d+1)

    A fractional delay ``d = j + 1 + f`` holds the command of two frames within
    one exposure: ``phi_cor(k) = influence_matrix ((1-f) u(k-j) + f u(k-j-1))``.

    With a ``mirror`` the position follows each command as its local loop lets it, and the
    delay is that at which the command arrives: ``phi_cor(k) = influence_matrix (c[0] u(k) +
    c[1] u(k-1) + ...)`` with the exposure-averaged taps c of :attr:`mirror_taps`.

    Parameters
    ----------
    frame_rate_hz : float
        Frame rate [Hz].
    delay_frames : float, optional
        Total delay d [frames], at least 1.
    sensor_matrix : (q, n) array_like, optional
        Sensor response to the n modes; the identity by default.
    influence_matrix : (n, m) array_like, optional
        Mirror response to the m commands; the identity by default.
    modes : int, optional
        Number of modes n when neither matrix is given.
    mirror : PositionLoop, optional
        Dynamics of the mirror, the same for all commands; a mirror that settles at once by
        default.
    suite : SensorSuite, optional
        Sensors beside the loop's own; none by default.

    Raises
    ------
    ProblemError
        If a value is not finite, out of range, or the sizes clash; or if the local loop does
        not run a whole number of samples per frame.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> path = lbt.LoopHardware(frame_rate_hz=800, delay_frames=2.25)
    >>> [float(tap) for tap in path.mirror_taps]  # of u(k), u(k-1), u(k-2)
    [0.0, 0.75, 0.25]
    """

    frame_rate_hz: Positive
    delay_frames: Annotated[
        float,
        ("at_least", 1),
        ("at_most", LONGEST_DELAY),
        ("hint", "The exposure itself is one frame, and each frame adds states."),
    ] = 2.0
    sensor_matrix: FloatArray | None = None
    influence_matrix: FloatArray | None = None
    modes: int = 2
    mirror: PositionLoop | None = None
    suite: SensorSuite = OWN_SENSOR_ALONE

    def __post_init__(self) -> None:
        sensor, influence = self.sensor_matrix, self.influence_matrix
        n = integer(self.modes, "modes", at_least=1, at_most=_MOST_MODES)
        if sensor is not None:
            sensor = matrix(sensor, "sensor_matrix")
            n = sensor.shape[1]
        if influence is not None:
            rows = None if sensor is None else (n, f"to match sensor_matrix {sensor.shape}")
            influence = matrix(influence, "influence_matrix", rows=rows)
            n = influence.shape[0]
        if n < 1 or (influence is not None and influence.shape[1] < 1):
            raise ProblemError(f"a loop needs at least one mode and one command; got {n} modes.")
        matrices = {"sensor_matrix": sensor, "influence_matrix": influence}
        for name, value in matrices.items():
            if value is not None and not np.any(value):
                raise ProblemError(f"{name} must respond to something; got only zeros.")
            matrices[name] = frozen_copy(np.eye(n)) if value is None else value
        if sensor is not None and influence is not None:
            sizes = np.linalg.norm(sensor) * np.linalg.norm(influence)
            if np.linalg.norm(sensor @ influence) <= BLIND * sizes:
                raise ProblemError("sensor_matrix must see something that influence_matrix moves.")
        check_fields(self, modes=n, **matrices)
        if self.mirror is not None:
            _ = self.mirror_system  # refuses a mirror that does not fit the frame rate

    @property
    def sensor(self) -> FloatArray:
        """Sensor matrix (q, n)."""
        return cast("FloatArray", self.sensor_matrix)  # set by __post_init__

    @property
    def influence(self) -> FloatArray:
        """Influence matrix N (n, m)."""
        return cast("FloatArray", self.influence_matrix)

    @property
    def projector(self) -> FloatArray:
        """Generalised inverse of the influence matrix, (m, n)."""
        return frozen_copy(np.linalg.pinv(self.influence))

    @property
    def n_commands(self) -> int:
        """Number of commands m."""
        return int(self.influence.shape[1])

    @property
    def n_measurements(self) -> int:
        """Number of measurements q of the loop's own sensor."""
        return int(self.sensor.shape[0])

    @property
    def hardware(self) -> LoopHardware:
        """The loop itself: a plant has its loop by this name."""
        return self

    @property
    def n_readings(self) -> int:
        """Number of measurements of all sensors."""
        return max(int(rows.stop) for rows in self.suite.rows(self).values())

    @property
    def period(self) -> int:
        """Common period of all sensors [frames]."""
        return self.suite.period(self)

    def own_sensor_alone(self) -> LoopHardware:
        """Return the loop without its other sensors."""
        return replace(self, suite=OWN_SENSOR_ALONE) if self.suite.sensors else self

    def facts(self) -> LoopFacts:
        """Return what tables say of the loop."""
        settled = self.mirror
        settling_ms = None if settled is None else 1e3 * settled.step_response().settling_s
        return fill_row(LoopFacts, self, settling_ms=settling_ms)

    def _brief(self) -> str:
        axes = count_text(self.modes, "axis", "axes")
        moving = "" if self.mirror is None else ", a mirror with dynamics"
        return f"{axes} at {self.frame_rate_hz:g} Hz, delay {self.delay_frames:g} frames{moving}"

    @property
    def dt_s(self) -> float:
        """Frame period [s]."""
        return 1 / self.frame_rate_hz

    @property
    def mirror_system(self) -> MirrorSystem:
        """Mirror and delay as a system at the frame rate, of one command."""
        return mirror_system(self.mirror, self.frame_rate_hz, self.delay_frames)

    @property
    def mirror_taps(self) -> FloatArray:
        """Weights c of ``phi_cor(k) = N (c[0] u(k) + c[1] u(k-1) + ...)``, to rounding."""
        return self.mirror_system.taps

    def single_mode(self) -> LoopHardware:
        """Return the hardware of one mode: the same delay and mirror, unit sensor and influence."""
        return replace(
            self, sensor_matrix=None, influence_matrix=None, modes=1, suite=OWN_SENSOR_ALONE
        )


def require_loop_rate(frame_rate_hz: float, hardware: LoopHardware) -> None:
    """Raise if a sampled disturbance does not have the loop's frame rate."""
    if not np.isclose(frame_rate_hz, hardware.frame_rate_hz, rtol=1e-9):
        raise ProblemError(
            f"a disturbance must be sampled at the loop's {hardware.frame_rate_hz:.6g} Hz; "
            f"got {frame_rate_hz:.6g} Hz."
        )


def loop_differences(own: LoopHardware, here: LoopHardware) -> list[str]:
    """Say how the loop that a design was made for differs from the loop that it runs in."""
    notes = []
    if own.delay_frames != here.delay_frames:
        notes.append(
            f"designed for a delay of {own.delay_frames:g} frames, run with {here.delay_frames:g}."
        )
    if not (
        np.array_equal(own.sensor, here.sensor) and np.array_equal(own.influence, here.influence)
    ):
        notes.append("designed for another sensor or influence matrix than it is run with.")
    if own.mirror != here.mirror:
        kinds = [
            "a mirror that settles at once" if h.mirror is None else "a mirror with dynamics"
            for h in (own, here)
        ]
        other = "other dynamics of the mirror than it is run with."
        differ = kinds[0] != kinds[1]
        notes.append(f"designed for {f'{kinds[0]}, run with {kinds[1]}.' if differ else other}")
    return notes


def past_corrections(taps: FloatArray, commands: FloatArray) -> FloatArray:
    """Return ``c(k) = taps[0] u(k-1) + taps[1] u(k-2) + ...``, which measurement k sees.

    Commands (frames, m) before the first row count as zero, so the first ``len(taps)`` rows of
    the answer (frames, m) are not known.
    """
    from scipy.signal import lfilter  # slow to import

    return np.asarray(lfilter([0.0, *taps], [1.0], commands, axis=0))
