"""One sample of a study: its configuration, its real loop and its real disturbances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from lbt_synth.config import Config
from lbt_synth.config.load import build_config, validate_sections
from lbt_synth.config.schema import FileSection
from lbt_synth.errors import refuse_config
from lbt_synth.models import LoopHardware, Truth
from lbt_synth.studies.study.config_keys import set_number
from lbt_synth.studies.study.study import DELAY_ERROR, NOISE_FACTOR, Study
from lbt_synth.validation import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """One sample of a study."""

    config: Config  # what designs assume
    hardware: LoopHardware  # the real loop: that of ``config`` with the delay error
    truth: Truth  # what it really meets: that of ``config`` with the real noise
    delay_error_frames: float  # real delay less that of ``config`` [frames]
    noise_factor: float  # real noise over that of ``config``


def make_sample(study: Study, values: Sequence[float] | FloatArray) -> Sample:
    """Make the sample of a row of ``Study.values``."""
    base = study.config
    full = base.settings.model_dump()
    content = base.settings.model_dump(exclude_unset=True)
    for parameter, value in zip(study.parameters, values, strict=True):
        for keys in parameter.places:
            set_number(content, keys, float(value), full=full)
    config = build_config(validate_sections(FileSection, content, base.source), base.source)
    parameters = study.parameters_by_name(values)
    delay_error = parameters.get(DELAY_ERROR, 0.0)
    factor = parameters.get(NOISE_FACTOR, 1.0)
    hardware, truth = config.hardware, config.truth
    with refuse_config(f"the real loop, with {DELAY_ERROR} and {NOISE_FACTOR}"):
        if delay_error != 0:
            hardware = replace(hardware, delay_frames=hardware.delay_frames + delay_error)
        if factor != 1:
            truth = replace(truth, noise_nm=truth.noise_nm * factor)
    return Sample(
        config=config,
        hardware=hardware,
        truth=truth,
        delay_error_frames=delay_error,
        noise_factor=factor,
    )
