"""The mirror at the frame rate: from the command of each frame to the mean position over it.

Commands arrive once per frame, ``delay_frames - 1`` frames after the exposure that follows
their computation has begun; an exposure averages the position over one frame. A mirror that
settles at once shows the commands of at most two frames within an exposure. A mirror with
dynamics is lifted: its local loop runs a whole number of samples between two commands, and the
integral of its position over either part of an exposure is a linear function of its state and
of the command (discretisation of hybrid adaptive-optics loops: C. Correia, H.-F. Raynaud,
C. Kulcsar, J.-M. Conan, J. Opt. Soc. Am. A 27, 333 (2010), doi:10.1364/JOSAA.27.000333).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from lbt_synth.errors import ProblemError
from lbt_synth.linear.state_space import balancing_scales
from lbt_synth.models.mirror.position_loop import PositionLoop
from lbt_synth.models.sensor_suite import WHOLE
from lbt_synth.validation import ComplexArray, FloatArray, frozen_copy, set_fields

_NOTHING = 1e-14  # a leading tap of at most this counts as zero
_TAIL = 1e-15  # the taps end where at most this is left of the step response
_MOST_TAPS = 4000
_MOST_SAMPLES = 100_000  # of the local loop per frame; they are run one by one
_PIECES = 16  # of a frame, in which the mean position counts: 4e-3 of its motion is left out
_FRAME = frozen_copy([0.0, 1.0])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Response:
    """A system of one input and one output, which may have no state at all."""

    A: FloatArray  # (n, n)
    B: FloatArray  # (n,)
    C: FloatArray  # (n,)
    D: float

    def __post_init__(self) -> None:  # cached systems are shared, so they must not change
        set_fields(self, **{name: frozen_copy(getattr(self, name)) for name in "ABC"})

    @property
    def n_states(self) -> int:
        """Number of states."""
        return len(self.B)

    def repeated(self, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return A, B, C of as many equal systems, each state of all of them side by side."""
        parts = (self.A, self.B[:, None], self.C[None])
        if count == 1:
            return parts
        A, B, C = (np.asarray(np.kron(part, np.eye(count)), dtype=np.float64) for part in parts)
        return A, B, C

    def impulse(self, frames: int) -> FloatArray:
        """Impulse response over a number of frames."""
        out, state = np.zeros(frames), self.B
        out[0] = self.D
        for k in range(1, frames):
            out[k] = self.C @ state
            state = self.A @ state
        return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hold:
    """Where the mirror is while a command holds: for one frame, from its arrival on.

    The frame is cut into g pieces, in each of which the position counts by its mean.
    """

    start: float  # of the hold of u(k) after the begin of exposure k [frames]
    edges: FloatArray  # (g + 1,): ends of the pieces after the start, from 0 to 1 [frames]
    C: FloatArray  # (g, n): mean position in each piece, over the states of the core
    D: FloatArray  # (g,): over u(k)

    @property
    def weights(self) -> FloatArray:
        """Lengths of the pieces [frames], (g,)."""
        return np.diff(self.edges)

    def positions(
        self, influence: FloatArray, commands: tuple[FloatArray, FloatArray], first: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return C (..., g, n, s) and D (..., g, n, w) of the mean positions in a loop.

        The commands are its rows (..., m, s) and (..., m, w); the states of the core, one set a
        command, begin at the ``first`` of its states. The influence matrix is (n, m).
        """
        C, D = (np.einsum("g,im,...ms->...gis", self.D, influence, rows) for rows in commands)
        core = slice(first, first + self.C.shape[1] * influence.shape[1])
        moved = np.einsum("gs,im->gism", self.C, influence)
        C[..., core] += moved.reshape(*moved.shape[:2], -1)
        return C, D

    def phase_means(self, frequency: FloatArray) -> ComplexArray:
        """Return the mean of ``exp(2 pi i f t)`` over each piece, for t from exposure k, (f, g).

        The frequencies are in cycles per frame.
        """
        middle = self.start + (self.edges[1:] + self.edges[:-1]) / 2
        f = frequency[:, None]
        return np.asarray(np.exp(2j * np.pi * f * middle) * np.sinc(f * self.weights))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MirrorSystem:
    """The response of an exposure to the commands."""

    whole: Response  # from u(k) to the position averaged over exposure k
    # the same, ``lead`` frames earlier; has a feedthrough, and the first states of ``whole``
    core: Response
    hold: Hold  # where the mirror is within a frame
    lead: int  # frames in which a command does nothing
    taps: FloatArray  # (t,): impulse response of ``whole``, to rounding, with the sum 1


def mirror_system(
    loop: PositionLoop | None, frame_rate_hz: float, delay_frames: float
) -> MirrorSystem:
    """Mirror and delay at the frame rate; without a local loop the mirror settles at once."""
    if loop is None:
        return instant_mirror(delay_frames)
    return lifted_mirror(loop, frame_rate_hz, delay_frames)


@lru_cache(maxsize=64)
def instant_mirror(delay_frames: float) -> MirrorSystem:
    """System of a mirror that settles at once; its states are past commands, newest first."""
    lead = int(np.floor(delay_frames - 1))
    fraction = delay_frames - 1 - lead
    taps = np.zeros(lead + 1 + (fraction > 0))
    taps[lead] = 1 - fraction
    taps[lead + 1 :] = fraction
    core = tapped_mirror(taps[lead:])
    still = frozen_copy(np.zeros((1, core.n_states)))
    hold = Hold(start=delay_frames - 1, edges=_FRAME, C=still, D=frozen_copy(np.ones(1)))
    return MirrorSystem(
        whole=tapped_mirror(taps),
        core=core,
        hold=hold,
        lead=lead,
        taps=frozen_copy(taps),
    )


@lru_cache(maxsize=64)
def lifted_mirror(loop: PositionLoop, frame_rate_hz: float, delay_frames: float) -> MirrorSystem:
    """Exact system of a mirror in its local loop.

    The samples of the local loop are counted from the arrival of each command; the edges of
    an exposure may lie between them.
    """
    samples = samples_per_frame(loop, frame_rate_hz)
    lead = int(np.floor(delay_frames - 1))
    fraction = delay_frames - 1 - lead
    core, positions, edges = _one_frame(loop, samples, (1 - fraction) * samples)
    while abs(core.D) <= _NOTHING:  # the mirror has not moved yet: one more frame of delay
        core = replace(core, C=core.C @ core.A, D=float(core.C @ core.B))
        lead += 1
    scales = balancing_scales(core.A, np.abs(core.B), np.abs(core.C))
    units = scales[:-1] / scales[-1]  # powers of two, in which the system is balanced
    core = Response(A=core.A * units / units[:, None], B=core.B / units, C=core.C * units, D=core.D)
    hold = Hold(
        start=delay_frames - 1,
        edges=frozen_copy(edges),
        C=frozen_copy(positions[:, :-1] * units),
        D=frozen_copy(positions[:, -1]),
    )
    return MirrorSystem(
        whole=_delay(core, lead),
        core=core,
        hold=hold,
        lead=lead,
        taps=frozen_copy(np.concatenate([np.zeros(lead), _taps(core)])),
    )


def samples_per_frame(loop: PositionLoop, frame_rate_hz: float) -> int:
    """Count the samples of a local loop per frame, which must be a whole number."""
    ratio = loop.sampling_hz / frame_rate_hz
    if not ratio <= _MOST_SAMPLES:
        raise ProblemError(
            f"the local loop of the mirror must run at most {_MOST_SAMPLES} samples per frame; got "
            f"{ratio:.9g}. Lower sampling_hz, or raise the frame rate."
        )
    samples = round(ratio)
    if samples < 1 or abs(ratio - samples) > WHOLE * ratio:
        counts = [n for n in (int(ratio) + 1, int(ratio)) if n > 0]
        fitting = " and ".join(f"{loop.sampling_hz / n:.9g}" for n in counts)
        raise ProblemError(
            "the local loop of the mirror must run a whole number of samples per frame; got "
            f"{loop.sampling_hz:.9g} Hz over {frame_rate_hz:.9g} Hz = {ratio:.9g}. Frame rates "
            f"that fit are {fitting} Hz."
        )
    if loop.ramp_samples > samples:
        raise ProblemError(
            f"ramp_samples must be at most {samples}, the samples of a frame; got "
            f"{loop.ramp_samples}."
        )
    return samples


def _one_frame(
    loop: PositionLoop, samples: int, split: float
) -> tuple[Response, FloatArray, FloatArray]:
    """System of one frame after the arrival of a command, as two exposures see it.

    The first ``split`` samples belong to the exposure under way, the others to the next one. Return
    also the mean positions in pieces of the frame, over states and command (g, n + 1), and the ends
    of the pieces [frames], (g + 1,).
    """
    local = loop.closed_loop()
    n, ramped, late = local.n_states, loop.ramp_samples > 1, split < samples
    width = n + 2  # the local loop's states at the arrival, the command, the one before it
    state, ways = np.eye(n, width), np.zeros((samples, n + 1, width))
    for i in range(samples):
        ways[i, :n] = state
        ways[i, n, n] = min(1.0, (i + 1) / loop.ramp_samples)
        ways[i, n, n + 1] = 1 - ways[i, n, n]
        state = local.A @ state + local.B @ ways[i, n:]
    scale = 1 / (samples * loop.static_gain)
    first, total = scale * _integrals(loop, ways, np.array([split, samples]))
    size = n + int(late) + int(ramped)

    def over_states(rows: FloatArray) -> FloatArray:
        """Sort columns into the states of the frame, which are not the next part's, and command."""
        out = np.zeros((len(rows), size + 1))
        out[:, :n], out[:, -1] = rows[:, :n], rows[:, n]
        if ramped:
            out[:, size - 1] = rows[:, n + 1]
        return out

    A, B = np.zeros((size, size)), np.zeros(size)
    A[:n], B[:n] = (part := over_states(state))[:, :-1], part[:, -1]
    C, D = (part := over_states(first[None]))[0, :-1], part[0, -1]
    if late:  # the part of the last frame that this exposure sees is a state
        part = over_states((total - first)[None])
        A[n], B[n], C[n] = part[0, :-1], part[0, -1], 1.0
    if ramped:
        B[-1] = 1.0
    edges = np.linspace(
        0, samples, max(min(samples, _PIECES), -(-_PIECES // samples) * samples) + 1
    )
    means = np.diff(_integrals(loop, ways, edges), axis=0) / np.diff(edges)[:, None]
    return (
        Response(A=A, B=B, C=C, D=float(D)),
        over_states(means / loop.static_gain),
        edges / samples,
    )


def _integrals(loop: PositionLoop, ways: FloatArray, ends: FloatArray) -> FloatArray:
    """Integral of the position to times [samples], (t, width), by ways (samples, n + 1, width)."""
    per_sample = loop.position_integral(1.0) @ ways
    before = np.vstack([np.zeros(ways.shape[2]), np.cumsum(per_sample, axis=0)])
    started = np.minimum(ends.astype(np.int64), len(ways) - 1)
    parts = [
        loop.position_integral(end - i) @ ways[i] for i, end in zip(started, ends, strict=True)
    ]
    return np.asarray(before[started] + np.array(parts))


def _taps(core: Response) -> FloatArray:
    """Impulse response until the rest of the step response is rounding."""
    radius = float(np.max(np.abs(np.linalg.eigvals(core.A))))
    frames = 2 * core.n_states + 2 + int(np.ceil(np.log(1e-18) / np.log(max(radius, 1e-9))))
    if not radius < 1 or frames > _MOST_TAPS:
        raise ProblemError(
            f"the mirror must settle within {_MOST_TAPS} frames; got one that decays by a factor "
            f"of {radius:.9g} per frame. Raise the bandwidth or the damping of its local loop."
        )
    taps = core.impulse(frames)
    rest = np.cumsum(np.abs(taps[::-1]))[::-1]
    taps = taps[: max(int(np.sum(rest > _TAIL)), 1)]
    return np.asarray(taps / taps.sum())


def _delay(core: Response, lead: int) -> Response:
    """Delay the output of a core by ``lead`` frames."""
    if not lead:
        return core
    n, late = core.n_states, np.eye(lead)[0]
    return Response(
        A=np.block([[core.A, np.zeros((n, lead))], [np.outer(late, core.C), np.eye(lead, k=-1)]]),
        B=np.concatenate([core.B, core.D * late]),
        C=np.concatenate([np.zeros(n), np.eye(lead)[-1]]),
        D=0.0,
    )


def tapped_mirror(taps: FloatArray) -> Response:
    """System with an impulse response; its states are the past commands."""
    n = len(taps) - 1
    return Response(A=np.eye(n, k=-1), B=np.eye(n, 1)[:, 0], C=taps[1:], D=float(taps[0]))
