"""Designs that a diagnosis compares: those of studies, and of a plant with bands for its lines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from lbt_synth.design import Design, model_integrator
from lbt_synth.errors import LbtSynthError
from lbt_synth.identification.fit.identified_model import IdentifiedModel
from lbt_synth.identification.prediction.comparison import INTEGRATOR
from lbt_synth.loop import close_loop
from lbt_synth.methods.registry import all_methods, reference_methods
from lbt_synth.methods.request import PlantInputs, design_request
from lbt_synth.models import TipTiltPlant


def candidate_designs(model: IdentifiedModel) -> dict[str, Callable[[], Design]]:
    """Return what builds each candidate for a model, by the name of its row."""
    plant = model.plant()
    inputs = PlantInputs(plant=plant)
    with_bands = [each for each in all_methods().values() if each.plant_section is not None]
    builders: dict[str, Callable[[], Design]] = {
        method.title: partial(design_request(method.name, {}).build, inputs)
        for method in (*reference_methods(estimators_only=True), *with_bands)
    }
    return builders | {INTEGRATOR: partial(model_integrator, plant)}


def stable_designs(
    builders: Mapping[str, Callable[[], Design]], plant: TipTiltPlant
) -> tuple[dict[str, Design], list[str]]:
    """Return the designs that can be built and hold a plant's loop, and why others are missing."""
    found, notes = {}, []
    for name, build in builders.items():
        try:
            design = build()
        except LbtSynthError as error:
            notes.append(f"no {name}: {error}")
            continue
        if close_loop(plant.hardware, design.controller).is_stable:
            found[name] = design
        else:
            notes.append(f"no {name}: its loop is not stable at the identified sensor gain")
    return found, notes
