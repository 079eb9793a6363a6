"""The schema of a configuration file, with units in its keys; unknown keys are refused."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeAlias, get_origin

from pydantic import (
    BaseModel,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    create_model,
    model_validator,
)

from lbt_synth.methods.method import Count, Damping, Fraction, NonNegative, Positive
from lbt_synth.methods.method import Section as MethodSection
from lbt_synth.methods.registry import all_methods

ONE, EACH = "one", "each"  # one value for all axes, or a list with one per axis


def _tag_one_or_each(value: Any) -> str:
    return EACH if isinstance(value, list) else ONE


PositiveOrEach = Annotated[
    Annotated[Positive, Tag(ONE)] | Annotated[list[Positive], Field(min_length=1), Tag(EACH)],
    Discriminator(_tag_one_or_each),
]


class Section(MethodSection):
    """A section of a configuration, whose builders declare which numbers may vary."""

    @property
    def per_sample(self) -> Self:
        """The same section, read by a builder that takes its numbers for each of many samples.

        Builders declare thus which numbers may be arrays; see ``config.samples``.
        """
        return self

    def require_one_value(self) -> None:
        """Declare that samples evaluated together must have the same numbers in this section."""


class TelescopeSection(Section):
    """The pupil."""

    diameter_m: Positive
    obstruction: Annotated[float, Field(ge=0, lt=1)] = 0.0


class AtmosphereSection(Section):
    """The turbulence; ``outer_scale_m: null`` is Kolmogorov."""

    seeing_arcsec: Positive
    outer_scale_m: Positive | None
    wind_speed_m_s: Positive
    seeing_wavelength_um: Positive = 0.5


class PyramidSection(Section):
    """Pyramid sensor, from which the noise is computed."""

    wavelength_um: Positive
    modulation_lambda_over_d: Positive
    subapertures_across: Count
    photons: Positive
    read_noise_electrons: NonNegative


class SensorSection(Section):
    """Measurement noise: given, or from a pyramid."""

    noise_nm: PositiveOrEach | None = None
    noise_mas: Positive | None = None
    pyramid: PyramidSection | None = None
    matrix: list[list[float]] | None = None

    @model_validator(mode="after")
    def _require_one_noise(self) -> SensorSection:
        given = [v is not None for v in (self.noise_nm, self.noise_mas, self.pyramid)]
        if sum(given) != 1:
            raise ValueError("expected exactly one of noise_nm, noise_mas, pyramid")
        return self


class LocalLoopSection(Section):
    """The mirror's local position loop: its gains, or the frequency and damping they make."""

    natural_frequency_hz: Positive
    damping: NonNegative
    bandwidth_hz: Positive | None = None
    bandwidth_damping: Positive | None = None
    proportional_per_s2: NonNegative | None = None
    derivative_per_s: NonNegative | None = None
    feed_forward: NonNegative = 1.0
    sampling_hz: Positive = 72_000.0
    delay_samples: Annotated[int, Field(ge=0)] = 1
    ramp_samples: Count = 1

    @model_validator(mode="after")
    def _require_one_kind_of_gains(self) -> LocalLoopSection:
        gains = (self.proportional_per_s2 is not None, self.derivative_per_s is not None)
        if gains[0] != gains[1] or gains[0] == (self.bandwidth_hz is not None):
            raise ValueError(
                "expected either bandwidth_hz (and bandwidth_damping), or both of "
                "proportional_per_s2 and derivative_per_s"
            )
        if self.bandwidth_damping is not None and self.bandwidth_hz is None:
            raise ValueError("bandwidth_damping goes with bandwidth_hz, and only with it")
        return self


class MirrorSection(Section):
    """Deformable mirror; ``modes`` counts the controlled ones, for modal designs and end to end."""

    modes: Count | None = None
    influence_matrix: list[list[float]] | None = None
    local_loop: LocalLoopSection | None = None


class LoopSection(Section):
    """Timing, and how many axes there are."""

    axes: Annotated[int, Field(ge=1, le=2)] | None = None
    frame_rate_hz: Positive
    delay_frames: Annotated[float, Field(ge=1, le=20)] = 2.0


