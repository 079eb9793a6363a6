"""The schema of a configuration file, with units in its keys; unknown keys are refused."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from pydantic import Discriminator, Field, Tag, ValidationError, create_model

from lbt_synth.methods import quantities as q
from lbt_synth.methods.method import Section, exactly_one, rule
from lbt_synth.methods.registry import METHODS
from lbt_synth.models.loop_hardware import LONGEST_DELAY
from lbt_synth.models.vibration import MOST_SECTIONS

_Row: TypeAlias = Annotated[list[q.Entry], Field(min_length=1)]
Matrix: TypeAlias = Annotated[list[_Row], Field(min_length=1)]
_TAGS = (q.ONE, q.EACH)  # in the places of mistakes
_TWO_DIRECTIONS = "expected at most one of axis, direction_deg"
_SECTIONS = "how many equal resonances in series it is: a bump of steep flanks has 2 to 4"


def goes_with(name: str, other: str) -> Any:
    """Return the rule that a key makes sense beside another one alone."""
    text = f"{other} goes with {name}, and only with it"
    return rule(lambda s: text * (getattr(s, name) is None and getattr(s, other) is not None))


def by_kind(**keys: tuple[str, ...]) -> Any:
    """Return the rule which keys each kind has; those that end in a question mark may be absent."""
    kinds: dict[str, list[str]] = {}
    for kind, names in keys.items():
        for name in names:
            kinds.setdefault(name.rstrip("?"), []).append(kind)

    def mistake(section: Any) -> str:
        for name, having in kinds.items():
            is_set = getattr(section, name) is not None
            if is_set and section.kind not in having:
                return f"{name} goes with kind: {' or '.join(having)}, and only with it"
            if not is_set and name in keys[section.kind]:
                return f"{name} is missing, which goes with kind: {section.kind}"
        return ""

    return rule(mistake)


def key(text: str, default: Any = ..., **limits: Any) -> Any:
    """Return a key: what it is, with its unit; its default; limits, for a type without any."""
    return Field(default, description=text, **limits)


class TelescopeSection(Section):
    """The pupil."""

    diameter_m: float = key("diameter of the pupil [m]", ge=1e-2, le=1e3)
    obstruction: float = key("central obstruction over the diameter", 0.0, ge=0, le=0.99)


class AtmosphereSection(Section):
    """The turbulence; ``outer_scale_m: null`` is Kolmogorov."""

    seeing_arcsec: q.Arcseconds = key("seeing [arcsec]")
    outer_scale_m: q.Metres | None = key("outer scale [m], null for Kolmogorov")
    wind_speed_m_s: q.MetresPerSecond = key("wind speed [m/s]")
    seeing_wavelength_um: q.Micrometres = key("wavelength of the seeing [um]", 0.5)


class PyramidSection(Section):
    """Pyramid sensor, from which the noise is computed."""

    wavelength_um: q.Micrometres = key("sensing wavelength [um]")
    modulation_lambda_over_d: q.Gain = key("modulation radius [lambda/D]")
    subapertures_across: int = key("subapertures over the diameter", ge=1, le=1000)
    photons: q.Ratio = key("photons per subaperture and frame")
    read_noise_electrons: q.RatioFromZero = key("read noise per pixel [electrons]")


class SensorSection(Section):
    """Measurement noise: given, or from a pyramid."""

    noise_nm: q.NanometresOrEach | None = key(
        "noise per frame [nm rms], or one per measurement", None
    )
    noise_mas: q.Milliarcseconds | None = key("noise per frame [mas]", None)
    pyramid: PyramidSection | None = key("a pyramid, whose noise is computed", None)
    matrix: Matrix | None = key("rows: measurements by modes (default: identity)", None)
    _rules = exactly_one("noise_nm", "noise_mas", "pyramid")


class MotionSection(Section):
    """How a channel of an accelerometer moves with a vibration, at its frequency."""

    motion_nm_per_nm: q.Ratio = key(
        "motion at the channel per motion of the wavefront [nm per nm rms]"
    )
    phase_deg: float = key("phase of it against the wavefront's [deg]", 0.0, ge=-360, le=360)


class OtherSensorSection(Section):
    """A sensor beside the loop's own: a wavefront sensor of another rate, or an accelerometer."""

    kind: Literal["wavefront", "accelerometer"] = key("wavefront or accelerometer", "wavefront")
    rate_hz: q.Hertz = key("readings per second, a fraction of the frame rate [Hz]")
    delay_frames: float = key("total delay, in periods of the sensor [frames]", ge=1, le=100)
    noise_nm: q.NanometresOrEach | None = key(
        "noise of a reading of a wavefront sensor [nm rms]", None
    )
    matrix: Matrix | None = key("rows: measurements by modes (default: identity)", None)
    channels: list[str] | None = key(
        "names of the channels of an accelerometer", None, min_length=1
    )
    noise_m_s2: q.AccelerationOrEach | None = key(
        "noise of a reading of an accelerometer [m/s^2]", None
    )
    highpass_hz: q.Hertz | None = key("corner of an accelerometer's high pass [Hz]", None)
    covariance: Matrix | None = key(
        "covariance of the noise, in place of its size [nm^2, (m/s^2)^2]", None
    )
    _rules = by_kind(
        wavefront=("noise_nm?", "matrix?", "covariance?"),
        accelerometer=("channels", "noise_m_s2?", "highpass_hz?", "covariance?"),
    )
    _one_noise = exactly_one("noise_nm", "noise_m_s2", "covariance")


