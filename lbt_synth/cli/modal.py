"""The command modal: integrators and filters of all modes of the mirror, under modal models."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from lbt_synth import models
from lbt_synth.cli.loop_inputs import load_shown
from lbt_synth.cli.output import RMS, Report
from lbt_synth.config import Config
from lbt_synth.design.modal import MixedController, modal_filters, modal_gains, modal_residuals
from lbt_synth.errors import ConfigError
from lbt_synth.models.turbulence.ar_models import noll_orders
from lbt_synth.report.figures import modal_figure
from lbt_synth.storage.display_unit import nm_text
from lbt_synth.storage.rows import Facts, fact, facts
from lbt_synth.validation import FloatArray, integer

_MIRROR_NOTE = (
    "mirror: its local loop on every mode; the Kalman filters know its real positions, but command "
    "their estimates as if it were there at once (lbt-synth mirror, design lqg: tip and tilt "
    "without this lag)."
)


def run(arguments: Namespace) -> Report:
    """Compare integrators, optimised gains and Kalman filters, mode by mode."""
    config = load_shown(arguments, all_modes=True)
    count = _mode_count(arguments.modes, config)
    atmosphere = config.require_atmosphere(
        "the turbulence of hundreds of modes is computed from it"
    )
    noise, assumed = _noise_nm(config, count)
    air = models.modal_turbulence(
        atmosphere, modes=count, frame_rate_hz=config.hardware.frame_rate_hz
    )
    uniform, gains, residuals = _design_controllers(config, air, noise)
    rows = _order_rows(air.rms_nm, noise, gains, *residuals.values())
    totals_nm = {name: _total_rms(rms) for name, rms in residuals.items()}
    report = Report(
        data={
            "modes": count,
            "uniform_gain": uniform,
            "residual_nm": totals_nm,
            "turbulence_nm": _total_rms(air.rms_nm),
        }
    )
    leaves = [f"{name} {nm_text(rms, '.1f')} rms" for name, rms in totals_nm.items()]
    turbulence = nm_text(_total_rms(air.rms_nm), ".1f")
    report.verdict.append(
        f"Of {turbulence} rms of turbulence in {count} modes, what is left is: {'; '.join(leaves)}."
    )
    report.add_rows(
        "rows",
        "By radial order, residuals over its modes",
        rows,
        figure=lambda: modal_figure(residuals, gains=gains, turbulence_nm=air.rms_nm),
    )
    report.notes += [
        "turbulence: AR1 models, von Karman variances, poles by radial order.",
        "vibrations: those of the model, on tip and tilt.",
        assumed,
        *([] if config.hardware.mirror is None else [_MIRROR_NOTE]),
        "the modes are those of Zernike, independent; nothing leaks from one to another.",
    ]
    return report


def _design_controllers(
    config: Config, air: models.ModalTurbulence, noise: FloatArray
) -> tuple[float, FloatArray, dict[str, FloatArray]]:
    """Return the best single gain, the best of each mode, and the residuals by controller [nm]."""
    hardware = config.hardware
    path: dict[str, Any] = {name: getattr(hardware, name) for name in ("delay_frames", "mirror")}
    path["sensor_gain"] = config.sensor_gain
    seen: dict[str, Any] = {"noise_nm": noise, "vibrations": _axis_vibrations(config, noise.size)}
    gains = modal_gains(air, frame_rate_hz=air.frame_rate_hz, **path, **seen)

    def integrator_rms(gain: float) -> FloatArray:
        control = MixedController(gains=np.full(noise.size, gain))
        return modal_residuals(
            control, air, hardware=hardware, sensor_gain=config.sensor_gain, **seen
        )

    best = minimize_scalar(
        lambda gain: _total_rms(integrator_rms(gain)),
        bounds=(1e-3 * gains.limit.min(), gains.limit.min()),
        method="bounded",
    )
    uniform = float(best.x)
    residuals = {
        f"integrators, gain {uniform:.2f}": integrator_rms(uniform),
        "integrators, optimised gains": gains.rms_nm,
        "Kalman filters": modal_filters(air, **path, **seen).rms_nm,
    }
    return uniform, gains.gains, residuals


def _mode_count(given: int | None, config: Config) -> int:
    count = config.settings.mirror.modes if given is None else given
    if count is None:
        raise ConfigError(
            f"{config.source}: the key mirror.modes is missing; give it, or --modes.",
            path="mirror.modes",
        )
    return integer(count, "modes", at_least=2)


def _noise_nm(config: Config, count: int) -> tuple[FloatArray, str]:
    """Return the noise of each mode [nm], and what it assumes in words."""
    settings = config.settings
    for path, value in (
        ("sensor.noise_nm", settings.sensor.noise_nm),
        ("model.sensor_gain", settings.model.sensor_gain),
    ):
        if isinstance(value, list):
            raise ConfigError(
                f"{config.source}: {path} must be one number for hundreds of modes; got one per "
                "axis.",
                path=path,
            )
    pyramid, one = settings.sensor.pyramid, float(config.noise_nm)
    if pyramid is None:
        return np.full(count, one), f"noise: {nm_text(one, '.6g')} on every mode (assumed)."
    modulation = pyramid.modulation_lambda_over_d
    noise = models.pyramid_modal_noise_nm(one, modes=count, modulation_lambda_over_d=modulation)
    return noise, (
        f"noise: {nm_text(one, '.6g')} on tip and tilt, less on modes of higher order, down to "
        f"{nm_text(noise[-1], '.6g')} (assumed, of a pyramid with a modulation of {modulation:g} "
        "lambda/D)."
    )


def _axis_vibrations(config: Config, count: int) -> dict[int, list[models.Vibration]]:
    """Return the vibrations of the model on tip and on tilt, each axis by itself."""
    vibrations: dict[int, list[models.Vibration]] = {}
    for line in config.plant.vibrations:
        for axis, part in enumerate(line.direction):
            size = abs(part) * line.rms_nm
            if axis < count and size > 1e-9 * line.rms_nm:
                own = replace(line, rms_nm=size, direction=(1.0,))
                vibrations.setdefault(axis, []).append(own)
    return vibrations


def _total_rms(rms: FloatArray) -> float:
    return float(np.sqrt(np.sum(rms**2)))


def _order_rows(
    turbulence: FloatArray, noise: FloatArray, gains: FloatArray, *residuals: FloatArray
) -> list[Facts]:
    """Return a row for each radial order: root sums of squares over its modes."""
    radial, _ = noll_orders(noise.size)
    rows = []
    for order in np.unique(radial):
        which = radial == order
        uniform, optimised, filtered = (_total_rms(rms[which]) for rms in residuals)
        rows.append(
            facts(
                radial_order=fact(int(order), "radial order"),
                modes=fact(int(which.sum()), "modes"),
                turbulence_nm=fact(_total_rms(turbulence[which]), "turbulence", **RMS),
                noise_nm=fact(float(noise[which][0]), "noise per mode", unit="nm", format=".2f"),
                gain=fact(float(gains[which].mean()), "mean gain", format=".3f"),
                uniform_nm=fact(uniform, "one gain", **RMS),
                optimised_nm=fact(optimised, "optimised gains", **RMS),
                kalman_nm=fact(filtered, "Kalman", **RMS),
            )
        )
    return rows