class _LineSection(Section):
    # which of axis and direction_deg is needed depends on the number of axes
    axis: Literal["tip", "tilt", "both"] | None = None
    direction_deg: float | None = None
    frequency_hz: Positive
    rms_nm: Positive | None = None
    rms_mas: Positive | None = None

    @model_validator(mode="after")
    def _require_one_size_and_direction(self) -> _LineSection:
        if (self.rms_nm is None) == (self.rms_mas is None):
            raise ValueError("expected exactly one of rms_nm, rms_mas")
        if self.axis is not None and self.direction_deg is not None:
            raise ValueError("expected exactly one of axis, direction_deg")
        return self


class VibrationSection(_LineSection):
    """A vibration of the model; ``spread_hz`` makes several ``lines`` of it."""

    damping: Damping
    spread_hz: Positive | None = None
    lines: Annotated[int, Field(ge=1, le=64)] | None = None

    @model_validator(mode="after")
    def _require_spread_of_lines(self) -> VibrationSection:
        if self.lines is not None and self.spread_hz is None:
            raise ValueError("lines goes with spread_hz, and only with it")
        return self


class TrueVibrationSection(_LineSection):
    """A vibration of the truth: a sinusoid, a resonance with its damping, or one that drifts."""

    kind: Literal["sinusoid", "resonance", "drift"]
    damping: Damping | None = None
    end_hz: Positive | None = None
    duration_s: Positive | None = None

    @model_validator(mode="after")
    def _require_what_the_kind_needs(self) -> TrueVibrationSection:
        if self.kind != "drift" and (self.kind == "resonance") != (self.damping is not None):
            raise ValueError(
                "damping goes with kind: resonance, and only with it or with kind: drift"
            )
        for given in (self.end_hz, self.duration_s):
            if (self.kind == "drift") != (given is not None):
                raise ValueError("end_hz and duration_s go with kind: drift, and only with it")
        return self


class Ar1Section(Section):
    """AR1 turbulence, from the atmosphere."""

    kind: Literal["ar1"]


class Ar2Section(Section):
    """AR2 turbulence, fitted to the atmosphere's spectrum above the noise."""

    kind: Literal["ar2"]


class ArSection(Section):
    """Auto-regressive turbulence by its coefficients."""

    kind: Literal["ar"]
    coefficients: Annotated[list[float], Field(min_length=1)]
    driving_rms_nm: Positive


TurbulenceSection = Annotated[Ar1Section | Ar2Section | ArSection, Field(discriminator="kind")]


class ModelSection(Section):
    """What the design assumes; leave ``vibrations`` out for a plant without any."""

    turbulence: Annotated[
        Annotated[TurbulenceSection, Tag(ONE)]
        | Annotated[list[TurbulenceSection], Field(min_length=1), Tag(EACH)],
        Discriminator(_tag_one_or_each),
    ]
    vibrations: Annotated[list[VibrationSection], Field(min_length=1)] | None = None
    sensor_gain: PositiveOrEach = 1.0


class TruthSection(Section):
    """What the real loop meets; ``vibrations: model`` takes those of the model."""

    turbulence: Literal["frozen_flow", "model", "none"] | None = None
    vibrations: Annotated[
        Annotated[Literal["model"], Tag(ONE)] | Annotated[list[TrueVibrationSection], Tag(EACH)],
        Discriminator(_tag_one_or_each),
    ] = []
    sensor_gain: PositiveOrEach = 1.0


class ImagingSection(Section):
    """The camera."""

    wavelength_um: Positive = 2.2
    other_modes_strehl: Fraction = 1.0


def _design_section() -> type[Section]:
    """Return the defaults of the synthesis: options of the methods, and their own sections."""
    fields: dict[str, Any] = {}
    for method in all_methods().values():
        for name in sorted(method.configurable):
            option = method.options.model_fields[name]
            fields[name] = (option.annotation, option)
        if method.section is not None:
            fields[method.name] = (method.section | None, None)
    return create_model("DesignSection", __base__=Section, **fields)


if TYPE_CHECKING:
    DesignSection: TypeAlias = Any
else:
    DesignSection = _design_section()


class SimulationSection(Section):
    """Time-domain runs."""

    frames: Annotated[int, Field(ge=2)] = 8000
    cases: Count = 4
    seed: Annotated[int, Field(ge=0)] = 0
    settle_frames: Annotated[int, Field(ge=0)] = 2000


class RobustnessSection(Section):
    """The studies over a frequency error, a sensor gain and a delay error."""

    errors_hz: Annotated[list[float], Field(min_length=1)] = [x / 2 for x in range(-7, 8)]
    hold: Literal["driving", "rms"] = "driving"
    sensor_gains: Annotated[list[Positive], Field(min_length=1)] = [x / 40 for x in range(10, 53)]
    delay_errors_frames: Annotated[list[float], Field(min_length=1)] = [0.0]


