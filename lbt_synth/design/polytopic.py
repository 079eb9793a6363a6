"""The polytopic filter: one for all vibration frequencies of an interval."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag

from lbt_synth.design.certificate import (
    NORM_TOLERANCE,
    Certificate,
    Check,
    certify_error,
    certify_loop,
)
from lbt_synth.design.facts import PolytopicFacts, model_facts
from lbt_synth.design.result import UNCERTIFIED, EstimatorDesign, SolverReport, with_certificate
from lbt_synth.design.worst_case import bound_worst_error, error_size, search_worst_error
from lbt_synth.linear import Controller, EstimationProblem, StateSpace
from lbt_synth.linear.riccati.filtering import kalman_riccati
from lbt_synth.loop import youla_controller
from lbt_synth.models import TipTiltPlant, tip_tilt_plant
from lbt_synth.models.plant.frequency_interval import FrequencyInterval, error_system
from lbt_synth.models.plant.tip_tilt import with_vibrations
from lbt_synth.validation import ComplexArray, FloatArray, choice, set_fields

_NORMS = {  # how the bound of each is proved
    "hinf": "envelope of all plants, level sets",
    "h2": "branch and bound, Lyapunov equations",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PolytopicDesign(EstimatorDesign):
    """A filter with a bound on its error over an interval of vibration frequencies.

    ``gamma``, ``rms`` and the first checks of the certificate are those of the plant at the
    centre.

    Attributes
    ----------
    problem : TipTiltPlant
        The plant at the centre of the interval.
    predictor : Controller
        From the pseudo-open-loop measurement ybar(k) to the estimate of z(k+1).
    half_width_hz : float
        Half width of the interval of frequencies [Hz].
    norm : str
        "hinf" or "h2": what is bounded, the H-infinity norm or the standard deviation.
    bound_guaranteed : float
        The error is not above it anywhere on the interval.
    worst_achieved : float
        The worst error that a search over the interval found.
    worst_frequency_hz : float
        Frequency at which it was found [Hz].
    bound_programme : float
        The bound that the semidefinite programme gave; what the solver said, no evidence.
    """

    controller: Controller = field(init=False)
    problem: TipTiltPlant
    predictor: Controller
    half_width_hz: float
    norm: str
    bound_guaranteed: float
    worst_achieved: float
    worst_frequency_hz: float
    bound_programme: float

    def __post_init__(self) -> None:
        set_fields(self, controller=_controller(self.problem, self.predictor))

    @property
    def interval(self) -> FrequencyInterval:
        """The plants of the interval."""
        return FrequencyInterval(plant=self.problem, half_width_hz=self.half_width_hz)

    def facts(self) -> PolytopicFacts:
        """Return what the filter guarantees over its interval, beside the worst that was found."""
        ratio = self.bound_guaranteed / self.worst_achieved
        return model_facts(PolytopicFacts, self, self.interval, guaranteed_over_found=ratio)

    @property
    def poles(self) -> ComplexArray:
        """Poles of the filter, (n,)."""
        return np.linalg.eigvals(self.predictor.A).astype(np.complex128)

    def error_system(self, problem: EstimationProblem | None = None) -> StateSpace:
        """System from w to the estimation error.

        Parameters
        ----------
        problem : EstimationProblem, optional
            Problem with other disturbances, or another plant; that at the centre by default.

        Returns
        -------
        StateSpace
            With the states of the plant and of the filter.
        """
        return error_system(problem or self.problem, self.predictor)

    def recertify(self) -> Certificate:
        """Compute the certificate again from the matrices."""
        interval, norm, predictor = self.interval, self.norm, self.predictor
        stability = "spectral radius of plant and filter"
        certificate = certify_error(self.error_system(), stability=stability)
        if not certificate.passed:
            return certificate
        bound, worst, limit = self.bound_guaranteed, self.worst_achieved, NORM_TOLERANCE
        found, _ = search_worst_error(interval, predictor, norm)
        a1 = interval.coefficient(self.worst_frequency_hz)
        there = error_size(interval.error_system(a1, predictor), norm)
        beyond = abs(self.worst_frequency_hz - self.problem.vibrations[0].frequency_hz)
        beyond, high_hz = beyond - interval.half_width_hz, interval.high_hz
        again = bound_worst_error(interval, predictor, norm)
        search, one = "grid of frequencies, refined", "relative, one error system"
        change, above = abs(there / worst - 1), again / bound - 1
        rows = (
            ("bound recomputed over the one stated, less 1", above, limit, _NORMS[norm]),
            ("worst error found over the bound, less 1", found / bound - 1, limit, search),
            ("worst error found over the one stated, less 1", found / worst - 1, limit, search),
            ("worst error stated, against that at its frequency", change, limit, one),
            ("distance of that frequency beyond the interval", beyond, 1e-9 * high_hz, "Hz"),
        )
        loop = certify_loop(self.problem.hardware, self.controller)
        checks = (*(Check(*row) for row in rows), loop)
        return replace(certificate, checks=(*certificate.checks, *checks))


def polytopic(
    plant: TipTiltPlant, *, half_width_hz: float, norm: str = "hinf", horizon: int = 1
) -> PolytopicDesign:
    """Design one filter for all vibration frequencies of an interval.

    The filter has the order of the plant. Its bound over the whole interval is made least by
    linear matrix inequalities with Lyapunov matrices that follow the frequency, and then
    proved again, without a solver. The frequency is unknown and constant; the decay rate
    (damping times frequency) and the driving noise are those of the plant.

    Parameters
    ----------
    plant : TipTiltPlant
        The plant at the centre. Its vibrations share frequency and damping.
    half_width_hz : float
        Half width of the interval [Hz]; 0 for the plant alone.
    norm : {"hinf", "h2"}, optional
        What is made least over the interval: the H-infinity norm of the error, or its
        standard deviation.
    horizon : int, optional
        Frames from the newest measurement to the estimate, as ``plant.ahead``.

    Returns
    -------
    PolytopicDesign
        Certified design.

    Raises
    ------
    ProblemError
        If the plant has no vibration or several frequencies, or a value is out of its range.
    NumericalError
        If the solver fails.
    CertificateError
        If the design does not pass its checks.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> slow = lbt.models.ARModel(coefficients=[0.9886], driving_rms_nm=89.1, frame_rate_hz=800)
    >>> line = lbt.Vibration(frequency_hz=20, damping=0.01, rms_nm=563.6, direction=(1,))
    >>> plant = lbt.tip_tilt_plant(
    ...     frame_rate_hz=800, turbulence=slow, vibrations=[line], noise_nm=15.5, modes=1
    ... )
    >>> design = lbt.design.polytopic(plant, half_width_hz=0.5)
    >>> design.worst_achieved <= design.bound_guaranteed <= 1.001 * design.worst_achieved
    True
    """
    choice(norm, "norm", tuple(_NORMS))
    interval = FrequencyInterval(plant=plant, half_width_hz=half_width_hz)
    interval = replace(interval, plant=plant.ahead(horizon))
    predictor, bound, solver = _synthesise(interval, norm)
    stable = bool(np.max(np.abs(np.linalg.eigvals(predictor.A))) < 1)
    found, where = search_worst_error(interval, predictor, norm) if stable else (np.inf, np.nan)
    design = PolytopicDesign(
        method=f"polytopic-{norm}",
        certificate=UNCERTIFIED,
        solver=solver,
        problem=interval.plant,
        predictor=predictor,
        half_width_hz=interval.half_width_hz,
        norm=norm,
        bound_guaranteed=bound_worst_error(interval, predictor, norm) if stable else np.inf,
        worst_achieved=found,
        worst_frequency_hz=where,
        bound_programme=bound,
    )
    return with_certificate(design, "Try a narrower interval.")


def _controller(plant: TipTiltPlant, predictor: Controller) -> Controller:
    """Return the controller that commands the estimate of a predictor."""
    to_command = plant.hardware.projector @ predictor.C
    D = np.zeros((len(to_command), predictor.B.shape[1]))
    return youla_controller(plant.hardware, replace(predictor, C=to_command, D=D))


def _synthesise(interval: FrequencyInterval, norm: str) -> tuple[Controller, float, SolverReport]:
    """Synthesise the filter of all axes; those that nothing couples are designed one by one."""
    from lbt_synth.linear.lmi.polytopic import SegmentFilter, segment_filter

    plant = interval.plant
    filters: list[SegmentFilter] = []
    distinct: list[tuple[TipTiltPlant, SegmentFilter]] = []
    for axis in _decoupled_axes(plant):
        same = [known for other, known in distinct if _equal_plants(axis, other)]
        if not same:
            ends = (axis.A, axis.A)
            if axis.vibrations:
                own = replace(interval, plant=axis)
                low, high = own.coefficients
                ends = (own.state_matrix(low), own.state_matrix(high))
            coordinates, scale = _expected_error(axis, interval.half_width_hz, norm)
            same = [segment_filter(axis, ends, norm=norm, coordinates=coordinates, scale=scale)]
            distinct.append((axis, same[0]))
        filters.append(same[0])
    bounds = np.array([each.bound for each in filters])
    A, B, C = (block_diag(*(getattr(each, name) for each in filters)) for name in "ABC")
    predictor = Controller(A=A, B=B, C=C, D=np.zeros((len(C), B.shape[1])), dt_s=plant.dt_s)
    status = next((each.status for each in filters if each.status != "optimal"), "optimal")
    rounds = sum(each.iterations for _, each in distinct)
    report = SolverReport(route="lmi", status=status, iterations=rounds)
    return predictor, float(np.max(bounds) if norm == "hinf" else np.linalg.norm(bounds)), report


def _decoupled_axes(plant: TipTiltPlant) -> list[TipTiltPlant]:
    """Plants of the single axes, or the plant itself where something couples them."""
    hw, n = plant.hardware, plant.hardware.modes
    directions = np.array([line.direction for line in plant.vibrations])
    decoupled = (
        n > 1
        and hw.n_measurements == n
        and all(not np.any(m - np.diag(np.diag(m))) for m in (hw.sensor, plant.R))
        and bool(np.all(np.diag(hw.sensor) != 0))
        and bool(np.all(np.count_nonzero(directions, axis=1) == 1))
    )
    if not decoupled:
        return [plant]
    lines = [[x for x in plant.vibrations if x.direction[i] != 0] for i in range(n)]
    return [
        tip_tilt_plant(
            frame_rate_hz=hw.frame_rate_hz,
            turbulence=plant.turbulence[i],
            vibrations=[replace(line, direction=(1.0,)) for line in lines[i]] or None,
            noise_nm=plant.R[i : i + 1, i : i + 1],
            delay_frames=hw.delay_frames,
            sensor_matrix=hw.sensor[i : i + 1, i : i + 1],
            mirror=hw.mirror,
        )
        for i in range(n)
    ]


def _equal_plants(one: TipTiltPlant, other: TipTiltPlant) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in "ABCDL")


def _expected_error(
    plant: TipTiltPlant, half_width_hz: float, norm: str
) -> tuple[FloatArray, float]:
    """Covariance and size of the Kalman error for a line as wide as the interval: a guess."""
    if plant.vibrations:
        wide = [(line, half_width_hz / (2 * line.frequency_hz)) for line in plant.vibrations]
        lines = [replace(line, damping=max(line.damping, width)) for line, width in wide]
        plant = with_vibrations(plant, lines)
    solution = kalman_riccati(plant)
    return solution.P, error_size(plant.error_system(solution.gain_predictor), norm)