class LocalLoopSection(Section):
    """The mirror's local position loop: its gains, or the frequency and damping they make."""

    natural_frequency_hz: q.Hertz = key("frequency of the mode itself [Hz]")
    damping: q.RatioFromZero = key("damping ratio of that mode")
    bandwidth_hz: q.Hertz | None = key("frequency with the loop [Hz]", None)
    bandwidth_damping: q.Ratio | None = key("damping with the loop, 0.7", None)
    proportional_per_s2: float | None = key("position gain [1/s^2]", None, ge=0, le=1e12)
    derivative_per_s: q.RatioFromZero | None = key("velocity gain [1/s]", None)
    feed_forward: q.RatioFromZero = key("feed-forward over holding force", 1.0)
    sampling_hz: q.Hertz = key("rate, whole multiple of the frame rate [Hz]", 72_000.0)
    delay_samples: q.Whole = key("computing delay of the local loop [samples]", 1)
    ramp_samples: q.Count = key("samples over which a command is ramped", 1)
    _one_position_gain = exactly_one("bandwidth_hz", "proportional_per_s2")
    _one_velocity_gain = exactly_one("bandwidth_hz", "derivative_per_s")
    _of_bandwidth = goes_with("bandwidth_hz", "bandwidth_damping")


class MirrorSection(Section):
    """Deformable mirror; ``modes`` counts the controlled ones, for modal designs and end to end."""

    modes: q.Count | None = key("number of controlled modes", None)
    influence_matrix: Matrix | None = key("rows: modes by commands (default: identity)", None)
    local_loop: LocalLoopSection | None = key("position loop (default: it settles at once)", None)


class LoopSection(Section):
    """Timing, and how many axes there are."""

    axes: int | None = key("number of axes (default 2)", None, ge=1, le=2)
    frame_rate_hz: float = key("frame rate [Hz]", ge=0.1, le=1e6)
    delay_frames: float = key("total delay [frames]", 2.0, ge=1, le=LONGEST_DELAY)


class _LineSection(Section):
    # which of axis and direction_deg is needed depends on the number of axes
    axis: Literal["tip", "tilt", "both"] | None = key("tip, tilt or both", None)
    direction_deg: q.Degrees | None = key("angle from tip to tilt [deg]", None)
    frequency_hz: q.Hertz = key("frequency [Hz], below half the frame rate")
    rms_nm: q.Nanometres | None = key("standard deviation [nm rms]", None)
    rms_mas: q.Milliarcseconds | None = key("standard deviation [mas]", None)
    frequency_error_hz: q.HertzFromZero | None = key(
        "how far the true frequency may be off [Hz]; 0 where it is known", None
    )
    accelerometers: dict[str, MotionSection] | None = key(
        "accelerometer channels that move with it", None
    )
    _one_size = exactly_one("rms_nm", "rms_mas")
    _one_direction = rule(
        lambda line: _TWO_DIRECTIONS * (None not in (line.axis, line.direction_deg))
    )


class VibrationSection(_LineSection):
    """A vibration of the model; ``spread_hz`` makes several ``lines`` of it."""

    damping: q.Damping = key("damping ratio; above 1 nothing oscillates")
    spread_hz: q.Hertz | None = key("half width of its interval [Hz]", None)
    lines: int | None = key("how many lines cover it (default 5)", None, ge=1, le=64)
    sections: int = key(_SECTIONS, 1, ge=1, le=MOST_SECTIONS)
    _of_spread = goes_with("spread_hz", "lines")


