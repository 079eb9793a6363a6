"""Methods of synthesis by name: their routes and options, and the design for a configuration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lbt_synth.config.load import Config
from lbt_synth.config.robust import design_robust
from lbt_synth.design import (
    Design,
    hinf,
    integrator,
    kalman,
    lqg,
    mixed,
    optimal_integrator,
    polytopic,
)

METHOD_ROUTES: Mapping[str, tuple[str, ...]] = {
    "kalman": ("riccati", "sdp"),
    "hinf": ("lmi", "riccati"),
    "mixed": (),
    "lqg": (),
    "polytopic": (),
    "integrator": (),
    "robust": (),
}
OPTION_METHODS: Mapping[str, tuple[str, ...]] = {  # the methods that take an option
    "gamma": ("hinf", "mixed"),
    "gamma_ratio": ("hinf", "mixed"),
    "rms": ("mixed",),
    "taps": ("mixed",),
    "norm": ("polytopic",),
    "half_width_hz": ("polytopic",),
    "gain": ("integrator",),
    "command_weight": ("lqg",),
}
METHODS_WITHOUT_HORIZON = ("integrator", "robust", "lqg")


@dataclass(frozen=True, slots=True, kw_only=True)
class DesignRequest:
    """A method of synthesis and its options; the configuration gives the others."""

    method: str  # a key of METHOD_ROUTES
    # keys: ``route``, ``horizon`` and those of OPTION_METHODS; no value is None
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """Method and options as people read them."""
        given = ", ".join(f"{name} {value}" for name, value in self.options.items())
        return f"{self.method} ({given})" if given else self.method


def design_by_method(config: Config, request: DesignRequest) -> Design:
    """Design a controller for a configuration.

    Examples
    --------
    >>> import lbt_synth as lbt
    >>> from lbt_synth.config.design_methods import DesignRequest, design_by_method
    >>> config = lbt.load_config("examples/lbt.yaml")
    >>> design_by_method(config, DesignRequest(method="integrator", options={"gain": 0.4})).gain
    0.4
    """
    method, options = request.method, request.options
    defaults, horizon = config.settings.design, options.get("horizon", 1)
    if method == "kalman":
        return kalman(config.plant, horizon=horizon, route=options.get("route", "riccati"))
    if method == "integrator":
        if "gain" in options:
            return integrator(config.hardware, gain=options["gain"])
        return optimal_integrator(config.hardware, config.truth)
    if method == "robust":
        return design_robust(config)
    if method == "lqg":
        weight = options.get("command_weight", defaults.command_weight)
        return lqg(config.plant, command_weight=weight)
    if method == "polytopic":
        return polytopic(
            config.plant,
            half_width_hz=options["half_width_hz"],
            norm=options.get("norm", "hinf"),
            horizon=horizon,
        )
    bounds = {name: options[name] for name in ("gamma", "gamma_ratio", "rms") if name in options}
    bounds = bounds or {"gamma_ratio": defaults.gamma_ratio}
    if method == "mixed":
        return mixed(config.plant, **bounds, taps=options.get("taps", 16), horizon=horizon)
    return hinf(config.plant, **bounds, horizon=horizon, route=options.get("route"))