class EndToEndSection(Section):
    """The end-to-end simulation; the other sections describe its system."""

    pixels: Annotated[int, Field(ge=8)] = 60
    frames: Annotated[int, Field(ge=2)] = 1600
    settle_frames: Annotated[int, Field(ge=200)] = 400
    gain: NonNegative = 0.5
    leak: Annotated[float, Field(ge=0, le=1)] = 0.97
    leak_from_mode: Annotated[int, Field(ge=2)] = 50
    actuators_across: Annotated[int, Field(ge=3)] = 31
    wind_direction_deg: float = 0.0
    calibration_nm: Positive = 20.0


class FileSection(Section):
    """A whole configuration file; an identified system knows no telescope and no atmosphere."""

    version: Annotated[int, Field(ge=1, le=1)]
    telescope: TelescopeSection | None = None
    atmosphere: AtmosphereSection | None = None
    sensor: SensorSection
    mirror: MirrorSection = MirrorSection()
    loop: LoopSection
    model: ModelSection
    truth: TruthSection = TruthSection()
    imaging: ImagingSection = ImagingSection()
    design: DesignSection = DesignSection()
    simulation: SimulationSection = SimulationSection()
    robustness: RobustnessSection = RobustnessSection()
    end_to_end: EndToEndSection = EndToEndSection()

    @property
    def usual_turbulence(self) -> str:
        """Turbulence of a truth that names none: frozen_flow if there is an atmosphere."""
        return "model" if self.atmosphere is None else "frozen_flow"

    @property
    def true_turbulence(self) -> str:
        """Turbulence that the real loop meets: frozen_flow, model or none."""
        return self.truth.turbulence or self.usual_turbulence


def describe_error(
    error: ValidationError, schema: type[BaseModel] = FileSection
) -> tuple[str, str]:
    """Return one sentence on the first mistake, and the path of its key."""
    details = error.errors()
    # an unknown key says more than the missing one that it was meant to be
    first = next((d for d in details if d["type"] == "extra_forbidden"), details[0])
    location = tuple(p for p in first["loc"] if p not in ("ar1", "ar2", "ar", ONE, EACH))
    key = _key_path(location)
    more = f" ({len(details) - 1} more after this one.)" if len(details) > 1 else ""
    if first["type"] == "extra_forbidden":
        known = _list_keys(schema, location[:-1])
        close = difflib.get_close_matches(str(location[-1]), known, n=1, cutoff=0.6)
        hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}."
        return f"unknown key {key}; {hint}{more}", key
    if first["type"] == "missing":
        return f"the key {key} is missing.{more}", key
    if first["type"] == "value_error":
        return f"{key}: {first['ctx']['error']}.{more}", key
    if first["type"] == "too_short" and key.endswith("vibrations"):
        return f"{key} is empty; leave the key out for a model without vibrations.{more}", key
    if first["type"] == "union_tag_invalid":
        expected, got = first["ctx"]["expected_tags"], first["ctx"]["tag"]
        return f"{key}.kind must be one of {expected}; got {got!r}.{more}", key
    if first["type"] == "model_type":
        return f"{key} must be a mapping of keys; got {first['input']!r}.{more}", key
    text = first["msg"][0].lower() + first["msg"][1:]
    return f"{key}: {text}; got {first['input']!r}.{more}", key


def _key_path(location: tuple[int | str, ...]) -> str:
    out = ""
    for part in location:
        out += f"[{part}]" if isinstance(part, int) else f".{part}" if out else str(part)
    return out


def _list_keys(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Return the keys that the schema knows at a location."""
    here: list[type[BaseModel]] = [model]
    chosen_name = False  # the next part is a name that the file chooses, a key of a mapping
    for part in location:
        if isinstance(part, int) or chosen_name:
            chosen_name = False
            continue
        fields = [
            field
            for section in here
            for name, field in section.model_fields.items()
            if part == (field.alias or name)
        ]
        chosen_name = any(get_origin(field.annotation) is dict for field in fields)
        here = [found for field in fields for found in _find_models(field.annotation)]
    return sorted(
        {field.alias or name for section in here for name, field in section.model_fields.items()}
    )


def _find_models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for arg in getattr(annotation, "__args__", ()) for m in _find_models(arg)]