class TrueVibrationSection(_LineSection):
    """A vibration of the truth: a sinusoid, a resonance with its damping, or one that drifts."""

    kind: Literal["sinusoid", "resonance", "drift"] = key("sinusoid, resonance or drift")
    damping: q.Damping | None = key("damping ratio of a resonance", None)
    sections: int | None = key(_SECTIONS, None, ge=1, le=MOST_SECTIONS)
    end_hz: q.Hertz | None = key("frequency at the end of a drift [Hz]", None)
    duration_s: q.Seconds | None = key("duration of a drift [s]", None)
    _rules = by_kind(
        sinusoid=(), resonance=("damping", "sections?"), drift=("end_hz", "duration_s")
    )


class TurbulenceSection(Section):
    """Auto-regressive turbulence: from the atmosphere, or by its coefficients."""

    kind: Literal["ar1", "ar2", "ar"] = key(
        "first or second order from the atmosphere, or any by its coefficients"
    )
    coefficients: list[q.Entry] | None = key("of past values, newest first", None, min_length=1)
    driving_rms_nm: Annotated[float, Field(ge=1e-6, le=1e6)] | None = key(
        "rms of the driving noise [nm]", None
    )
    _rules = by_kind(ar1=(), ar2=(), ar=("coefficients", "driving_rms_nm"))


class ModelSection(Section):
    """What the design assumes; leave ``vibrations`` out for a plant without any."""

    turbulence: Annotated[
        Annotated[TurbulenceSection, Tag(q.ONE)]
        | Annotated[list[TurbulenceSection], Field(min_length=1), Tag(q.EACH)],
        Discriminator(q.tag_one_or_each),
    ] = key("model of the turbulence, or one per axis")
    vibrations: list[VibrationSection] | None = key(
        "the vibrations, if there are any", None, min_length=1
    )
    sensor_gain: q.GainOrEach = key(
        "sensor gain that the design assumes, or one per measurement", 1.0
    )


class TruthSection(Section):
    """What the real loop meets; ``vibrations: model`` takes those of the model."""

    turbulence: Literal["frozen_flow", "model", "none"] | None = key(
        "spectrum of the turbulence", None
    )
    vibrations: Annotated[
        Annotated[Literal["model"], Tag(q.ONE)]
        | Annotated[list[TrueVibrationSection], Tag(q.EACH)],
        Discriminator(q.tag_one_or_each),
    ] = key("the vibrations, or model: those of the model", [])
    sensor_gain: q.Gain = key("real sensor gain; the mean, where the model has several", 1.0)


class ImagingSection(Section):
    """The camera."""

    wavelength_um: q.Micrometres = key("wavelength of the Strehl ratio [um]", 2.2)
    other_modes_strehl: q.Fraction = key("Strehl ratio of all other modes", 1.0)


def _design_section() -> type[Section]:
    """Return the defaults of the synthesis: options of the methods, and their own sections."""
    fields: dict[str, Any] = {}
    for method in METHODS.values():
        for name in sorted(method.configurable):
            option = method.options.model_fields[name]
            fields[name] = (option.annotation, option)
        if method.section is not None:
            fields[method.name] = (method.section | None, Field(None, description=method.title))
    return create_model("DesignSection", __base__=Section, **fields)


if TYPE_CHECKING:
    DesignSection: TypeAlias = Any
else:
    DesignSection = _design_section()


class SimulationSection(Section):
    """Time-domain runs."""

    frames: int = key("frames recorded", 8000, ge=2, le=10**9)
    cases: q.Count = key("independent runs", 4)
    seed: int = key("seed of the random series", 0, ge=0, lt=2**128)
    settle_frames: q.Whole = key("frames before those recorded", 2000)


class RobustnessSection(Section):
    """The studies over a frequency error, a sensor gain and a delay error."""

    errors_hz: Annotated[list[q.Shift], Field(min_length=1)] | None = key(
        "true frequency minus the assumed one, of the vibration that moves most [Hz] "
        "(default: 15 steps over the stated errors, or over 17.5 % and at most 3.5 Hz)",
        None,
    )
    hold: Literal["driving", "rms"] = key(
        "what a shifted vibration keeps: its driving or its own rms", "driving"
    )
    sensor_gains: list[q.Gain] = key(
        "real sensor gains of maps", [x / 40 for x in range(10, 53)], min_length=1
    )
    delay_errors_frames: list[q.Shift] = key(
        "real delay minus the design's [frames]", [0.0], min_length=1
    )


class EndToEndSection(Section):
    """The end-to-end simulation; the other sections describe its system."""

    pixels: int = key("pixels across the pupil", 60, ge=8, le=10_000)
    frames: int = key("frames of the exposure", 1600, ge=2, le=10**9)
    settle_frames: int = key("frames before it", 400, ge=200, le=10**9)
    gain: q.RatioFromZero = key("integrator gain of every mode without a filter", 0.5)
    leak: float = key("leak of the integrators", 0.97, ge=0, le=1)
    leak_from_mode: int = key("first mode with a leak", 50, ge=2, le=10**9)
    actuators_across: int = key("actuators across the mirror", 31, ge=3, le=1000)
    wind_direction_deg: q.Degrees = key("direction of the wind [deg]; 0 is along tip", 0.0)
    calibration_nm: q.Nanometres = key("amplitude of the calibration [nm]", 20.0)


class FileSection(Section):
    """A whole configuration file; an identified system knows no telescope and no atmosphere."""

    version: int = key("version of the layout: 1", ge=1, le=1)
    units: Literal["nm", "um", "mas", "urad"] | None = key(
        "what commands show wavefronts in: nm (default), um, mas or urad", None
    )
    telescope: TelescopeSection | None = key("the pupil", None)
    atmosphere: AtmosphereSection | None = key("the turbulence", None)
    sensor: SensorSection = key("noise of the measurements")
    sensors: dict[str, OtherSensorSection] | None = key(
        "sensors beside the loop's own, by name", None, min_length=1
    )
    mirror: MirrorSection = key("the deformable mirror", MirrorSection())
    loop: LoopSection = key("timing, and the number of axes")
    model: ModelSection = key("what the design assumes")
    truth: TruthSection = key("what the loop meets", TruthSection())
    imaging: ImagingSection = key("the camera of the Strehl ratio", ImagingSection())
    design: DesignSection = key("defaults of the methods of synthesis", DesignSection())
    simulation: SimulationSection = key("time-domain runs", SimulationSection())
    robustness: RobustnessSection = key("errors that studies try", RobustnessSection())
    end_to_end: EndToEndSection = key("the end-to-end simulation", EndToEndSection())

    @property
    def true_turbulence(self) -> str:
        """Turbulence that the real loop meets: frozen_flow, model or none."""
        return self.truth.turbulence or ("frozen_flow" if self.atmosphere else "model")


def config_schema() -> dict[str, Any]:
    """Return the JSON schema of a configuration file, of draft 2020-12, for editors.

    Rules over several keys, such as one of ``rms_nm`` and ``rms_mas``, are not in it.
    """
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, **FileSection.model_json_schema(), "title": "lbt-synth"}


def describe_error(error: ValidationError) -> tuple[str, str]:
    """Return one sentence on the first mistake, and the path of its key."""
    details = error.errors()
    missing = [_key_path(d["loc"]) for d in details if d["type"] == "missing"]
    # an unknown key says more than the missing one that it was meant to be
    first = next((d for d in details if d["type"] == "unknown_key"), details[0])
    kind, key, got, mentioned = first["type"], _key_path(first["loc"]), first["input"], 1
    if kind == "unknown_key":
        key = _key_path((*first["loc"], first["ctx"]["word"]))
        text = f"unknown key {key}; {first['ctx']['advice']}"
    elif kind == "missing":
        mentioned = len(missing)
        one = mentioned == 1
        text = f"the key{'' if one else 's'} {', '.join(missing)} {'is' if one else 'are'} missing."
    elif kind == "value_error":
        text = f"{key}: {first['ctx']['error']}."
    elif kind == "too_short" and key.endswith("vibrations"):
        text = f"{key} is empty; leave the key out for a model without vibrations."
    elif kind == "model_type":
        text = f"{key} must be a mapping of keys; got {got!r}."
    else:
        text = f"{key}: {first['msg'][0].lower()}{first['msg'][1:]}; got {got!r}."
    rest = len(details) - mentioned
    after = "this one" if mentioned == 1 else "these"
    return text + (f" ({rest} more after {after}.)" if rest else ""), key


def _key_path(location: Iterable[int | str]) -> str:
    """Return the path of a key, without the tags of what may stand there."""
    words = [f"[{p}]" if isinstance(p, int) else f".{p}" for p in location if p not in _TAGS]
    return "".join(words).removeprefix(".")
